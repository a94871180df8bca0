"""Messages that are packed without ROS: what comes out is what rclpy would have made of the same numbers."""

from __future__ import annotations

import random
import struct

import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Temperature

from bota_ethercat.cdr import StampedNumbers


@pytest.mark.parametrize("frame_id", ["", "a", "ft", "fts", "arm", "ft_sensor", "ü" * 37])
def test_every_length_of_text_before_the_numbers(frame_id: str) -> None:
    wanted = WrenchStamped()
    wanted.header.frame_id = frame_id
    packed = StampedNumbers(frame_id, 6)
    rng = random.Random(1)
    for _ in range(50):
        numbers = [rng.uniform(-1e3, 1e3) for _ in range(6)]
        stamp_ns = rng.randrange(2**31 * 10**9)
        wanted.header.stamp.sec, wanted.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        force, torque = wanted.wrench.force, wanted.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = numbers
        message = packed.pack(stamp_ns, *numbers)
        assert deserialize_message(message, WrenchStamped) == wanted
        assert len(message) == len(serialize_message(wanted))  # bytes of padding may be anything


def test_whole_numbers_are_numbers_and_too_few_are_an_error() -> None:
    packed = StampedNumbers("", 2)
    assert deserialize_message(packed.pack(0, 5, 1), Temperature) == Temperature(
        temperature=5.0, variance=1.0
    )
    with pytest.raises(struct.error):
        packed.pack(0, 5)
