# SPDX-License-Identifier: Apache-2.0
# mypy: ignore-errors
"""A simulated sensor, a controller manager at 1 kHz, and an arm that gives way to the force measured."""

import shlex

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = FindPackageShare("bota_ethercat_hardware")
CONTROLLERS = PathJoinSubstitution([PACKAGE, "config", "mock_arm_controllers.yaml"])
BROADCASTERS = ["joint_state_broadcaster", "force_torque_sensor_broadcaster", "imu_sensor_broadcaster"]
ARGUMENTS = (
    ("host", "localhost", "Of ethercat-server"),
    ("port", "12001", "Of ethercat-server"),
    ("virtual", "true", "Start that server, with a simulated sensor; false: it is running"),
    ("server_command", "ethercat-server", "Which needs root: 'sudo -n /path/to/ethercat-server', say"),
)


def start(context):
    """What the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    urdf = PathJoinSubstitution([PACKAGE, "urdf", "mock_arm.urdf.xacro"])
    description = Command(["xacro ", urdf, f" host:={given['host']} port:={given['port']}"])
    robot = {"robot_description": ParameterValue(description, value_type=str)}
    server = [*shlex.split(given["server_command"]), "virtual", given["port"]]
    spawned = [*BROADCASTERS, "admittance_controller", "--param-file", CONTROLLERS]
    actions = [
        Node(package="robot_state_publisher", executable="robot_state_publisher", parameters=[robot]),
        Node(
            package="controller_manager", executable="ros2_control_node", parameters=[CONTROLLERS],
            output="screen", on_exit=Shutdown(reason="the controller manager has ended"),
        ),
        Node(package="controller_manager", executable="spawner", arguments=spawned, output="screen"),
    ]  # fmt: skip
    if given["virtual"].lower() == "true":
        ended = Shutdown(reason="ethercat-server has ended")
        actions.insert(0, ExecuteProcess(cmd=server, name="ethercat-server", output="screen", on_exit=ended))
    return actions


def generate_launch_description():
    """See the top."""
    declared = [DeclareLaunchArgument(name, default_value=d, description=text) for name, d, text in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
