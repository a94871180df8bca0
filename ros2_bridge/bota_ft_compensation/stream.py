# SPDX-License-Identifier: Apache-2.0
"""One compensated stream: the samples of a sensor without bias, weight and inertia of the tool.

The one place for the node, `ethercat-export --tool`, `ethercat-monitor --tool` and `ethercat-identify`; the
ros2_control plugin does the same in C++ (compensation.hpp, sensor_loop.hpp). What is in force for the samples
comes from the timeline (`bota_ethercat.stream.timeline`), which of them may be used from its table
(`usable`). No threads, no ROS, no clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Final, NamedTuple, cast

import numpy as np

from bota_ethercat.pdo import Sample, Vector3
from bota_ethercat.replies import SensorInfo
from bota_ethercat.settings import SettingValue
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.stream.usable import (
    ACCELERATION,
    ANGULAR_RATE,
    FORCE_TORQUE,
    Channel,
    Usability,
    judge,
)
from bota_ft_compensation.alignment import Array, align
from bota_ft_compensation.bias import BiasRamp
from bota_ft_compensation.bounds import Bounds, at_reference
from bota_ft_compensation.compensator import Compensator, Stages
from bota_ft_compensation.contact import ContactDetector, Surface, detector_of
from bota_ft_compensation.imu import IMU_IS_OFF, ImuSource, Source
from bota_ft_compensation.own_offset import OwnOffset
from bota_ft_compensation.quantities import (
    EXACT,
    NO_PAYLOAD,
    STILL,
    UNKNOWN_ACCURACY,
    ZERO,
    Accelerometer,
    Accuracy,
    Payload,
    Turning,
    Wrench,
)

Settings = Mapping[str, SettingValue]
_ROUNDING_S: Final = 1e-6
_BEING_CHANGED: Final = "the sensor's own offset was being changed"
_BY_IMU: Final = (FORCE_TORQUE, ACCELERATION, ANGULAR_RATE)  # what weight and inertia by the IMU need


def obstacle(settings: Settings, *, has_tool: bool, by_imu: bool) -> str:
    """The setting with which nothing can be compensated, a sentence that says what to do; empty if none is.

    `by_imu`: the specific force at a tool is from the sensor's own accelerometer.
    """
    if settings.get("calibration_matrix") is False:
        return (
            "settings.calibration_matrix is off, so force and torque are counts and not N and Nm: "
            "switch it on"
        )
    if settings.get("inertia_compensation") is True and has_tool:
        return (
            "settings.inertia_compensation is on, so the sensor takes gravity off itself: switch it off, "
            "or set tool_mass to 0"
        )
    if settings.get("coordinate_system") is True and has_tool and by_imu:
        return (
            "settings.coordinate_system is on, so the wrench is in a frame configured in the sensor, and "
            "the rotation from the IMU to it is unknown: switch it off, or take the orientation of that "
            "frame from the robot (gravity_source)"
        )
    return IMU_IS_OFF if settings.get("imu_active") == 0 and has_tool and by_imu else ""


class Plan(NamedTuple):
    """What is done with a sample; replaced as a whole, from any thread."""

    source: Source = Source()
    payload: Payload = NO_PAYLOAD
    ramp: BiasRamp = BiasRamp()
    accelerometer: Accelerometer = EXACT
    accuracy: Accuracy = UNKNOWN_ACCURACY

    @property
    def has_tool(self) -> bool:
        """Whether anything has weight."""
        return self.payload.mass > 0.0


class CompensatedStream:
    """Compensates one sample after the other, or many at once.

    Attributes:
        plan: what is done with what comes next.
        in_force: for what comes next (`configure`).
        own_offset: how the sensor's own offset changes the bias.
        forbidden: why nothing may be compensated, whatever is in force; empty: it may.
        hold: why nothing is compensated for now, a sentence; empty: nothing holds it up (`check`).
        use_saturated: whether samples that are saturated or out of range are compensated all the same.
    """

    def __init__(self, plan: Plan = Plan(), *, use_saturated: bool = True) -> None:  # noqa: B008
        self.plan, self.use_saturated = plan, use_saturated
        self.forbidden = self.hold = ""
        self.in_force, self.own_offset = InForce(SensorInfo()), OwnOffset()
        self._compensator = Compensator()
        self._made: tuple[object, Bounds | None] = (None, None)  # what the bounds are made of, and they
        self._newest_s = self._doubted_until_s = -math.inf

    def configure(self, in_force: InForce) -> None:
        """What is in force for the samples that follow; for the thread that adds them."""
        self.in_force = in_force

    @property
    def offset(self) -> Wrench | None:
        """The sensor's own, N and Nm; None if it is not known."""
        offset = self.in_force.info.offset
        return None if offset is None else Wrench.of(offset)

    def follow_offset(self) -> Wrench | None:
        """Shift the bias by what the sensor's own offset has changed by; None: it is as it was.

        The next samples may have been measured before the change was complete.
        """
        if (change := self.own_offset.follow(self.offset)) is not None:
            self.plan = self.plan._replace(ramp=self.plan.ramp.shifted(change))
            self._doubted_until_s = self._newest_s + self.in_force.doubt_after_ns * 1e-9 + _ROUNDING_S
        self.check()
        return change

    def check(self) -> None:
        """Find out what holds up the samples that follow; after a change of the plan, or of what forbids."""
        found: object = None
        while found is not (found := self.in_force):  # another thread may have changed it meanwhile
            has_tool, by_imu = self.plan.has_tool, self.plan.source.is_imu
            why = self.forbidden or obstacle(self.in_force.info.settings, has_tool=has_tool, by_imu=by_imu)
            self.hold = why or self.own_offset.doubt(self.offset)

    def feel(self, sample: Sample, time_s: float, stamp_s: float, *, always: bool = False) -> Vector3 | None:
        """The specific force at the tool in this sample, m/s²; None if it is not known.

        Zero without a tool, unless `always`. Every new sample is to come here, in order; `time_s` is by the
        server's monotonic clock, `stamp_s` since 1970.
        """
        source, payload, _, _, _ = self.plan
        in_force, self._newest_s = self.in_force, time_s
        if payload.mass <= 0.0 and not always:
            return ZERO
        if source.in_force is not in_force:
            source.configure(in_force)
        return source.specific_force(sample, time_s, stamp_s)

    def why_not(self, sample: Sample) -> str:
        """Why this sample may not be used, a clause; empty if it may, if `feel` knows what it felt."""
        if self.hold:
            return self.hold
        if self._newest_s <= self._doubted_until_s:
            return _BEING_CHANGED
        if not (
            sample.warnings
            or sample.force_torque_saturated
            or sample.acceleration_saturated
            or sample.angular_rate_saturated
        ):
            return ""
        usability, why = judge(sample, self._needed)
        if usability is Usability.SATURATED:
            return "" if self.use_saturated else f"{why}, and on_saturation is stop"
        return why

    @property
    def _needed(self) -> Sequence[Channel]:
        """Of a sample, in the plan."""
        return _BY_IMU if self.plan.has_tool and self.plan.source.is_imu else _BY_IMU[:1]

    def stages(self, sample: Any, time_s: float, felt: Vector3, turning: Turning | None = None) -> Stages:
        """Every stage of a sample in which `felt` was felt. Components may be arrays of samples."""
        (source, payload, ramp, _, _), compensator = self.plan, self._compensator
        compensator.payload, compensator.bias = payload, ramp.at(time_s)
        if turning is None:
            turning = source.turning
        return compensator.compensate(sample.force, sample.torque, felt, turning)

    def compensate(self, samples: Any) -> tuple[Array, Array]:
        """n samples as arrays, attributes as of a `Sample`, and `monotonic_ns`, by the IMU.

        (n, 6) N, Nm, NaN where it is not known or may not be used; (n, 2) `bounds`, N and Nm.
        """
        source, times = self.plan.source, samples.monotonic_ns * 1e-9
        assert isinstance(source, ImuSource)
        felt, turning = np.zeros((3, len(times))), cast(Any, STILL)
        if self.plan.has_tool:
            if source.in_force is not self.in_force:
                source.configure(self.in_force)
            felt, turning = source.follow_all(samples.acceleration, samples.angular_rate, times)
        columns = SimpleNamespace(force=samples.force.T, torque=samples.torque.T)
        found = np.vstack(self.stages(columns, math.inf, cast(Any, felt), turning).final).T
        flagged = sum(channel.flagged(samples) for channel in self._needed)
        found[(times <= self._doubted_until_s) | (flagged != 0)] = math.nan
        if self.hold:
            found[:] = math.nan
        self._newest_s = times[-1] if len(times) else self._newest_s
        return found, np.column_stack(np.broadcast_arrays(*self.bounds(felt, turning), times)[:2])

    def bounds(self, felt: Any = None, turning: Any = None) -> tuple[Any, Any]:
        """95 % bounds of the error of a sample's force, N, and torque, Nm; without contact.

        Of one that felt `felt`, m/s², and turned so; None: as the latest.
        """
        source = self.plan.source
        felt, turning = source.felt if felt is None else felt, source.turning if turning is None else turning
        return self._bounds().at(felt, turning)

    def _bounds(self, noise: Sequence[float] = ()) -> Bounds:
        """By what is in force; `noise` of the sensor, 6, N and Nm, if it is known otherwise."""
        plan, info = self.plan, self.in_force.info
        source, by_imu = plan.source, isinstance(plan.source, ImuSource)
        made_of = plan.payload, plan.accelerometer, plan.ramp.taken, plan.accuracy, source, info, noise
        made, found = self._made
        if found is None or made_of != made:
            aligned, taken = align(info.settings, info.rate_hz), plan.ramp.taken
            if any(noise):
                taken = taken._replace(noise=at_reference(noise, info.settings))
            lever = source.lever_of(info.name) if isinstance(source, ImuSource) else ZERO
            read = plan.accelerometer if by_imu else None
            found = Bounds(plan.payload, read, aligned, lever, taken, plan.accuracy)
            self._made = made_of, found
        return found

    def contact_detector(
        self, surface: Surface, noise: Sequence[float] = (), alarms_per_hour: float = 1.0
    ) -> ContactDetector:
        """Of contact with the tool, by what is in force; `noise` as there. CompensationError."""
        info = self.in_force.info
        return detector_of(
            surface, self.plan.payload, self._bounds(noise), info.settings, info.rate_hz, alarms_per_hour
        )
