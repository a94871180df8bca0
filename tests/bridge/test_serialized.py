"""Messages that are serialised once: what comes out is what rclpy would have made of the same numbers."""

from __future__ import annotations

import random
import struct
from typing import Any

import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Float64MultiArray

from bridge.publishing.serialized import SerializedMessage, axes


@pytest.mark.parametrize("frame_id", ["", "a", "ft", "fts", "arm", "ft_sensor", "ü" * 37])
def test_every_length_of_text_before_the_numbers(frame_id: str) -> None:
    wanted = WrenchStamped()
    wanted.header.frame_id = frame_id
    made = WrenchStamped()
    made.header.frame_id = frame_id
    serialized = SerializedMessage(
        made, [axes(made.wrench.force), axes(made.wrench.torque)], made.header.stamp
    )
    assert serialized.message() == serialize_message(wanted)
    rng = random.Random(1)
    for _ in range(50):
        numbers = [rng.uniform(-1e3, 1e3) for _ in range(6)]
        stamp_ns = rng.randrange(2**31 * 10**9)
        wanted.header.stamp.sec, wanted.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        force, torque = wanted.wrench.force, wanted.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = numbers
        serialized.stamp(stamp_ns)
        serialized.fill(0, numbers[:3])
        serialized.fill(1, numbers[3:])
        assert serialized.message() == serialize_message(wanted)
        assert deserialize_message(serialized.message(), WrenchStamped) == wanted


def test_whole_numbers_are_numbers() -> None:
    """A message's own fields take 5 for 5e-324."""
    message = Temperature(variance=0.25)
    serialized = SerializedMessage(message, [[(message, "temperature")]], message.header.stamp)
    serialized.fill(0, (5,))
    found = deserialize_message(serialized.message(), Temperature)
    assert (found.temperature, found.variance) == (5.0, 0.25)


def test_a_number_that_cannot_be_found_is_refused() -> None:
    message = Imu()
    apart = [*axes(message.orientation, "xyzw"), *axes(message.angular_velocity)]  # a covariance between them
    with pytest.raises(ValueError, match="cannot be found"):
        SerializedMessage(message, [apart])


def test_too_few_numbers_are_an_error_not_an_old_number() -> None:
    message = Float64MultiArray(data=[0.0] * 12)
    positions: list[Any] = [(message.data, position) for position in range(12)]
    with pytest.raises(struct.error):
        SerializedMessage(message, [positions]).fill(0, [1.0] * 11)
