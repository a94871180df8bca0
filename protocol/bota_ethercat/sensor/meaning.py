# SPDX-License-Identifier: Apache-2.0
"""What settings mean in words and figures: sampling rate, cut-off frequency, delay.

Cut-off frequencies are those of `filters`; what it lacks is called not in the table. Delays are `response`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from bota_ethercat.sensor.filters import (
    ACCELERATION_FILTERS,
    ANGULAR_RATE_FILTERS,
    FORCE_TORQUE_FILTERS,
    ForceTorqueFilter,
    ImuFilter,
)
from bota_ethercat.sensor.response import Response, force_torque_response
from bota_ethercat.settings import SettingValue, rate_divisor, sampling_rate_hz, sinc_length_of

NOT_IN_TABLE: Final = "not in the table"

_ON_OFF: Final[Mapping[str, tuple[str, str]]] = {
    "calibration_matrix": ("force and torque in N and Nm", "force and torque as raw counts"),
    "temperature_compensation": ("corrected for temperature", "not corrected for temperature"),
    "coordinate_system": ("the configured coordinate system", "the sensor's own coordinate system"),
    "inertia_compensation": ("inertia and gravity compensated by the sensor", "as measured"),
    "orientation_estimation": ("the sensor estimates its orientation", "no orientation estimate"),
    "fir": ("FIR on: lower cut-off, more delay", "FIR off"),
    "fast": ("FAST on: switches FIR off on steps, latency varies", "FAST off"),
    "chop": ("CHOP on: less drift, unpredictable latency", "CHOP off"),
}
_IMU: Final = ("no IMU", "internal IMU", "external IMU", "both IMUs")
_OTHERS: Final[Mapping[str, Callable[[int], str]]] = {
    "imu_active": lambda value: _IMU[value] if 0 <= value < len(_IMU) else NOT_IN_TABLE,
    "acceleration_range_g": lambda value: f"±{value} g",
    "angular_rate_range_dps": lambda value: f"±{value} °/s",
    "acceleration_filter": lambda value: _or_not(ACCELERATION_FILTERS.get(value)),
    "angular_rate_filter": lambda value: _or_not(ANGULAR_RATE_FILTERS.get(value)),
}


def value_meaning(
    name: str, value: SettingValue, rate_hz: int | None = None, chop: SettingValue | None = False
) -> str:
    """The meaning of `value` for the setting `name`. KeyError if there is no such setting.

    For a SINC length that was read: `rate_hz` is the sampling rate that the sensor reports, if it is known,
    and `chop` whether CHOP is on. The rate decides.
    """
    if name in _ON_OFF:
        return _ON_OFF[name][0 if value else 1]
    return _sinc_meaning(value, rate_hz, chop) if name == "sinc_length" else _OTHERS[name](value)


def _sinc_meaning(length: int, rate_hz: int | None, chop: SettingValue | None) -> str:
    divisor = rate_divisor(length, rate_hz, chop) if rate_hz else 1
    if divisor is None:
        right = sinc_length_of(length, rate_hz, chop)
        row = None if chop else FORCE_TORQUE_FILTERS.get(right or 0)
        cutoff = NOT_IN_TABLE if row is None else _cutoff_text(row)
        return f"{rate_hz} Hz; cut-off {cutoff}: by the sampling rate, which this length does not match"
    if divisor > 1:
        nominal_hz = sampling_rate_hz(length)
        return f"{rate_hz} Hz (CHOP divides {nominal_hz} Hz by {divisor}); cut-off {NOT_IN_TABLE}"
    row = FORCE_TORQUE_FILTERS.get(length)
    if row is None:
        return f"{sampling_rate_hz(length)} Hz (51200 / length); cut-off {NOT_IN_TABLE}"
    return f"{row.rate_hz} Hz; cut-off {_cutoff_text(row)}"


def _cutoff_text(row: ForceTorqueFilter) -> str:
    return f"{row.cutoff_fir_off_hz:g} Hz with FIR off, {row.cutoff_fir_on_hz:g} Hz with FIR on"


class Meaning(NamedTuple):
    """What a set of settings means. None: not in the tables, or not among the settings."""

    rate_hz: int | None  # Sampling rate
    # Of force and torque. None with FAST on, which switches between the two cut-offs, and with CHOP on.
    cutoff_hz: float | None
    force_torque: Response
    acceleration: ImuFilter | None
    angular_rate: ImuFilter | None

    def lines(self) -> list[str]:
        """For people, one sentence each."""
        rate = NOT_IN_TABLE if self.rate_hz is None else f"{self.rate_hz} Hz"
        cutoff = NOT_IN_TABLE if self.cutoff_hz is None else f"{self.cutoff_hz:g} Hz"
        return [
            f"sampling rate {rate}",
            f"force and torque: cut-off {cutoff}, delay {self.force_torque}",
            f"acceleration: {_or_not(self.acceleration)}",
            f"angular rate: {_or_not(self.angular_rate)}",
        ]

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "rate_hz": self.rate_hz,
            "cutoff_hz": self.cutoff_hz,
            "delay_ms": self.force_torque.delay_ms,
            "delay_source": self.force_torque.source.value,
            "acceleration": self.acceleration._asdict() if self.acceleration else None,
            "angular_rate": self.angular_rate._asdict() if self.angular_rate else None,
        }


def meaning(settings: Mapping[str, SettingValue], rate_hz: int | None = None) -> Meaning:
    """What `settings` mean together; `rate_hz` is the rate that the sensor reports, if it is known."""
    length, row = settings.get("sinc_length"), None
    if length is not None:
        row = FORCE_TORQUE_FILTERS.get(length)
    fir = settings.get("fir")
    divided = length and rate_hz and rate_divisor(length, rate_hz, settings.get("chop")) != 1
    plain = not settings.get("fast") and not settings.get("chop")
    known = row is not None and fir is not None and plain and not divided
    return Meaning(
        rate_hz or (sampling_rate_hz(length) if length else None),
        row.cutoff_hz(bool(fir)) if row is not None and known else None,
        force_torque_response(settings, rate_hz),
        ACCELERATION_FILTERS.get(settings.get("acceleration_filter", 0)),
        ANGULAR_RATE_FILTERS.get(settings.get("angular_rate_filter", 0)),
    )


def _or_not(row: ImuFilter | None) -> str:
    return NOT_IN_TABLE if row is None else str(row)
