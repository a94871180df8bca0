# SPDX-License-Identifier: Apache-2.0
"""Where the specific force at the tool is from: `Source`, and the sensor's own IMU on its lever arm."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from bota_ethercat.pdo import STANDARD_GRAVITY, Sample, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.sensor.frames import IMU_HEIGHTS
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, judge
from bota_ft_compensation.alignment import Array, align
from bota_ft_compensation.quantities import (
    EXACT,
    IDENTITY,
    STILL,
    UPRIGHT,
    ZERO,
    Accelerometer,
    Matrix,
    Turning,
    length,
)
from bota_ft_compensation.specific_force import ImuSpecificForce
from bota_ft_compensation.stationary import triple

# Of a check of gravity: looks, s apart on average, and at most; rad/s, and m/s² of deviation, that are rest;
# m/s² that is wrong.
_LOOKS, _APART_S, _MOST_S, _RESTING, _STEADY, _WRONG = 50, 0.02, 0.2, 0.1, 0.3, 2.0
_UNEVEN: Final = 0.5 * (math.sqrt(5.0) - 1.0)
_READ: Final = (ACCELERATION, ANGULAR_RATE)
IMU_IS_OFF: Final = "the accelerometer reads zero: switch the IMU on (settings.imu_active)"


def imu_position(name: str, given: Vector3 = ZERO) -> Vector3:
    """Of the IMU from the wrench origin, m: `given`, or of zeros by the drawings of the model `name`."""
    return given if any(given) else (0.0, 0.0, IMU_HEIGHTS.get(name[4:8], 0.0))


class Source:
    """The specific force at the tool's center of gravity, m/s² in the sensor's frame. Of this class: none.

    One thread, which has the samples, calls `configure` and `specific_force`; the others are for any.
    """

    name = "none"  # for people
    is_imu = False  # whether it is the sensor's own, with the tool's acceleration; else it is minus gravity
    turning: Turning = STILL  # of the latest sample, if `is_imu`
    felt: Vector3 = UPRIGHT  # likewise
    in_force = InForce(SensorInfo())  # of the latest `configure`

    def __init__(self, why: str = "gravity_source is none") -> None:
        self._why = why
        self.close: Callable[[], object] = lambda: None

    def configure(self, in_force: InForce) -> None:
        """What is in force for the samples that follow."""
        self.in_force = in_force

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        """None if what is known is too old. `time_s` is by a monotonic clock, `stamp_s` since 1970."""
        return None

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        """Why there is none for this sample, a sentence; empty if nothing is known to be wrong."""
        return (
            f"{self._why}, so the weight of the tool is not known: set gravity_source to a source, or set "
            "tool_mass to 0"
        )

    def age_s(self, time_s: float) -> float:  # noqa: ARG002
        """How old the robot's orientation is; infinite where there is none."""
        return math.inf


class ImuSource(Source):
    """The sensor's own accelerometer and gyroscope, at the instant of its force and torque."""

    name = "imu"
    is_imu = True

    def __init__(
        self, center: Vector3 = ZERO, position: Vector3 = ZERO, accelerometer: Accelerometer = EXACT,
        gyroscope: Matrix = IDENTITY,
    ) -> None:  # fmt: skip
        """`center` of gravity and the IMU's `position` from the wrench origin, m; zeros: as it was made."""
        super().__init__()
        self._center, self._position = center, position
        self._imu = ImuSpecificForce(accelerometer=accelerometer, gyroscope=gyroscope)

    def configure(self, in_force: InForce) -> None:
        before, now, self.in_force = self.in_force.info, in_force.info, in_force
        self._imu.lever = self.lever_of(now.name)
        if (before.settings, before.rate_hz) != (now.settings, now.rate_hz):
            self._imu.align(align(now.settings, now.rate_hz))

    def lever_of(self, name: str) -> Vector3:
        """From the IMU of the model `name` to the center of gravity, m."""
        (x, y, z), (cx, cy, cz) = imu_position(name, self._position), self._center
        return cx - x, cy - y, cz - z

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:  # noqa: ARG002
        found = self._imu.follow(sample.acceleration, sample.angular_rate, time_s)
        self.turning = self._imu.turning
        if found is None or not any(sample.acceleration):
            return None
        self.felt = found
        return found

    def follow_all(self, acceleration: Array, angular_rate: Array, times: Array) -> tuple[Array, Array]:
        """As `specific_force`, of samples (n, 3) at `times` (n,): as `ImuSpecificForce.follow_all`."""
        felt, turned = self._imu.follow_all(np.hstack([acceleration, angular_rate]), times)
        self.turning = self._imu.turning
        felt[:, ~acceleration.any(axis=1)] = math.nan
        for at in np.flatnonzero(np.isfinite(felt[0]))[-1:]:
            x, y, z = felt[:, at].tolist()
            self.felt = x, y, z
        return felt, turned

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        if not any(sample.acceleration):
            return IMU_IS_OFF
        return "" if sample.is_finite else "the IMU sends NaN or infinity: see the status stream"


class GravityCheck:
    """Whether gravity by a source looks right to the sensor's accelerometer, while the sensor is at rest.

    A second or more of looks at uneven intervals: what moves to and fro, at whatever frequency, is no rest,
    and what is steady for so long is gravity. For the thread that has the samples.
    """

    def __init__(self) -> None:
        self.problem = ""  # what is wrong and what to do, a clause
        self.due_s = -math.inf  # of the next look
        self._rows, self._last_s = list[tuple[Sample, Vector3]](), -math.inf

    def look(self, sample: Sample, felt: Vector3 | None, time_s: float, *, by_imu: bool) -> None:
        """At the first sample from `due_s` on, and the specific force that the source gave for it, m/s²."""
        rows, passed_s, self._last_s = self._rows, time_s - self._last_s, time_s
        if not 0.0 < passed_s <= _MOST_S:
            rows.clear()
        self.due_s = time_s + _APART_S * (0.5 + len(rows) * _UNEVEN % 1.0)
        if felt is None:
            rows.clear()
            return
        rows.append((sample, felt))
        if len(rows) == _LOOKS:
            if not any(judge(each, _READ)[1] or not any(each.acceleration) for each, _ in rows):
                self._judge(
                    np.array([(*each.acceleration, *each.angular_rate, *at) for each, at in rows]), by_imu
                )
            rows.clear()

    def _judge(self, rows: Array, by_imu: bool) -> None:
        read, rate, felt = np.split(rows.mean(axis=0), 3)
        size = math.hypot(*read)
        # Of nothing at rest is it so small: then the rate's unit is as wrong.
        turns = math.hypot(*rate) > _RESTING and size > _WRONG
        if not turns and rows[:, :3].std(axis=0).max() < _STEADY * max(1.0, size / STANDARD_GRAVITY):
            self.problem = _gravity_problem(triple(read), triple(felt), by_imu=by_imu)


def _gravity_problem(read: Vector3, felt: Vector3, *, by_imu: bool) -> str:
    size, told = length(read), length(felt)
    if abs(size - STANDARD_GRAVITY) > _WRONG:
        return f"the accelerometer reads {size:.2g} m/s² at rest, where gravity is 9.81: check imu_raw_units"
    if abs(told - STANDARD_GRAVITY) > _WRONG:
        wrong = "accelerometer.offset and accelerometer.scale" if by_imu else "gravity"
        return (
            f"gravity is taken for {told:.2g} m/s², where the accelerometer reads {size:.2g}: check {wrong}"
        )
    if by_imu or math.dist(read, felt) < _WRONG:
        return ""
    cosine = sum(a * b for a, b in zip(read, felt, strict=True)) / (size * told)
    angle = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    return (
        f"gravity by the robot's orientation is {angle:.0f}° from the accelerometer's: check the signs of "
        "gravity and orientation, orientation.mounting, and how the robot's base is mounted"
    )
