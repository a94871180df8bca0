# SPDX-License-Identifier: Apache-2.0
"""A SensONE and a Rokubi on one bus and one server: a node and a namespace for each.

`virtual:=true` starts the server too, with a virtual bus that has both.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import PushRosNamespace

from launch import LaunchDescription

FOLDER = Path(__file__).parent

# The models, in the order of the bus, if that is virtual.
MODELS = "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8"
NAMES = "first_name", "second_name"  # arguments

# Those of bridge.launch.py, for two nodes; its others go for both as they are.
ARGUMENTS = {
    "namespace": ("", "Namespace of both nodes' own, such as a robot's"),
    "first_name": ("sensone", "The first sensor's name: the namespace of its node, and before its frames"),
    "second_name": ("rokubi", "The second sensor's name, likewise"),
    "sensor": ("0", "The first sensor's position on the bus, from 0; the other is the next"),
    "array_topic": ("sensor_data", "Topic of the Float64MultiArray, in the node's namespace"),
    "frame_id": ("ft_sensor", "Frame of the wrench, after the sensor's name and _: arm/ft is arm/NAME_ft"),
    "imu_frame_id": ("ft_sensor_imu", "Frame of the IMU, likewise"),
    "sensor_options": ("", "Options of ethercat-virtual-sensor, such as '--pdo 77'; the models are given"),
    "server_port": ("12001", "TCP port of the server"),
    "virtual": ("false", "true starts a server with two virtual sensors"),
}


def value(name):
    return LaunchConfiguration(name)


def named(name, frame):
    """The frame of that argument, with the sensor's name before the last part of it."""
    return PythonExpression(["'%s%s", value(name), "_%s' % '", value(frame), "'.rpartition('/')"])


def generate_launch_description():
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            # The nodes first: if launch cannot make sense of their arguments, no server is left behind.
            # A group keeps to itself what the first node is given.
            *(
                GroupAction(
                    [
                        PushRosNamespace(value("namespace")),
                        IncludeLaunchDescription(
                            str(FOLDER / "bridge.launch.py"),
                            launch_arguments={
                                "namespace": value(name),
                                "sensor": PythonExpression([value("sensor"), f" + {place}"]),
                                "frame_id": named(name, "frame_id"),
                                "imu_frame_id": named(name, "imu_frame_id"),
                            }.items(),
                        ),
                    ]
                )
                for place, name in enumerate(NAMES)
            ),
            IncludeLaunchDescription(
                str(FOLDER / "virtual_server.launch.py"),
                condition=IfCondition(value("virtual")),
                launch_arguments=[("sensor_options", [f"--model {MODELS} ", value("sensor_options")])],
            ),
        ]
    )
