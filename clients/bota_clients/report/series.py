"""What a report is about: a recorded sensor's settings and frames, and its new, valid samples on a time axis.

A sample is a frame that is neither REPEATED nor INVALID. Times are
seconds of CLOCK_MONOTONIC since the first frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.numbers import count, listing, moment
from bota_clients.recording.columns import Bools, Columns, Floats, Ints, columns, joined
from bota_clients.recording.reader import RecordedSensor, Recording, open_recording
from bota_ethercat.accounting import StreamAccounting
from bota_ethercat.health.limits import LIMITS
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.filters import LONG_SINC, SHORT_SINC, noise_limit
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SettingValue, rate_divisor
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, FORCE_TORQUE
from bota_ethercat.text.untrusted import printable

_HIGHEST_RATE_HZ: Final = 100_000.0
_MOST_EVENTS_NAMED: Final = 10
_MOST_SENSORS_NAMED: Final = 4
_LONGEST_CHANGE_NS: Final = 2_000_000_000  # a change of settings takes the sensor out of operation for less


@dataclass(frozen=True)
class Subject:
    info: SensorInfo
    columns: Columns
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


def of_recording(path: Path, imu_units: ImuUnits) -> list[Subject]:
    """The sensors of the recording at `path`, by position; RecordingError if there is none to be read."""
    with open_recording(path) as recording:
        recorded = [s for s in recording.sensors if not recording.chosen or s.sensor in recording.chosen]
        if not recorded:
            raise RecordingError(f"{path} has no sensor")
        remarks = [f"The recording was cut off: {recording.cut_off}."] if recording.cut_off else []
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


def _subject(recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits) -> Subject:
    """Its longest stretch without a change of settings or sensor."""
    # The order in the file decides what came first, because clocks differ.
    stretches: list[tuple[SensorInfo, list[Columns]]] = [(sensor.info, [columns([])])]
    lost = dict[int, str]()  # by stretch: what the server said when it lost the sensor in it
    for in_force, frames in recording.batches(sensor.sensor, imu_units):
        was, info = stretches[-1][0], in_force.info
        if (was.identity, was.settings) != (info.identity, info.settings):
            stretches.append((info, []))
        stretches[-1][1].append(frames)
        if in_force.lost:
            lost[len(stretches) - 1] = in_force.lost
    longest = max(range(len(stretches)), key=lambda number: sum(map(len, stretches[number][1])))
    kept, found = stretches[longest][0], joined(stretches[longest][1])
    if longest + 1 < len(stretches):
        # Without the end in which the change was made already: the sensor gives nothing then.
        last = np.flatnonzero(found.fresh)[-1:].max(initial=-1)
        changing = found.monotonic_ns > found.monotonic_ns[-1:] - _LONGEST_CHANGE_NS
        found = found.where(~changing | (np.arange(len(found)) <= last))
    remarks = [] if kept.settings else ["The settings are not known."]
    remarks += _remarks([row.info for row in sensor.history], kept, found)
    offsets = (row.info.offset for row in sensor.offsets if row.info.offset is not None)
    if (tared := sum(was != now for was, now in pairwise(offsets))) > 0:
        remarks.append(
            f"The sensor's own offset was changed {count(tared, 'time')} (by a tare, say): forces before and "
            "after differ by that."
        )
    subject = Subject(kept, found, recording.path.name, lost_because=printable(lost.get(longest, ""), 300))
    return subject.with_remarks(remarks)


def _remarks(history: Sequence[SensorInfo], kept: SensorInfo, frames: Columns) -> list[str]:
    """What was changed while it was recorded, and which part this is."""
    if len(history) < 2:
        return []
    remarks = []
    there = dict.fromkeys(f"{who.name}, serial {who.serial}, firmware {who.firmware}" for who in history)
    if len(there) > 1:
        remarks.append(
            f"The sensor was exchanged while it was recorded ({'; '.join([*there][:_MOST_SENSORS_NAMED])}): "
            f"this report is of serial {kept.serial}."
        )
    if changes := sum(new.serial == old.serial for old, new in pairwise(history)):
        remarks.append(f"The settings were changed {count(changes, 'time')} while it was recorded.")
    if len(frames):
        first, last = (moment(int(frames.stamp_ns[row])) for row in (0, -1))
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


class Series:
    """The n samples of one subject on a time axis, their 12 channels as in `CHANNELS`, and how they came.

    Arrays of n - 1 are of what lies between one sample and the next.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        frames = self.frames = subject.columns  # every frame, also those that are no samples
        samples = self.samples = frames.where(frames.fresh)
        self.count = len(samples)  # n
        since_ns = frames.monotonic_ns - frames.monotonic_ns[:1]
        self.frame_time: Floats = np.multiply(since_ns, 1e-9)  # of every frame, s
        self.time: Floats = self.frame_time[frames.fresh]  # (n,) s
        # From the first frame to the last, s; 0 if there are fewer than two.
        self.duration = float(max(np.ptp(self.frame_time), 0.0)) if len(frames) else 0.0
        self.values: Floats = np.hstack([getattr(samples, group.name) for group in GROUPS])  # (n, 12)
        self.finite: Bools = np.isfinite(self.values)  # (n, 12)
        fields = [getattr(samples, channel.group.saturation) & channel.bit != 0 for channel in CHANNELS]
        self.saturated: Bools = np.column_stack(fields)  # (n, 12) as the sensor says
        flagged = [channel.flagged(samples) != 0 for channel in _OF_GROUP]
        self.usable: Bools = self.finite & ~np.repeat(np.column_stack(flagged), 3, axis=1)  # (n, 12)
        self.not_finite: Bools = ~self.finite.all(axis=1) | ~np.isfinite(samples.temperature)  # (n,)
        self.imu_off = subject.settings.get("imu_active") == 0
        self.intervals: Floats = np.diff(self.time)  # (n - 1,) s
        self.nominal_period = subject.nominal_period_s  # by the settings
        forward = self.intervals[self.intervals > 0]
        # The usual interval, s; what the settings say if there are none.
        self.period = float(np.median(forward)) if len(forward) else self.nominal_period or 1e-3
        self.width = max(self.duration, self.period)  # of the plots over time, s
        self.silent: Bools = np.diff(np.flatnonzero(frames.fresh)) > 1  # REPEATED or INVALID frames between
        accounting = StreamAccounting(fresh_only=False)
        # Not the usual interval: where every other sample is lost, that is two periods.
        accounting.rate_hz = 1 / (self.nominal_period or self.period)
        self.counts = accounting.counts  # the frames' kinds, as every client counts them
        self.missing = self._missing(accounting)
        # Whether the samples on either side do not follow one another.
        self.broken: Bools = self.silent | (self.missing > 0) | (self.intervals <= 0)
        self.broken |= self.intervals > _LONG * self.period
        # By how much each interval with nothing missing in it differs from the usual one, s.
        self.deviations: Floats = self.intervals[~self.broken] - self.period
        off = np.abs(self.deviations)
        self.usual_deviation = float(np.quantile(off, 0.95)) if len(off) else 0.0  # of 95 %, s
        # Whether the stamps are not those of a clock that is followed.
        self.is_irregular = self.usual_deviation > LIMITS.irregular * self.period
        moved = np.diff(samples.stamp_ns - samples.monotonic_ns)
        self.clock_steps: Floats = moved[np.abs(moved) > _STEP_NS] * 1e-9  # adjustments of CLOCK_REALTIME, s
        # Nobody counts what was missing while there was no connection.
        kept = ~self.silent & (self.intervals > 0)
        kept &= (self.missing > 0) | (self.intervals <= _LONG * self.period)
        periods = float(np.sum(1 + self.missing[kept]))
        # s, over everything but silences.
        self.mean_period = float(self.intervals[kept].sum() / periods) if periods else self.period
        self.silences = self._silences()
        self.lost = int(self.missing.sum())  # samples, except those of a silent sensor
        # Those of the lost samples that the server had numbered: the client or recorder was too slow.
        self.withheld = min(self.counts.withheld, self.lost)

    def _missing(self, accounting: StreamAccounting) -> Ints:
        """(n - 1,) how many samples are missing between one and the next, as every client counts them."""
        frames, summed = self.frames, list[int]()
        heads = (array.tolist() for array in (frames.sequence, frames.monotonic_ns, frames.flags))
        for head in zip(*heads, strict=True):
            accounting.count(*head)
            summed.append(self.counts.missing)
        return np.diff(np.array(summed, np.int64)[frames.fresh])

    def _silences(self) -> Floats:
        """How long the sensor was silent each time, s, the time before the first and after the last too."""
        if self.count == 0:
            return np.full(min(len(self.frames), 1), self.duration)
        spans = (self.intervals - (1 + self.missing) * self.period)[self.silent]
        fresh = self.frames.fresh
        ends = [] if fresh[0] else [self.time[0] - self.frame_time[0]]
        ends += [] if fresh[-1] else [self.frame_time[-1] - self.time[-1]]
        return np.asarray(np.maximum(np.concatenate([spans, ends]), 0.0), np.float64)


def bits(fields: Ints) -> int:
    """Every bit that is set in any."""
    return int(np.bitwise_or.reduce(fields))
