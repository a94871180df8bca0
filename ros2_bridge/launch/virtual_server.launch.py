# SPDX-License-Identifier: Apache-2.0
"""Starts `ethercat-server` on a virtual bus, for launch files without hardware; its end ends the launch.

With exit code 1 if the server fails: launch has that for exceptions, and ends what runs all the same.
"""

import shlex
import shutil
import sys

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

ARGUMENTS = (
    ("server_port", "12001", "TCP port of the server"),
    ("sensor_options", "", "Options of ethercat-virtual-sensor, such as '--pdo 77'"),
    (
        "server_command",
        "ethercat-server",
        "The server, which needs root: 'sudo -n /path/to/ethercat-server', say",
    ),
)


def start_server(context):
    def value(name):
        return LaunchConfiguration(name).perform(context)

    command = shlex.split(value("server_command"))
    if not command or shutil.which(command[0]) is None:
        # A process that says so, not an exception: that would leave behind what is being started already.
        missing = f"{value('server_command')!r} is no program: give server_command:=/path/to/ethercat-server"
        command = [sys.executable, "-c", "import sys; sys.exit(sys.argv[1])", missing]
    # "--virtual=..." in one word: what follows begins with dashes itself.
    sensors = [f"--virtual={value('sensor_options')}"] if value("sensor_options") else []
    return [
        ExecuteProcess(
            cmd=[*command, *sensors, "virtual", value("server_port")],
            name="ethercat-server",
            output="screen",
            on_exit=end,
        )
    ]


def end(event, context):
    """End the launch, for a process has ended."""
    text = f"{event.process_name} has ended"
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f"{text} with exit code {event.returncode}: see its message above")
    return Shutdown(reason=text)


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in ARGUMENTS
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_server)])
