"""Starts the node with config/bridge.yaml, or with `params_file:=FILE`; `namespace:=NAME` is taken too."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    default = PathJoinSubstitution([FindPackageShare("bridge"), "config", "bridge.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=default, description="The node's parameters"),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
            Node(
                package="bridge",
                executable="client",
                name="bridge",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params_file")],
                output="screen",
            ),
        ]
    )
