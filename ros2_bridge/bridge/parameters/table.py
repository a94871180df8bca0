"""The node's parameters: one table, from which they are declared, checked, described and documented. No ROS.

Those of the compensation (`compensation`), limits and covariances can be set while the node runs (`live`),
others are read-only. A wrong value ends the node at start with one sentence. The sensor's settings are
parameters too, but the server decides about them: `sensor_settings`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from bota_ethercat.client.real_time import HIGHEST_PRIORITY
from bota_ethercat.health.verdict import LIMITS, Limits
from bota_ethercat.pdo import ImuUnits
from bridge.parameters.compensation import ROWS as COMPENSATION_ROWS
from bridge.parameters.compensation import CompensationParameters, gather
from bridge.parameters.row import NO_TEXTS, Numbers, ParameterError, Row
from bridge.parameters.wrench_frames import WrenchFrame, parse

_UNKNOWN: Final = (0.0, 0.0, 0.0)
_COVARIANCE: Final = "3 variances or 9 numbers row by row; 0 = unknown"

_LIMITS: Final = "diagnostics."
"""Prefix of those limits of every verdict that can be set for this node."""


def _limit(name: str, meaning: str, low: float, high: float) -> Row:
    return Row(_LIMITS + name, getattr(LIMITS, name), meaning, low, high)


SERVER_PORT: Final = Row("server_port", 12001, "TCP port of ethercat-server", 1, 65535)
_LIVE: Final = ("publishing_frequency", "temperature_variance", _LIMITS)
"""Prefixes of what can be set while the node runs; covariances can, too."""
_TABLE: Final = (
    Row("server_host", "localhost", "Host that ethercat-server runs on"),
    SERVER_PORT,
    Row("SERVER_PORT", 0, "Another name for server_port; 0 = not used", 0, 65535),
    Row("sensor", 0, "The sensor's position on the bus, from 0", 0, 255),
    Row(
        "rt_priority",
        40,
        "SCHED_FIFO priority of the stream's thread, if allowed; 0 = as the node was started",
        0,
        HIGHEST_PRIORITY,
    ),
    Row("cpu", -1, "CPU of the stream's thread; -1 = any", -1, 1023),
    Row("publishing_frequency", 0.0, "Most messages a second, always the newest; 0 = every sample", 0, 1e6),
    Row("array_topic", "sensone_sensor_data", "Topic of the Float64MultiArray"),
    Row("frame_id", "ft_sensor", "Frame of the wrench (its origin is the sensor's) and of the temperature"),
    Row(
        "wrench_frames",
        NO_TEXTS,
        "Frames of wrench_compensated/NAME: NAME (by TF), or 'NAME x y z [qx qy qz qw]' in frame_id, m",
    ),
    Row("imu_frame_id", "ft_sensor_imu", "Frame of the IMU's messages"),
    Row(
        "imu_raw_units",
        ImuUnits.G_DPS.value,
        "What the sensor sends acceleration and angular rate in",
        choices=tuple(units.value for units in ImuUnits),
    ),
    Row("orientation_covariance", _UNKNOWN, f"Of the IMU's orientation, rad²: {_COVARIANCE}", 0, 1e12),
    Row("angular_velocity_covariance", _UNKNOWN, f"Of the IMU, (rad/s)²: {_COVARIANCE}", 0, 1e12),
    Row("linear_acceleration_covariance", _UNKNOWN, f"Of the IMU, (m/s²)²: {_COVARIANCE}", 0, 1e12),
    Row("temperature_variance", 0.0, "Of the temperature, K²; 0 = unknown", 0, 1e6),
    _limit("stale_after", "Seconds without a new sample that are an error", 0.05, 60),
    _limit("rate_tolerance", "Part by which the rate may differ before it is a warning", 0, 1),
    _limit("age_warn", "Age of the samples (p99), s, from which it is a warning", 0, 60),
    _limit("age_error", "Age of the samples (p99), s, from which it is an error", 0, 60),
    _limit("lost_warn", "Samples lost or skipped in a second that are a warning", 1, 10**6),
    _limit("temperature_warn", "Temperature, °C, from which it is a warning", -40, 200),
    _limit("temperature_error", "Temperature, °C, from which it is an error", -40, 200),
    *COMPENSATION_ROWS,
)
PARAMETERS: Final = tuple(
    row._replace(live=row.live or row.name.startswith(_LIVE) or row.name.endswith("_covariance"))
    for row in _TABLE
)


class Parameters(NamedTuple):
    """The parameters' values, checked."""

    server_host: str
    server_port: int
    sensor: int
    publishing_frequency: float
    array_topic: str
    imu_units: ImuUnits
    frame_id: str
    imu_frame_id: str
    orientation_covariance: Numbers
    angular_velocity_covariance: Numbers
    linear_acceleration_covariance: Numbers
    temperature_variance: float
    wrench_frames: tuple[WrenchFrame, ...]
    limits: Limits
    compensation: CompensationParameters
    """As they are at start."""
    rt_priority: int
    cpu: int


def gather_all(values: dict[str, Any]) -> Parameters:
    """From checked values by the rows' names, which it uses up; ParameterError if they do not go together."""
    port, alias = values["server_port"], values["SERVER_PORT"]
    if alias:
        if port not in (SERVER_PORT.default, alias):
            raise ParameterError(
                f"parameters server_port is {port} and SERVER_PORT is {alias}: they are one thing, give one"
            )
        values["server_port"] = alias
    del values["SERVER_PORT"]
    for name in ("frame_id", "imu_frame_id", "orientation.base_frame"):
        if values[name].startswith("/"):
            raise ParameterError(
                f"parameter {name} is {values[name]!r}: frames have no leading slash, give "
                f"{values[name].lstrip('/') or 'a name'!r}"
            )
    compensation = gather({row.name: values.pop(row.name) for row in COMPENSATION_ROWS})
    rows = [row.name for row in _TABLE if row.name.startswith(_LIMITS)]
    limits = LIMITS._replace(**{name.removeprefix(_LIMITS): values.pop(name) for name in rows})
    units, frames = ImuUnits(values.pop("imu_raw_units")), parse(values.pop("wrench_frames"))
    return Parameters(
        **values, imu_units=units, wrench_frames=frames, limits=limits, compensation=compensation
    )


DEFAULTS: Final = gather_all({row.name: row.default for row in PARAMETERS})
