"""Where gravity points, sample by sample: what the reader asks, around `ft_compensation.orientation`. No ROS.

The reader alone calls `gravity`. `why_none` and `age_s` are for the diagnostics' thread.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Protocol

from bridge.parameters.compensation import CompensationParameters, Quaternion
from ft_compensation.attitude.tilt import GyroscopeOffset
from ft_compensation.bias import tilt_95
from ft_compensation.orientation import AccelerometerGravity, QuaternionGravity
from ft_compensation.quantities import EXACT, length
from protocol.pdo import STANDARD_GRAVITY, Sample, Vector3

_POSES: Final = ((STANDARD_GRAVITY, 0.0, 0.0), (0.0, STANDARD_GRAVITY, 0.0), (0.0, 0.0, STANDARD_GRAVITY))
IMU_IS_OFF: Final = "the accelerometer reads zero: switch the IMU on (settings.imu_active)"


class Oriented(NamedTuple):
    """An orientation and its time, ns since the Unix epoch."""

    quaternion: Quaternion
    stamp_ns: int


class Source(Protocol):
    """Gravity in the sensor's frame from one kind of orientation."""

    describe: str
    """Its name for people."""
    is_accelerometer: bool
    """Whether it is: at rest the mean of a window is better then than the filter."""

    @property
    def tilt(self) -> float | None:
        """The error of the direction that is not exceeded in 95 % of cases, rad; None if unknown."""

    def gravity(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:
        """m/s², for this sample; None if what is known is too old, or nothing is.

        Args:
            sample: the next one.
            time_s: its time by a clock that nobody sets.
            stamp_s: its time by the wall clock, which others stamp their orientations by.
        """

    def why_none(self, time_s: float, stamp_s: float) -> str:
        """The reason for None, a sentence."""

    def age_s(self, time_s: float) -> float:
        """How old the orientation in use is."""


class NoSource:
    """There is none: `orientation_source` is `none`, or what it is set to cannot be had."""

    describe = "none"
    is_accelerometer = False
    tilt = None

    def __init__(self, why: str = "orientation_source is none") -> None:
        self._why = why

    def gravity(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """None."""
        return None

    def why_none(self, time_s: float, stamp_s: float) -> str:  # noqa: ARG002
        """What to do."""
        return (
            f"{self._why}, so where gravity points is not known: set orientation_source to a source, or "
            "set tool_mass to 0"
        )

    def age_s(self, time_s: float) -> float:  # noqa: ARG002
        """Infinite."""
        return math.inf


class AccelerometerSource:
    """The sensor's own accelerometer and gyroscope."""

    describe = "accelerometer"
    is_accelerometer = True

    def __init__(self, parameters: CompensationParameters, gyroscope: GyroscopeOffset) -> None:
        """`gyroscope`: the estimate of its offset, which is improved in place."""
        p = parameters.accelerometer
        self._filter = AccelerometerGravity(
            length(parameters.gravity),
            time_constant_s=p.time_constant,
            gate=p.gate,
            stale_after_s=p.stale_after,
            tilt_limit=p.tilt_limit,
            offset=gyroscope,
        )
        self._correct = None if p.reading == EXACT else p.reading.correct
        # In the worst of the poses: the filter does not see it.
        self._own_tilt = max(tilt_95(pose, p.reading) for pose in _POSES)
        self._broken = ""

    @property
    def tilt(self) -> float | None:
        """The bound of the estimate's tilt that holds in 95 % of cases, rad."""
        found = math.hypot(self._filter.tilt_95, self._own_tilt)
        return found if math.isfinite(found) else None

    def gravity(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """From this sample and those before it."""
        acceleration = sample.acceleration
        if not (any(acceleration) or any(sample.angular_rate)):
            self._broken = IMU_IS_OFF  # what was known is of no use: nobody sees the sensor turn
            return None
        if not sample.angular_rate_saturated:
            usable = None if sample.acceleration_saturated else acceleration
            if usable is not None and self._correct is not None:
                usable = self._correct(usable)
            good = self._filter.update(usable, sample.angular_rate, time_s)
            if not good and not math.isfinite(sum(acceleration) + sum(sample.angular_rate)):
                self._broken = "the IMU sends NaN or infinity: see the status stream"
                return None
        found = self._filter.gravity(time_s)
        if found is None:
            self._broken = "" if any(acceleration) else IMU_IS_OFF
        return found

    def why_none(self, time_s: float, stamp_s: float) -> str:  # noqa: ARG002
        """The IMU is off or broken, it is too early, or the sensor has been accelerated for long."""
        if self._broken:
            return self._broken
        f, age_s = self._filter, self._filter.age_s(time_s)
        since = "not yet" if math.isinf(age_s) else f"not for {age_s:.2f} s"
        if self.tilt is not None and age_s <= f.stale_after_s:
            return (
                f"gravity from the accelerometer may be tilted by {math.degrees(f.tilt_95):.1f}°, too much "
                "to start with: keep the sensor stationary for a second"
            )
        return (
            f"the accelerometer has {since} agreed with {f.magnitude:.2f} ± {f.gate:g} m/s² and the "
            "gyroscope: the sensor is being moved hard, or imu_raw_units is wrong; for use in motion take "
            "the orientation from the robot (orientation_source)"
        )

    def age_s(self, time_s: float) -> float:
        """Time since the accelerometer was last used."""
        return self._filter.age_s(time_s)


class SensorSource:
    """The orientation that the sensor estimates, where it maps one."""

    describe = "the sensor's own estimate"
    is_accelerometer = False
    tilt = None

    def __init__(self, parameters: CompensationParameters) -> None:
        self._turn = QuaternionGravity(parameters.gravity, stale_after_s=parameters.orientation.stale_after)

    def gravity(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """From this sample's orientation."""
        if sample.orientation is not None and not self._turn.update(sample.orientation, time_s):
            # Time went back: what was known is of no use any more.
            self._turn.reset()
            self._turn.update(sample.orientation, time_s)
        return self._turn.gravity(time_s)

    def why_none(self, time_s: float, stamp_s: float) -> str:  # noqa: ARG002
        """It estimates none."""
        return (
            "the sensor gives no orientation of its own: switch it on (settings.orientation_estimation), "
            "which only sensors with 77 bytes of process data have, or take another orientation_source"
        )

    def age_s(self, time_s: float) -> float:
        """Since the last estimate."""
        return self._turn.age_s(time_s)


class Listening(Protocol):
    """What is used of an `OrientationListener`."""

    latest: Oriented | None
    problem: str
    describe: str


class ListenerSource:
    """A topic or TF: the latest orientation, carried on to the sample's time by the gyroscope."""

    is_accelerometer = False
    tilt = None

    def __init__(self, parameters: CompensationParameters, listener: Listening) -> None:
        self._listener = listener
        self._limit_s = parameters.orientation.stale_after
        self._turn = QuaternionGravity(parameters.gravity, stale_after_s=self._limit_s)
        self._taken: Oriented | None = None
        self.describe = listener.describe

    def gravity(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:
        """From the latest orientation, if its time is close to the sample's."""
        self._turn.follow(sample.angular_rate, time_s)
        latest = self._listener.latest
        if latest is not self._taken and latest is not None:
            self._taken = latest
            then_s = latest.stamp_ns * 1e-9 - stamp_s + time_s
            if not self._turn.update(latest.quaternion, then_s):
                # The publisher's clock went back, or it is another publisher: what came last is what counts.
                self._turn.reset()
                self._turn.update(latest.quaternion, then_s)
        return self._turn.gravity(time_s)

    def why_none(self, time_s: float, stamp_s: float) -> str:  # noqa: ARG002
        """Nothing has come, it stopped, it is of no use, or its stamps are of another time."""
        latest, name = self._listener.latest, self.describe
        if latest is None:
            return f"no orientation from {name}: {self._listener.problem}"
        behind_s = stamp_s - latest.stamp_ns * 1e-9
        if behind_s < 0:
            return (
                f"the orientation from {name} is stamped {_seconds(-behind_s)} after the sample (limit "
                f"{self._limit_s:g} s): the clocks of the two computers differ"
            )
        problem = self._listener.problem
        return (
            f"the latest orientation from {name} is {_seconds(behind_s)} older than the sample (limit "
            f"{self._limit_s:g} s)"
            + (f": {problem}" if problem else ": it has stopped, is slow, or has another clock")
        )

    def age_s(self, time_s: float) -> float:
        """Between the stamps of sample and orientation."""
        return self._turn.age_s(time_s)


def _seconds(value: float) -> str:
    return f"{value:.3f} s" if value < 100 else f"{value:.3g} s"
