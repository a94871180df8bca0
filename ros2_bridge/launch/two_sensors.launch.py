# SPDX-License-Identifier: Apache-2.0
"""A SensONE and a Rokubi on one bus and one server: a node and a namespace for each.

`virtual:=true` starts the server too, with a virtual bus that has both.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

FOLDER = Path(__file__).parent

# Namespace, in the order of the bus, and the model that stands there if the bus is virtual.
SENSORS = {"sensone": "BFT-SENS-ECAT-M8", "rokubi": "BFT-ROKS-ECAT-M8"}


def generate_launch_description():
    # The other arguments of the included files, such as params_file, go for both nodes.
    return LaunchDescription(
        [
            DeclareLaunchArgument("server_port", default_value="12001", description="TCP port of the server"),
            DeclareLaunchArgument(
                "virtual", default_value="false", description="true starts a server with two virtual sensors"
            ),
            # The nodes first: if launch cannot make sense of their arguments, no server is left behind.
            *(
                IncludeLaunchDescription(
                    str(FOLDER / "bridge.launch.py"),
                    launch_arguments={
                        "namespace": namespace,
                        "sensor": str(position),
                        # Without the model, which is in the namespace.
                        "array_topic": "sensor_data",
                        "frame_id": f"{namespace}_ft_sensor",
                        "imu_frame_id": f"{namespace}_ft_sensor_imu",
                    }.items(),
                )
                for position, namespace in enumerate(SENSORS)
            ),
            IncludeLaunchDescription(
                str(FOLDER / "virtual_server.launch.py"),
                condition=IfCondition(LaunchConfiguration("virtual")),
                launch_arguments=[("sensor_options", f"--model {','.join(SENSORS.values())}")],
            ),
        ]
    )
