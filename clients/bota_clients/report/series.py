"""What a report is about: a recorded sensor's settings and frames, and its new, valid samples on a time axis.

A sample is a frame that is neither REPEATED nor INVALID. Times are
seconds of CLOCK_MONOTONIC since the first frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.numbers import count, listing, moment
from bota_clients.recording.asked import Asked
from bota_clients.recording.columns import Bools, Columns, Floats, Ints
from bota_clients.recording.reader import ALL, RecordedSensor, Recording, open_recording
from bota_ethercat.accounting import FrameKind, StreamAccounting
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.filters import LONG_SINC, SHORT_SINC, noise_limit
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SettingValue, rate_divisor
from bota_ethercat.stream import usable
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.text.untrusted import printable

_HIGHEST_RATE_HZ: Final = 100_000.0
_MOST_EVENTS_NAMED: Final = 10
_MOST_SENSORS_NAMED: Final = 4
_MOST_VALUES: Final = 1 << 17
_GRAVITY_STEP: Final = 1e-6  # m/s²
_MOST_GRAVITY: Final = 1e9  # m/s²: all that is larger
_FIELDS: Final = ("force_torque_saturated", "acceleration_saturated", "angular_rate_saturated", "warnings")
_MAX: Final = (1 << 63) - 1
_LONGEST_CHANGE_NS: Final = 2_000_000_000  # a change of settings takes the sensor out of operation for less


@dataclass(frozen=True)
class Subject:
    info: SensorInfo
    parts: Iterable[Columns]  # its frames, some in each, of which there may be many: to be read several times
    source: str  # a file name
    remarks: tuple[str, ...] = ()  # sentences about the recording for the reader of the report
    lost_because: str = ""  # what the server said when it lost the sensor last

    @property
    def who(self) -> str:
        return f"{self.info.name or '?'}, serial {'?' if self.info.serial is None else self.info.serial}"

    @property
    def settings(self) -> Mapping[str, SettingValue]:
        """Those that are known."""
        return self.info.settings

    @property
    def sinc_length(self) -> int | None:
        return self.settings.get("sinc_length")

    @property
    def nominal_period_s(self) -> float | None:
        """From the settings; None if unknown."""
        rate_hz = self.info.rate_hz
        if self.sinc_length is not None:
            divisor = rate_divisor(self.sinc_length, round(rate_hz), self.settings.get("chop"))
            return self.sinc_length * (divisor or 1) / BASE_SAMPLING_RATE_HZ
        return 1 / rate_hz if 0 < rate_hz <= _HIGHEST_RATE_HZ else None


def of_recording(path: Path, imu_units: ImuUnits, asked: Asked = ALL) -> list[Subject]:
    """The sensors of the recording at `path`, by position; RecordingError if there is none to be read."""
    with open_recording(path, asked) as recording:
        recorded = [s for s in recording.sensors if not recording.chosen or s.sensor in recording.chosen]
        if not recorded:
            raise RecordingError(f"{path} has no sensor")
        remarks = [f"The recording {remark}." for remark in recording.remarks]
        if asked.part:
            remarks.append(f"Of the recording only the part {asked.part} was read.")
        if others := [str(sensor.sensor) for sensor in recording.sensors if sensor not in recorded]:
            remarks.append(f"Not recorded, because others were chosen: sensor {listing(others)}.")
        events = Counter(printable(event.name, 40) for event in recording.events)
        if told := [f"{name} ({times})" for name, times in sorted(events.items()) if name != "connected"]:
            remarks.append(f"Events of the whole recording: {listing(told, _MOST_EVENTS_NAMED)}.")
        return [_subject(recording, sensor, imu_units, remarks) for sensor in recorded]


class _Stretch:
    """The frames of a sensor between two changes of settings or sensor; to be read several times."""

    def __init__(self, recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits) -> None:
        self._of, self._sensor, self._units = (recording.path, recording.asked), sensor.sensor, imu_units
        self.info, self.lost_because = sensor.info, ""  # what the server said when it lost the sensor last
        self._begin, self._end = 0, _MAX  # numbers of the sensor's frames: of the first one, behind the last
        self._last = self._until_ns = _MAX  # frames after this one and after this time give nothing

    def _batches(self) -> Iterator[tuple[InForce, Columns]]:
        with open_recording(*self._of) as recording:
            yield from recording.batches(self._sensor, self._units)

    def choose_longest(self) -> None:
        """The order in the file decides, because clocks differ."""
        info, lost, begin, end, last, frames = self.info, "", 0, 0, -1, 0
        for in_force, part in self._batches():
            if (info.identity, info.settings) != (in_force.info.identity, in_force.info.settings):
                info, lost, begin, last = in_force.info, "", end, -1
            lost, new = in_force.lost or lost, np.flatnonzero(part.fresh)
            last = end + int(new[-1]) if len(new) else last
            end += len(part)
            if end - begin > frames:
                frames, self._begin, self._end, self._last = end - begin, begin, end, last
                # Without the end in which the change was made already: the sensor gives nothing then.
                self._until_ns = int(part.monotonic_ns[-1]) - _LONGEST_CHANGE_NS
                self.info, self.lost_because = info, lost
        if self._end == end:
            self._last = _MAX

    def __iter__(self) -> Iterator[Columns]:
        at = 0
        for _, part in self._batches():
            rows = np.arange(at, at + len(part))
            at += len(part)
            kept = (rows >= self._begin) & (rows < self._end)
            kept &= (rows <= self._last) | (part.monotonic_ns <= self._until_ns)
            if kept.any():
                yield part if kept.all() else part.where(kept)


def _subject(
    recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits, remarks: Iterable[str]
) -> Subject:
    """Its longest stretch without a change of settings or sensor."""
    parts = _Stretch(recording, sensor, imu_units)
    if len(sensor.history) > 1 or any(each.in_force.lost for each in sensor.changes):
        parts.choose_longest()
    said = tuple(printable(remark, 300) for remark in (*_remarks(sensor, parts), *remarks))
    return Subject(parts.info, parts, recording.path.name, said, printable(parts.lost_because, 300))


def _remarks(sensor: RecordedSensor, kept: _Stretch) -> Iterator[str]:
    """What was changed while it was recorded, and which part this is."""
    history = [row.info for row in sensor.history]
    if not kept.info.settings:
        yield "The settings are not known."
    there = dict.fromkeys(f"{who.name}, serial {who.serial}, firmware {who.firmware}" for who in history)
    if len(there) > 1:
        yield (
            f"The sensor was exchanged while it was recorded ({'; '.join([*there][:_MOST_SENSORS_NAMED])}): "
            f"this report is of serial {kept.info.serial}."
        )
    if changes := sum(new.serial == old.serial for old, new in pairwise(history)):
        yield f"The settings were changed {count(changes, 'time')} while it was recorded."
    if len(history) > 1 and (stamps := [int(part.stamp_ns[row]) for part in kept for row in (0, -1)]):
        first, last = moment(stamps[0]), moment(stamps[-1])
        yield f"This report is of the longest stretch without a change, from {first} to {last}."
    offsets = (row.info.offset for row in sensor.offsets if row.info.offset is not None)
    if tared := sum(was != now for was, now in pairwise(offsets)):
        yield (
            f"The sensor's own offset was changed {count(tared, 'time')} (by a tare, say): forces before and "
            "after differ by that."
        )


class Group(NamedTuple):
    """Three channels of one kind."""

    name: str  # of the array in `columns.Columns`
    title: str
    unit: str
    judged: usable.Channel  # tells which of its samples may be used
    first_bit: int  # of its saturation field
    limits_short: tuple[float, float, float]  # noise of a healthy sensor at SINC 51, standard deviation
    limits_long: tuple[float, float, float]  # the same at SINC 1024
    is_imu: bool = False


_IMU: Final = (0.1, 0.1, 0.1)  # the only figure published, for all filters
GROUPS: Final = (
    Group("force", "Force", "N", usable.FORCE_TORQUE, 0, (0.6, 0.6, 0.6), (0.1, 0.1, 0.08)),
    Group("torque", "Torque", "Nm", usable.FORCE_TORQUE, 3, (0.014, 0.014, 0.005), (0.0015, 0.0015, 0.0007)),
    Group("acceleration", "Acceleration", "m/s²", usable.ACCELERATION, 0, _IMU, _IMU, is_imu=True),
    Group("angular_rate", "Angular rate", "rad/s", usable.ANGULAR_RATE, 0, _IMU, _IMU, is_imu=True),
)


class Channel(NamedTuple):
    group: Group
    axis: int  # 0, 1, 2 for x, y, z
    title: str  # for people: Force z

    def limit(self, sinc_length: int) -> float:
        """Noise (standard deviation) below which it is healthy at this SINC length."""
        short, long = self.group.limits_short[self.axis], self.group.limits_long[self.axis]
        return noise_limit(short, long, sinc_length)


# In the order of `/sensone_sensor_data`: force, torque, acceleration, angular rate.
CHANNELS: Final = tuple(
    Channel(group, axis, f"{group.title} {'xyz'[axis]}") for group in GROUPS for axis in range(3)
)


def limit_origin(sinc_length: int) -> str:
    """Where the limits of force and torque for this length come from, a sentence."""
    if sinc_length in (SHORT_SINC, LONG_SINC):
        return f"Limits of force and torque: Bota's own test limits for SINC {sinc_length}."
    how = "interpolated between" if SHORT_SINC < sinc_length < LONG_SINC else "extrapolated from"
    return (
        f"Limits of force and torque for SINC {sinc_length} are {how} Bota's own test limits, which are "
        f"published for SINC {SHORT_SINC} and {LONG_SINC} only (a straight line in a log-log plot)."
    )


_LONG: Final = 2.5  # an interval of more than this many periods is none between two successive samples
# CLOCK_REALTIME that moves against CLOCK_MONOTONIC by more than this between two samples was adjusted.
_STEP_NS: Final = 1_000_000
BINS: Final = 640  # of the plots: about the width of a page in points
DENSE: Final = 2 * BINS  # more samples than this are drawn as an envelope


class Histogram:
    """How often each whole number came; many different ones in coarser steps, so that memory is bounded."""

    def __init__(self) -> None:
        self._shift, self._waiting, self._held = 0, list[Ints](), 0
        self._values, self._counts = np.zeros((2, 0), np.int64)

    def add(self, values: Ints) -> None:
        self._waiting.append(values >> self._shift)
        self._held += len(values)
        if self._held > _MOST_VALUES:
            self._fold()

    def quantiles(self, *shares: float, of: Callable[[Ints], Floats | Ints] = np.asarray) -> list[float]:
        """Of what `of` makes of the numbers, as `numpy.quantile`; empty if there are none."""
        self._fold()
        values = of((self._values << self._shift) + (1 << self._shift >> 1))
        order = np.argsort(values, kind="stable")
        values, ends = values[order], self._counts[order].cumsum()
        if not len(values):
            return []
        at = np.multiply(shares, ends[-1] - 1)
        low, high = (values[np.searchsorted(ends, each(at), "right")] for each in (np.floor, np.ceil))
        found: list[float] = (low + (high - low) * (at % 1)).tolist()
        return found

    def _fold(self, coarser: int = 0) -> None:
        counts = np.append(self._counts, np.ones(self._held, np.int64))
        values = np.concatenate([self._values, *self._waiting]) >> coarser
        self._values, inverse = np.unique(values, return_inverse=True)
        self._counts = np.bincount(inverse, counts).astype(np.int64)
        self._waiting, self._held, self._shift = [], 0, self._shift + coarser
        if not coarser and len(self._values) > _MOST_VALUES:
            self._fold(1)


class Bins:
    """What the samples were in each of `BINS` parts of 0 to `width` s.

    Attributes:
        low, high: (channels, bins) the least and the largest value; NaN where there is none.
        flags: (fields, bins) the bits that are set in any.
    """

    def __init__(self, width: float, channels: int, fields: int) -> None:
        self.width = width
        self.low, self.high = np.full((2, channels, BINS), np.nan)
        self._sums, self._counts = np.zeros((2, channels, BINS))
        self.flags = np.zeros((fields, BINS), np.int64)

    @property
    def mean(self) -> Floats:
        """(channels, bins) NaN where there is no value."""
        return self._sums / np.where(self._counts, self._counts, np.nan)

    @property
    def middles(self) -> Floats:
        """(bins,) s."""
        return np.linspace(0, self.width, 2 * BINS + 1)[1::2]

    def add(self, times: Floats, values: Floats, flags: Ints) -> None:
        """Values (n, channels) and flags (n, fields) at `times` (n,), s, in any order.

        What is not finite is ignored.
        """
        bins = np.clip((times / self.width * BINS).astype(np.int64), 0, BINS - 1)
        order = np.argsort(bins, kind="stable")
        # Along rows that are in one piece a reduction takes a tenth of the time.
        values, flags = np.ascontiguousarray(values[order].T), np.ascontiguousarray(flags[order].T)
        bins = bins[order]
        begin = np.flatnonzero(np.diff(bins, prepend=-1))
        at, good = bins[begin], np.isfinite(values)
        known = np.where(good, values, np.nan)
        self.low[:, at] = np.fmin(self.low[:, at], np.fmin.reduceat(known, begin, axis=1))
        self.high[:, at] = np.fmax(self.high[:, at], np.fmax.reduceat(known, begin, axis=1))
        self._sums[:, at] += np.add.reduceat(np.where(good, values, 0.0), begin, axis=1)
        self._counts[:, at] += np.add.reduceat(good, begin, axis=1, dtype=np.int64)
        self.flags[:, at] |= np.bitwise_or.reduceat(flags, begin, axis=1)


class Samples(NamedTuple):
    """n samples that follow one another."""

    time: Floats  # (n,) s since the first frame
    values: Floats  # (n, 12) as in `CHANNELS`
    usable: Bools  # (n, 12)
    interval_ns: Ints  # (n,) since the sample before; of the very first 0
    is_apart: Bools  # (n,) whether something is missing before it


class Series:
    """How the samples of one subject came, and what they were: found in two passes over its frames."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.imu_off = subject.settings.get("imu_active") == 0
        self.nominal_period = subject.nominal_period_s  # by the settings
        self._measure_time()
        self._accounting = StreamAccounting(fresh_only=False)
        # Not the usual interval: where every other sample is lost, that is two periods.
        self._accounting.rate_hz = 1 / (self.nominal_period or self.period)
        self.counts = self._accounting.counts  # the frames' kinds, as every client counts them
        self.lost = self.backwards = self.not_finite = 0
        self.clock_steps, self.largest_step = 0, 0.0  # adjustments of CLOCK_REALTIME; s
        self.bins = Bins(self.width, len(CHANNELS) + 1, len(_FIELDS) + 1)  # the last: temperature, losses
        self.few = list[Samples]()  # all of them, if they are up to DENSE
        self._unbroken, self._gravity = Histogram(), Histogram()
        self._kept_ns = self._kept_periods = 0
        # Of the latest sample: CLOCK_MONOTONIC and CLOCK_REALTIME, how many are missing, number of its frame.
        self._latest = np.zeros((4, 0), np.int64)

    def _measure_time(self) -> None:
        intervals, self.frames, self.count = Histogram(), 0, 0  # frames, samples
        self.stamps = list[int]()  # of the first and the last frame
        frames_ns, samples_ns, span = list[int](), list[int](), list[int]()
        for part in self.subject.parts:
            moments, new = part.monotonic_ns, part.monotonic_ns[part.fresh]
            steps = np.diff(new, prepend=samples_ns[-1:] or new[:1])
            intervals.add(steps[steps > 0])
            self.frames, self.count = self.frames + len(part), self.count + len(new)
            self.stamps = _ends(self.stamps, part.stamp_ns)
            frames_ns, samples_ns = _ends(frames_ns, moments), _ends(samples_ns, new)
            span = [*span, int(moments.min()), int(moments.max())]
            span = [min(span), max(span)]
        # From the first frame to the last, s; 0 if there are fewer than two.
        self.duration = (span[1] - span[0]) * 1e-9 if span else 0.0
        self._begin_ns, end_ns = frames_ns or (0, 0)
        # s, the time before the first sample and after the last too
        self.longest_silence = self.duration
        if samples_ns:
            self.longest_silence = max(samples_ns[0] - self._begin_ns, end_ns - samples_ns[1], 0) * 1e-9
        # The usual interval, s; what the settings say if there are none.
        self.period = self.nominal_period or 1e-3
        for interval_ns in intervals.quantiles(0.5):
            self.period = interval_ns * 1e-9
        self.width = max(self.duration, self.period)  # of the plots over time, s

    def read(self) -> Iterator[Samples]:
        """The samples, a few thousand at once; what is found of them is here when all were read."""
        frames = 0
        for part in self.subject.parts:
            fresh, numbers = part.fresh, np.arange(frames, frames + len(part))
            frames += len(part)
            heads = np.array([part.monotonic_ns, part.stamp_ns, self._count(part), numbers])[:, fresh]
            yield self._measure(part if fresh.all() else part.where(fresh), *self._take(heads))
        self._end()

    def _take(self, heads: Ints) -> tuple[Ints, Ints, Bools]:
        """How n samples came, by their `heads` (4, n): intervals, samples lost before each, is it apart."""
        before = self._latest if self._latest.size else heads[:, :1]
        self._latest = np.hstack([before, heads])[:, -1:]
        intervals, stamped, lost, frames = np.diff(heads, prepend=before)  # of the very first sample 0
        moved = stamped - intervals
        steps = moved[np.abs(moved) > _STEP_NS] * 1e-9
        self.clock_steps += len(steps)
        self.largest_step = max([self.largest_step, *steps.tolist()], key=abs)
        self.lost += int(lost.sum())
        self.backwards += int((intervals[frames > 0] <= 0).sum())
        silent, is_long = frames > 1, intervals > _LONG * self.period * 1e9
        # Nobody counts what was missing while there was no connection.
        kept = ~silent & (intervals > 0) & ((lost > 0) | ~is_long)
        self._unbroken.add(intervals[kept & (lost == 0)])
        self._kept_ns += int(intervals[kept].sum())
        self._kept_periods += int((1 + lost[kept]).sum())
        silences = intervals[silent] * 1e-9 - (1 + lost[silent]) * self.period
        self.longest_silence = float(silences.max(initial=self.longest_silence))
        return intervals, lost, silent | is_long | (lost > 0)

    def _measure(self, samples: Columns, intervals: Ints, lost: Ints, is_apart: Bools) -> Samples:
        time: Floats = np.multiply(samples.monotonic_ns - self._begin_ns, 1e-9)
        table = np.column_stack([*(getattr(samples, group.name) for group in GROUPS), samples.temperature])
        finite, flagged = np.isfinite(table), [group.judged.flagged(samples) != 0 for group in GROUPS]
        is_usable = finite[:, :-1] & ~np.repeat(np.column_stack(flagged), 3, axis=1)
        self.not_finite += int((~finite.all(axis=1)).sum())
        lengths = np.linalg.norm(samples.acceleration[finite[:, 6:9].all(axis=1)], axis=1)
        self._gravity.add(np.rint(np.minimum(lengths, _MOST_GRAVITY) / _GRAVITY_STEP).astype(np.int64))
        self.bins.add(time, table, np.column_stack([*(getattr(samples, name) for name in _FIELDS), lost > 0]))
        found = Samples(time, table[:, :-1], is_usable, intervals, is_apart)
        if self.count <= DENSE:
            self.few.append(found)
        return found

    def _count(self, part: Columns) -> Ints:
        """(n,) how many samples are missing up to each frame, as every client counts them."""
        accounting, missing = self._accounting, np.zeros(len(part), np.int64)
        follows = (np.diff(part.sequence) == 1) & (part.flags[1:] == 0)
        heads = part.sequence, part.monotonic_ns, part.flags
        for begin, end in pairwise([0, *(np.flatnonzero(~follows) + 1).tolist(), len(part)]):
            row, kind = begin, FrameKind.OLD
            while row < end and kind is FrameKind.OLD:
                kind = accounting.count(*(each[row].item() for each in heads))
                row += 1
            if row < end:  # nothing is missing after a frame that is not old
                last, last_ns, _ = (each[end - 1].item() for each in heads)
                accounting.count_run(last)
                accounting.count_next(last, last_ns)
            missing[begin:end] = self.counts.missing
        return missing

    def saturated(self, group: Group) -> Bools:
        """(3, bins) whether the sensor said so of any sample."""
        bits = self.bins.flags[_FIELDS.index(group.judged.saturation[0])]
        found: Bools = bits >> np.arange(group.first_bit, group.first_bit + 3)[:, np.newaxis] & 1 != 0
        return found

    def _end(self) -> None:
        # By how much each interval with nothing missing in it differs from the usual one, s: 50 %, 95 %,
        # 99.9 % and all; empty if there is none.
        self.deviations = self._unbroken.quantiles(
            0.5, 0.95, 0.999, 1.0, of=lambda values: np.abs(values * 1e-9 - self.period)
        )
        self.usual_deviation = self.deviations[1] if self.deviations else 0.0
        # s, over everything but silences.
        self.mean_period = self._kept_ns * 1e-9 / self._kept_periods if self._kept_periods else self.period
        # Those of the lost samples that the server had numbered: the client or recorder was too slow.
        self.withheld = min(self.counts.withheld, self.lost)
        # The median of what the accelerometer measures, m/s²; None: nothing.
        self.gravity = next((steps * _GRAVITY_STEP for steps in self._gravity.quantiles(0.5)), None)
        low, high = self.bins.low[-1], self.bins.high[-1]
        is_known = bool(np.isfinite(low).any())
        self.temperatures = (float(np.nanmin(low)), float(np.nanmax(high))) if is_known else None
        # Every bit that is set in any sample.
        self.bits = dict(zip(_FIELDS, np.bitwise_or.reduce(self.bins.flags, axis=1).tolist(), strict=False))


def _ends(known: list[int], values: Ints) -> list[int]:
    """The first and the last of the numbers so far."""
    every = [*known, *values[:1].tolist(), *values[-1:].tolist()]
    return [*every[:1], *every[-1:]]
