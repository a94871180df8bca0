# SPDX-License-Identifier: Apache-2.0
"""The whole chain without hardware: `ethercat-server` with a virtual sensor, and the node.

Whichever of the two ends first, and Ctrl-C, ends both; if it failed, so has the launch.
"""

import runpy
from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, RegisterEventHandler
from launch.event_handlers import OnProcessExit

from launch import LaunchDescription

FOLDER = Path(__file__).parent
END = runpy.run_path(str(FOLDER / "virtual_server.launch.py"))["end"]


def generate_launch_description():
    # Both included files take server_port; all their other arguments are arguments here too.
    return LaunchDescription(
        [
            DeclareLaunchArgument("server_port", default_value="12001", description="TCP port of the server"),
            DeclareLaunchArgument("server_host", default_value="localhost", description="Host of the server"),
            RegisterEventHandler(OnProcessExit(on_exit=END)),
            # The node first: if launch cannot make sense of its arguments, no server is left behind.
            IncludeLaunchDescription(str(FOLDER / "bridge.launch.py")),
            IncludeLaunchDescription(str(FOLDER / "virtual_server.launch.py")),
        ]
    )
