"""The parameters of the compensation: their rows, their values, and what must hold between them.

All can be set while the node runs. A wrong value is refused with a sentence and the old one stays.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from bota_ethercat.pdo import Vector3
from bridge.parameters.row import ParameterError, Row
from ft_compensation.outputs.filter import LEAST_CUTOFF_HZ, LEAST_NOTCH_HZ, FilterSettings
from ft_compensation.quantities import (
    DEFAULT_GRAVITY,
    EXACT,
    ZERO,
    Accelerometer,
    Payload,
    Quaternion,
    Wrench,
    length,
    unit_quaternion,
)
from ft_compensation.stationary_limits import StationaryLimits

AUTO: Final = "auto"
"""The value of a path that is for the node to choose."""
TOPIC_SOURCES: Final = ("topic_pose", "topic_quaternion", "topic_imu")
SOURCES: Final = ("none", "imu", *TOPIC_SOURCES, "tf")
_LEAST_GRAVITY: Final = 0.1
_LEAST_SCALE: Final = 0.5
_REST: Final = StationaryLimits()

_TABLE: Final = (
    Row("tool_mass", 0.0, "Mass of what hangs on the sensor, kg; 0 = it is not compensated", 0, 1000),
    Row("tool_center_of_gravity", ZERO, "Its center of gravity in frame_id, m", 0, 10, lengths=(3,)),
    Row("gravity", DEFAULT_GRAVITY,
        "Gravity, m/s², in the base frame: that of the orientations", 0, 100, lengths=(3,)),
    Row("bias", (0.0,) * 6,
        "Subtracted from the wrench: Fx Fy Fz (N) Mx My Mz (Nm); ~/tare sets it", 0, 1e6, lengths=(6,)),
    Row("bias_ramp_time", 0.5, "Seconds in which a new bias replaces the old one; 0 = at once", 0, 60),
    Row("bias_keep", False, "Whether the bias is kept across restarts, by the sensor's serial number"),
    Row("bias_directory", AUTO,
        "Where it is kept; auto = bota-ethercat-bridge in $XDG_STATE_HOME or ~/.local/state"),
    Row("imu_position", ZERO,
        "Position of the IMU in frame_id, m; zeros = that of the sensor's model", 0, 1, lengths=(3,)),
    Row("on_saturation", "publish",
        "What wrench_compensated does on samples whose force or torque is saturated",
        choices=("publish", "stop")),
    Row("gravity_source", "imu",
        "Where the tool's weight is from: imu (with its inertia), or an orientation of the robot's",
        choices=SOURCES),
    Row("orientation.topic", "orientation", f"Topic of the sources {', '.join(TOPIC_SOURCES)}"),
    Row("orientation.base_frame", "base_link", "Frame that gravity is given in, for the source tf"),
    Row("orientation.mounting", (0.0, 0.0, 0.0, 1.0),
        "Quaternion x y z w: frame_id in the frame of the topic", 0, 1, lengths=(4,)),
    Row("orientation.stale_after", 0.1,
        "Largest difference of the stamps of orientation and sample, s", 0.001, 10),
    Row("accelerometer.offset", ZERO, "Its offset, m/s²; ~/identify finds it", 0, 5, lengths=(3,)),
    Row("accelerometer.scale", EXACT.scale,
        "Its scale factors; ~/identify finds them", 0, 2, lengths=(3,)),
    Row("accelerometer.offset_interval", EXACT.offset_interval,
        "Half of the 95 % interval of its offset, m/s²; ~/identify finds it", 0, 5, lengths=(3,)),
    Row("accelerometer.scale_interval", EXACT.scale_interval,
        "Half of the 95 % interval of its scale; ~/identify finds it", 0, 1, lengths=(3,)),
    Row("rest.duration", 1.0, "Seconds that ~/tare and ~/identify/add_pose take samples for", 0.05, 60),
    Row("rest.force_spread", _REST.force_spread, "Largest standard deviation when stationary, N", 0, 1e3),
    Row("rest.torque_spread", _REST.torque_spread, "Largest standard deviation when stationary, Nm", 0, 1e3),
    Row("rest.force_wander", _REST.force_wander, "Largest drift of the mean when stationary, N", 0, 1e3),
    Row("rest.torque_wander", _REST.torque_wander, "Largest drift of the mean when stationary, Nm", 0, 1e3),
    Row("rest.angular_rate", _REST.angular_rate, "Largest mean angular rate when stationary, rad/s", 0, 10),
    Row("rest.angular_rate_spread", _REST.angular_rate_spread,
        "Largest standard deviation when stationary, rad/s", 0, 10),
    Row("rest.acceleration_spread", _REST.acceleration_spread,
        "Largest standard deviation when stationary, m/s²", 0, 100),
    Row("rest.acceleration_wander", _REST.acceleration_wander,
        "Largest drift of the mean when stationary, m/s²", 0, 100),
    Row("filter.cutoff", 0.0,
        "Low-pass of wrench_filtered, -3 dB, Hz; 0 = no such topic", 0, 1000),
    Row("filter.notch", 0.0, "Center of its notch, Hz; 0 = none", 0, 1000),
    Row("filter.notch_width", 5.0, "Width of the notch between -3 dB points, Hz", 0.1, 1000),
    Row("filter.dead_band_force", 0.0, "Subtracted from the magnitude of its force, N; 0 = none", 0, 1e6),
    Row("filter.dead_band_torque", 0.0, "Subtracted from the magnitude of its torque, Nm; 0 = none", 0, 1e6),
    Row("identify.file", AUTO,
        "YAML file that ~/identify/solve writes; auto = sensor-SERIAL-payload.yaml in bias_directory"),
)  # fmt: skip
ROWS: Final = tuple(row._replace(live=True) for row in _TABLE)
"""Every one can be set while the node runs."""


class OrientationParameters(NamedTuple):
    """Where the orientation comes from."""

    source: str
    topic: str
    base_frame: str
    mounting: Quaternion
    stale_after: float


class CompensationParameters(NamedTuple):
    """The values, checked."""

    payload: Payload
    gravity: Vector3
    bias: Wrench
    bias_ramp_time: float
    bias_keep: bool
    bias_directory: str
    imu_position: Vector3
    on_saturation: str
    orientation: OrientationParameters
    accelerometer: Accelerometer
    rest_duration: float
    rest: StationaryLimits
    identify_file: str
    filter: FilterSettings


def gather(values: Mapping[str, Any]) -> CompensationParameters:
    """From checked values by the rows' names; ParameterError if they do not go together."""
    gravity, mounting = values["gravity"], values["orientation.mounting"]
    if length(gravity) < _LEAST_GRAVITY:
        raise ParameterError(
            f"parameter gravity is {list(gravity)}: it must be at least {_LEAST_GRAVITY} m/s² long; for no "
            "compensation of gravity set tool_mass to 0"
        )
    try:
        mounting = unit_quaternion(mounting)
    except ValueError as error:
        raise ParameterError(f"parameter orientation.mounting is {list(mounting)}: {error}") from None
    if min(values["accelerometer.scale"]) < _LEAST_SCALE:
        raise ParameterError(
            f"parameter accelerometer.scale is {list(values['accelerometer.scale'])}: each must be at least "
            f"{_LEAST_SCALE}; 1 is an exact axis"
        )

    def group(prefix: str) -> dict[str, Any]:
        return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}

    rest = group("rest.")
    duration = rest.pop("duration")
    for name, least in (("filter.cutoff", LEAST_CUTOFF_HZ), ("filter.notch", LEAST_NOTCH_HZ)):
        if 0.0 < values[name] < least:
            raise ParameterError(
                f"parameter {name} is {values[name]:g}: it must be 0, for none, or at least {least:g} Hz"
            )
    orientation = group("orientation.") | {"mounting": mounting}
    names = set(CompensationParameters._fields) & values.keys() - {"bias"}
    return CompensationParameters(
        **{name: values[name] for name in names},
        payload=Payload(values["tool_mass"], values["tool_center_of_gravity"]),
        bias=Wrench.of(values["bias"]),
        orientation=OrientationParameters(values["gravity_source"], **orientation),
        accelerometer=Accelerometer(**group("accelerometer.")),
        rest_duration=duration,
        rest=StationaryLimits(**rest),
        identify_file=values["identify.file"],
        filter=FilterSettings(**group("filter.")),
    )


DEFAULTS: Final = gather({row.name: row.default for row in ROWS})
