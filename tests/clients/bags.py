"""Bags of ROS 2 for tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES: Any = STORE.types
NONE = np.zeros(9)


def _header(stamp_ns: int) -> Any:
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), "")


def imu(stamp_ns: int, rate: Sequence[float] = (0.0, 0.0, 0.0)) -> Any:
    """sensor_msgs/Imu with this angular rate, rad/s."""
    vector, turned = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Quaternion"](0, 0, 0, 1)
    parts = turned, NONE, vector(*rate), NONE, vector(0, 0, 0), NONE
    return TYPES["sensor_msgs/msg/Imu"](_header(stamp_ns), *parts)


def joint_states(stamp_ns: int, **positions: float) -> Any:
    """sensor_msgs/JointState, rad."""
    values = np.array([*positions.values()])
    return TYPES["sensor_msgs/msg/JointState"](_header(stamp_ns), [*positions], values, NONE[:0], NONE[:0])


def write_bag(path: Path, topic: str, messages: Sequence[Any]) -> Path:
    """An MCAP file with these messages."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(topic, messages[0].__msgtype__, typestore=STORE)
        for number, each in enumerate(messages):
            writer.write(connection, number, STORE.serialize_cdr(each, each.__msgtype__))
    return next(path.glob("*.mcap"))
