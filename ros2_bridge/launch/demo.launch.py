# SPDX-License-Identifier: Apache-2.0
"""The whole chain without hardware: `ethercat-server` with a virtual sensor, and the node.

Whichever of the two ends first, and Ctrl-C, ends both.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.launch_description_sources import load_python_launch_file_as_module
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

include = load_python_launch_file_as_module(str(Path(__file__).with_name("include.py")))


def generate_launch_description():
    # All other arguments of the two included files are arguments here too.
    port = LaunchConfiguration("server_port")
    return LaunchDescription(
        [
            DeclareLaunchArgument("server_port", default_value="12001", description="TCP port of the server"),
            RegisterEventHandler(OnProcessExit(on_exit=[Shutdown(reason="one of the two has ended")])),
            # The node first: if launch cannot make sense of its arguments, no server is left behind.
            include.File("bridge.launch.py", server_host="localhost", server_port=port),
            include.File("virtual_server.launch.py", server_port=port),
        ]
    )
