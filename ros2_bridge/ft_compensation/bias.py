"""The bias: estimated while the sensor is stationary, ramped in, and undone.

Pose-aware: with a payload, its weight at the pose of the window is not part of the bias, so it stays with
gravity compensation and the bias holds in every pose.
"""

from __future__ import annotations

import threading
from typing import Final, NamedTuple

from ft_compensation.compensator import Compensator
from ft_compensation.quantities import (
    NO_PAYLOAD,
    NO_WRENCH,
    ZERO,
    CompensationError,
    Payload,
    Wrench,
    length,
)
from ft_compensation.stationary import StationaryMeans
from protocol.pdo import STANDARD_GRAVITY, Vector3

GRAVITY_TOLERANCE: Final = 0.5
"""m/s²: how much a stationary accelerometer may differ from g."""


def gravity_of(
    acceleration: Vector3, magnitude: float = STANDARD_GRAVITY, tolerance: float = GRAVITY_TOLERANCE
) -> Vector3:
    """Gravity in the sensor's frame, m/s², from what the stationary accelerometer reads.

    Only the direction is taken from it; `magnitude` is the length. CompensationError if it reads nothing
    like g: by more than `tolerance`, m/s².
    """
    measured = length(acceleration)
    if abs(measured - magnitude) > tolerance:
        raise CompensationError(
            f"the stationary accelerometer reads {measured:.2f} m/s² where {magnitude:.2f} should be: check "
            "imu_raw_units, the IMU's settings and its offset"
        )
    scale = -magnitude / measured
    x, y, z = acceleration
    return x * scale, y * scale, z * scale


def estimate_bias(
    means: StationaryMeans,
    payload: Payload = NO_PAYLOAD,
    gravity: Vector3 | None = None,
) -> Wrench:
    """The bias that makes the compensated wrench of this window zero.

    Args:
        means: of a stationary window (`StationaryWindow.means`).
        payload: what hangs on the sensor; its weight is not counted as bias. Without one everything is.
        gravity: in the sensor's frame, m/s². None: from the window's own accelerometer.
    """
    if not payload.mass:
        return means.wrench
    return means.wrench.plus(weight(payload, gravity or gravity_of(means.acceleration)), -1.0)


def weight(payload: Payload, gravity: Vector3) -> Wrench:
    """What a payload weighs with this gravity in the sensor's frame, m/s²."""
    return Compensator(payload).compensate(ZERO, ZERO, gravity).gravity


_EARLY_S: Final = 0.1
"""A sample may be so much older than the one that a ramp began at."""


class _Course(NamedTuple):
    start: Wrench
    target: Wrench
    begin_s: float
    seconds: float

    def is_under_way(self, now_s: float) -> bool:
        """Whether a sample of this time falls into it.

        One of long before it does not: the clock was set back, and what was to be left behind is left behind.
        """
        return self.seconds > 0.0 and -_EARLY_S <= now_s - self.begin_s < self.seconds


class BiasRamp:
    """The applied bias: moves linearly from the old to the new one; the last change can be undone.

    Times are of the samples, s on any one clock. `at` may run in one thread while others change it.
    """

    def __init__(self, bias: Wrench = NO_WRENCH, seconds: float = 0.0) -> None:
        """`seconds` is how long a change takes; 0 = at once."""
        self.seconds = seconds
        self._course = _Course(bias, bias, 0.0, 0.0)
        self._before: Wrench | None = None
        self._lock = threading.RLock()

    @property
    def target(self) -> Wrench:
        """The bias that it leads to."""
        return self._course.target

    def go(self, target: Wrench, now_s: float) -> None:
        """From the bias of `now_s` (the newest sample's time) to `target`."""
        with self._lock:
            self._before = self.target
            self._course = _Course(self.at(now_s), target, now_s, self.seconds)

    def shift(self, change: Wrench) -> None:
        """At once, whatever it is and was: the sensor itself adds so much more from here on."""
        with self._lock:
            start, target, begin_s, seconds = self._course
            self._course = _Course(start.plus(change), target.plus(change), begin_s, seconds)
            if self._before not in {None, NO_WRENCH}:  # none stays none
                self._before = self._before.plus(change)

    def forget(self) -> None:
        """There is nothing to undo any more."""
        self._before = None

    def undo(self, now_s: float) -> Wrench:
        """Go back to the target before the last `go` and return it. CompensationError if there is none."""
        with self._lock:
            before = self._before
            if before is None:
                raise CompensationError("there is no change of the bias to undo")
            self.go(before, now_s)
            self._before = None
            return before

    def arrived(self, now_s: float) -> bool:
        """Whether the bias of `now_s` is the target."""
        return not self._course.is_under_way(now_s)

    def at(self, now_s: float) -> Wrench:
        """The bias of the sample of time `now_s`."""
        course = self._course
        if not course.is_under_way(now_s):
            return course.target
        start, target, begin_s, seconds = course
        share = max(0.0, (now_s - begin_s) / seconds)
        (ax, ay, az), (au, av, aw) = start
        (bx, by, bz), (bu, bv, bw) = target
        return Wrench(
            (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)),
            (au + share * (bu - au), av + share * (bv - av), aw + share * (bw - aw)),
        )
