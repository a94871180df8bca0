"""What a report is about: a recorded sensor's settings and frames, and its new, valid samples on a time axis.

A sample is a frame that is neither REPEATED nor INVALID. Times are
seconds of CLOCK_MONOTONIC since the first frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.numbers import count, listing, moment
from bota_clients.recording.asked import Asked
from bota_clients.recording.columns import Bools, Columns, Floats, Ints
from bota_clients.recording.reader import ALL, RecordedSensor, Recording, open_recording
from bota_ethercat.accounting import StreamAccounting
from bota_ethercat.health.limits import LIMITS
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.filters import LONG_SINC, SHORT_SINC, noise_limit
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SettingValue, rate_divisor
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, FORCE_TORQUE
from bota_ethercat.text.untrusted import printable

_HIGHEST_RATE_HZ: Final = 100_000.0
_MOST_EVENTS_NAMED: Final = 10
_MOST_SENSORS_NAMED: Final = 4
_MOST_VALUES: Final = 1 << 17
_GRAVITY_STEP: Final = 1e-6  # m/s²
_MOST_GRAVITY: Final = 1e9  # m/s²: all that is larger
_BITS: Final = ("warnings", "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated")
_MAX: Final = (1 << 63) - 1
_LONGEST_CHANGE_NS: Final = 2_000_000_000  # a change of settings takes the sensor out of operation for less


@dataclass(frozen=True)
class Subject:
    info: SensorInfo
    parts: Iterable[Columns]  # its frames, of which there may be many: to be read several times
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

    def with_remarks(self, remarks: Iterable[str]) -> Subject:
        return replace(self, remarks=(*self.remarks, *(printable(remark, 300) for remark in remarks)))


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
        remarks += _event_remarks(event.name for event in recording.events)
        return [_subject(recording, sensor, imu_units).with_remarks(remarks) for sensor in recorded]


def _event_remarks(names: Iterable[str]) -> list[str]:
    """A remark that says which events there were, if any."""
    counts = Counter(printable(name, 40) for name in names)
    counts.pop("connected", None)
    told = [f"{name} ({times})" for name, times in sorted(counts.items())]
    return [f"Events of the whole recording: {listing(told, _MOST_EVENTS_NAMED)}."] if told else []


class _Stretch:
    """The frames of a sensor between two changes of settings or sensor; to be read several times."""

    def __init__(self, recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits) -> None:
        self._of, self._sensor, self._units = (recording.path, recording.asked), sensor, imu_units
        self._number: int | None = None  # of those of the recording; None: it is all of it
        self.info, self.lost_because = sensor.info, ""  # what the server said when it lost the sensor last
        self._last = self._until_ns = _MAX  # frames after this one and after this time give nothing

    def _batches(self) -> Iterator[tuple[int, InForce, Columns]]:
        """With the number of their stretch; the order in the file decides, because clocks differ."""
        number, was = 0, self._sensor.info
        with open_recording(*self._of) as recording:
            for in_force, part in recording.batches(self._sensor.sensor, self._units):
                info = in_force.info
                number += (was.identity, was.settings) != (info.identity, info.settings)
                was = info
                yield number, in_force, part

    def choose_longest(self) -> None:
        found: dict[int, list[Any]] = {}  # by stretch: info, why lost, frames, last new one, time of the last
        number = 0
        for number, in_force, part in self._batches():
            row = found.setdefault(number, [in_force.info, "", 0, -1, 0])
            new = np.flatnonzero(part.fresh)
            row[1] = in_force.lost or row[1]
            row[3] = row[2] + int(new[-1]) if len(new) else row[3]
            row[2], row[4] = row[2] + len(part), int(part.monotonic_ns[-1])
        if found:
            self._number = max(found, key=lambda each: found[each][2])
            self.info, self.lost_because, _, last, until_ns = found[self._number]
            if self._number < number:
                self._last, self._until_ns = last, until_ns - _LONGEST_CHANGE_NS

    def __iter__(self) -> Iterator[Columns]:
        at = 0
        for number, _, part in self._batches():
            if self._number in (None, number):
                rows = np.arange(at, at + len(part))
                at += len(part)
                # Without the end in which the change was made already: the sensor gives nothing then.
                kept = (rows <= self._last) | (part.monotonic_ns <= self._until_ns)
                if kept.any():
                    yield part if kept.all() else part.where(kept)


def _subject(recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits) -> Subject:
    """Its longest stretch without a change of settings or sensor."""
    parts = _Stretch(recording, sensor, imu_units)
    if len(sensor.history) > 1 or any(each.in_force.lost for each in sensor.changes):
        parts.choose_longest()
    remarks = [] if parts.info.settings else ["The settings are not known."]
    remarks += _remarks([row.info for row in sensor.history], parts)
    offsets = (row.info.offset for row in sensor.offsets if row.info.offset is not None)
    if (tared := sum(was != now for was, now in pairwise(offsets))) > 0:
        remarks.append(
            f"The sensor's own offset was changed {count(tared, 'time')} (by a tare, say): forces before and "
            "after differ by that."
        )
    subject = Subject(parts.info, parts, recording.path.name, lost_because=printable(parts.lost_because, 300))
    return subject.with_remarks(remarks)


def _remarks(history: Sequence[SensorInfo], kept: _Stretch) -> list[str]:
    """What was changed while it was recorded, and which part this is."""
    if len(history) < 2:
        return []
    remarks = []
    there = dict.fromkeys(f"{who.name}, serial {who.serial}, firmware {who.firmware}" for who in history)
    if len(there) > 1:
        remarks.append(
            f"The sensor was exchanged while it was recorded ({'; '.join([*there][:_MOST_SENSORS_NAMED])}): "
            f"this report is of serial {kept.info.serial}."
        )
    if changes := sum(new.serial == old.serial for old, new in pairwise(history)):
        remarks.append(f"The settings were changed {count(changes, 'time')} while it was recorded.")
    if stamps := [int(part.stamp_ns[row]) for part in kept for row in (0, -1)]:
        first, last = moment(stamps[0]), moment(stamps[-1])
        remarks.append(f"This report is of the longest stretch without a change, from {first} to {last}.")
    return remarks


class Group(NamedTuple):
    """Three channels of one kind."""

    name: str  # of the array in `columns.Columns`
    title: str
    unit: str
    saturation: str  # the array with its saturation bits
    first_bit: int
    limits_short: tuple[float, float, float]  # noise of a healthy sensor at SINC 51, standard deviation
    limits_long: tuple[float, float, float]  # the same at SINC 1024
    is_imu: bool = False


_OF_GROUP: Final = (FORCE_TORQUE, FORCE_TORQUE, ACCELERATION, ANGULAR_RATE)  # by GROUPS
_IMU: Final = (0.1, 0.1, 0.1)  # the only figure published, for all filters
GROUPS: Final = (
    Group("force", "Force", "N", "force_torque_saturated", 0, (0.6, 0.6, 0.6), (0.1, 0.1, 0.08)),
    Group("torque", "Torque", "Nm", "force_torque_saturated", 3,
          (0.014, 0.014, 0.005), (0.0015, 0.0015, 0.0007)),
    Group("acceleration", "Acceleration", "m/s²", "acceleration_saturated", 0, _IMU, _IMU, is_imu=True),
    Group("angular_rate", "Angular rate", "rad/s", "angular_rate_saturated", 0, _IMU, _IMU, is_imu=True),
)  # fmt: skip


class Channel(NamedTuple):
    group: Group
    axis: int  # 0, 1, 2 for x, y, z
    title: str  # for people: Force z
    bit: int  # its bit in the saturation field of its group


# In the order of `/sensone_sensor_data`: force, torque, acceleration, angular rate.
CHANNELS: Final = tuple(
    Channel(group, axis, f"{group.title} {'xyz'[axis]}", 1 << (group.first_bit + axis))
    for group in GROUPS
    for axis in range(3)
)


def channel_limit(channel: Channel, sinc_length: int) -> float:
    """Noise (standard deviation) below which the channel is healthy at this SINC length."""
    group, axis = channel.group, channel.axis
    return noise_limit(group.limits_short[axis], group.limits_long[axis], sinc_length)


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
        self._found = np.zeros((2, 0), np.int64)

    def add(self, values: Ints) -> None:
        self._waiting.append(values >> self._shift)
        self._held += len(values)
        if self._held > _MOST_VALUES:
            self._fold()

    def counts(self) -> tuple[Ints, Ints]:
        """Values, ascending, and how often each came."""
        self._fold()
        values, counts = self._found
        return (values << self._shift) + (1 << self._shift >> 1), counts

    def _fold(self) -> None:
        values, inverse = np.unique(np.concatenate([self._found[0], *self._waiting]), return_inverse=True)
        weights = np.append(self._found[1], np.ones(self._held, np.int64))
        counts = np.bincount(inverse, weights, len(values)).astype(np.int64)
        self._found, self._waiting, self._held = np.stack([values, counts]), [], 0
        if len(values) > _MOST_VALUES:
            self._shift += 1
            coarser, begin = np.unique(values >> 1, return_index=True)
            self._found = np.stack([coarser, np.add.reduceat(counts, begin)])


def quantiles(values: Floats | Ints, counts: Ints, *shares: float) -> Floats:
    """Of values, ascending, that came so often each: as `numpy.quantile`."""
    at, ends = np.multiply(shares, counts.sum() - 1), counts.cumsum()
    low, high = (values[np.searchsorted(ends, each(at), "right")] for each in (np.floor, np.ceil))
    return np.asarray(low + (high - low) * (at % 1))


class Envelope:
    """Least, largest and mean of the values of channels in each bin of 0 to `width` s; NaN in empty ones."""

    def __init__(self, width: float, channels: int, bins: int = BINS) -> None:
        self.width, self.bins = width, bins
        self.low, self.high = np.full((2, bins, channels), np.nan)
        self._sums, self._counts = np.zeros((2, bins, channels))

    @property
    def mean(self) -> Floats:
        return self._sums / np.where(self._counts, self._counts, np.nan)

    @property
    def middles(self) -> Floats:
        """Of the bins, s."""
        return np.linspace(0, self.width, 2 * self.bins + 1)[1::2]

    def bins_of(self, times: Floats) -> Ints:
        index: Ints = np.clip((times / self.width * self.bins).astype(np.int64), 0, self.bins - 1)
        return index

    def add(self, times: Floats, values: Floats) -> None:
        """Values (n, channels) at `times` (n,), s, in any order; what is not finite is ignored."""
        index = self.bins_of(times)
        if (np.diff(index) < 0).any():
            order = np.argsort(index, kind="stable")
            index, values = index[order], values[order]
        begin = np.flatnonzero(np.diff(index, prepend=-1))
        at, good = index[begin], np.isfinite(values)
        known = values if good.all() else np.where(good, values, np.nan)
        if len(at):
            self.low[at] = np.fmin(self.low[at], np.fmin.reduceat(known, begin))
            self.high[at] = np.fmax(self.high[at], np.fmax.reduceat(known, begin))
            self._sums[at] += np.add.reduceat(
                values if known is values else np.where(good, values, 0.0), begin
            )
            self._counts[at] += np.add.reduceat(good, begin, dtype=np.int64)


class Samples(NamedTuple):
    """n samples that follow one another."""

    time: Floats  # (n,) s since the first frame
    values: Floats  # (n, 12) as in `CHANNELS`
    usable: Bools  # (n, 12)
    interval_ns: Ints  # (n,) since the sample before; of the very first 0


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
        self.longest_silence = 0.0  # s, the time before the first sample and after the last too
        self.clock_steps, self.largest_step = 0, 0.0  # adjustments of CLOCK_REALTIME; s
        self.bits = dict.fromkeys(_BITS, 0)  # every bit that is set in any sample
        self.envelope = Envelope(self.width, len(CHANNELS) + 1)  # the last one is temperature
        self.saturated = np.zeros((BINS, len(CHANNELS)), bool)
        self.lossy = np.zeros(BINS, bool)
        self.few = list[tuple[float, Floats, bool]]()  # up to DENSE samples: time, values, is it apart
        self._unbroken, self._gravity = Histogram(), Histogram()
        self._kept_ns = self._kept_periods = 0
        self._before: tuple[int, int, int] | None = None  # monotonic and stamp of the latest sample, missing
        self._since = 0  # other frames since it

    def _measure_time(self) -> None:
        intervals, first, last = Histogram(), None, -1
        self.frames = self.count = self._begin_ns = 0  # frames, samples, stamp of the first frame
        self.stamps: tuple[int, int] | None = None  # of the first and the last frame
        ends = list[int]()
        for part in self.subject.parts:
            if not len(part):
                continue
            moments, new = part.monotonic_ns, part.monotonic_ns[part.fresh]
            if not self.frames:
                self._begin_ns, first = int(moments[0]), int(part.stamp_ns[0])
            ends = [min([int(moments.min()), *ends[:1]]), max([int(moments.max()), *ends[1:]])]
            steps = np.diff(new, prepend=new[:1] if last < 0 else last)
            intervals.add(steps[steps > 0])
            self.frames, self.count = self.frames + len(part), self.count + len(new)
            last = int(new[-1]) if len(new) else last
            self.stamps = first or 0, int(part.stamp_ns[-1])
        # From the first frame to the last, s; 0 if there are fewer than two.
        self.duration = (ends[1] - ends[0]) * 1e-9 if ends else 0.0
        values, counts = intervals.counts()
        # The usual interval, s; what the settings say if there are none.
        self.period = self.nominal_period or 1e-3
        if len(values):
            self.period = float(quantiles(values, counts, 0.5)[0]) * 1e-9
        self.width = max(self.duration, self.period)  # of the plots over time, s

    def read(self) -> Iterator[Samples]:
        """The samples, a few thousand at once; what is found of them is here when all were read."""
        for part in self.subject.parts:
            if len(part):
                yield self._take(part)
        if self._since and self._before:
            self._silence((self._last_ns - self._before[0]) * 1e-9)
        elif self._since:
            self._silence(self.duration)
        self._end()

    def _take(self, part: Columns) -> Samples:
        fresh = part.fresh
        missing = self._count(part)  # so far, of each frame
        samples = part if fresh.all() else part.where(fresh)
        at, self._last_ns = np.flatnonzero(fresh), int(part.monotonic_ns[-1])
        moments, stamps = samples.monotonic_ns, samples.stamp_ns
        before = self._before
        if before is None and len(at):
            before = int(moments[0]), int(stamps[0]), int(missing[at[0]])
            if self._since + at[0]:
                self._silence((int(moments[0]) - self._begin_ns) * 1e-9)
        was_ns, was_stamp_ns, were_missing = before or (0, 0, 0)
        intervals = np.diff(moments, prepend=was_ns)
        lost = np.diff(missing[at], prepend=were_missing)
        silent = np.diff(at, prepend=-1 - self._since) > 1
        real = np.ones(len(at), bool)  # is there one before?
        if self._before is None:
            real[:1] = silent[:1] = False
        moved = intervals - np.diff(stamps, prepend=was_stamp_ns)
        steps = -moved[(np.abs(moved) > _STEP_NS) & real] * 1e-9
        self.clock_steps += len(steps)
        if len(steps):
            self.largest_step = max(self.largest_step, float(steps[np.abs(steps).argmax()]), key=abs)
        self.lost += int(lost[real].sum())
        self.backwards += int((intervals[real] <= 0).sum())
        limit_ns = _LONG * self.period * 1e9
        follows = real & ~silent & (intervals > 0)
        self._unbroken.add(intervals[follows & (lost == 0) & (intervals <= limit_ns)])
        # Nobody counts what was missing while there was no connection.
        kept = follows & ((lost > 0) | (intervals <= limit_ns))
        self._kept_ns += int(intervals[kept].sum())
        self._kept_periods += int((1 + lost[kept]).sum())
        if (mute := real & silent).any():
            self._silence(float((intervals[mute] * 1e-9 - (1 + lost[mute]) * self.period).max()))
        if len(at):
            self._before = int(moments[-1]), int(stamps[-1]), int(missing[at[-1]])
            self._since = len(part) - 1 - int(at[-1])
        else:
            self._since += len(part)
        return self._measure(
            samples, np.where(real, intervals, 0), lost * real, silent | (intervals > limit_ns)
        )

    def _measure(self, samples: Columns, intervals: Ints, lost: Ints, apart: Bools) -> Samples:
        time: Floats = np.multiply(samples.monotonic_ns - self._begin_ns, 1e-9)
        table = np.column_stack([*(getattr(samples, group.name) for group in GROUPS), samples.temperature])
        values, finite = table[:, :-1], np.isfinite(table)
        fields = [getattr(samples, channel.group.saturation) & channel.bit != 0 for channel in CHANNELS]
        flagged = [channel.flagged(samples) != 0 for channel in _OF_GROUP]
        usable = finite[:, :-1] & ~np.repeat(np.column_stack(flagged), 3, axis=1)
        self.not_finite += int((~finite.all(axis=1)).sum())
        for name in _BITS:
            self.bits[name] |= bits(getattr(samples, name))
        lengths = np.linalg.norm(samples.acceleration[finite[:, 6:9].all(axis=1)], axis=1)
        self._gravity.add(np.rint(np.minimum(lengths, _MOST_GRAVITY) / _GRAVITY_STEP).astype(np.int64))
        self.envelope.add(time, table)
        bins = self.envelope.bins_of(time)
        rows, channels = np.nonzero(np.column_stack(fields))
        self.saturated[bins[rows], channels] = True
        self.lossy[bins[lost > 0]] = True
        if self.count <= DENSE:
            self.few += zip(time.tolist(), values, (apart | (lost > 0)).tolist(), strict=True)
        return Samples(time, values, usable, intervals)

    def _count(self, part: Columns) -> Ints:
        """(n,) how many samples are missing up to each frame, as every client counts them."""
        accounting, summed = self._accounting, np.zeros(len(part), np.int64)
        is_next = np.append(False, np.diff(part.sequence) == 1) & (part.flags == 0)
        heads, row = (part.sequence, part.monotonic_ns, part.flags), 0
        for stop in [*np.flatnonzero(~is_next).tolist(), len(part)]:
            while row < min(stop + 1, len(part)):
                sequence, moment_ns, flags = (each[row].item() for each in heads)
                if row < stop and accounting.count_next(sequence, moment_ns):  # and so are all up to there
                    if stop - row > 1:
                        sequence, moment_ns = (each[stop - 1].item() for each in heads[:2])
                        accounting.count_run(sequence)
                        accounting.count_next(sequence, moment_ns)
                    summed[row:stop] = self.counts.missing
                    row = stop
                else:
                    accounting.count(sequence, moment_ns, flags)
                    summed[row] = self.counts.missing
                    row += 1
        return summed

    def _silence(self, seconds: float) -> None:
        self.longest_silence = max(self.longest_silence, seconds)

    def _end(self) -> None:
        values, counts = self._unbroken.counts()
        off = np.abs(values * 1e-9 - self.period)
        order = np.argsort(off, kind="stable")
        # By how much each interval with nothing missing in it differs from the usual one, s: (shares,).
        self.deviations = np.zeros(0)
        if len(values):
            self.deviations = quantiles(off[order], counts[order], 0.5, 0.95, 0.999, 1.0)
        self.usual_deviation = float(self.deviations[1]) if len(values) else 0.0  # of 95 %, s
        # Whether the stamps are not those of a clock that is followed.
        self.is_irregular = self.usual_deviation > LIMITS.irregular * self.period
        # s, over everything but silences.
        self.mean_period = self._kept_ns * 1e-9 / self._kept_periods if self._kept_periods else self.period
        # Those of the lost samples that the server had numbered: the client or recorder was too slow.
        self.withheld = min(self.counts.withheld, self.lost)
        lengths, counts = self._gravity.counts()
        # The median of what the accelerometer measures, m/s²; None: nothing.
        self.gravity = float(quantiles(lengths, counts, 0.5)[0]) * _GRAVITY_STEP if len(lengths) else None
        low, high = self.envelope.low[:, -1], self.envelope.high[:, -1]
        self.temperatures = (
            (float(np.nanmin(low)), float(np.nanmax(high))) if np.isfinite(low).any() else None
        )


def bits(fields: Ints) -> int:
    """Every bit that is set in any."""
    return int(np.bitwise_or.reduce(fields))
