# SPDX-License-Identifier: Apache-2.0
"""The whole chain without hardware: `ethercat-server` with a virtual sensor, and the node.

Whichever of the two ends first, and Ctrl-C, ends both.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit

from launch import LaunchDescription

FOLDER = Path(__file__).parent


def generate_launch_description():
    # Both included files take server_port; all their other arguments are arguments here too.
    return LaunchDescription(
        [
            DeclareLaunchArgument("server_port", default_value="12001", description="TCP port of the server"),
            RegisterEventHandler(OnProcessExit(on_exit=[Shutdown(reason="one of the two has ended")])),
            # The node first: if launch cannot make sense of its arguments, no server is left behind.
            IncludeLaunchDescription(
                str(FOLDER / "bridge.launch.py"), launch_arguments=[("server_host", "localhost")]
            ),
            IncludeLaunchDescription(str(FOLDER / "virtual_server.launch.py")),
        ]
    )
