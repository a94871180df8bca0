"""The twelve measured channels: one table with name, unit, saturation bit and the noise of a healthy sensor.

Noise limits are Bota's own test limits (standard deviation), published for SINC 51 and SINC 1024. Between and
beyond them they are interpolated here; see `noise_limit`. For the IMU a single figure, 0.1, is published
without unit or filter; it is taken as m/s² and rad/s, in which Bota's own drivers publish.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

SHORT_SINC: Final = 51
LONG_SINC: Final = 1024
"""The two lengths for which limits are published."""
_IMU_LIMIT: Final = 0.1


class Group(NamedTuple):
    """Three channels of one kind; the name is that of the array in `clients.recording.columns.Columns`."""

    name: str
    title: str
    unit: str
    saturation: str
    """The array with its saturation bits."""
    first_bit: int

    @property
    def is_imu(self) -> bool:
        """Whether the IMU measures it."""
        return self.saturation != "force_torque_saturated"


GROUPS: Final[tuple[Group, ...]] = (
    Group("force", "Force", "N", "force_torque_saturated", 0),
    Group("torque", "Torque", "Nm", "force_torque_saturated", 3),
    Group("acceleration", "Acceleration", "m/s²", "acceleration_saturated", 0),
    Group("angular_rate", "Angular rate", "rad/s", "angular_rate_saturated", 0),
)
FORCE, TORQUE, ACCELERATION, ANGULAR_RATE = GROUPS


class Channel(NamedTuple):
    """One measured quantity."""

    group: Group
    axis: int
    """0, 1, 2 for x, y, z."""
    limit_short: float
    """Noise of a healthy sensor at SINC 51, standard deviation in the group's unit."""
    limit_long: float
    """The same at SINC 1024."""

    @property
    def title(self) -> str:
        """For people: Force z."""
        return f"{self.group.title} {'xyz'[self.axis]}"

    @property
    def bit(self) -> int:
        """Its bit in the saturation field of its group."""
        return 1 << (self.group.first_bit + self.axis)


_LIMITS: Final = (
    (FORCE, (0.6, 0.6, 0.6), (0.1, 0.1, 0.08)),
    (TORQUE, (0.014, 0.014, 0.005), (0.0015, 0.0015, 0.0007)),
    (ACCELERATION, (_IMU_LIMIT,) * 3, (_IMU_LIMIT,) * 3),
    (ANGULAR_RATE, (_IMU_LIMIT,) * 3, (_IMU_LIMIT,) * 3),
)
CHANNELS: Final[tuple[Channel, ...]] = tuple(
    Channel(group, axis, short[axis], long[axis]) for group, short, long in _LIMITS for axis in range(3)
)
"""In the order of `/sensone_sensor_data`: force, torque, acceleration, angular rate."""


def noise_limit(channel: Channel, sinc_length: int) -> float:
    """Noise (standard deviation) below which the channel is healthy at this SINC length.

    Interpolated along the straight line through the two published limits in a log-log plot, as noise falls
    with a power of the averaging length; beyond the two lengths the same line is followed.
    """
    if channel.group.is_imu:
        return channel.limit_short  # the SINC filter is not the IMU's
    power = math.log(channel.limit_long / channel.limit_short) / math.log(LONG_SINC / SHORT_SINC)
    return float(channel.limit_short * (sinc_length / SHORT_SINC) ** power)


def limit_origin(sinc_length: int) -> str:
    """Where the limits of force and torque for this length come from, a sentence."""
    if sinc_length in (SHORT_SINC, LONG_SINC):
        return f"Limits of force and torque: Bota's own test limits for SINC {sinc_length}."
    how = "interpolated between" if SHORT_SINC < sinc_length < LONG_SINC else "extrapolated from"
    return (
        f"Limits of force and torque for SINC {sinc_length} are {how} Bota's own test limits, which are "
        f"published for SINC {SHORT_SINC} and {LONG_SINC} only (a straight line in a log-log plot)."
    )
