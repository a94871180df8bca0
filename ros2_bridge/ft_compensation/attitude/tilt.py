"""How far the carried attitude is tilted: a Kalman filter of the tilt and of the gyroscope's offset.

One step for each block of about `BLOCK_S`, so that it may use NumPy. The z axis of the still frame is the
estimate of up. The error state, 7 numbers, is

    tilt    (2)  rotation about the still frame's x and y that makes the estimate true, rad
    offset  (3)  what the gyroscope reads at rest beyond `GyroscopeOffset.value`, in the sensor's frame, rad/s
    arm     (2)  how far the arm's own acceleration tilts the measured direction, rad

    d tilt/dt = -(R offset)x,y + noise     R turns vectors of the sensor into the still frame
    measured  = tilt + arm + noise         measured = (fy, -fx) / |f|, f: mean acceleration in the still frame

An arm's acceleration is no white noise: it keeps its direction for up to a second, and adds up to nothing
over a move. While f is steady in the still frame, `arm` is one number (`ArmAcceleration`). So the offset,
which makes f turn, shows at once, and the direction is trusted after some time constants. While f is not
steady, a block is worth little (`_MOTION`).

A block's direction does not count if |f| - g is beyond the gate, or if its angle contradicts the estimate:
then `arm` may be anything, and only how f turns while it is steady tells something of the tilt. The
uncertainty grows. A contradiction that is steady for longer than an arm can accelerate shows that the
estimate is wrong: the filter restarts.

The offset is learned at rest only: with f steady in the sensor's frame and the rate steady and small. Turning
about the vertical cannot be seen by the accelerometer, and a slow turn passes for rest. The filter
therefore never learns the offset along gravity, until another pose has made it horizontal; its
variance stays and becomes uncertainty of the tilt when the sensor is turned.
Of an arm that never rests all this learns little: `MotionTilt` helps.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ft_compensation.attitude.arm import ANY_ARM, ArmAcceleration
from ft_compensation.attitude.block import Block
from ft_compensation.attitude.covariance import Array, inverse, largest
from ft_compensation.attitude.in_motion import MotionTilt
from ft_compensation.attitude.steadiness import Rest, Steadiness
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
_STEADY_ARM: Final = 0.5 * _SWAY
"""rad²: the same of an arm that accelerates."""
_AT_FIRST: Final = 0.7
"""Steadiness counts for so much of its time while nothing is in use: the arm may have been moving before."""
_LONGEST_ARM_S: Final = 1.5
"""Arms do not accelerate for longer."""
_SWAYING: Final = 0.01**2
"""rad²: what remains of `arm` then, however long it lasts."""
_MOTION: Final = 0.05**2 / BLOCK_S
"""rad²: accelerations of 0.5 m/s² that last for half a second, as equivalent white noise: f is not steady."""
_OWN_OFFSET: Final = 0.01**2
"""rad²: tilt by an accelerometer offset of 0.1 m/s², which is not observable here."""
_ANY_LENGTH: Final = 0.5
"""Part of g by which |f| may differ from it: not in free fall or a shock."""
_START: Final = math.radians(20.0) ** 2
"""rad²: of a first guess by a sensor that may be accelerated by 3.5 m/s²."""

_STEADY: Final = 0.2
"""m/s², in the still frame, besides four times the noise of a block: an offset of 0.03 rad/s turns f by
0.09 m/s² within the mean's time."""
_TURNING: Final = 0.1
"""rad/s: beyond it an error of the scale would be learned as an offset."""

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
"""Seconds without a block that counts before the estimate is doubted. Arms reverse earlier."""
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
        self.is_by_motion = False
        """Whether the last block's correction is `MotionTilt`'s."""
        self._steady, self._rest = Steadiness(_STEADY), Rest()
        self._covariance: Array
        self._motion = MotionTilt(magnitude)
        self._arm = ArmAcceleration(magnitude, time_constant_s)
        self.forget()

    def forget(self) -> None:
        """Nothing is known of the tilt, and nothing has been measured. The offset remains known."""
        p = self._covariance = np.zeros((7, 7))
        p[0, 0] = p[1, 1] = _START
        p[2:5, 2:5] = self.offset.covariance
        self._arm.is_new(p)
        self._held_s = self._turned = self.rejected_s = 0.0
        self._steady.forget()
        self._rest.forget()
        self._motion.forget(_START, self.offset.covariance)

    def begin_anew(self) -> None:
        """The still frame was leveled by `steady`."""
        lasted_s, size = self._steady.lasted_s, math.hypot(*self._steady.mean)
        self.forget()
        self._steady.lasted_s, self._steady.mean = lasted_s, (0.0, 0.0, size)
        self._arm.is_new(self._covariance, lasted_s=lasted_s)

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
        lasted_s = min(self.rejected_s, self._steady.lasted_s)
        return lasted_s > _RECOVERS * self.time_constant_s and self._is_near_g(math.hypot(*self.steady))

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
        found = self._take_motion(_IN_DOUBT[not in_use])
        self.is_by_motion = found is not None
        found = found or self._measure(block, in_use)
        if found is not None:
            self._motion.corrected(found, np.subtract(self.offset.value, before))
        return found

    def _take_motion(self, doubt: float) -> tuple[float, float] | None:
        """What the arm's velocity tells, where that is much better known."""
        own, motion = largest(self._covariance), self._motion
        if own < doubt or largest(motion.covariance) > 0.5 * own:
            return None
        p = self._covariance = np.zeros((7, 7))
        p[:5, :5] = motion.covariance[:5, :5]
        self._arm.is_new(p)
        self.rejected_s = 0.0
        self._steady.forget()
        return self._apply(np.array((*motion.error, 0.0, 0.0)))

    def _measure(self, block: Block, in_use: bool) -> tuple[float, float] | None:
        passed_s, mean = block.passed_s, block.acceleration
        self.rejected_s += passed_s
        size = 0.0 if mean is None else math.hypot(*mean)
        if mean is None or not abs(size - self.magnitude) <= max(self.gate, _ANY_LENGTH * self.magnitude):
            self._steady.forget()
            self._rest.forget()
            return None
        self._watch(block, mean, size)
        measured = np.array((mean[1], -mean[0])) / size
        if mean[2] < 0.0:  # more than 90°: as far off as can be
            across = math.hypot(*measured)
            measured = measured / across if across > 1e-6 else np.array((1.0, 0.0))
        lasted_s = self._steady.lasted_s
        scatter = (block.noise / self.magnitude) ** 2
        agrees = _OTHER_POSE * min(1.0, self._turned) ** 2 + scatter
        agrees += _AGREES if lasted_s else _AGREES_MOVED
        is_near_g = self._is_near_g(size)
        weight = inverse(self._covariance[:2, :2] + np.eye(2) * agrees)
        if not is_near_g or measured @ weight @ measured > _GATE:
            if is_near_g:
                self._held_s = max(self._held_s, min(lasted_s, self.rejected_s))
            if not lasted_s:
                self._arm.is_new(self._covariance, ANY_ARM)
            if not 0.0 < lasted_s < _LONGEST_ARM_S:
                return None
            variance = scatter + _STEADY_ARM
            return self._apply(self._update(self._arm.error, _MEASURED, measured, variance, learns=False))
        self.rejected_s = 0.0
        is_at_rest = self._rest.is_rest
        learns = is_at_rest and math.hypot(*block.rate) <= _TURNING
        variance = scatter + (_MOTION if not lasted_s else _REST if is_at_rest else _SWAY)
        error = self._update(self._arm.error, _MEASURED, measured, variance, learns)
        if lasted_s > self._held_s and (is_at_rest or self._covariance[5, 5] > _SWAYING):
            error = self._update(
                error,
                _ARM_ONLY,
                np.zeros(2),
                self._arm.less_likely(passed_s * (1.0 if in_use else _AT_FIRST)),
                learns,
            )
        if lasted_s and self._covariance[5, 5] < _KNOWN_ARM:
            self._turned = 0.0
        return self._apply(error)

    def _watch(self, block: Block, mean: Vector3, size: float) -> None:
        """Follow for how long the acceleration has been steady; if it is another, `arm` is unknown again."""
        self._rest.watch(block, mean)
        if not self._steady.watch(mean, block.passed_s, block.noise):
            self._arm.is_new(self._covariance, self._arm.by_length(size, block.noise))

    def _is_near_g(self, size: float) -> bool:
        return abs(size - self.magnitude) <= self.gate

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

    def _apply(self, error: Array) -> tuple[float, float]:
        tilt_x, tilt_y, dx, dy, dz, arm_x, arm_y = error.tolist()
        self._arm.tilt = arm_x, arm_y
        x, y, z = self.offset.value
        self.offset.value = x + dx, y + dy, z + dz
        self.offset.covariance = self._covariance[2:5, 2:5]
        x, y, z = self._steady.mean  # the still frame is about to be turned
        self._steady.mean = x + tilt_y * z, y - tilt_x * z, z + tilt_x * y - tilt_y * x
        return tilt_x, tilt_y
