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
BROADCASTERS = "joint_state_broadcaster force_torque_sensor_broadcaster"
ARGUMENTS = (
    ("host", "localhost", "Of ethercat-server"),
    ("port", "12001", "Of ethercat-server"),
    ("virtual", "true", "Start that server, with a simulated sensor; false: it is running"),
    ("server_command", "ethercat-server", "Which needs root: 'sudo -n /path/to/ethercat-server', say"),
    ("controllers", f"{BROADCASTERS} admittance_controller", "To activate"),
)


def start(context):
    """What the arguments ask for."""

    def value(name):
        return LaunchConfiguration(name).perform(context)

    urdf = PathJoinSubstitution([PACKAGE, "urdf", "mock_arm.urdf.xacro"])
    description = Command(["xacro ", urdf, f" host:={value('host')} port:={value('port')}"])
    actions = []
    if value("virtual").lower() == "true":
        actions.append(
            ExecuteProcess(
                cmd=[*shlex.split(value("server_command")), "virtual", value("port")],
                name="ethercat-server",
                output="screen",
                on_exit=Shutdown(reason="ethercat-server has ended"),
            )
        )
    return [
        *actions,
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[{"robot_description": ParameterValue(description, value_type=str)}],
        ),
        Node(
            package="controller_manager",
            executable="ros2_control_node",
            parameters=[CONTROLLERS],
            output="screen",
            on_exit=Shutdown(reason="the controller manager has ended"),
        ),
        Node(
            package="controller_manager",
            executable="spawner",
            arguments=[*value("controllers").split(), "--param-file", CONTROLLERS],
            output="screen",
        ),
    ]


def generate_launch_description():
    """See the top."""
    arguments = [
        DeclareLaunchArgument(name, default_value=d, description=text) for name, d, text in ARGUMENTS
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
