# SPDX-License-Identifier: Apache-2.0
"""What the sensor's filters do to a signal: the delay and the noise of each channel, and how it is known.

Force and torque: Bota publishes rate and -3 dB point (`filters`), no delay. With the FIR filter off the
point is 0.262 of the rate, that of a third-order sinc filter, which delays by 1.5 sample periods. With FIR
on it is 0.0394. Names of the settings and rates are those of the AD7730 and AD7731 converters, whose second
filter has 22 taps and linear phase: their settling time is 22 periods where that of the first filter is one
(AD7731, Table III). For the same filter in its IP3102, Beckhoff gives -3 dB at 0.0390 of the rate and 64.5
dB from 0.140 on. A Kaiser window of 22 taps with beta 8.8 behind a third-order sinc filter has -3 dB at
0.0390 and 65 dB from 0.140 on.

Accelerometer and gyroscope: bandwidth and delay are Bota's tables, which are those of an MPU-9250.
"""

from __future__ import annotations

import cmath
import functools
import math
from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.sensor.filters import ACCELERATION_FILTERS, ANGULAR_RATE_FILTERS, ImuFilter
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SettingValue

SINC_ORDER: Final = 3
FIR_TAPS: Final = 22  # symmetrical
_KAISER_BETA: Final = 8.8
# Of a healthy sensor's force and torque: standard deviation at SINC 51, and the power with which it falls as
# the length grows: half of what Bota's own test allows at 51, and a little under half of it at 1024.
_NOISE_SINC: Final = 51
_NOISE: Final = (*((0.3, 0.62),) * 3, (0.007, 0.78), (0.007, 0.78), (0.0025, 0.78))
_GYROSCOPE_NOISE_DENSITY_DPS_RTHZ: Final = 0.01  # MPU-9250's data sheet; Bota gives the accelerometer's only
# Behind a third-order sinc filter neighboring samples of white noise are correlated as 66, 26 and 1: as if
# each had these shares of the one before, in turn.
_SINC_TAPS: Final = 0.4305753, 0.0430963
_UNKNOWN: Final = (0.0, 0.0, 0.0)
_IMU_FILTERS: Final = {"acceleration_filter": 1, "angular_rate_filter": 3}  # as sensors are delivered


class DelaySource(Enum):
    """How a delay is known."""

    PUBLISHED = "published by Bota"
    DERIVED = "derived from the cut-off frequency"
    FIR = "derived from the converter's data sheet, ± 0.5 periods"
    FAST = "unknown: FAST switches the FIR filter off on steps"
    CHOP = "unknown: CHOP"
    UNKNOWN = "unknown"


class Response(NamedTuple):
    """Of one channel."""

    delay_s: float | None  # group delay, the same at all frequencies that pass; None: unknown
    source: DelaySource

    @property
    def delay_ms(self) -> float | None:
        """Rounded, for display."""
        return None if self.delay_s is None else round(self.delay_s * 1e3, 2)

    def phase_deg(self, hz: float) -> float | None:
        """By how much a sine of this frequency comes late, degrees; None: unknown."""
        return None if self.delay_s is None else 360.0 * hz * self.delay_s

    def __str__(self) -> str:
        return self.source.value if self.delay_s is None else f"{self.delay_ms:g} ms ({self.source.value})"


def force_torque_response(settings: Mapping[str, SettingValue], rate_hz: float | None = None) -> Response:
    """Of force and torque, sampled at `rate_hz`, by default what `sinc_length` implies."""
    length = settings.get("sinc_length") or 0
    rate = rate_hz or (BASE_SAMPLING_RATE_HZ / length if length else 0.0)
    if not rate:
        return Response(None, DelaySource.UNKNOWN)
    chop, fir, fast = settings.get("chop"), settings.get("fir"), settings.get("fast")
    if chop or fir is None:
        return Response(None, DelaySource.CHOP if chop else DelaySource.UNKNOWN)
    if fir and fast:
        return Response(None, DelaySource.FAST)
    periods = SINC_ORDER / 2 + ((FIR_TAPS - 1) / 2 if fir else 0.0)
    return Response(periods / rate, DelaySource.FIR if fir else DelaySource.DERIVED)


def acceleration_response(settings: Mapping[str, SettingValue]) -> Response:
    """Of the accelerometer."""
    return _imu(ACCELERATION_FILTERS.get(settings.get("acceleration_filter", 0)))


def angular_rate_response(settings: Mapping[str, SettingValue]) -> Response:
    """Of the gyroscope."""
    return _imu(ANGULAR_RATE_FILTERS.get(settings.get("angular_rate_filter", 0)))


def force_lag_s(settings: Mapping[str, SettingValue], rate_hz: float | None = None) -> float | None:
    """By how much force and torque are later than the accelerometer; negative: earlier; None: unknown."""
    force_torque, imu = force_torque_response(settings, rate_hz), acceleration_response(settings)
    if force_torque.delay_s is None or imu.delay_s is None:
        return None
    return force_torque.delay_s - imu.delay_s


def delays_ms(settings: Mapping[str, SettingValue], rate_hz: float | None = None) -> dict[str, float | None]:
    """Of all channels, as `describe` gives them; None: unknown."""
    return {
        "force_torque": force_torque_response(settings, rate_hz).delay_ms,
        "acceleration": acceleration_response(settings).delay_ms,
        "angular_rate": angular_rate_response(settings).delay_ms,
    }


def _imu(row: ImuFilter | None) -> Response:
    if row is None:
        return Response(None, DelaySource.UNKNOWN)
    return Response(row.delay_ms * 1e-3, DelaySource.PUBLISHED)


def sinc_gain(share: float) -> float:
    """Magnitude of the sinc filter at this share of the sampling rate."""
    return 1.0 if share == 0 else abs(math.sin(math.pi * share) / (math.pi * share)) ** SINC_ORDER


def fir_gain(share: float) -> float:
    """Magnitude of the FIR filter at this share of the sampling rate."""
    return abs(sum(tap * cmath.exp(-2j * math.pi * share * number) for number, tap in enumerate(fir_taps())))


@functools.cache
def noise_bandwidth(fir: bool) -> float:
    """Bandwidth of force and torque for white noise, as a share of the sampling rate."""
    # Both filters together last 24 periods, so that for steps of less than 1/48 the sum is the integral.
    steps = 64
    gains = (sinc_gain(n / steps) * (fir_gain(n / steps) if fir else 1.0) for n in range(1, 4 * steps))
    return (0.5 + sum(gain * gain for gain in gains)) / steps


def healthy_noise(sinc_length: int, *, fir: bool = False) -> tuple[float, ...]:
    """Standard deviations of force (N) and torque (Nm): a longer filter makes them quieter."""
    passed = math.hypot(*fir_taps()) if fir else 1.0
    return tuple(passed * deviation * (sinc_length / _NOISE_SINC) ** -power for deviation, power in _NOISE)


def noise_taps(settings: Mapping[str, SettingValue]) -> tuple[float, ...]:
    """What makes noise like that of force and torque of white noise; the sum of their squares is 1."""
    taps = [*fir_taps()] if settings.get("fir") else [1.0]
    for share in _SINC_TAPS:
        taps = [tap + share * before for tap, before in zip([*taps, 0.0], [0.0, *taps], strict=True)]
    size = math.hypot(*taps)
    return tuple(tap / size for tap in taps)


def noise_ratios(settings: Mapping[str, SettingValue]) -> tuple[float, ...]:
    """By how much noisier force and torque are with these settings than at SINC 51 with FIR off."""
    length = int(settings.get("sinc_length") or _NOISE_SINC)
    found = healthy_noise(length, fir=bool(settings.get("fir")))
    return tuple(each / deviation for each, (deviation, _) in zip(found, _NOISE, strict=True))


def imu_noise(settings: Mapping[str, SettingValue]) -> tuple[float, float]:
    """Standard deviations of acceleration, m/s², and angular rate, rad/s, by known or usual filters."""
    known = {name: settings.get(name) or number for name, number in _IMU_FILTERS.items()}
    _, rate, acceleration = imu_variances(known)
    return math.sqrt(acceleration[0]), math.sqrt(rate[0])


def imu_variances(settings: Mapping[str, SettingValue]) -> tuple[Vector3, Vector3, Vector3]:
    """Typical variances (x, y, z) of orientation, rad², angular rate, (rad/s)², and acceleration, (m/s²)².

    White noise of these densities over the bandwidth of the filters in force; zeros: they are not known. An
    orientation is as noisy as gravity's direction, and its heading is anywhere in a turn.
    """
    accelerometer = ACCELERATION_FILTERS.get(settings.get("acceleration_filter", 0))
    gyroscope = ANGULAR_RATE_FILTERS.get(settings.get("angular_rate_filter", 0))
    if accelerometer is None or gyroscope is None:
        return _UNKNOWN, _UNKNOWN, _UNKNOWN
    tilt = ((accelerometer.noise_density_ug_rthz or 0) * 1e-6) ** 2 * accelerometer.bandwidth_hz
    rate = math.radians(_GYROSCOPE_NOISE_DENSITY_DPS_RTHZ) ** 2 * gyroscope.bandwidth_hz
    acceleration = tilt * STANDARD_GRAVITY**2
    return (tilt, tilt, math.pi**2 / 3), (rate, rate, rate), (acceleration, acceleration, acceleration)


@functools.cache
def fir_taps() -> tuple[float, ...]:
    """The FIR filter's coefficients; their sum is 1."""
    window = [_kaiser(2 * k / (FIR_TAPS - 1) - 1) for k in range(FIR_TAPS)]
    return tuple(value / sum(window) for value in window)


def _kaiser(x: float) -> float:
    """The FIR filter's window, 1 in its middle, at x from -1 to 1; 0 beyond."""
    return _bessel(_KAISER_BETA * math.sqrt(1 - x * x)) / _bessel(_KAISER_BETA) if -1 <= x <= 1 else 0.0


def _bessel(x: float) -> float:
    """The modified Bessel function I0."""
    return sum((x / 2) ** (2 * k) / math.factorial(k) ** 2 for k in range(30))
