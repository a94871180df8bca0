"""A simulated sensor, a controller manager at 1 kHz, and an arm that gives way to the force that the sensor measures."""

import shlex

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = FindPackageShare("bota_ethercat_hardware")
CONTROLLERS = PathJoinSubstitution([PACKAGE, "config", "mock_arm_controllers.yaml"])
ARGUMENTS = (
    ("host", "localhost", "Of ethercat-server"),
    ("port", "12001", "Of ethercat-server"),
    ("server_command", "ethercat-server virtual", "Starts it; needs root. '' if it is running"),
    ("controllers", "joint_state_broadcaster force_torque_sensor_broadcaster admittance_controller", "To activate"),
)


def start(context):
    def value(name):
        return LaunchConfiguration(name).perform(context)

    urdf = PathJoinSubstitution([PACKAGE, "urdf", "mock_arm.urdf.xacro"])
    description = Command(["xacro ", urdf, f" host:={value('host')} port:={value('port')}"])
    server = shlex.split(value("server_command"))
    actions = []
    if server:
        actions.append(
            ExecuteProcess(
                cmd=[*server, value("port")],
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
    arguments = [DeclareLaunchArgument(name, default_value=d, description=text) for name, d, text in ARGUMENTS]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
