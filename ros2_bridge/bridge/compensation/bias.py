"""The bias: estimated from a window at rest, ramped in, and undone.

Pose-aware: with a payload, its weight at the pose of the window is not part of the bias, so it stays with
gravity compensation and the bias holds in every pose.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from bridge.compensation.compensator import Compensator
from bridge.compensation.quantities import (
    NO_PAYLOAD,
    NO_WRENCH,
    ZERO,
    CompensationError,
    Payload,
    Wrench,
    length,
)
from bridge.compensation.still import StillMeans
from protocol.pdo import STANDARD_GRAVITY, Vector3

_UNDO_DEPTH: Final = 16
GRAVITY_TOLERANCE: Final = 0.5
"""m/s²: by how much the accelerometer may miss g at rest before it is not believed."""


def gravity_of(acceleration: Vector3, magnitude: float = STANDARD_GRAVITY) -> Vector3:
    """Gravity in the sensor's frame, m/s², from what the accelerometer reads at rest.

    Only the direction is taken from it; `magnitude` is the length. CompensationError if it reads nothing
    like g.
    """
    measured = length(acceleration)
    if abs(measured - magnitude) > GRAVITY_TOLERANCE:
        raise CompensationError(
            f"at rest the accelerometer reads {measured:.2f} m/s² where {magnitude:.2f} should be: check "
            "imu_raw_units, the IMU's settings and its offset"
        )
    scale = -magnitude / measured
    x, y, z = acceleration
    return x * scale, y * scale, z * scale


def estimate_bias(
    means: StillMeans,
    payload: Payload = NO_PAYLOAD,
    gravity: Vector3 | None = None,
    target: Wrench = NO_WRENCH,
) -> Wrench:
    """The bias that makes the compensated wrench of this window `target`.

    Args:
        means: of a window at rest (`StillWindow.means`).
        payload: what hangs on the sensor; its weight is not counted as bias. Without one everything is.
        gravity: in the sensor's frame, m/s². None: from the window's own accelerometer.
        target: what the environment really exerts meanwhile, zero as a rule.
    """
    if payload.mass:
        weight = (
            Compensator(payload).compensate(ZERO, ZERO, gravity or gravity_of(means.acceleration)).gravity
        )
    else:
        weight = NO_WRENCH
    return Wrench.of(
        [m - w - t for m, w, t in zip(means.wrench.values, weight.values, target.values, strict=True)]
    )


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
    """The applied bias: goes from the old to the new one on a straight line, over a settable time.

    Times are of the samples, s on any one clock. `at` may run in one thread while another calls `go`.
    """

    def __init__(self, bias: Wrench = NO_WRENCH, seconds: float = 0.0) -> None:
        """`seconds` is how long a change takes unless `go` says otherwise; 0 = at once."""
        self.seconds = seconds
        self._course = _Course(bias, bias, 0.0, 0.0)

    @property
    def target(self) -> Wrench:
        """The bias that it leads to."""
        return self._course.target

    def go(self, target: Wrench, now_s: float, seconds: float | None = None) -> None:
        """From the bias of `now_s` (the newest sample's time) to `target`."""
        self._course = _Course(self.at(now_s), target, now_s, self.seconds if seconds is None else seconds)

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


class BiasHistory:
    """The bias in force and those before it, applied through a `BiasRamp`."""

    def __init__(self, bias: Wrench = NO_WRENCH, ramp_seconds: float = 0.0) -> None:
        self.ramp = BiasRamp(bias, ramp_seconds)
        self._before: list[Wrench] = []

    @property
    def bias(self) -> Wrench:
        """The bias in force, or the one that the ramp leads to."""
        return self.ramp.target

    @property
    def can_undo(self) -> bool:
        """Whether there is something to go back to."""
        return bool(self._before)

    def set(self, bias: Wrench, now_s: float) -> None:
        """Put a bias in force; it can be undone (the latest 16 can)."""
        self._before = [*self._before[1 - _UNDO_DEPTH :], self.bias]
        self.ramp.go(bias, now_s)

    def undo(self, now_s: float) -> Wrench:
        """Go back to the bias before and return it. CompensationError if there is none."""
        if not self._before:
            raise CompensationError("there is no change of the bias to undo")
        self.ramp.go(self._before.pop(), now_s)
        return self.bias
