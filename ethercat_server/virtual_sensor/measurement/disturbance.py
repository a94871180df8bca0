"""Faults of channels and sampling: noise, saturation, frozen values, skipped samples.

They act on the measured values, before the offsets are added.
"""

from __future__ import annotations

import random
from typing import Final, NamedTuple

from bota_ethercat.sensor.warnings_register import WarningFlag
from ethercat_server.virtual_sensor.measurement.signals import Reading

CHANNELS: Final[tuple[str, ...]] = tuple(
    f"{vector}.{axis}" for vector in ("force", "torque", "acceleration", "angular_rate") for axis in "xyz"
)
"""As the fields of the process data are named, in their order."""
MOST_SKIPPED: Final = 90.0
"""%"""
_SKIP_STEPS: Final = 1 << 32
_MIX: Final = 0x9E3779B97F4A7C15

_FORCE_TORQUE, _ACCELERATION, _ANGULAR_RATE = slice(0, 6), slice(6, 9), slice(9, 12)


class Saturation(NamedTuple):
    """The three saturation fields of the process data: a bit for each axis, bit 0 = x."""

    force_torque: int = 0
    acceleration: int = 0
    angular_rate: int = 0

    @property
    def warnings(self) -> int:
        """The bits that they set in the warnings register."""
        flags = (
            WarningFlag.FORCE_TORQUE_SATURATED,
            WarningFlag.ACCELERATION_SATURATED,
            WarningFlag.ANGULAR_RATE_SATURATED,
        )
        return sum(flag for field, flag in zip(self, flags, strict=True) if field)


NO_SATURATION: Final = Saturation()


class Disturbances:
    """Channel faults of one sensor; none at first. `seed` is that of the noise."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._gauss = random.Random(seed ^ _MIX).gauss
        self._noise: dict[int, float] = {}
        self._limits: dict[int, float] = {}
        self._frozen: dict[int, float | None] = {}
        self._skipped, self._skip_after = 0, 0

    def set_noise(self, channel: str, deviation: float) -> None:
        """Add Gaussian noise of this standard deviation, in the channel's unit; 0 ends it."""
        self._noise[CHANNELS.index(channel)] = deviation
        if not deviation:
            del self._noise[CHANNELS.index(channel)]

    def set_limit(self, channel: str, limit: float | None) -> None:
        """Saturate the channel at ± `limit`, in its unit; None ends it."""
        if limit is None:
            self._limits.pop(CHANNELS.index(channel), None)
        else:
            self._limits[CHANNELS.index(channel)] = limit

    def freeze(self, channel: str, on: bool) -> None:
        """Freeze the channel at its next value, or end that."""
        if on:
            self._frozen.setdefault(CHANNELS.index(channel), None)
        else:
            self._frozen.pop(CHANNELS.index(channel), None)

    def set_skip(self, percent: float, newest: int) -> None:
        """Skip this percentage of the samples after number `newest` at random; 0 ends it."""
        self._skipped, self._skip_after = round(percent / 100 * _SKIP_STEPS), newest

    def newest_given(self, number: int) -> int:
        """The newest sample up to `number` that is not skipped."""
        if self._skipped:
            while number > self._skip_after and self._is_skipped(number):
                number -= 1
        return number

    def _is_skipped(self, number: int) -> bool:
        # A hash of the number (splitmix64), so that repeated queries agree.
        word = (number + 1 + (self._seed << 20)) * _MIX & 0xFFFFFFFFFFFFFFFF
        word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 & 0xFFFFFFFFFFFFFFFF
        word = (word ^ word >> 27) * 0x94D049BB133111EB & 0xFFFFFFFFFFFFFFFF
        return (word ^ word >> 31) % _SKIP_STEPS < self._skipped

    def apply(self, reading: Reading) -> tuple[Reading, Saturation]:
        """The reading with every fault in it, and which axes are saturated."""
        if not (self._noise or self._limits or self._frozen):
            return reading, NO_SATURATION
        values = [*reading.force_torque, *reading.acceleration, *reading.angular_rate]
        for position, deviation in self._noise.items():
            values[position] += self._gauss(0.0, deviation)
        bits = 0
        for position, limit in self._limits.items():
            if abs(values[position]) > limit:
                values[position] = limit if values[position] > 0 else -limit
                bits |= 1 << position
        for position, kept in self._frozen.items():
            if kept is None:
                self._frozen[position] = values[position]
            else:
                values[position] = kept
        a, b, c, d, e, f = values[_FORCE_TORQUE]
        ax, ay, az = values[_ACCELERATION]
        rx, ry, rz = values[_ANGULAR_RATE]
        disturbed = reading._replace(
            force_torque=(a, b, c, d, e, f), acceleration=(ax, ay, az), angular_rate=(rx, ry, rz)
        )
        return disturbed, Saturation(bits & 0x3F, bits >> 6 & 0x7, bits >> 9 & 0x7)
