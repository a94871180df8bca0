"""Where gravity points in the sensor's frame: from the sensor's accelerometer, or from an orientation.

Both kinds of source answer `gravity(now)` with a vector, or with None when what they know is too old: nobody
goes on with an old pose. Times are seconds on one clock, the same for `update` and `gravity`.
"""

from __future__ import annotations

import math
from typing import Final

from ft_compensation.quantities import DEFAULT_GRAVITY, ZERO
from protocol.pdo import STANDARD_GRAVITY, Vector3

_NO_DIRECTION: Final = 0.5
"""Of g: a mean shorter than this is one of directions that contradict each other."""


class AccelerometerGravity:
    """From the sensor's own accelerometer: right while the sensor does not accelerate much.

    A low-pass filter over the samples whose acceleration has nearly the length of g; the rest, jerks and
    knocks, are left out. With the gyroscope the estimate is turned along by the measured rate between
    corrections (a complementary filter), so that it does not lag behind a turn; the accelerometer then only
    takes out the drift. Only the direction comes from the accelerometer, the length is `magnitude`.
    """

    def __init__(
        self,
        magnitude: float = STANDARD_GRAVITY,
        *,
        time_constant_s: float = 0.5,
        gate: float = 0.5,
        stale_after_s: float = 0.5,
        gyroscope: bool = True,
        angular_rate_offset: Vector3 = ZERO,
    ) -> None:
        """Make a source that knows nothing yet.

        Args:
            magnitude: of gravity, m/s².
            time_constant_s: of the filter, by the samples' time.
            gate: m/s²; a sample counts only if the length of its acceleration is this near `magnitude`.
            stale_after_s: without a sample that counts for this long, there is no answer.
            gyroscope: whether the measured angular rate rotates the estimate. Without it the answer lags
                behind a steady turn by the time constant.
            angular_rate_offset: what the gyroscope reads at rest, rad/s (`StationaryMeans.angular_rate`);
                subtracted. What is
                left of it tilts the estimate by `time_constant_s` times it.
        """
        if not (magnitude > 0.0 and time_constant_s > 0.0):
            raise ValueError("magnitude of gravity and time constant must be greater than 0")
        self.magnitude, self.time_constant_s, self.gate = magnitude, time_constant_s, gate
        self.stale_after_s, self.gyroscope = stale_after_s, gyroscope
        self.angular_rate_offset = angular_rate_offset
        self.rejected = 0
        self._down: Vector3 | None = None
        self._time_s = self._accepted_s = -math.inf
        self._began_s = 0.0

    def update(self, acceleration: Vector3, angular_rate: Vector3, time_s: float) -> bool:
        """Take a sample's acceleration (m/s²) and angular rate (rad/s). False: it did not count.

        Samples that are saturated or INVALID do not belong here: leave them out.
        """
        ax, ay, az = acceleration
        size = math.sqrt(ax * ax + ay * ay + az * az)
        counts = abs(size - self.magnitude) <= self.gate  # False for NaN
        down = self._down
        passed_s = time_s - self._time_s
        if -self.stale_after_s <= passed_s < 0.0:
            time_s, passed_s = self._time_s, 0.0  # a hair early; a clock that was set back is another matter
        if down is None or passed_s < 0.0 or time_s - self._accepted_s > self.stale_after_s:
            # Nothing to go on from: the filter begins here.
            if not counts:
                self.rejected += 1
                self._down = None
                return False
            self._down = (-ax, -ay, -az)
            self._time_s = self._accepted_s = self._began_s = time_s
            return True
        x, y, z = down
        if self.gyroscope:
            ox, oy, oz = self.angular_rate_offset
            tx, ty, tz = (
                (angular_rate[0] - ox) * passed_s,
                (angular_rate[1] - oy) * passed_s,
                (angular_rate[2] - oz) * passed_s,
            )
            # A vector that stands still in the world turns by minus the rate in the sensor: second order.
            ux, uy, uz = ty * z - tz * y, tz * x - tx * z, tx * y - ty * x
            vx, vy, vz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
            x, y, z = x - ux + 0.5 * vx, y - uy + 0.5 * vy, z - uz + 0.5 * vz
            if not math.isfinite(x + y + z):
                self.rejected += 1
                return False
        if counts:
            # Until a time constant has passed, the mean of what there was.
            since_s = time_s - self._began_s
            share = 1.0 - math.exp(-passed_s / self.time_constant_s)
            if since_s < self.time_constant_s and passed_s > 0.0:
                share = max(share, passed_s / (since_s + passed_s))
            x, y, z = x - share * (ax + x), y - share * (ay + y), z - share * (az + z)
            self._accepted_s = time_s
        else:
            self.rejected += 1
        self._down = (x, y, z)
        self._time_s = time_s
        return counts

    def age_s(self, now_s: float) -> float:
        """How long since a sample last counted, s; infinite if none did."""
        return abs(now_s - self._accepted_s)

    def gravity(self, now_s: float) -> Vector3 | None:
        """Gravity in the sensor's frame, m/s²; None when no sample has counted for `stale_after_s`."""
        down = self._down
        if down is None or not abs(now_s - self._accepted_s) <= self.stale_after_s:
            return None
        x, y, z = down
        size = math.sqrt(x * x + y * y + z * z)
        if size < _NO_DIRECTION * self.magnitude:
            return None
        scale = self.magnitude / size
        return x * scale, y * scale, z * scale


class QuaternionGravity:
    """From the orientation of the sensor in a base: the sensor's own estimate, a topic, TF.

    The quaternion turns vectors of the sensor's frame into the base's, as poses and Imu messages have it.
    """

    def __init__(self, gravity: Vector3 = DEFAULT_GRAVITY, *, stale_after_s: float = 0.1) -> None:
        """`gravity` is in the base, m/s²."""
        self.base_gravity, self.stale_after_s = gravity, stale_after_s
        self._latest: tuple[Vector3, float] | None = None

    def reset(self) -> None:
        """Forget everything."""
        self._latest = None

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
        self._latest = (
            (
                gx + w * tx + (ty * z - tz * y),
                gy + w * ty + (tz * x - tx * z),
                gz + w * tz + (tx * y - ty * x),
            ),
            time_s,
        )
        return True

    def age_s(self, now_s: float) -> float:
        """How old the latest orientation is, s; infinite if there is none."""
        return math.inf if self._latest is None else abs(now_s - self._latest[1])

    def gravity(self, now_s: float) -> Vector3 | None:
        """Gravity in the sensor's frame, m/s²; None when the orientation is older than `stale_after_s`."""
        latest = self._latest
        if latest is None or not abs(now_s - latest[1]) <= self.stale_after_s:
            return None
        return latest[0]
