"""From a reading to process data: the effects of settings, and the packing.

Offsets are added; values beyond the range are clipped and set the saturation fields and warnings; the IMU
and the orientation estimate can be off; without the calibration matrix force and torque are raw counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from bota_ethercat.pdo import PdoLayout
from bota_ethercat.settings import SettingValue
from ethercat_server.virtual_sensor.measurement.disturbance import NO_SATURATION, Saturation
from ethercat_server.virtual_sensor.measurement.signals import Reading

COUNTS_PER_NEWTON: Final = 10_000.0
COUNTS_PER_NEWTON_METRE: Final = 500_000.0
"""Raw counts without the calibration matrix. A real sensor mixes its channels; this one only scales."""
_SCALES = (COUNTS_PER_NEWTON,) * 3 + (COUNTS_PER_NEWTON_METRE,) * 3
_LARGEST_REAL32 = 3.4e38

Triple = tuple[float, float, float]


def _limit(values: Triple, limit: float) -> tuple[Triple, int]:
    """`values` cut off at the range, and a bit for each axis that was."""
    x, y, z = values
    if -limit <= x <= limit and -limit <= y <= limit and -limit <= z <= limit:
        return values, 0
    bits = sum(1 << axis for axis, value in enumerate(values) if abs(value) > limit)
    return (
        max(-limit, min(limit, x)),
        max(-limit, min(limit, y)),
        max(-limit, min(limit, z)),
    ), bits


def _plus(values: Triple, offsets: tuple[float, ...]) -> Triple:
    return values[0] + offsets[0], values[1] + offsets[1], values[2] + offsets[2]


class Measurement:
    """The settings in force, ready to be applied to every sample."""

    def __init__(
        self,
        layout: PdoLayout,
        settings: Mapping[str, SettingValue],
        force_torque_offset: tuple[float, ...],
        acceleration_offset: tuple[float, ...],
        angular_rate_offset: tuple[float, ...],
        exact: bool,
    ) -> None:
        self._layout = layout
        self._exact = exact
        self._offset = force_torque_offset
        self._acceleration_offset = acceleration_offset
        self._angular_rate_offset = angular_rate_offset
        self._calibrated = bool(settings["calibration_matrix"])
        self._imu = settings["imu_active"] != 0
        self._orientation = bool(settings["orientation_estimation"])
        self._acceleration_range = float(settings["acceleration_range_g"])
        self._angular_rate_range = float(settings["angular_rate_range_dps"])

    def pack(self, reading: Reading, warnings: int, saturated: Saturation = NO_SATURATION) -> bytes:
        """Process data of one sample.

        `warnings` is ORed into the register, `saturated` into the saturation fields.
        """
        load: tuple[float, ...]
        load, acceleration, rate, temperature, quaternion = reading
        force_torque_bits, acceleration_bits, rate_bits = saturated
        if not self._exact:
            load = tuple(a + b for a, b in zip(load, self._offset, strict=True))
            if not self._calibrated:
                load = tuple(float(round(a * s)) for a, s in zip(load, _SCALES, strict=True))
            load = tuple(
                a if -_LARGEST_REAL32 < a < _LARGEST_REAL32 else math.copysign(math.inf, a) for a in load
            )
            if self._imu:
                acceleration, beyond = _limit(
                    _plus(acceleration, self._acceleration_offset), self._acceleration_range
                )
                acceleration_bits |= beyond
                rate, beyond = _limit(_plus(rate, self._angular_rate_offset), self._angular_rate_range)
                rate_bits |= beyond
            else:
                acceleration = rate = (0.0, 0.0, 0.0)
                acceleration_bits = rate_bits = 0
        if force_torque_bits or acceleration_bits or rate_bits:
            warnings |= Saturation(force_torque_bits, acceleration_bits, rate_bits).warnings
        tail: tuple[float, ...] = ()
        if self._layout.has_orientation:
            tail = quaternion if self._orientation else (0.0, 0.0, 0.0, 0.0)
        return self._layout.struct.pack(
            0, warnings, *load, force_torque_bits, *acceleration, acceleration_bits, *rate, rate_bits,
            temperature, *tail,
        )  # fmt: skip
