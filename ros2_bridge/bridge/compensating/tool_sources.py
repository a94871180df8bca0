"""The specific force at the tool, sample by sample: what the reader asks. No ROS.

The reader alone calls `specific_force`; the others are for the diagnostics' thread too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple, Protocol

from bota_ethercat.pdo import Sample, Vector3
from bota_ethercat.settings import SettingValue
from bridge.parameters.table import Parameters
from ft_compensation.alignment import align
from ft_compensation.motion_error import MotionError
from ft_compensation.quantities import STILL, Quaternion, Turning
from ft_compensation.specific_force import ImuSpecificForce, QuaternionGravity

IMU_IS_OFF = "the accelerometer reads zero: switch the IMU on (settings.imu_active)"


class Oriented(NamedTuple):
    """An orientation and its time, ns since the Unix epoch."""

    quaternion: Quaternion
    stamp_ns: int


class Source:
    """The specific force at the tool's center of gravity, m/s² in the sensor's frame. Of this class: none."""

    describe = "none"  # its name for people
    is_imu = False  # whether it is measured, with what the tool accelerates; else it is minus gravity
    turning: Turning = STILL  # of the latest sample, where it is measured

    def __init__(self, why: str = "gravity_source is none") -> None:
        """`why` there is none."""
        self._why = why

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """m/s², for this sample; None if what is known is too old, or nothing is.

        `time_s` is by a clock that nobody sets, `stamp_s` by the wall clock, which others stamp by.
        """
        return None

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        """Why there is none for this sample, a sentence; empty if nothing is known to be wrong."""
        return (
            f"{self._why}, so the weight of the tool is not known: set gravity_source to a source, or set "
            "tool_mass to 0"
        )

    def age_s(self, time_s: float) -> float:  # noqa: ARG002
        """How old the orientation in use is; 0 where every sample brings its own, infinite where none is."""
        return math.inf

    def error(self, mass: float) -> MotionError | None:  # noqa: ARG002
        """What the latest second of motion leaves of this mass, kg; None where it is not known."""
        return None


class Filters(Protocol):
    """What is known of the sensor's filters: the node's `Link`."""

    settings: Mapping[str, SettingValue]  # replaced, never changed in place
    rate_hz: float


class ImuSource(Source):
    """The sensor's own accelerometer and gyroscope, at the instant of its force and torque."""

    describe = "imu"
    is_imu = True

    def __init__(self, parameters: Parameters, imu_position: Vector3, filters: Filters) -> None:
        """`imu_position` is the IMU's, m from the wrench origin."""
        (cx, cy, cz), (x, y, z) = parameters.payload.center, imu_position
        self._imu = ImuSpecificForce((cx - x, cy - y, cz - z), parameters.accelerometer)
        self._filters = filters
        self._settings: Mapping[str, SettingValue] | None = None  # those of the alignment

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """Of this sample."""
        if self._filters.settings is not self._settings:
            self._settings = self._filters.settings
            self._imu.align(align(self._settings, self._filters.rate_hz))
        found = self._imu.follow(sample.acceleration, sample.angular_rate, time_s)
        self.turning = self._imu.turning
        return found if any(sample.acceleration) else None

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        """The IMU is off or broken."""
        if not any(sample.acceleration):
            return IMU_IS_OFF
        return "" if sample.is_finite else "the IMU sends NaN or infinity: see the status stream"

    def age_s(self, time_s: float) -> float:  # noqa: ARG002
        """Every sample brings its own."""
        return 0.0

    def error(self, mass: float) -> MotionError | None:
        """As far as it is known."""
        return self._imu.error(mass)


class Listening(Protocol):
    """What is used of an `OrientationListener`."""

    latest: Oriented | None
    problem: str
    describe: str


class ListenerSource(Source):
    """A topic or TF: the latest orientation, carried on to the sample's time by the gyroscope."""

    def __init__(self, parameters: Parameters, listener: Listening) -> None:
        self._listener = listener
        self._limit_s = parameters.orientation.stale_after
        self._turn = QuaternionGravity(parameters.gravity, stale_after_s=self._limit_s)
        self._taken: Oriented | None = None
        self.describe = listener.describe

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:
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
        found = self._turn.gravity(time_s)
        return None if found is None else (-found[0], -found[1], -found[2])

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        """Nothing has come, it stopped, it is of no use, or its stamps are of another time."""
        latest, problem, name = self._listener.latest, self._listener.problem, self.describe
        if latest is None:
            return f"no orientation from {name}: {problem}"
        behind_s = stamp_s - latest.stamp_ns * 1e-9
        if abs(behind_s) <= self._limit_s:
            return ""
        limit = f"(limit {self._limit_s:g} s)"
        if behind_s < 0:
            return (
                f"the orientation from {name} is stamped {_seconds(-behind_s)} after the sample {limit}: the "
                "clocks of the two computers differ"
            )
        why = problem or "it has stopped, is slow, or has another clock"
        return (
            f"the latest orientation from {name} is {_seconds(behind_s)} older than the sample {limit}: {why}"
        )

    def age_s(self, time_s: float) -> float:
        """Between the stamps of sample and orientation."""
        return self._turn.age_s(time_s)


def _seconds(value: float) -> str:
    return f"{value:.3f} s" if value < 100 else f"{value:.3g} s"
