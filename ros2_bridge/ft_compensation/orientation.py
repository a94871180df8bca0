"""Where gravity points in the sensor's frame: from the sensor's accelerometer, or from an orientation.

Both kinds of source answer `gravity(now)` with a vector, or with None when what they know is too old or too
uncertain: nobody goes on with an old pose. In between the gyroscope carries them on. Times are seconds on one
clock, the same for everything that is told and asked.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from ft_compensation.attitude.block import BlockSum
from ft_compensation.attitude.carried import CarriedAttitude, Quaternion, matrix_of
from ft_compensation.attitude.tilt import BLOCK_S, GyroscopeOffset, TiltFilter
from ft_compensation.quantities import DEFAULT_GRAVITY, ZERO
from protocol.pdo import STANDARD_GRAVITY, Vector3

_HAIR_S: Final = 1e-6
_FASTEST: Final = 100.0
"""rad/s: three times the largest range. A rate beyond it is none."""
_AT_FIRST: Final = 0.054
"""rad: what `tilt_95` must be below, besides the limit, before there is an answer; 3°."""
_AT_FIRST_BY_MOTION: Final = 0.07
"""The same where only the motion of an arm that never rests tells it."""
_MOST_RATES: Final = 4096
"""Remembered for orientations that come late: 2.5 s at 1600 Hz."""


class AccelerometerGravity:
    """From the sensor's own accelerometer and gyroscope.

    The gyroscope turns the estimate with every sample. Means of the acceleration over `BLOCK_S`, taken in the
    frame that the gyroscope carries along, correct it, as far as `TiltFilter` believes them. Only the
    direction comes from the accelerometer, the length is `magnitude`.
    """

    def __init__(
        self,
        magnitude: float = STANDARD_GRAVITY,
        *,
        time_constant_s: float = 0.5,
        gate: float = 0.5,
        stale_after_s: float = 0.5,
        tilt_limit: float = 0.2,
        offset: GyroscopeOffset | None = None,
    ) -> None:
        """Make a source that knows nothing yet.

        Args:
            magnitude: of gravity, m/s².
            time_constant_s: with which trust grows in an accelerometer that is steady.
            gate: m/s²; a mean counts only if its length is this near `magnitude`.
            stale_after_s: without a sample for this long there is no answer; shorter gaps are bridged.
            tilt_limit: rad; there is no answer while `tilt_95` is larger, nor at first until it is 3°.
            offset: what is known of the gyroscope; it is improved in place.
        """
        if not (magnitude > 0.0 and time_constant_s > 0.0):
            raise ValueError("magnitude of gravity and time constant must be greater than 0")
        self.magnitude, self.gate = magnitude, gate
        self.stale_after_s, self.tilt_limit = stale_after_s, tilt_limit
        self.tilt_95 = math.inf
        """The true tilt of the estimate is below this in 95 % of cases, rad."""
        self.offset = offset or GyroscopeOffset()
        self._filter = TiltFilter(magnitude, gate, time_constant_s, self.offset)
        self._attitude = CarriedAttitude()
        self._is_begun = self._is_known = False
        self._time_s = -math.inf
        self._sum = BlockSum()

    def update(self, acceleration: Vector3 | None, angular_rate: Vector3, time_s: float) -> bool:
        """Take a sample's acceleration (m/s²; None if it was saturated) and angular rate (rad/s).

        False: it cannot be, or nothing is known and it has not the length of gravity. Samples whose
        angular rate is saturated do not belong here: leave them out.
        """
        passed_s = time_s - self._time_s
        if -self.stale_after_s <= passed_s < 0.0:
            time_s, passed_s = self._time_s, 0.0  # a hair early; a clock that was set back is another matter
        if not self._is_begun or not 0.0 <= passed_s <= self.stale_after_s:
            return self._begin(acceleration, time_s)
        tx, ty, tz = angular_rate
        if not tx * tx + ty * ty + tz * tz <= _FASTEST**2:  # nor NaN
            return False
        self._time_s = time_s
        turn = self._attitude.advance(angular_rate, passed_s)
        is_good = self._sum.add(self._attitude, acceleration, angular_rate, turn, passed_s)
        if time_s - self._sum.began_s >= BLOCK_S - _HAIR_S:
            self._close_block(time_s)
        return is_good

    def _begin(self, acceleration: Vector3 | None, time_s: float) -> bool:
        """Guess from one sample, if it can be one of a sensor that does not accelerate."""
        self._is_begun = self._is_known = False
        self.tilt_95 = math.inf
        if acceleration is None or not abs(math.hypot(*acceleration) - self.magnitude) <= self.gate:
            return False
        self._attitude = CarriedAttitude()
        self._attitude.offset = self.offset.value
        self._attitude.level(acceleration)
        self._filter.forget()
        self._is_begun, self._time_s = True, time_s
        self._sum.begin(time_s, self._attitude)
        return True

    def _close_block(self, time_s: float) -> None:
        attitude, tilt = self._attitude, self._filter
        block = self._sum.end(time_s, attitude)
        tilt.predict(block)
        correction = tilt.correct(block, in_use=self._is_known)
        if correction is not None:
            attitude.rotate((*correction, 0.0))
            attitude.offset = self.offset.value
        if tilt.is_wrong:
            self._begin_anew()
        self.tilt_95 = tilt.tilt_95
        at_first = _AT_FIRST_BY_MOTION if tilt.is_by_motion else _AT_FIRST
        limit = self.tilt_limit if self._is_known else min(self.tilt_limit, at_first)
        self._is_known = self.tilt_95 <= limit
        self._sum.begin(time_s, self._attitude)

    def _begin_anew(self) -> None:
        """From the recent steady mean."""
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self._attitude.matrix
        x, y, z = self._filter.steady
        # The matrix's transpose: back into the sensor's frame.
        self._attitude.level((xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z))
        self._filter.begin_anew()
        self._is_known = False

    def age_s(self, now_s: float) -> float:
        """Time since the accelerometer was last used, s; infinite if it never was."""
        if not self._is_begun:
            return math.inf
        return abs(now_s - self._time_s) + self._filter.rejected_s

    def gravity(self, now_s: float) -> Vector3 | None:
        """Gravity in the sensor's frame, m/s²; None when it is not known well enough."""
        if not self._is_known or not abs(now_s - self._time_s) <= self.stale_after_s:
            return None
        x, y, z = self._attitude.matrix[2]
        scale = -self.magnitude
        return x * scale, y * scale, z * scale


class QuaternionGravity:
    """From the orientation of the sensor in a base: the sensor's own estimate, a topic, TF.

    The quaternion turns vectors of the sensor's frame into the base's, as poses and Imu messages have it.
    With `follow`, an orientation is carried on by the gyroscope from its own time to that of the sample.
    """

    def __init__(self, gravity: Vector3 = DEFAULT_GRAVITY, *, stale_after_s: float = 0.1) -> None:
        """`gravity` is in the base, m/s²."""
        self.base_gravity, self.stale_after_s = gravity, stale_after_s
        self._latest: tuple[Vector3, float] | None = None
        self._still: Vector3 | None = None
        """Gravity in the frame that the gyroscope carries."""
        self._attitude = CarriedAttitude()
        self._known: deque[tuple[float, Quaternion]] = deque(maxlen=_MOST_RATES)
        """Attitudes in that frame and their times, of the last `stale_after_s`."""

    def reset(self) -> None:
        """Forget everything."""
        self._latest = self._still = None
        self._known.clear()

    def follow(self, angular_rate: Vector3, time_s: float, offset: Vector3 = ZERO) -> None:
        """Take a sample's angular rate and what the gyroscope reads at rest, rad/s."""
        known, attitude = self._known, self._attitude
        passed_s = time_s - known[-1][0] if known else 0.0
        if not (0.0 <= passed_s <= self.stale_after_s and math.isfinite(sum(angular_rate))):
            known.clear()  # a gap, or a clock that was set: the orientation is held until the next one
            self._still = None
            return
        attitude.offset = offset
        attitude.advance(angular_rate, passed_s)
        known.append((time_s, attitude.quaternion))
        while time_s - known[0][0] > self.stale_after_s:
            known.popleft()

    def update(self, orientation: tuple[float, float, float, float], time_s: float) -> bool:
        """Take an orientation x, y, z, w of time `time_s`. False: it is none, or older than what is known."""
        x, y, z, w = orientation
        size = x * x + y * y + z * z + w * w
        if not 0.5 <= size <= 2.0:
            return False
        # Messages may overtake each other; a clock that was set back is another matter.
        if self._latest is not None and 0.0 < self._latest[1] - time_s <= self.stale_after_s:
            return False
        gx, gy, gz = self.base_gravity
        # The inverse turns base vectors into the sensor's: minus the vector part. |q|² cancels in s.
        s = 2.0 / size
        tx, ty, tz = s * (gy * z - gz * y), s * (gz * x - gx * z), s * (gx * y - gy * x)
        gx, gy, gz = (
            gx + w * tx + (ty * z - tz * y),
            gy + w * ty + (tz * x - tx * z),
            gz + w * tz + (tx * y - ty * x),
        )
        self._latest, self._still = ((gx, gy, gz), time_s), None
        then = self._attitude_at(time_s)
        if then is not None:
            (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix_of(*then)
            self._still = (
                xx * gx + xy * gy + xz * gz,
                yx * gx + yy * gy + yz * gz,
                zx * gx + zy * gy + zz * gz,
            )
        return True

    def _attitude_at(self, time_s: float) -> Quaternion | None:
        """In the carried frame; None if that is not known."""
        known = self._known
        if not known or time_s < known[0][0]:
            return None
        if time_s >= known[-1][0]:
            return self._attitude.ahead(min(time_s - known[-1][0], self.stale_after_s))
        after_s, after = known[-1]
        for at_s, quaternion in reversed(known):
            if at_s <= time_s:
                share = (time_s - at_s) / (after_s - at_s)
                x, y, z, w = (a + share * (b - a) for a, b in zip(quaternion, after, strict=True))
                return x, y, z, w  # between two samples a chord is as long as its arc
            after_s, after = at_s, quaternion
        return None

    def age_s(self, now_s: float) -> float:
        """How old the latest orientation is, s; infinite if there is none."""
        return math.inf if self._latest is None else abs(now_s - self._latest[1])

    def gravity(self, now_s: float) -> Vector3 | None:
        """Gravity in the sensor's frame, m/s²; None when the orientation is older than `stale_after_s`."""
        latest = self._latest
        if latest is None or not abs(now_s - latest[1]) <= self.stale_after_s:
            return None
        if self._still is None:
            return latest[0]
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self._attitude.matrix
        x, y, z = self._still
        return xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z
