"""The table of parameters: what each may be, and the sentence where it is not."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically

from bridge.parameters.compensation import ROWS as COMPENSATION_ROWS
from bridge.parameters.compensation import gather
from bridge.parameters.declare import descriptor
from bridge.parameters.row import ParameterError
from bridge.parameters.table import PARAMETERS
from tests.bridge.compensating import UP, hold
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer

pytestmark = pytest.mark.ros
ROWS = {row.name: row for row in PARAMETERS}
CONFIG = Path(__file__).parents[2] / "ros2_bridge" / "config" / "client.yaml"


def test_defaults_are_the_contracts() -> None:
    defaults = {name: row.default for name, row in ROWS.items()}
    assert defaults == {
        "server_host": "localhost", "server_port": 12001, "SERVER_PORT": 0, "sensor": 0,
        "rt_priority": 40, "cpu": -1,
        "publishing_frequency": 0.0, "array_topic": "sensone_sensor_data", "frame_id": "ft_sensor",
        "imu_frame_id": "ft_sensor_imu", "imu_raw_units": "g_dps", "temperature_variance": 0.0,
        "orientation_covariance": (0.0, 0.0, 0.0), "angular_velocity_covariance": (0.0, 0.0, 0.0),
        "linear_acceleration_covariance": (0.0, 0.0, 0.0), "wrench_frames": ("",),
        "diagnostics.stale_after": 0.5,
        "diagnostics.rate_tolerance": 0.01, "diagnostics.age_warn": 0.01, "diagnostics.age_error": 0.1,
        "diagnostics.lost_warn": 1, "diagnostics.temperature_warn": 60.0,
        "diagnostics.temperature_error": 80.0,
        "tool_mass": 0.0, "tool_center_of_gravity": (0.0, 0.0, 0.0), "gravity": (0.0, 0.0, -9.80665),
        "bias": (0.0,) * 6, "bias_ramp_time": 0.5, "bias_keep": False, "bias_directory": "auto",
        "imu_position": (0.0, 0.0, 0.0),
        "on_saturation": "publish", "gravity_source": "imu",
        "orientation.topic": "orientation", "orientation.base_frame": "base_link",
        "orientation.mounting": (0.0, 0.0, 0.0, 1.0), "orientation.stale_after": 0.1,
        "accelerometer.offset": (0.0, 0.0, 0.0),
        "accelerometer.scale": (1.0, 1.0, 1.0), "accelerometer.offset_interval": (0.784, 0.784, 0.784),
        "accelerometer.scale_interval": (0.0098, 0.0098, 0.0098),
        "rest.duration": 1.0, "rest.force_spread": 0.8,
        "rest.torque_spread": 0.02, "rest.force_wander": 0.3, "rest.torque_wander": 0.01,
        "rest.angular_rate": 0.05, "rest.angular_rate_spread": 0.02, "rest.acceleration_spread": 0.3,
        "rest.acceleration_wander": 0.05, "identify.file": "auto",
        "filter.cutoff": 0.0, "filter.notch": 0.0, "filter.notch_width": 5.0,
        "filter.dead_band_force": 0.0, "filter.dead_band_torque": 0.0,
    }  # fmt: skip
    assert all(row.check(row.default) == row.default for row in PARAMETERS)


def test_the_configuration_file_says_the_same() -> None:
    pairs = (line.split("#")[0].partition(":") for line in CONFIG.read_text().splitlines())
    given = {name.strip(): value.strip() for name, _, value in pairs if value.strip()}
    defaults = {name: row.default for name, row in ROWS.items() if name != "SERVER_PORT"}
    assert given == {name: _yaml(default) for name, default in defaults.items()}


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str([*value] if isinstance(value, tuple) else value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("server_host", ""), ("server_host", 5), ("server_port", 0), ("server_port", 65536),
        ("server_port", "12001"), ("server_port", True), ("server_port", 12001.0), ("server_port", None),
        ("sensor", -1), ("sensor", 256), ("publishing_frequency", -1.0), ("publishing_frequency", math.nan),
        ("publishing_frequency", math.inf), ("publishing_frequency", True), ("publishing_frequency", "fast"),
        ("imu_raw_units", "SI"), ("imu_raw_units", ""), ("array_topic", ""), ("frame_id", ""),
        ("orientation_covariance", 0.1), ("orientation_covariance", [0.1]),
        ("orientation_covariance", "abc"), ("orientation_covariance", [0.1, 0.1, math.nan]),
        ("linear_acceleration_covariance", [True, False, True]), ("diagnostics.stale_after", 0.0),
        ("tool_mass", -0.1), ("tool_mass", "1"), ("tool_mass", True), ("bias", [0.0] * 5), ("bias", 0.0),
        ("tool_center_of_gravity", [0.0] * 9), ("tool_center_of_gravity", [0.0, 0.0, math.nan]),
        ("tool_center_of_gravity", [0.0, 0.0, -11.0]), ("bias_keep", 1), ("bias_keep", "yes"),
        ("wrench_frames", [1.0, 2.0, 3.0]), ("wrench_frames", 5), ("wrench_frames", ["tool0", 5]),
        ("filter.cutoff", -1.0), ("filter.cutoff", "10"), ("filter.notch_width", 0.0),
        ("gravity_source", "accelerometer"), ("orientation.mounting", [0.0] * 3), ("rest.duration", 0.0),
    ],
)  # fmt: skip
def test_wrong_values_are_named(name: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=f"parameter {name} is .*: it must be "):
        ROWS[name].check(value)


def test_a_whole_number_is_a_number() -> None:
    checked = ROWS["publishing_frequency"].check(100)
    assert checked == 100.0
    assert isinstance(checked, float)


def test_numbers_of_the_compensation_say_how_many() -> None:
    with pytest.raises(ParameterError, match="it must be 6 numbers, none beyond 1e\\+06 either way"):
        ROWS["bias"].check([1.0])
    with pytest.raises(ParameterError, match="it must be true or false"):
        ROWS["bias_keep"].check(0.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gravity": (0.0, 0.05, 0.0)}, "set tool_mass to 0"),
        ({"orientation.mounting": (0.5, 0.5, 0.5, 0.6)}, "a quaternion of length 1"),
        ({"orientation.mounting": (0.0, 0.0, 0.0, 0.0)}, "a quaternion of length 1"),
        ({"filter.cutoff": 0.01}, "parameter filter.cutoff is 0.01: it must be 0, for none, or at least"),
        ({"filter.notch": 0.5}, "parameter filter.notch is 0.5: it must be 0, for none, or at least 1 Hz"),
    ],
)
def test_values_that_do_not_go_together(changes: dict[str, Any], words: str) -> None:
    values = {row.name: row.default for row in COMPENSATION_ROWS} | changes
    with pytest.raises(ParameterError, match=words):
        gather(values)


@pytest.mark.parametrize("value", [[1, 2, 3], array("d", [1, 2, 3]), [0.5] * 9, [-0.5] * 9])
def test_a_covariance_is_three_or_nine_numbers(value: Any) -> None:
    assert ROWS["orientation_covariance"].check(value) == tuple(map(float, value))


def test_every_parameter_describes_itself() -> None:
    for row in PARAMETERS:
        described = descriptor(row)
        assert described.description
        assert described.read_only is not row.live
        if isinstance(row.default, int | float) and not isinstance(row.default, bool):
            assert described.integer_range or described.floating_point_range, row.name


# What any participant may send.


def hostile_values(length: int) -> Iterator[ParameterValue]:
    """Numbers that are none or too large, arrays of `length` of them, empty ones, and every type."""
    kinds = ParameterType
    for number in (math.nan, math.inf, -math.inf, 1e308, -1e308, -1.0):
        yield ParameterValue(type=kinds.PARAMETER_DOUBLE, double_value=number)
        yield ParameterValue(type=kinds.PARAMETER_DOUBLE_ARRAY, double_array_value=[number] * length)
    for whole in (-1, 2**63 - 1, -(2**63)):
        yield ParameterValue(type=kinds.PARAMETER_INTEGER, integer_value=whole)
        yield ParameterValue(type=kinds.PARAMETER_INTEGER_ARRAY, integer_array_value=[whole] * length)
    yield ParameterValue(type=kinds.PARAMETER_BOOL, bool_value=True)
    for text in ("", " ", "-1", "a\x00b", "/" * 300):
        yield ParameterValue(type=kinds.PARAMETER_STRING, string_value=text)
        yield ParameterValue(type=kinds.PARAMETER_STRING_ARRAY, string_array_value=[text] * length)
    yield from (ParameterValue(type=kind) for kind in (*range(11), 255))  # empty, and no types


@pytest.mark.usefixtures("_ros")
def test_no_value_of_any_parameter_ends_the_node() -> None:
    server = SimulatedServer()
    hold(server, UP)
    with SimulatedNode(server) as node:
        heard = node.hear("wrench_compensated")
        node.run(1.0)
        names = node.call("list_parameters", ListParameters.Request()).result.names
        assert {*ROWS, "settings.fir", "use_sim_time"} <= {*names}
        for name in names:
            (before,) = node.call("get_parameters", GetParameters.Request(names=[name])).values
            length = max(len(getattr(before, f"{kind}_array_value")) for kind in ("double", "string"))
            for value in hostile_values(length or 3):
                parameters = [Parameter(name=name, value=value)]
                (result,) = node.call("set_parameters", SetParameters.Request(parameters=parameters)).results
                request = SetParametersAtomically.Request(parameters=parameters)
                again = node.call("set_parameters_atomically", request).result
                assert again.successful == result.successful, (name, value)
                if result.successful:
                    restored = SetParameters.Request(parameters=[Parameter(name=name, value=before)])
                    assert node.call("set_parameters", restored).results[0].successful, (name, value)
                else:
                    assert result.reason, (name, value)
                values = node.call("get_parameters", GetParameters.Request(names=[name])).values
                assert values == [before], (name, value)
            heard.clear()
            node.run(0.05)
            assert heard, name
