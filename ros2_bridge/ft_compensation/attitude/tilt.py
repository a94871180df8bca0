"""How far the carried attitude is tilted: a Kalman filter of the tilt and of the gyroscope's offset.

One step for each block of about `BLOCK_S`, so that it may use NumPy. The z axis of the still frame is the
estimate of up. The error state, 7 numbers, is

    tilt    (2)  rotation about the still frame's x and y that makes the estimate true, rad
    offset  (3)  what the gyroscope reads at rest beyond `GyroscopeOffset.value`, in the sensor's frame, rad/s
    arm     (2)  how far the arm's own acceleration tilts the measured direction, rad

    d tilt/dt = -(R offset)x,y + noise     R turns vectors of the sensor into the still frame
    measured  = tilt + arm + noise         measured = (fy, -fx) / |f|, f: mean acceleration in the still frame

An arm's acceleration is no white noise: it keeps its direction for up to a second, and adds up to nothing
over a move. While f is steady in the still frame, `arm` is one number, unknown at first, and the longer it
lasts the less likely to be anything but zero. So the offset, which makes f turn, shows at once, and the
direction is trusted after some time constants. While f is not steady, a block is worth little (`_MOTION`).

A block does not count at all if |f| - g is beyond the gate, or if its angle contradicts the estimate. Then
only the gyroscope remains, and the uncertainty grows. A contradiction that is steady for longer than an arm
can accelerate shows that the estimate is wrong: the filter restarts.

The offset is learned at rest only: with f steady in the sensor's frame and the rate steady and small. Turning
about the vertical cannot be seen by the accelerometer, and a slow turn passes for rest. The filter
therefore never learns the offset along gravity, until another pose has made it horizontal; its
variance stays and becomes uncertainty of the tilt when the sensor is turned.

Of an arm that never rests all this learns little: `MotionTilt` helps out.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ft_compensation.attitude.block import Block
from ft_compensation.attitude.covariance import Array, inverse, largest
from ft_compensation.attitude.in_motion import MotionTilt
from ft_compensation.attitude.steadiness import Steadiness
from ft_compensation.quantities import ZERO
from protocol.pdo import Vector3

BLOCK_S: Final = 0.05
"""Long enough for a vibration of 20 Hz to cancel out, a quarter of the shortest move."""
COVERS_95: Final = 2.45
"""A tilt about two axes is within this many standard deviations of one axis in 95 % of cases (Rayleigh)."""

# The gyroscope.
_OFFSET: Final = 0.02**2
"""(rad/s)²: variance of an unknown offset; 0.03 rad/s is usual."""
_OFFSET_DRIFT: Final = 1e-4**2
"""(rad/s)² per s: 0.05 °/s in a minute, by temperature."""
_RATE_NOISE: Final = 1e-3**2
"""(rad/s)² per Hz: 0.03 rad/s at 800 Hz, ten times a healthy sensor's noise, because vibration adds to it."""
_RATE_SCALE: Final = 0.01**2
"""Square of the error of the scale, over turns of about a second."""
_LOST_TURN: Final = 1.25**2
"""(rad/s²)², times s⁴: an eighth of the angular acceleration, 10 rad/s², that a gap between samples may hide
from the mean of the rates at its ends."""

# The accelerometer, as angles: m/s² over g.
_REST: Final = 0.005**2
"""rad²: noise of a block at rest, 0.05 m/s²."""
_SWAY: Final = 0.014**2 * 2 * 0.5 / BLOCK_S
"""rad²: sway of 0.2 m/s² (peak) that changes within half a second, as equivalent white noise: f is steady,
but the sensor does not rest."""
_SWAYING: Final = 0.01**2
"""rad²: what remains of `arm` then, however long it lasts."""
_MOTION: Final = 0.05**2 / BLOCK_S
"""rad²: accelerations of 0.5 m/s² that last for half a second, as equivalent white noise: f is not steady."""
_LENGTH_NOISE: Final = 0.02
"""m/s²: of |f|."""
_ARM: Final = 0.064**2
"""rad²: an acceleration across gravity, 0.6 m/s², that makes f longer by no more than that."""
_UNEVEN: Final = 3 * 2.0
"""rad² per relative error of |f|: an acceleration across gravity, a, makes f longer by a²/2g. Three times
that, because it may also point down a little."""
_OWN_OFFSET: Final = 0.01**2
"""rad²: tilt by an accelerometer offset of 0.1 m/s², which is not observable here."""
_START: Final = math.radians(20.0) ** 2
"""rad²: of a first guess by a sensor that may be accelerated by 3.5 m/s²."""

# When is f steady, when is the sensor at rest? Besides four times the noise of a block.
_STEADY: Final = 0.2
"""m/s², in the still frame: an offset of 0.03 rad/s turns f by 0.09 m/s² within the mean's time."""
_AT_REST: Final = 0.08
"""m/s², in the sensor's frame."""
_STILL: Final = 0.006
"""rad/s: change of the rate."""
_TURNING: Final = 0.1
"""rad/s: beyond it an error of the scale would be learned as an offset."""
_RESTS_S: Final = 0.275
"""Seconds of both that are rest: at its turning points slow motion looks like it."""

# When does a block contradict?
_GATE: Final = 3.0**2
_AGREES: Final = 0.006**2
"""rad²: besides the tilt's own uncertainty, while f is steady: 0.06 m/s²."""
_AGREES_MOVED: Final = 0.05**2
"""rad²: the same while it is not: 0.5 m/s² of vibration or motion."""
_OTHER_POSE: Final = 0.03**2
"""The same, rad² per rad² of a turn, up to 1 rad: an offset of the accelerometer (0.2 m/s²) tilts to another
side then, until the filter has adapted to the new pose: `arm` is known to `_KNOWN_ARM` (rad²)."""
_KNOWN_ARM: Final = 0.03**2
_RECOVERS: Final = 3.0
"""Time constants of steady contradiction after which the estimate, and not the accelerometer, is wrong."""
_HELD_S: Final = 30.0
"""Time constant, s, of the memory of how long the arm held an acceleration: nothing steady is trusted before
it has lasted longer. Otherwise, on an arm that never rests, the filter would believe half of its moves."""
_CONTRADICTED_S: Final = 10.0
"""Seconds without a block that counts from which the estimate is doubted. Arms reverse much earlier."""
_DOUBT: Final = 0.02**2
"""rad² per s, then."""

_IN_DOUBT: Final = 0.05**2, 0.02**2
"""rad²: beyond it `MotionTilt` is taken, if its variance is half of the own; and while nothing is in use."""

_MEASURED: Final = np.eye(2, 7) + np.eye(2, 7, 5)
_ARM_ONLY: Final = np.eye(2, 7, 5)


class GyroscopeOffset:
    """The estimate of a gyroscope's offset. Outlives the filters that learn it."""

    def __init__(self) -> None:
        self.value: Vector3 = ZERO
        """rad/s"""
        self.covariance: Array = np.eye(3) * _OFFSET


class TiltFilter:
    """One step, `predict` and `correct`, for each block."""

    def __init__(
        self, magnitude: float, gate: float, time_constant_s: float, offset: GyroscopeOffset
    ) -> None:
        """`magnitude` of gravity and `gate` are in m/s²."""
        self.magnitude, self.gate, self.time_constant_s = magnitude, gate, time_constant_s
        self.offset = offset
        self.rejected_s = 0.0
        """Since a block counted."""
        self._steady, self._rest, self._still = Steadiness(_STEADY), Steadiness(_AT_REST), Steadiness(_STILL)
        self._covariance: Array
        self._motion = MotionTilt(magnitude)
        self.forget()

    def forget(self) -> None:
        """Nothing is known of the tilt, and nothing has been measured. The offset remains known."""
        p = self._covariance = np.zeros((7, 7))
        p[0, 0] = p[1, 1] = _START
        p[2:5, 2:5] = self.offset.covariance
        p[5, 5] = p[6, 6] = self._first_arm = _ARM
        self._arm = 0.0, 0.0
        self._likely_s = self._held_s = self._turned = self.rejected_s = 0.0
        for each in (self._steady, self._rest, self._still):
            each.forget()
        self._motion.forget(_START, self.offset.covariance)

    def begin_anew(self) -> None:
        """The still frame was leveled by `steady`."""
        lasted_s, size = self._steady.lasted_s, math.hypot(*self._steady.mean)
        self.forget()
        self._steady.lasted_s, self._steady.mean = lasted_s, (0.0, 0.0, size)
        self._likely_s = min(lasted_s, 5.0 * self.time_constant_s)
        p = self._covariance
        p[5, 5] = p[6, 6] = _ARM * math.exp(-2.0 * self._likely_s / self.time_constant_s)

    @property
    def tilt_95(self) -> float:
        """The true tilt is below this in 95 % of cases, rad."""
        return COVERS_95 * math.sqrt(largest(self._covariance) + _OWN_OFFSET)

    @property
    def steady(self) -> Vector3:
        """The recent mean acceleration, m/s² in the still frame."""
        return self._steady.mean

    @property
    def is_wrong(self) -> bool:
        """Whether the accelerometer has contradicted steadily, so that the filter must restart."""
        return min(self.rejected_s, self._steady.lasted_s) > _RECOVERS * self.time_constant_s

    def predict(self, block: Block) -> None:
        """Propagate over the time of a block."""
        passed_s, turned = block.passed_s, math.hypot(*block.rate) * block.passed_s
        self._turned += turned
        self._held_s *= math.exp(-passed_s / _HELD_S)
        f = np.eye(7)
        f[:2, 2:5] = -passed_s * block.attitude[:2]
        p = f @ self._covariance @ f.T
        grows = _RATE_NOISE * passed_s + _RATE_SCALE * turned * turned / passed_s
        grows += _LOST_TURN * block.longest_s**4
        self._motion.follow(block, grows, _OFFSET_DRIFT * passed_s)
        if self.rejected_s > _CONTRADICTED_S:
            grows += _DOUBT * passed_s
        drift = _OFFSET_DRIFT * passed_s
        for axis, more in enumerate((grows, grows, drift, drift, drift)):
            p[axis, axis] += more
        self._covariance = p

    def correct(self, block: Block, *, in_use: bool) -> tuple[float, float] | None:
        """Take a block's acceleration.

        Returns the rotation about x and y by which to turn the attitude, rad; None if the block does not
        count. The offset is corrected in place.
        """
        before = self.offset.value
        found = self._take_motion(_IN_DOUBT[not in_use]) or self._measure(block)
        if found is not None:
            self._motion.corrected(found, np.subtract(self.offset.value, before))
        return found

    def _take_motion(self, doubt: float) -> tuple[float, float] | None:
        """What the arm's velocity tells, where that is much better known."""
        own, motion = largest(self._covariance), self._motion
        if own < doubt or largest(motion.covariance) > 0.5 * own:
            return None
        p = self._covariance = np.diag((0.0, 0.0, 0.0, 0.0, 0.0, _ARM, _ARM))
        p[:5, :5], self._first_arm = motion.covariance[:5, :5], _ARM
        self._likely_s = self.rejected_s = 0.0
        self._steady.forget()
        return self._apply(np.array((*motion.error, 0.0, 0.0)))

    def _measure(self, block: Block) -> tuple[float, float] | None:
        passed_s, mean = block.passed_s, block.acceleration
        self.rejected_s += passed_s
        size = 0.0 if mean is None else math.hypot(*mean)
        uneven = abs(size - self.magnitude)
        if mean is None or not uneven <= self.gate:
            self._steady.forget()
            self._rest.forget()
            return None
        self._watch(block, mean, uneven)
        measured = np.array((mean[1], -mean[0])) / size
        if mean[2] < 0.0:  # more than 90°: as far off as can be
            across = math.hypot(*measured)
            measured = measured / across if across > 1e-6 else np.array((1.0, 0.0))
        lasted_s = self._steady.lasted_s
        scatter = (block.noise / self.magnitude) ** 2
        agrees = (
            (_AGREES if lasted_s else _AGREES_MOVED) + _OTHER_POSE * min(1.0, self._turned) ** 2 + scatter
        )
        if measured @ inverse(self._covariance[:2, :2] + np.eye(2) * agrees) @ measured > _GATE:
            self._held_s = max(self._held_s, min(lasted_s, self.rejected_s))
            return None
        self.rejected_s = 0.0
        is_at_rest = min(self._rest.lasted_s, self._still.lasted_s) > _RESTS_S
        learns = is_at_rest and math.hypot(*block.rate) <= _TURNING
        variance = scatter + (_MOTION if not lasted_s else _REST if is_at_rest else _SWAY)
        error = np.array((0.0, 0.0, 0.0, 0.0, 0.0, *self._arm))
        error = self._update(error, _MEASURED, measured, variance, learns)
        if lasted_s > self._held_s and (is_at_rest or self._covariance[5, 5] > _SWAYING):
            error = self._update(error, _ARM_ONLY, np.zeros(2), self._less_likely(passed_s), learns)
        if lasted_s and self._covariance[5, 5] < _KNOWN_ARM:
            self._turned = 0.0
        return self._apply(error)

    def _watch(self, block: Block, mean: Vector3, uneven: float) -> None:
        """Follow for how long the acceleration has been steady; if it is another, `arm` is unknown again."""
        x, y, z = (block.attitude.T @ mean).tolist()
        self._rest.watch((x, y, z), block.passed_s, block.noise)
        self._still.watch(block.rate, block.passed_s, block.rate_noise)
        if not self._steady.watch(mean, block.passed_s, block.noise):
            self._arm, self._likely_s = (0.0, 0.0), 0.0
            self._first_arm = _ARM + _UNEVEN * max(0.0, uneven - _LENGTH_NOISE - block.noise) / self.magnitude
            p = self._covariance
            p[5:] = p[:, 5:] = 0.0
            p[5, 5] = p[6, 6] = self._first_arm

    def _update(self, error: Array, h: Array, measured: Array, noise: float, learns: bool) -> Array:
        """Take `measured` (2,) = `h @ error` + noise (its variance); returns the new estimate."""
        p = self._covariance
        ph = p @ h.T
        gain = ph @ inverse(h @ ph + np.eye(2) * noise)
        if not learns:  # a consider state: uncertain, but not corrected
            gain[2:5] = 0.0
        m = np.eye(7) - gain @ h
        p = m @ p @ m.T + noise * gain @ gain.T  # Joseph's form: right for any gain
        self._covariance = 0.5 * (p + p.T)
        return error + gain @ (measured - h @ error)

    def _less_likely(self, passed_s: float) -> float:
        """Variance, rad², of measuring `arm` = 0, which a block more of steadiness amounts to.

        All of them together leave `arm` a standard deviation that falls exponentially.
        """
        past, more = 2.0 * self._likely_s / self.time_constant_s, 2.0 * passed_s / self.time_constant_s
        self._likely_s = min(self._likely_s + passed_s, 5.0 * self.time_constant_s)
        return self._first_arm / (math.exp(past) * math.expm1(min(more, 10.0)))

    def _apply(self, error: Array) -> tuple[float, float]:
        tilt_x, tilt_y, dx, dy, dz, arm_x, arm_y = error.tolist()
        self._arm = arm_x, arm_y
        x, y, z = self.offset.value
        self.offset.value = x + dx, y + dy, z + dz
        self.offset.covariance = self._covariance[2:5, 2:5]
        x, y, z = self._steady.mean  # the still frame is about to be turned
        self._steady.mean = x + tilt_y * z, y - tilt_x * z, z + tilt_x * y - tilt_y * x
        return tilt_x, tilt_y
