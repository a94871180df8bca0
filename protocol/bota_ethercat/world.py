# SPDX-License-Identifier: Apache-2.0
"""What a virtual sensor feels, and the datagram with which a world outside tells it: docs/world.md."""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from bota_ethercat.pdo import STANDARD_GRAVITY

# All little-endian: 4 bytes of magic with the version, position of the sensor, 3 zero bytes, time, values.
DATAGRAM: Final = struct.Struct("<4sB3x d 6d 3d 3d d")
_MAGIC: Final = b"FTW1"
_MAX_VALUE: Final = 1e6  # of any value, in its unit


class Felt(NamedTuple):
    """What the sensor feels at one moment, in its own frame."""

    wrench: tuple[float, ...]  # (6,) force N, torque Nm
    acceleration: tuple[float, ...] = (0.0, 0.0, STANDARD_GRAVITY)  # (3,) specific force, m/s²; up at rest
    angular_rate: tuple[float, ...] = (0.0, 0.0, 0.0)  # (3,) rad/s
    temperature: float = 35.0  # °C
    attitude: tuple[float, float, float] | None = None
    """Yaw, pitch and roll about z, y', x'', rad; None: there is no estimate. Not in datagrams."""


REST: Final = Felt((0.0,) * 6)


def encode(time_s: float, felt: Felt, sensor: int = 0) -> bytes:
    """The datagram: what the sensor at this position feels at `time_s` of CLOCK_MONOTONIC."""
    return DATAGRAM.pack(
        _MAGIC, sensor, time_s, *felt.wrench, *felt.acceleration, *felt.angular_rate, felt.temperature
    )


def decode(data: bytes) -> tuple[int, float, Felt] | None:
    """Sensor, time (s) and content of a datagram; None if it is none, or has values that cannot be."""
    if len(data) != DATAGRAM.size:
        return None
    magic, sensor, *values = DATAGRAM.unpack(data)
    if magic != _MAGIC or not all(abs(value) < _MAX_VALUE for value in values[1:]):
        return None
    time_s, *wrench = values[:7]
    return sensor, time_s, Felt(tuple(wrench), tuple(values[7:10]), tuple(values[10:13]), values[13])
