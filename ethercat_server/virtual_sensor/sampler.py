"""The sensor's newest sample as process data at any time, with its measurement faults.

Samples follow the sensor's own clock. Only those that are read are computed.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Final

from bota_ethercat.pdo import layout_for
from bota_ethercat.sensor.warnings_register import WarningFlag
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ
from ethercat_server.virtual_sensor.dictionary import Dictionary
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.signals import (
    CHANNELS,
    FORMULAS,
    SCENES,
    Formula,
    PhysicalSample,
)
from ethercat_server.virtual_sensor.world import ExternalWorld, Measured

_PPM_SCALE = 10**12  # ppm in steps of one millionth


class SamplingClock:
    """The sensor's own clock: sample numbers and their instants, independent of the master.

    The instant of sample k is the anchor plus (k - k0) * T, with T = SINC / 51200 s / (1 + ppm * 1e-6).
    In whole nanoseconds, without accumulating rounding errors.
    """

    def __init__(self, now: int, sinc_length: int, ppm: float = 0.0) -> None:
        self._anchor, self._anchor_number = now, 0
        self._set(sinc_length, ppm)

    def _set(self, sinc_length: int, ppm: float) -> None:
        self.sinc_length, self.ppm = sinc_length, ppm
        # T in ns as a fraction.
        self._numerator = sinc_length * 10**9 * _PPM_SCALE
        self._denominator = BASE_SAMPLING_RATE_HZ * (_PPM_SCALE + round(ppm * 1e6))

    def number_at(self, now: int) -> int:
        elapsed = now - self._anchor
        if elapsed < 0:
            return self._anchor_number
        return self._anchor_number + ((elapsed + 1) * self._denominator - 1) // self._numerator

    def instant(self, number: int) -> int:
        return self._anchor + (number - self._anchor_number) * self._numerator // self._denominator

    def change(self, now: int, *, sinc_length: int | None = None, ppm: float | None = None) -> None:
        """Change the rate from the newest sample on, without skipping or repeating one."""
        newest = self.number_at(now)
        self._anchor, self._anchor_number = self.instant(newest), newest
        self._set(self.sinc_length if sinc_length is None else sinc_length, self.ppm if ppm is None else ppm)


# Channels that are saturated, as bits, and the warning of each of the three saturation fields.
_SATURATION: Final = (
    (0o0077, WarningFlag.FORCE_TORQUE_SATURATED),
    (0o0700, WarningFlag.ACCELERATION_SATURATED),
    (0o7000, WarningFlag.ANGULAR_RATE_SATURATED),
)
_SKIP_STEPS: Final = 1 << 32


# Raw counts without the calibration matrix, per N and per Nm. A real sensor mixes its channels; this one
# only scales.
_COUNTS: Final = (10_000.0,) * 3 + (500_000.0,) * 3
_STEPS: Final = 1 << 64 // len(CHANNELS)  # by chance, of 64 bits of it
# What the last bit of a converter is worth; of those of the IMU, which have 16 bits, in its narrowest ranges.
_LAST_BITS: Final = (*(1 / counts for counts in _COUNTS), *(2 / 2**15,) * 3, *(250 / 2**15,) * 3)
_LARGEST_REAL32 = 3.4e38


def _measured(
    values: Sequence[float], offsets: tuple[float, ...], limit: float
) -> tuple[tuple[float, ...], int]:
    """`values` plus offsets, cut off at the range, and a bit for each axis that was."""
    x, y, z = values[0] + offsets[0], values[1] + offsets[1], values[2] + offsets[2]
    if -limit <= x <= limit and -limit <= y <= limit and -limit <= z <= limit:
        return (x, y, z), 0
    bits = sum(1 << axis for axis, value in enumerate((x, y, z)) if abs(value) > limit)
    return (max(-limit, min(limit, x)), max(-limit, min(limit, y)), max(-limit, min(limit, z))), bits


_U64: Final = 2**64 - 1


def _scattered(number: int, seed: int) -> int:
    """64 random bits that are always the same for a number and a seed (splitmix64)."""
    word = (number + 1 + (seed << 20)) * 0x9E3779B97F4A7C15 & _U64
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 & _U64
    word = (word ^ word >> 27) * 0x94D049BB133111EB & _U64
    return word ^ word >> 31


class Sampler:
    """Computes samples from power-on to power-off, with the settings in the dictionary.

    `now` gives the time in ns; signals and a world outside have `stamp` of it. Faults of channels act on the
    measured values, before the offsets are added.
    """

    def __init__(
        self, options: SensorOptions, dictionary: Dictionary, now: Callable[[], int],
        stamp: Callable[[int], int] = int,
    ) -> None:  # fmt: skip
        self._dictionary = dictionary
        self._now, self._stamp = now, stamp
        self._layout = layout_for(options.pdo_size)
        self.clock = SamplingClock(now(), dictionary.sinc_in_effect, options.ppm)
        self.made = 0  # number of samples computed
        self.stuck = b""  # process data to be repeated until it is empty again: a fault
        # Faults of channels by position, in their units; call `changed` after changing them: standard
        # deviation of Gaussian noise, saturation at ± this, standing still at this (None: at the next value).
        self.noise: dict[int, float] = {}
        self.limits: dict[int, float] = {}
        self.frozen: dict[int, float | None] = {}
        self._gauss = random.Random(options.seed ^ 0x9E3779B97F4A7C15).gauss
        self._seed = options.seed
        self._warnings, self._warnings_until = 0, -1
        self._skipped, self._skip_after = 0, 0
        self._number, self._data = -1, b""
        self._prepared_number, self._prepared = -1, b""
        self.measure(options)

    def measure(self, options: SensorOptions) -> None:
        """Measure the signal in `options`, which begins with the next sample."""
        world = options.world or SCENES.get(options.signal)
        self._external = world if isinstance(world, ExternalWorld) else None
        begin = self.clock.instant(self._number + 1)
        self._signal_start = self._stamp(begin) if self._external is None else 0
        self._signal: Measured | Formula = (
            FORMULAS[options.signal] if world is None else Measured(world, options.seed, options.noise)
        )
        is_noisy = FORMULAS[options.signal].is_exact if world is None else options.noise
        self._has_last_bit = options.last_bit and not is_noisy
        self.settings_changed()

    def number_at(self, instant: int) -> int:
        """Number of the newest sample at an instant that is not skipped."""
        number = self.clock.number_at(instant)
        if self._skipped:
            while number > self._skip_after and _scattered(number, self._seed) % _SKIP_STEPS < self._skipped:
                number -= 1
        return number

    def newest(self, later: int = 0) -> bytes:
        if self.stuck:
            return self.stuck
        now = self._now() + later
        number = self.number_at(now)
        if number != self._number:
            world = self._external
            if self._data and world is not None and world.is_faulty(self._stamp(now) * 1e-9):
                return self._data
            self._data = self._prepared if number == self._prepared_number else self._make(number)
            self._number = number
        return self._data

    def prepare(self, expected: int) -> None:
        """Compute the next sample, or that which a frame at `expected` will read, while there is time."""
        number = self.number_at(expected)
        number += number == self._number
        if number != self._prepared_number and not self.stuck and self._external is None:
            self._prepared = self._make(number)
            self._prepared_number = number

    def _make(self, number: int) -> bytes:
        self.made += 1
        instant = self._stamp(self.clock.instant(number))
        reading = self._signal.reading(number, instant, (instant - self._signal_start) * 1e-9)
        values = [*reading.values]
        if self._has_last_bit:
            self._add_last_bits(values, number)
        saturated = self._disturb(values)
        warnings = self._warnings if number < self._warnings_until else 0
        return self._pack(reading._replace(values=values), warnings, saturated)

    def _add_last_bits(self, values: list[float], number: int) -> None:
        """Add or subtract up to the last bit of each converter to the values of sample `number`."""
        chance = _scattered(number, self._seed)
        for position, bit in enumerate(_LAST_BITS):
            values[position] += bit * ((chance % _STEPS + 0.5) / _STEPS * 2 - 1)
            chance //= _STEPS

    def _disturb(self, values: list[float]) -> int:
        """Put every fault into the values; returns which channels are saturated, as bits."""
        for position, deviation in self.noise.items():
            values[position] += self._gauss(0.0, deviation)
        bits = 0
        for position, limit in self.limits.items():
            if abs(values[position]) > limit:
                values[position] = math.copysign(limit, values[position])
                bits |= 1 << position
        for position, kept in self.frozen.items():
            self.frozen[position] = values[position] = values[position] if kept is None else kept
        return bits

    def _pack(self, reading: PhysicalSample, warnings: int, saturated: int) -> bytes:
        """Process data of one sample, as the settings have it.

        Offsets are added; values beyond the range are clipped and set the saturation fields and warnings; the
        IMU and the orientation estimate can be off; without the calibration matrix force and torque are raw
        counts. `warnings` is ORed into the register, `saturated` (channels as bits) into the fields.
        """
        values, temperature, quaternion = reading
        load, acceleration, rate = values[:6], values[6:9], values[9:]
        load = tuple(a + b for a, b in zip(load, self._offset, strict=True))
        if not self._calibrated:
            load = tuple(float(round(a * s)) for a, s in zip(load, _COUNTS, strict=True))
        load = tuple(
            a if -_LARGEST_REAL32 < a < _LARGEST_REAL32 else math.copysign(math.inf, a) for a in load
        )
        if self._imu:
            acceleration, beyond = _measured(
                acceleration, self._acceleration_offset, self._acceleration_range
            )
            rate, rate_beyond = _measured(rate, self._angular_rate_offset, self._angular_rate_range)
            saturated |= beyond << 6 | rate_beyond << 9
        else:
            acceleration = rate = (0.0, 0.0, 0.0)
            saturated &= 0x3F
        if saturated:
            warnings |= sum(flag for mask, flag in _SATURATION if saturated & mask)
        tail: tuple[float, ...] = ()
        if self._layout.has_orientation:
            tail = quaternion if self._orientation else (0.0, 0.0, 0.0, 0.0)
        return self._layout.struct.pack(
            0, warnings, *load, saturated & 0x3F, *acceleration, saturated >> 6 & 7, *rate, saturated >> 9,
            temperature, *tail,
        )  # fmt: skip

    def changed(self) -> None:
        """Something has: it takes effect from the next sample on, the newest may have been read already."""
        self._prepared_number = -1

    def settings_changed(self) -> None:
        sinc_length = self._dictionary.sinc_in_effect
        if sinc_length != self.clock.sinc_length:
            self.clock.change(self._now(), sinc_length=sinc_length)
        settings = self._dictionary.settings()
        if isinstance(self._signal, Measured):
            self._signal.set_filters(sinc_length, settings)
        self._offset, self._acceleration_offset, self._angular_rate_offset = (
            self._dictionary.offsets(index) for index in (0x8000, 0x8001, 0x8002)
        )
        self._calibrated = bool(settings["calibration_matrix"])
        self._imu = settings["imu_active"] != 0
        self._orientation = bool(settings["orientation_estimation"])
        self._acceleration_range = float(settings["acceleration_range_g"])
        self._angular_rate_range = float(settings["angular_rate_range_dps"])
        self.changed()

    def set_ppm(self, ppm: float) -> None:
        self.clock.change(self._now(), ppm=ppm)
        self.changed()

    def set_warnings(self, bits: int, samples: int | None) -> None:
        self._warnings = bits
        self._warnings_until = 2**63 if samples is None else self.clock.number_at(self._now()) + 1 + samples
        self.changed()

    def set_skip(self, percent: float) -> None:
        """Skip this percentage of the samples after the newest one at random; 0 ends it."""
        self._skipped = round(percent / 100 * _SKIP_STEPS)
        self._skip_after = self.clock.number_at(self._now())
        self.changed()
