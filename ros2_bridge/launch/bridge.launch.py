# SPDX-License-Identifier: Apache-2.0
"""Starts the node with its parameter file; what is given as an argument wins over the file.

`ros2 launch bota_ethercat_bridge bridge.launch.py --show-args` lists the arguments.
"""

import os
from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

CONFIG = Path(__file__).parents[1] / "config"
# Parameters of the node that are arguments here. Text must stay text, even if it looks like a number; what is
# wrong with a number is for the node to say.
TEXT, NUMBER = str, None
PARAMETERS = {
    "server_host": (TEXT, "Host that ethercat-server runs on"),
    "server_port": (NUMBER, "TCP port of ethercat-server"),
    "sensor": (NUMBER, "The sensor's position on the bus, from 0"),
    "frame_id": (TEXT, "Frame of the wrench"),
    "imu_frame_id": (TEXT, "Frame of the IMU"),
    "array_topic": (TEXT, "Topic of the Float64MultiArray; without a leading slash it is in the namespace"),
    "lifecycle": (NUMBER, "true: a managed node, which waits for its transitions"),
}
IN_FILE = " (empty: as in params_file)"
# Other drivers: the node's name and its names of our topics; config/compat_NAME.yaml has the parameters.
COMPATIBLE = {"bota": ("bota_ft_sensor", [("wrench_compensated", "~/wrench"), ("imu/data_raw", "~/imu")])}
# Of Fast DDS 2 (Jazzy), and 3.
PROFILES = {"FASTRTPS_DEFAULT_PROFILES_FILE": "fastdds.xml", "FASTDDS_DEFAULT_PROFILES_FILE": "fastdds3.xml"}
REAL_TIME = 40  # SCHED_FIFO, below the 50 of a controller manager
# Name, default, meaning, and what it may be if it is one of some.
ARGUMENTS = (
    ("params_file", str(CONFIG / "client.yaml"), "The node's parameters"),
    ("namespace", "", "Namespace of the node"),
    ("compat", "", "bota: names of node, topics, frames and tare as Bota's driver has them", "", *COMPATIBLE),
    *((name, "", description + IN_FILE) for name, (_, description) in PARAMETERS.items()),
    ("realtime", "false", f"true asks for SCHED_FIFO {REAL_TIME}, locked memory and our Fast DDS profile",
     "true", "false", "True", "False"),
    ("respawn", "false", "true starts the node again 2 s after it ends, for whatever reason"),
    ("log_level", "", "debug, info, warn, error or fatal (empty: info)"),
)  # fmt: skip


def start_node(context):
    def value(name):
        return LaunchConfiguration(name).perform(context)

    file = Path(value("params_file")).expanduser()
    if not file.is_file():
        # launch_ros would warn and start the node with its defaults.
        raise FileNotFoundError(f"params_file: there is no file {file.absolute()}")
    node, remappings, compatible = "bridge", [], []
    if compat := value("compat"):
        node, remappings = COMPATIBLE[compat]
        compatible = [CONFIG / f"compat_{compat}.yaml"]
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=value_type)
        for name, (value_type, _) in PARAMETERS.items()
        if value(name)
    }
    environment = {}
    if value("realtime").lower() == "true":
        given["rt_priority"] = REAL_TIME
        if not any(map(os.environ.get, PROFILES)):
            environment = {variable: str(CONFIG / file) for variable, file in PROFILES.items()}
    return [
        Node(
            package="bota_ethercat_bridge",
            executable="client",
            name=node,
            namespace=value("namespace"),
            parameters=[file, *compatible, *([given] if given else [])],
            remappings=remappings,
            additional_env=environment,
            ros_arguments=["--log-level", value("log_level")] if value("log_level") else [],
            respawn=LaunchConfiguration("respawn"),
            respawn_delay=2.0,
            output="screen",
        )
    ]


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description, choices=choices or None)
        for name, default, description, *choices in ARGUMENTS
    ]
    # A function, because whether an argument was given is known only when the launch runs.
    return LaunchDescription([*arguments, OpaqueFunction(function=start_node)])
