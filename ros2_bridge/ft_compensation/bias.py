# SPDX-License-Identifier: Apache-2.0
"""The bias: estimated while the sensor is stationary, ramped in, and undone.

Pose-aware: with a payload, its weight at the pose of the window is not part of the bias, so it stays with
gravity compensation and the bias holds in every pose. `Taken` is what it takes to tell the bias for another
payload.
"""

from __future__ import annotations

import math
import threading
from typing import Final, NamedTuple

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from ft_compensation.compensator import Compensator
from ft_compensation.quantities import (
    NO_PAYLOAD,
    NO_WRENCH,
    NORMAL_95,
    ZERO,
    Accelerometer,
    CompensationError,
    Payload,
    Wrench,
    length,
    wrench_text,
)
from ft_compensation.stationary import StationaryMeans

# From half of an interval of one axis to the radius that holds as often for three (chi, 3 degrees), ...
_ABOUT_THREE_AXES: Final = 2.80 / NORMAL_95
# ... and for three times the distance between the directions of gravity in two poses, which are any.
_BETWEEN_POSES: Final = 4.39 / NORMAL_95


def check_at_rest(acceleration: Vector3, magnitude: float, tolerance: float = 0.5) -> None:
    """CompensationError unless the stationary accelerometer reads `magnitude`, m/s², within `tolerance`."""
    measured = length(acceleration)
    if abs(measured - magnitude) > tolerance:
        raise CompensationError(
            f"the stationary accelerometer reads {measured:.2f} m/s² where {magnitude:.2f} should be: check "
            "imu_raw_units, the IMU's settings and its offset"
        )


def force_bound_95(payload: Payload, accelerometer: Accelerometer, taken: Taken | None = None) -> float:
    """N: in 95 % of cases what is not known of the accelerometer shows as less force, in any pose.

    A bias `taken` by a tare that went by this accelerometer has the part of its offset in it, and what its
    scale and crossed axes did in that pose.
    """
    cross = accelerometer.cross_axis_interval
    largest = STANDARD_GRAVITY * max(*accelerometer.scale_interval, *cross)
    if taken is not None and taken.accelerometer == accelerometer:
        return payload.mass * _BETWEEN_POSES * largest
    per_axis = zip(
        accelerometer.offset_interval, accelerometer.scale_interval, cross[::2], cross[1::2], strict=True
    )
    halves = [math.hypot(offset, STANDARD_GRAVITY * max(parts)) for offset, *parts in per_axis]
    return payload.mass * _ABOUT_THREE_AXES * max(halves)


def estimate_bias(means: StationaryMeans, payload: Payload, specific_force: Vector3) -> Wrench:
    """The bias that makes the compensated wrench of this stationary window zero.

    The weight of `payload` is not counted as bias; without one everything is. `specific_force` is that during
    the window, in the sensor's frame, m/s².
    """
    return means.wrench.plus(_weight(payload, specific_force), -1.0)


def _weight(payload: Payload, specific_force: Vector3) -> Wrench:
    return Compensator(payload).compensate(ZERO, ZERO, specific_force).tool


class Taken(NamedTuple):
    """What a bias was taken with."""

    payload: Payload = NO_PAYLOAD  # whose weight is not part of it
    # During the tare, in the sensor's frame, m/s². None: unknown. Zero: of no tare, it holds for any.
    specific_force: Vector3 | None = ZERO
    accelerometer: Accelerometer | None = None  # as it was corrected, where that is by the sensor's own

    def weighed(self, payload: Payload) -> tuple[Wrench, Taken]:
        """By how much the bias is another for this payload; nothing if the specific force is unknown."""
        if self.specific_force is None or payload == self.payload:
            return NO_WRENCH, self
        before, now = (_weight(each, self.specific_force) for each in (self.payload, payload))
        return before.plus(now, -1.0), self._replace(payload=payload)

    def warning(self, change: Wrench, payload: Payload) -> str:
        """What `weighed`, and its `change`, mean for a user, a sentence; empty if nothing."""
        if change == NO_WRENCH:
            return self.doubt(payload)
        return (
            "the tool's parameters are not those of the tare: the bias is what it finds with the new ones, "
            f"another by {wrench_text(change)}; if the tool was put on or exchanged since, tare again"
        )

    def doubt(self, payload: Payload) -> str:
        """Why the bias may not fit this payload, a sentence; empty if it does."""
        if self.specific_force is not None or payload == self.payload:
            return ""
        (was, (ax, ay, az), _), (mass, (bx, by, bz), _) = self.payload, payload
        moved = mass * bx - was * ax, mass * by - was * ay, mass * bz - was * az
        return (
            f"the bias was taken with {self.payload}, and in which pose is not known: with {payload} it may "
            f"be wrong by {abs(mass - was) * STANDARD_GRAVITY:.3g} N and "
            f"{length(moved) * STANDARD_GRAVITY:.3g} Nm in every pose: tare again"
        )


_OF_NO_TARE: Final = Taken()
_EARLY_S: Final = 0.1  # a sample may be so much older than the one that a ramp began at


class _Course(NamedTuple):
    start: Wrench
    target: Wrench
    begin_s: float
    seconds: float
    taken: Taken  # the target

    def is_under_way(self, now_s: float) -> bool:
        """Whether a sample of this time falls into it.

        One of long before it does not: the clock was set back, and what was to be left behind is left behind.
        """
        return self.seconds > 0.0 and -_EARLY_S <= now_s - self.begin_s < self.seconds

    def shifted(self, change: Wrench, taken: Taken) -> _Course:
        return self._replace(start=self.start.plus(change), target=self.target.plus(change), taken=taken)


class BiasRamp:
    """The applied bias: moves linearly from the old to the new one; the last change can be undone.

    Times are of the samples, s on any one clock. `at` may run in one thread while others change it.
    """

    def __init__(self, bias: Wrench = NO_WRENCH, seconds: float = 0.0) -> None:
        """`seconds` is how long a change takes; 0 = at once."""
        self.seconds = seconds
        self._course = _Course(bias, bias, 0.0, 0.0, _OF_NO_TARE)
        self._before: tuple[Wrench, Taken] | None = None
        self._lock = threading.RLock()

    @property
    def target(self) -> Wrench:
        """The bias that it leads to."""
        return self._course.target

    @property
    def taken(self) -> Taken:
        """What that was taken with."""
        return self._course.taken

    def go(self, target: Wrench, now_s: float, taken: Taken = _OF_NO_TARE, *, may_undo: bool = True) -> None:
        """From the bias of `now_s` (the newest sample's time) to `target`."""
        with self._lock:
            self._before = (self.target, self.taken) if may_undo else None
            self._course = _Course(self.at(now_s), target, now_s, self.seconds, taken)

    def shift(self, change: Wrench) -> None:
        """At once, whatever it is and was: the sensor itself adds so much more from here on."""
        with self._lock:
            self._course = self._course.shifted(change, self.taken)
            if self._before is not None and self._before[0] != NO_WRENCH:  # none stays none
                self._before = self._before[0].plus(change), self._before[1]

    def weighed(self, payload: Payload) -> BiasRamp:
        """Another ramp that is as far, for another payload."""
        other = BiasRamp(seconds=self.seconds)
        with self._lock:
            other._course = self._course.shifted(*self.taken.weighed(payload))
            if self._before is not None:
                change, taken = self._before[1].weighed(payload)
                other._before = self._before[0].plus(change), taken
        return other

    def undo(self, now_s: float) -> Wrench:
        """Go back to the target before the last `go` and return it. CompensationError if there is none."""
        with self._lock:
            before = self._before
            if before is None:
                raise CompensationError("there is no tare to undo")
            self.go(before[0], now_s, before[1])
            self._before = None
            return before[0]

    def arrived(self, now_s: float) -> bool:
        """Whether the bias of `now_s` is the target."""
        return not self._course.is_under_way(now_s)

    def at(self, now_s: float) -> Wrench:
        """The bias of the sample of time `now_s`."""
        course = self._course
        if not course.is_under_way(now_s):
            return course.target
        start, target, begin_s, seconds, _ = course
        share = max(0.0, (now_s - begin_s) / seconds)
        (ax, ay, az), (au, av, aw) = start
        (bx, by, bz), (bu, bv, bw) = target
        return Wrench(
            (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)),
            (au + share * (bu - au), av + share * (bv - av), aw + share * (bw - aw)),
        )
