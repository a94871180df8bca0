# SPDX-License-Identifier: Apache-2.0
"""Observes one sensor over a time that ends now: what the server says of it in `describe`, `status` and
events (`SensorObserver`), and its frames, of which every one is used (`StreamObserver`).
"""

from __future__ import annotations

import functools
import math
import operator
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.accounting import NOT_NEW, FrameKind, StreamAccounting, StreamCounts
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.judge import Observation, emergency
from bota_ethercat.health.limits import LIMITS, StreamLimits
from bota_ethercat.health.sentences import drift
from bota_ethercat.pdo import LAYOUTS, PdoLayout, is_finite
from bota_ethercat.replies import SensorInfo, SensorStatus, Status
from bota_ethercat.stream.timeline import InForce

COMMON: Final[PdoLayout] = LAYOUTS[min(LAYOUTS)]  # the fields of every size of process data
_FLAGS: Final = tuple(
    COMMON.index(name)
    for name in ("warnings", "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated")
)
_TEMPERATURE: Final = COMMON.index("temperature")
_MAX_KEPT: Final = 1 << 16
_COUNTED: Final = ("lost_samples", "not_finite", "recoveries")  # what has grown matters
_MAX_HZ: Final = 1e6  # a rate beyond it is no sensor's, and not known


def by_sensor(frames: Iterable[DataMessage]) -> dict[int, list[DataMessage]]:
    """The frames of each sensor, in the order in which they came."""
    found: dict[int, list[DataMessage]] = {}
    for frame in frames:
        found.setdefault(frame.sensor, []).append(frame)
    return found


class _Batch(NamedTuple):
    """What came at one moment."""

    at_ns: int
    counts: tuple[int, ...] = (0,) * 5  # samples, missing ones; frames repeated and invalid; not finite
    flags: tuple[int, ...] = (0,) * len(_FLAGS)
    silent_ns: int = 0  # how long before there had been no sample; 0 if it brings none
    held_ns: int = 0  # of that, for how long samples had been made that came later
    first_ns: int = 0  # `monotonic_ns` of the first and the last sample; 0 if it brings none
    last_ns: int = 0

    def then(self, later: _Batch) -> _Batch:
        return _Batch(
            later.at_ns,
            tuple(map(operator.add, self.counts, later.counts)),
            tuple(map(operator.or_, self.flags, later.flags)),
            *max((self.silent_ns, self.held_ns), (later.silent_ns, later.held_ns)),
            self.first_ns or later.first_ns,
            later.last_ns or self.last_ns,
        )


class SensorObserver:
    """What the server says of one sensor, and what came of it in some time.

    Attributes:
        in_force: what is in force for its samples.
        status: its row of the newest `status`; nothing is known before the first of a connection.
    """

    def __init__(self) -> None:
        self.in_force, self.status = InForce(SensorInfo()), SensorStatus()
        self._missed_deadlines: int | None = None
        self._grown: deque[tuple[int, str, int]] = deque()  # when, what, and by how much
        self._unread: deque[tuple[int, tuple[float, bool]]] = deque()  # when, and of `Client.take_unread`
        self._dated: tuple[deque[Any], ...] = self._grown, self._unread
        self._emergency = "", 0  # and when it came
        self._emergencies: int | None = 0  # how many there were when `_emergency` was the last

    def connected(self, now_ns: int) -> None:
        """A connection was made."""
        if self.in_force.is_described:
            self._grown.append((now_ns, "reconnects", 1))
        self.disconnected()

    def disconnected(self) -> None:
        """Counts are not compared with those of another connection."""
        self.status, self._missed_deadlines = SensorStatus(), None

    def add_status(self, status: Status, position: int, now_ns: int) -> None:
        """A reply to `status`, in which it is the sensor at `position`."""
        before, row = self.status, status.find(position)
        counts = [(name, getattr(before, name), getattr(row, name)) for name in _COUNTED]
        for name, was, count in [
            *counts, ("missed_deadlines", self._missed_deadlines, status.missed_deadlines)
        ]:  # fmt: skip
            if was is not None and count is not None and count > was:
                self._grown.append((now_ns, name, count - was))
        if row.emergencies != self._emergencies and row.emergency.ago_s is not None:
            self._emergencies = row.emergencies
            self._emergency = emergency(row.emergency), now_ns - round(row.emergency.ago_s * 1e9)
        self.status, self._missed_deadlines = row, status.missed_deadlines

    def note_unread(self, unread: tuple[float, bool], now_ns: int) -> None:
        """What `Client.take_unread` has returned just now."""
        while self._unread and self._unread[-1][1] <= unread:  # never the worst again
            self._unread.pop()
        self._unread.append((now_ns, unread))

    def restart(self) -> None:
        """What comes from here on counts."""
        for dated in self._dated:
            dated.clear()

    def forget(self) -> None:
        """Forget all that has been."""
        self.restart()
        self._emergency = "", 0

    def grown(self, name: str, since_ns: int = 0) -> int:
        """By how much a count of `status` has grown, as known since then."""
        return sum(by for at_ns, what, by in self._grown if what == name and at_ns >= since_ns)

    def complete(
        self, seen: Observation, now_ns: int, window_ns: int | None = None, limits: StreamLimits = LIMITS
    ) -> Observation:
        """`seen` of its frames, with what the server said, at most in the last `window_ns`."""
        since_ns = now_ns - window_ns if window_ns else 0
        said, at_ns = self._emergency
        mode = self.status.clock.mode
        unread_s, busy = max((each for at, each in self._unread if at >= since_ns), default=(0.0, None))
        return seen._replace(
            unread_s=unread_s,
            busy=busy,
            not_finite=max(seen.not_finite, self.grown("not_finite", since_ns)),
            recoveries=self.grown("recoveries", since_ns),
            missed_deadlines=self.grown("missed_deadlines", since_ns),
            reconnects=self.grown("reconnects", since_ns),
            locked=mode == "locked" if mode else None,
            is_lost=self.in_force.lost is not None,
            state=self.in_force.info.state,
            emergency=said if 0 <= now_ns - at_ns < limits.emergency_s * 1e9 else "",
            drift=drift(self.status, limits),
            settings=self.in_force.info.settings,
        )


class StreamObserver(SensorObserver):
    """One sensor's frames from `start_ns` (CLOCK_MONOTONIC) on, subscribed to with `fresh_only` false.

    Attributes:
        newest: process data of the newest sample of this connection.
    """

    def __init__(self, nominal_hz: float, start_ns: int, *, window_ns: int | None = None) -> None:
        """`window_ns`: look back no further than this."""
        super().__init__()
        self._window_ns = window_ns
        self._batches: deque[_Batch] = deque()
        # When each came, and: the age of samples, ns; the interval between samples that follow one another.
        self._ages: deque[tuple[int, int]] = deque(maxlen=_MAX_KEPT)
        self._intervals: deque[tuple[int, int]] = deque(maxlen=_MAX_KEPT)
        self.connected(start_ns)
        self.begin(nominal_hz, start_ns)

    def connected(self, now_ns: int) -> None:
        """A connection was made: nothing before its first frame counts as missing."""
        super().connected(now_ns)
        self.newest: bytes | None = None
        self._accounting = StreamAccounting(fresh_only=False)
        self._previous_ns: int | None = None  # the newest sample's stamp, unless other frames have come since
        self._temperature: float | None = None

    @property
    def counts(self) -> StreamCounts:
        """Of all frames from the beginning on, however short the window is."""
        return self._accounting.counts

    def begin(self, nominal_hz: float, start_ns: int) -> None:
        """Observe from here on, at this rate; the counts go on."""
        self._nominal_hz = nominal_hz if 0 < nominal_hz <= _MAX_HZ else 0.0
        self._accounting.rate_hz = self._nominal_hz
        self._start_ns = self._fresh_at_ns = start_ns
        self._forget_frames()

    def forget(self) -> None:
        """Forget all that has been."""
        super().forget()
        self._forget_frames()

    def _forget_frames(self) -> None:
        for kept in (self._batches, self._ages, self._intervals):
            kept.clear()

    def add_frames(self, frames: Sequence[DataMessage], now_ns: int) -> list[tuple[Any, ...]]:
        """Frames that came just now, oldest first; the values of the new samples, as in COMMON."""
        if not frames:
            return []
        counts, count, before = self._accounting.counts, self._accounting.count, self._counted()
        fresh: list[DataMessage] = []
        previous, missing = self._previous_ns, counts.missing
        apart_ns = -1 if previous is None else 0  # the longest time in which no sample was made; -1: unknown
        for frame in frames:
            if count(frame.sequence, frame.monotonic_ns, frame.flags) is not FrameKind.NEW:
                previous, apart_ns = None, -1
                continue
            if previous is not None and counts.missing == missing:
                self._intervals.append((now_ns, frame.monotonic_ns - previous))
            if previous is not None and apart_ns >= 0:
                made_ns = round((counts.missing - missing) * 1e9 / (self._nominal_hz or 1e9))
                apart_ns = max(apart_ns, frame.monotonic_ns - previous - made_ns)
            previous, missing = frame.monotonic_ns, counts.missing
            fresh.append(frame)
        self._previous_ns = previous
        not_finite = sum(not is_finite(frame.process_data) for frame in fresh)
        batch = _Batch(now_ns, (*map(operator.sub, self._counted(), before), not_finite))
        rows = [COMMON.struct.unpack_from(frame.process_data) for frame in fresh]
        if fresh:
            self.newest, self._temperature = fresh[-1].process_data, rows[-1][_TEMPERATURE]
            batch = batch._replace(
                flags=tuple(functools.reduce(operator.or_, (row[index] for row in rows)) for index in _FLAGS),
                silent_ns=now_ns - self._fresh_at_ns,
                held_ns=max(now_ns - self._fresh_at_ns - apart_ns, 0) if apart_ns >= 0 else 0,
                first_ns=fresh[0].monotonic_ns,
                last_ns=fresh[-1].monotonic_ns,
            )
            self._fresh_at_ns = now_ns
        if self._window_ns is None and self._batches:
            batch = self._batches.pop().then(batch)
        self._batches.append(batch)
        self._drop(now_ns)
        return rows

    def note_age(self, frame: DataMessage, now_ns: int) -> None:
        """This frame was waited for and came just now, on the server's own machine."""
        if not frame.flags & NOT_NEW:
            self._ages.append((now_ns, now_ns - frame.monotonic_ns))

    def silent_s(self, now_ns: int) -> float:
        """Time since the newest sample came, or since the beginning."""
        return (now_ns - self._fresh_at_ns) * 1e-9

    def observation(self, now_ns: int, window_ns: int | None = None) -> Observation:
        """What was seen until now, at most in the last `window_ns`."""
        window_ns = window_ns or self._window_ns
        self._drop(now_ns)
        batches = (each for each in self._batches if window_ns is None or each.at_ns >= now_ns - window_ns)
        seen = functools.reduce(_Batch.then, batches, _Batch(now_ns))
        seconds = (now_ns - self._start_ns) * 1e-9
        samples, lost, repeated, invalid, not_finite = seen.counts
        warnings, force_torque, acceleration, angular_rate = seen.flags
        span_ns = seen.last_ns - seen.first_ns
        since_ns = now_ns - self._fresh_at_ns
        found = Observation(
            seconds=seconds if window_ns is None else min(seconds, window_ns * 1e-9),
            samples=samples,
            lost=lost,
            repeated=repeated,
            invalid=invalid,
            silent_s=max(seen.silent_ns, since_ns) * 1e-9,
            held_s=seen.held_ns * 1e-9 if seen.silent_ns > since_ns else 0.0,
            rate_hz=(samples - 1) * 1e9 / span_ns if span_ns > 0 else None,
            nominal_hz=self._nominal_hz,
            age_p99_us=p99(self.ages_us(now_ns, window_ns)),
            not_finite=not_finite,
            temperature=self._temperature,
            warnings=warnings,
            force_torque_saturated=force_torque,
            acceleration_saturated=acceleration,
            angular_rate_saturated=angular_rate,
        )
        return self.complete(found, now_ns, window_ns)

    def ages_us(self, now_ns: int, window_ns: int | None = None) -> list[float]:
        """The ages noted, at most those of the last `window_ns`."""
        self._drop(now_ns)
        return [age * 1e-3 for at_ns, age in self._ages if window_ns is None or at_ns >= now_ns - window_ns]

    def jitter_us(self, now_ns: int) -> tuple[float, float] | None:
        """Standard deviation of the intervals between stamps, and the largest deviation from their mean."""
        self._drop(now_ns)
        intervals = [interval for _, interval in self._intervals]
        if len(intervals) < 2:
            return None
        mean = sum(intervals) / len(intervals)
        deviation = math.dist(intervals, [mean] * len(intervals)) / math.sqrt(len(intervals))
        return deviation / 1e3, max(max(intervals) - mean, mean - min(intervals)) / 1e3

    def _counted(self) -> tuple[int, ...]:
        counts = self._accounting.counts
        return counts.new, counts.missing, counts.repeated, counts.invalid

    def _drop(self, now_ns: int) -> None:
        """Drop what is older than the window."""
        if self._window_ns is None:
            return
        oldest_ns = now_ns - self._window_ns
        all_kept: tuple[deque[Any], ...] = self._batches, self._ages, self._intervals, *self._dated
        for kept in all_kept:
            while kept and kept[0][0] < oldest_ns:
                kept.popleft()


def p99(values: Collection[float]) -> float | None:
    """The value that 99 % do not exceed; None without values. A single outlier of a few is none of it."""
    return sorted(values)[(len(values) - 1) * 99 // 100] if values else None
