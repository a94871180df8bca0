"""Tare: sets the sensor's own force/torque offset so that the mean reading becomes a given wrench.

The sensor adds its offset to what it measures, so new = target - mean + current.

An offset is taken back if an axis is then off target by more than `steady` and what noise explains: the load
moved. So is one that makes an axis worse: further from its target than before, by more than five standard
errors of the difference of the two means. The standard error of a mean is the larger of two estimates: from
single samples, and from the means of eight parts of its window, which covers noise that the sensor's filters
have correlated.

Rest is judged here (`why_moving`) by the limits of `bota_ethercat.sensor.rest`, but in raw units, and by
sums, which delay no exchange.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import repeat
from operator import add, mul
from typing import Any, Final, NamedTuple, Protocol

from bota_ethercat.control import ErrorCode
from bota_ethercat.errors import RequestError
from bota_ethercat.pdo import SampleDecoder
from bota_ethercat.sensor.rest import StationaryLimits
from bota_ethercat.stream.usable import ANGULAR_RATE, FORCE_TORQUE, judge
from ethercat_server.errors import BusError
from ethercat_server.ethercat.clock import Clock, Deadline
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.ethercat.slave.coe import Sdo
from ethercat_server.sensor.sensor import SETTLING_SAMPLES, Sensor
from ethercat_server.sensor.set_up import pack_offset, read_offset, write_offset
from ethercat_server.sensor.undo import Former, or_undone

LATER: Final = "; it gets its old offset when it is back"
OLD: Final = Former("the former offset", "; the old offset is in force", LATER, "tare it again")
# Fields of the process data with force and torque, and with the angular rate.
LOAD: Final = slice(2, 8)
RATE: Final = slice(13, 16)
LEAST_SAMPLES: Final = 20  # fewer would not show whether the sensor is stationary


_REST: Final = StationaryLimits()
_TURNS_DPS: Final = math.degrees(_REST.angular_rate_deviation)


class _Channel(NamedTuple):
    """A quantity of the process data, in its unit."""

    name: str
    unit: str
    most: float  # standard deviation of a stationary sensor
    steady: float  # what a mean may move within a window, and be off target after a tare, beyond noise


CHANNELS: Final = (
    *(_Channel(name, "N", _REST.force_deviation, _REST.force_drift) for name in ("Fx", "Fy", "Fz")),
    *(_Channel(name, "Nm", _REST.torque_deviation, _REST.torque_drift) for name in ("Mx", "My", "Mz")),
    *(_Channel(name, "deg/s", _TURNS_DPS, math.inf) for name in ("Rx", "Ry", "Rz")),
)
# Limit of the mean angular rate: above it the robot is moving. The residual shows slower motion.
_REST_TURN_DPS: Final = math.degrees(_REST.uncalibrated_angular_rate)
_BY_CHANCE: Final = 5.0  # standard errors by which two means must differ to differ significantly
_VAGUE: Final = 2.0  # standard errors by which a standard deviation of few samples may be above its limit
PARTS: Final = 8  # parts of a window whose means give the standard error of the whole window's
_ROUNDING: Final = 1e-6  # share of a reading by which REAL32 arithmetic in the sensor may be off
_PATIENCE: Final = 4.0  # timeout for samples, in multiples of their nominal duration


class Samples(Protocol):
    """The samples as they come in: the stream of the sensor."""

    @property
    def fresh(self) -> int:
        """How many there have been."""

    @property
    def process_data(self) -> bytes:
        """The newest."""


def tare(
    sdo: Sdo,
    sensor: Sensor,
    stream: Samples,
    samples: int,
    target: Sequence[float],
    on_offset: Callable[[Sensor], object] = lambda _: None,
) -> Steps[dict[str, Any]]:
    """Steps of the action `tare`; returns what its reply carries. RequestError if the sensor is not at rest,
    or cannot hold the offset, or if an axis is off target afterwards or worse than before.

    If it fails after that, the old offset is written again. `on_offset` is called before and after each
    write.
    """
    _check_fits(target, "the key 'target'")
    samples = max(samples, LEAST_SAMPLES)
    while sensor.settling:
        yield None
    before = yield from _average(sdo.clock, sensor, stream, samples)
    if why := why_moving(before):
        raise RequestError(
            ErrorCode.NOT_READY,
            f"sensor {sensor.number} is not at rest: {why}: hold it still and tare again",
        )
    old = yield from read_offset(sdo)
    new = tuple(t - found.mean + o for t, found, o in zip(target, before[:6], old, strict=True))
    _check_fits(new, "the offset that the key 'target' asks for")

    def put(offset: Sequence[float]) -> Steps[tuple[float, ...]]:
        # Said before the first number is written: of the samples meanwhile nobody knows the offset.
        sensor.offset_is_certain = False
        on_offset(sensor)
        written = sensor.offset = yield from write_offset(sdo, offset)
        sensor.offset_is_certain = True
        on_offset(sensor)
        return written

    def write() -> Steps[tuple[tuple[float, ...], list[ChannelStatistics]]]:
        written = yield from put(new)
        yield from _wait(sdo.clock, sensor, stream, SETTLING_SAMPLES)
        after = yield from _average(sdo.clock, sensor, stream, samples)
        _check_better(sensor, before, after, samples, target)
        return written, after

    try:
        new, after = yield from or_undone(write(), lambda: put(old), OLD, sensor)
    except (BusError, RequestError):
        sensor.offset = old
        raise
    return {
        "old_offset": list(old),
        "new_offset": list(new),
        "residual": [found.mean - t for found, t in zip(after[:6], target, strict=True)],
        "deviation": [found.deviation for found in before[:6]],
    }


def _check_fits(offset: Sequence[float], what: str) -> None:
    try:
        pack_offset(offset)
    except ValueError as error:
        raise RequestError(ErrorCode.BAD_REQUEST, f"{what} cannot be: {error}") from None


class ChannelStatistics(NamedTuple):
    """One channel over a window of samples."""

    mean: float
    deviation: float
    change: float  # from the mean of the first half to that of the second
    by_chance: float  # what noise explains of that
    error: float  # standard error of the mean
    samples: int


class Part:
    """Sums over part of a window."""

    def __init__(self, channels: int = len(CHANNELS)) -> None:
        self.taken = 0
        self.sums = [0.0] * channels
        self.squares = [0.0] * channels

    def add(self, columns: Sequence[Sequence[float]]) -> None:
        """Add samples, by channel."""
        self.taken += len(columns[0])
        self.sums = list(map(add, self.sums, map(sum, columns)))
        squares = map(map, repeat(mul), columns, columns)
        self.squares = list(map(add, self.squares, map(sum, squares)))


def _moments(parts: Sequence[Part], channel: int) -> tuple[float, float]:
    """Mean and variance."""
    taken = sum(part.taken for part in parts)
    mean = sum(part.sums[channel] for part in parts) / taken
    return mean, max(0.0, sum(part.squares[channel] for part in parts) / taken - mean * mean)


def channel_statistics(parts: Sequence[Part], channel: int, start: float = 0.0) -> ChannelStatistics:
    """One channel of a window of `PARTS` parts, in whose sums values are relative to `start`."""
    samples, first = sum(part.taken for part in parts), parts[: PARTS // 2]
    mean, variance = _moments(parts, channel)
    (one, noise), (other, more_noise) = _moments(first, channel), _moments(parts[PARTS // 2 :], channel)
    by_chance = _BY_CHANCE * math.sqrt((noise + more_noise) / sum(part.taken for part in first))
    means = [part.sums[channel] / part.taken for part in parts]
    of_parts = math.dist(means, [sum(means) / PARTS] * PARTS) / math.sqrt(PARTS * (PARTS - 1))
    error = max(math.sqrt(variance / samples), of_parts)
    return ChannelStatistics(start + mean, math.sqrt(variance), abs(other - one), by_chance, error, samples)


def _average(clock: Clock, sensor: Sensor, stream: Samples, samples: int) -> Steps[list[ChannelStatistics]]:
    """Over the next samples."""
    decoder = SampleDecoder(sensor.pdo_size)
    unpack = decoder.layout.struct.unpack
    deadline = _patience(clock, sensor, samples)
    seen, taken = stream.fresh, 0
    parts = [Part() for _ in range(PARTS)]
    first: list[float] = []
    while taken < samples:
        yield None
        if deadline.passed:
            raise RequestError(
                ErrorCode.NOT_READY, f"sensor {sensor.number} gives too few samples to tare it"
            )
        if stream.fresh == seen:
            continue
        seen = stream.fresh
        values = unpack(stream.process_data)
        row = [*values[LOAD], *values[RATE]]
        if why := judge(decoder.sample(values), (FORCE_TORQUE, ANGULAR_RATE))[1]:
            raise RequestError(ErrorCode.NOT_READY, f"sensor {sensor.number} cannot be tared: {why}")
        first = first or row
        # From the first on, so that a large load does not drown its small changes.
        parts[PARTS * taken // samples].add([(v - start,) for v, start in zip(row, first, strict=True)])
        taken += 1
    return [channel_statistics(parts, channel, start) for channel, start in enumerate(first)]


def _wait(clock: Clock, sensor: Sensor, stream: Samples, samples: int) -> Steps[None]:
    """Wait for `samples` samples, or the timeout."""
    target = stream.fresh + samples
    deadline = _patience(clock, sensor, samples)
    while stream.fresh < target and not deadline.passed:
        yield None


def _patience(clock: Clock, sensor: Sensor, samples: int) -> Deadline:
    """Timeout for `samples` samples."""
    return Deadline(clock, 1.0 + _PATIENCE * samples * sensor.period_ns * 1e-9)


def why_moving(window: Sequence[ChannelStatistics]) -> str:
    """Why a sensor was not at rest in a window of force, torque and angular rate; empty if it was."""
    turn = math.hypot(*(found.mean for found in window[6:]))
    if turn > _REST_TURN_DPS:
        return f"it turns by {turn:.3g} deg/s (mean; at most {_REST_TURN_DPS:.3g})"
    for (name, unit, limit, steady), found in zip(CHANNELS, window, strict=True):
        most = limit * (1.0 + _VAGUE / math.sqrt(2.0 * found.samples))
        if found.deviation > most:
            return f"{name} varies by {found.deviation:.3g} {unit} (standard deviation; at most {most:.2g})"
        if found.change > (most_change := steady + found.by_chance):
            return f"{name} changes by {found.change:.3g} {unit} (mean; at most {most_change:.3g})"
    return ""


def _check_better(
    sensor: Sensor,
    before: Sequence[ChannelStatistics],
    after: Sequence[ChannelStatistics],
    samples: int,
    target: Sequence[float],
) -> None:
    """RequestError if an axis is off target or further from it than before, and noise does not explain it."""
    worst, text = 0.0, ""
    for (name, unit, _, steady), old, new, wanted in zip(CHANNELS, before, after, target, strict=False):
        was, now = old.mean - wanted, new.mean - wanted
        allowed = _BY_CHANCE * math.hypot(old.error, new.error)
        allowed += _ROUNDING * max(1.0, abs(wanted), abs(old.mean))
        worse = abs(now) - abs(was) - allowed
        # Of single samples: a load that moves correlates the means of the parts.
        alone = math.hypot(old.deviation, new.deviation) / math.sqrt(samples)
        off = abs(now) - steady - _BY_CHANCE * alone
        excess = max(worse, off) / steady  # so that N and Nm compare
        if excess > worst:
            what = f"the load of sensor {sensor.number} moved during the tare"
            if worse > 0:
                what = f"the tare made sensor {sensor.number} worse"
            worst = excess
            text = f"{what}: {name} is {now:.3g} {unit} off target after it and was {was:.3g} before"
    if text:
        raise RequestError(ErrorCode.NOT_READY, f"{text}: keep its load still and tare again")
