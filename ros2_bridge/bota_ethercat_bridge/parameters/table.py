# SPDX-License-Identifier: Apache-2.0
"""The node's parameters: one table, from which they are declared, checked, described and documented. No ROS.

A wrong value ends the node at start, or is refused while it runs, with one sentence. The sensor's settings
are parameters too, but the server decides about them: `declare.NodeParameters`.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Final, NamedTuple

from bota_ethercat import option_types
from bota_ethercat.health.limits import LIMITS, StreamLimits
from bota_ethercat.option_types import OptionType
from bota_ethercat.pdo import ImuUnits, Vector3
from bota_ethercat.program.real_time import HIGHEST_PRIORITY
from bota_ethercat.sensor.rest import StationaryLimits
from bota_ft_compensation.contact import FARTHEST_M, Surface, surface_of
from bota_ft_compensation.outputs import LEAST_CUTOFF_HZ, WrenchTransform
from bota_ft_compensation.quantities import (
    DEFAULT_GRAVITY,
    EXACT,
    IDENTITY,
    NO_PAYLOAD,
    NORM_TOLERANCE,
    UNKNOWN_ACCURACY,
    ZERO,
    Accelerometer,
    Accuracy,
    CompensationError,
    Payload,
    Quaternion,
    length,
    unit_quaternion,
)

Numbers = tuple[float, ...]
ParameterValue = bool | int | float | str | Numbers | tuple[str, ...]
NO_TEXTS: Final = ("",)  # an empty list of strings: ROS cannot infer the type of []
AUTO: Final = "auto"  # the value of a path that is for the node to choose
TOPIC_SOURCES: Final = ("topic_pose", "topic_quaternion", "topic_imu")
_PORT: Final = 12001
_LEAST_GRAVITY: Final = 0.1
_GROUPS: Final = re.compile(
    "^(diagnostics|orientation(?!_cov)|accelerometer|accuracy|rest|filter|contact|identify)_"
)
_FRAME_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_REST: Final = StationaryLimits()


class ParameterError(Exception):
    """A parameter has a value that it cannot have; the text is one sentence."""


class ParameterRow(NamedTuple):
    """One parameter. The default's type is the parameter's; a tuple is texts, or as many numbers.

    `low` and `high` bound a number; of several, each from -`high` if `low` is 0. `live`: can be set while the
    node runs; others are read-only.
    """

    name: str
    default: ParameterValue
    description: str
    low: Any = 0.0
    high: Any = 0.0
    choices: tuple[str, ...] = ()
    live: bool = True
    optional: bool = False  # whether a text may be empty

    def check(self, value: object) -> ParameterValue:
        """Return `value`, a whole number as float where one is meant; ParameterError if it cannot be."""
        if value is None and self.default == NO_TEXTS:
            value = ()  # what rclpy makes of []
        try:
            checked: ParameterValue = self.type.check(value)
        except ValueError as error:
            raise ParameterError(f"parameter {self.name} is {value!r}: it must be {error}") from None
        return NO_TEXTS if checked == () else checked

    @property
    def type(self) -> OptionType[Any]:
        """What it may be."""
        default, low, high = self.default, self.low, self.high
        if self.choices:
            return option_types.choice(*self.choices)
        if default == NO_TEXTS:
            return option_types.several(option_types.text("text"), range(sys.maxsize), "a list of texts")
        if isinstance(default, tuple):
            low, count = low or -high, len(default)
            allowed = f"{count} numbers from {low:g} to {high:g}"
            return option_types.several(option_types.number(low, high), (count,), allowed)
        if isinstance(default, str):
            optional, given = option_types.text("text"), option_types.text("text that is not empty", bool)
            return optional if self.optional else given
        if isinstance(default, bool):
            return option_types.flag
        return option_types.integer(low, high) if isinstance(default, int) else option_types.number(low, high)


class WrenchFrame(NamedTuple):
    """A frame of the compensated wrench besides the sensor's, and the end of a topic's name."""

    name: str
    fixed: WrenchTransform | None = None  # from `frame_id` to it; None: from TF


def _row(default: Any, description: str, *bounds: float, **more: Any) -> Any:
    return field(default=default, metadata={"row": (default, description, *bounds), "more": more})


@dataclass(frozen=True)
class Parameters:
    """All parameters with their values, checked one by one; `gather` checks them together.

    The parameter of `group_name` is `group.name`, for the prefixes in _GROUPS.
    """

    # fmt: off
    server_host: str = _row("localhost", "Host that ethercat-server runs on", live=False)
    server_port: int = _row(_PORT, "TCP port of ethercat-server", 1, 65535, live=False)
    SERVER_PORT: int = _row(0, "Another name for server_port; 0 = not used", 0, 65535, live=False)
    sensor: int = _row(0, "The sensor's position on the bus, from 0", 0, 255, live=False)
    terminals: int = _row(0, "How many of the server's terminals are published: terminal_0, terminal_1, ...",
        0, 255, live=False)
    rt_priority: int = _row(0,
        "SCHED_FIFO priority of the stream's thread, if allowed; 0 = as the node was started",
        0, HIGHEST_PRIORITY, live=False)
    cpu: int = _row(-1, "CPU of the stream's thread; -1 = any", -1, 1023, live=False)
    publishing_frequency: float = _row(0.0, "Most messages a second, no low-pass; 0 = every sample", 0, 1e6)
    array_topic: str = _row("sensone_sensor_data", "Topic of the Float64MultiArray", live=False)
    lifecycle: bool = _row(False, "Managed by transitions (configure, activate); false = active at once",
        live=False)
    supervisor_topic: str = _row("/supervisor_status_data", "Topic that stops server and node; empty = none",
        live=False, optional=True)
    stamp: str = _row("sample",
        "What stamps are the time of: the sample, or the measurement, earlier by the sensor's filter delay",
        choices=("sample", "measurement"))
    frame_id: str = _row("ft_sensor",
        "Frame of the wrench (its origin is the sensor's) and of the temperature",
        live=False)
    wrench_frames: tuple[str, ...] = _row(NO_TEXTS,
        "Frames of wrench_compensated/NAME: NAME (by TF), or 'NAME x y z [qx qy qz qw]' in frame_id, m",
        live=False)
    imu_frame_id: str = _row("ft_sensor_imu", "Frame of the IMU's messages", live=False)
    imu_raw_units: str = _row(ImuUnits.G_DPS.value, "What the sensor sends acceleration and angular rate in",
        choices=tuple(units.value for units in ImuUnits), live=False)
    orientation_covariance: Vector3 = _row(ZERO,
        "Variances of the IMU's orientation, rad²; 0 = typical of its filter", 0, 1e12)
    angular_velocity_covariance: Vector3 = _row(ZERO, "Its variances, (rad/s)²; 0 = typical", 0, 1e12)
    linear_acceleration_covariance: Vector3 = _row(ZERO, "Its variances, (m/s²)²; 0 = typical", 0, 1e12)
    temperature_variance: float = _row(0.0, "Of the temperature, K²; 0 = unknown", 0, 1e6)
    # Those limits of every verdict that can be set for this node.
    diagnostics_stale_after: float = _row(LIMITS.stale_after, "Error: no new sample for so many s", 0.05, 60)
    diagnostics_rate_tolerance: float = _row(LIMITS.rate_tolerance,
        "Warning: relative error of the rate", 0, 1)
    diagnostics_age_warn: float = _row(LIMITS.age_warn, "Warning: age of the samples (p99), s", 0, 60)
    diagnostics_age_error: float = _row(LIMITS.age_error, "Error: age of the samples (p99), s", 0, 60)
    diagnostics_lost_warn: int = _row(LIMITS.lost_warn, "Warning: samples lost or skipped in 1 s", 1, 10**6)
    diagnostics_temperature_warn: float = _row(LIMITS.temperature_warn, "Warning: temperature, °C", -40, 200)
    diagnostics_temperature_error: float = _row(LIMITS.temperature_error, "Error: temperature, °C", -40, 200)
    tool_mass: float = _row(0.0, "Mass of what hangs on the sensor, kg; 0 = it is not compensated", 0, 1000)
    tool_center_of_gravity: Vector3 = _row(ZERO, "Its center of gravity in frame_id, m", 0, 10)
    tool_inertia: Numbers = _row(NO_PAYLOAD.inertia,
        "Ixx Iyy Izz Ixy Ixz Iyz about that, kg m², as in URDF; 0 = unknown", 0, 1e3)
    tool_center_of_gravity_interval: Vector3 = _row(NO_PAYLOAD.center_interval,
        "Half of the 95 % interval of its center of gravity, m; ~/identify finds it", 0, 1)
    tool_inertia_interval: Numbers = _row(NO_PAYLOAD.inertia_interval,
        "Half of the 95 % intervals of tool_inertia, kg m²; 0 = not identified", 0, 1e3)
    gravity: Vector3 = _row(DEFAULT_GRAVITY,
        "Gravity, m/s², in the base frame: that of the orientations", 0, 100)
    bias: Numbers = _row((0.0,) * 6,
        "Subtracted from the wrench: Fx Fy Fz (N) Mx My Mz (Nm); ~/tare sets it", 0, 1e6)
    sensor_offset: Numbers = _row((math.inf,) * 6,
        "The sensor's own offset (0x8000) that bias goes with, N and Nm; infinite = that at the start; "
        "~/identify finds it", 0, math.inf)
    bias_ramp_time: float = _row(0.5, "Seconds in which a new bias replaces the old one; 0 = at once", 0, 60)
    imu_position: Vector3 = _row(ZERO,
        "Position of the sensor's IMU in frame_id, m; zeros = that of its model", 0, 1)
    on_saturation: str = _row("publish",
        "What wrench_compensated does on samples that are saturated: force, torque, the IMU if it is used",
        choices=("publish", "stop"))
    gravity_source: str = _row("imu",
        "Where the tool's weight and inertia are from: the sensor's IMU, or the robot (topics, TF)",
        choices=("none", "imu", *TOPIC_SOURCES, "tf"))
    orientation_topic: str = _row("orientation", f"Topic of the sources {', '.join(TOPIC_SOURCES)}")
    orientation_base_frame: str = _row("base_link", "Frame that gravity is given in, for the source tf")
    orientation_mounting: Quaternion = _row((0.0, 0.0, 0.0, 1.0),
        "Quaternion x y z w: frame_id in the frame of the topic", 0, 1 + NORM_TOLERANCE)
    orientation_stale_after: float = _row(0.1,
        "Largest difference of the stamps of orientation and sample, s", 0.001, 10)
    accelerometer_offset: Vector3 = _row(ZERO, "Its offset, m/s²; ~/identify finds it", 0, 5)
    accelerometer_scale: Vector3 = _row(EXACT.scale, "Its scale factors; ~/identify finds them", 0.5, 2)
    accelerometer_offset_interval: Vector3 = _row(EXACT.offset_interval,
        "Half of the 95 % interval of its offset, m/s²; ~/identify finds it", 0, 5)
    accelerometer_scale_interval: Vector3 = _row(EXACT.scale_interval,
        "Half of the 95 % interval of its scale; ~/identify finds it", 0, 1)
    accelerometer_cross_axis: Numbers = _row(EXACT.cross_axis,
        "Parts of other axes to subtract: xy xz yx yz zx zy; ~/identify finds them", 0, 1)
    accelerometer_cross_axis_interval: Numbers = _row(EXACT.cross_axis_interval,
        "Half of their 95 % intervals; ~/identify finds them", 0, 1)
    gyroscope_matrix: Numbers = _row(IDENTITY,
        "What angular rates are multiplied with, row by row; ethercat-identify finds it", 0, 2)
    accuracy_noise: Numbers = _row(UNKNOWN_ACCURACY.noise,
        "Standard deviations of a sample at SINC 51 with FIR off, N and Nm; 0 = of the latest tare, or of a "
        "healthy sensor; ~/identify finds them", 0, 1e3)
    accuracy_left: Numbers = _row(UNKNOWN_ACCURACY.left,
        "What identified tool and IMU leave on each axis: N in any pose, N per m/s², N per rad/s², likewise "
        "Nm; 0 = by the intervals; ethercat-identify finds it", 0, 1e3)
    rest_duration: float = _row(1.0, "Seconds that ~/tare and ~/identify/add_pose take samples for", 0.05, 60)
    rest_force_deviation: float = _row(_REST.force_deviation, "Largest standard deviation at rest, N", 0, 1e3)
    rest_torque_deviation: float = _row(_REST.torque_deviation,
        "Largest standard deviation at rest, Nm", 0, 1e3)
    rest_force_drift: float = _row(_REST.force_drift, "Largest drift of the mean at rest, N", 0, 1e3)
    rest_torque_drift: float = _row(_REST.torque_drift, "Largest drift of the mean at rest, Nm", 0, 1e3)
    rest_angular_rate: float = _row(_REST.angular_rate, "Largest mean angular rate at rest, rad/s", 0, 10)
    rest_angular_rate_deviation: float = _row(_REST.angular_rate_deviation,
        "Largest standard deviation at rest, rad/s", 0, 10)
    rest_acceleration_deviation: float = _row(_REST.acceleration_deviation,
        "Largest standard deviation at rest, m/s²", 0, 100)
    rest_acceleration_drift: float = _row(_REST.acceleration_drift,
        "Largest drift of the mean at rest, m/s²", 0, 100)
    filter_cutoff: float = _row(0.0, "Low-pass of wrench_filtered, -3 dB, Hz; 0 = no such topic", 0, 1000)
    contact_surface: str = _row("", "What is touched, in frame_id, m: plane X Y Z NX NY NZ RADIUS, "
        "sphere X Y Z RADIUS or capsule X Y Z X Y Z RADIUS; empty = no topics contact",
        live=False, optional=True)
    contact_noise: Numbers = _row((0.0,) * 6,
        "Its standard deviations, N and Nm; 0 = of the latest tare, or of a healthy sensor", 0, 1e3)
    contact_false_alarms: float = _row(1.0, "Most of them an hour, without contact", 1e-6, 3600)
    identify_file: str = _row(AUTO,
        "YAML file that ~/identify/solve writes; auto = sensor-SERIAL-payload.yaml in bota-ethercat-bridge "
        "of $XDG_STATE_HOME or ~/.local/state")
    # fmt: on

    @cached_property
    def frames(self) -> tuple[WrenchFrame, ...]:
        return parse_frames(self.wrench_frames)

    @cached_property
    def limits(self) -> StreamLimits:
        return LIMITS._replace(**self._group("diagnostics_"))

    @cached_property
    def payload(self) -> Payload:
        intervals = self.tool_center_of_gravity_interval, self.tool_inertia_interval
        return Payload(self.tool_mass, self.tool_center_of_gravity, self.tool_inertia, *intervals)

    @cached_property
    def accelerometer(self) -> Accelerometer:
        return Accelerometer(**self._group("accelerometer_"))

    @cached_property
    def accuracy(self) -> Accuracy:
        return Accuracy(**self._group("accuracy_"))

    @cached_property
    def rest(self) -> StationaryLimits:
        given = self._group("rest_")
        return StationaryLimits(**{name: given[name] for name in given if name != "duration"})

    @cached_property
    def mounting(self) -> Quaternion:
        """`orientation.mounting`, exactly one long; ValueError."""
        return unit_quaternion(self.orientation_mounting)

    def _group(self, prefix: str) -> dict[str, Any]:
        names = (each.name for each in fields(self) if each.name.startswith(prefix))
        return {name.removeprefix(prefix): getattr(self, name) for name in names}


PARAMETERS: Final = tuple(
    ParameterRow(_GROUPS.sub(r"\1.", each.name), *each.metadata["row"], **each.metadata["more"])
    for each in fields(Parameters)
)


def gather(given: Mapping[str, Any]) -> Parameters:
    """From checked values by the parameters' names; ParameterError if they do not go together."""
    values = {name.replace(".", "_"): value for name, value in given.items()}
    port, alias = values["server_port"], values["SERVER_PORT"]
    if alias and port not in (_PORT, alias):
        raise ParameterError(
            f"parameters server_port is {port} and SERVER_PORT is {alias}: they are one thing, give one"
        )
    parameters = Parameters(**values | {"server_port": alias or port})
    for name in ("frame_id", "imu_frame_id", "orientation.base_frame"):
        _refuse_slash(f"parameter {name} is", given[name])
    if length(parameters.gravity) < _LEAST_GRAVITY:
        raise ParameterError(
            f"parameter gravity is {list(parameters.gravity)}: it must be at least {_LEAST_GRAVITY} m/s² "
            "long; for no compensation of gravity set tool_mass to 0"
        )
    try:
        unit_quaternion(parameters.orientation_mounting)
    except ValueError as error:
        mounting = list(parameters.orientation_mounting)
        raise ParameterError(f"parameter orientation.mounting is {mounting}: {error}") from None
    if 0.0 < (cutoff_hz := parameters.filter_cutoff) < LEAST_CUTOFF_HZ:
        raise ParameterError(
            f"parameter filter.cutoff is {cutoff_hz:g}: it must be 0, for none, or at least "
            f"{LEAST_CUTOFF_HZ:g} Hz"
        )
    parse_frames(parameters.wrench_frames)
    parse_surface(parameters.contact_surface)
    return parameters


def parse_surface(text: str) -> Surface | None:
    """The surface of `contact.surface`, None of an empty one; ParameterError."""
    try:
        return surface_of(text)
    except CompensationError as error:
        raise ParameterError(str(error)) from None


def _refuse_slash(what: str, frame: str) -> None:
    if frame.startswith("/"):
        name = frame.lstrip("/") or "a name"
        raise ParameterError(f"{what} {frame!r}: frames have no leading slash, give {name!r}")


def parse_frames(texts: Sequence[str]) -> tuple[WrenchFrame, ...]:
    """The frames of all strings of `wrench_frames` that are not empty; ParameterError.

    Each is `NAME`, whose pose TF tells, or `NAME x y z [qx qy qz qw]`, which is its pose in `frame_id`.
    """
    frames = tuple(_parse_frame(text) for text in texts if text.strip())
    names = [frame.name for frame in frames]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(f"parameter wrench_frames names {name!r} twice: give each frame once")
    return frames


def _parse_frame(text: str) -> WrenchFrame:
    name, *words = text.split()
    _refuse_slash("parameter wrench_frames has", name)
    if not _FRAME_NAME.fullmatch(name):
        raise ParameterError(
            f"parameter wrench_frames has {name!r}, which cannot be part of a topic's name: use letters, "
            "digits and _, and no digit first"
        )
    if not words:
        return WrenchFrame(name)
    try:
        numbers = [float(word) for word in words]
        if len(numbers) not in (3, 7) or not all(map(math.isfinite, numbers)):
            raise ValueError(f"{len(numbers)} numbers follow the name")
        x, y, z, qx, qy, qz, qw = numbers if len(numbers) == 7 else [*numbers, 0.0, 0.0, 0.0, 1.0]
        if max(abs(x), abs(y), abs(z)) > FARTHEST_M:
            raise ValueError(f"that is farther than {FARTHEST_M:g} m from the sensor")
        pose = WrenchTransform.of((x, y, z), (qx, qy, qz, qw))
    except ValueError as error:
        raise ParameterError(
            f"parameter wrench_frames has {text!r}: it must be NAME, NAME x y z, or NAME x y z qx qy qz qw, "
            f"in m ({error})"
        ) from None
    return WrenchFrame(name, pose.inverse())
