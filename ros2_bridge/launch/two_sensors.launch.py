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

# Namespace, in the order of the bus, and the model that stands there if the bus is virtual.
SENSORS = {"sensone": "BFT-SENS-ECAT-M8", "rokubi": "BFT-ROKS-ECAT-M8"}


# Those of bridge.launch.py, for two nodes; its others go for both as they are.
ARGUMENTS = {
    "namespace": ("", "Namespace of both nodes' own, such as a robot's"),
    "sensor": ("0", "The first sensor's position on the bus, from 0; the other is the next"),
    "array_topic": ("sensor_data", "Topic of the Float64MultiArray, in the node's namespace"),
    "frame_id": ("ft_sensor", "Frame of the wrench, after the sensor's name and _"),
    "imu_frame_id": ("ft_sensor_imu", "Frame of the IMU, likewise"),
    "sensor_options": ("", "Options of ethercat-virtual-sensor, such as '--pdo 77'; the models are given"),
    "server_port": ("12001", "TCP port of the server"),
    "virtual": ("false", "true starts a server with two virtual sensors"),
}


def value(name):
    return LaunchConfiguration(name)


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
                                "namespace": name,
                                "sensor": PythonExpression([value("sensor"), f" + {place}"]),
                                "frame_id": [f"{name}_", value("frame_id")],
                                "imu_frame_id": [f"{name}_", value("imu_frame_id")],
                            }.items(),
                        ),
                    ]
                )
                for place, name in enumerate(SENSORS)
            ),
            IncludeLaunchDescription(
                str(FOLDER / "virtual_server.launch.py"),
                condition=IfCondition(value("virtual")),
                launch_arguments=[
                    ("sensor_options", [f"--model {','.join(SENSORS.values())} ", value("sensor_options")])
                ],
            ),
        ]
    )
