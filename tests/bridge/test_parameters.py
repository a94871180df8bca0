"""The table of parameters: what each may be, the sentence where it is not, and what follows it at once."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically

from bota_ethercat.pdo import encode
from bota_ethercat_bridge.node import StartError
from bota_ethercat_bridge.parameters.declare import descriptor
from bota_ethercat_bridge.parameters.table import PARAMETERS, ParameterError, gather
from tests.bridge.simulated_node import UP, Node, Server

ROWS = {row.name: row for row in PARAMETERS}
CONFIG = Path(__file__).parents[2] / "ros2_bridge" / "config" / "client.yaml"


def test_defaults_are_the_contracts() -> None:
    contract = {
        "server_host": "localhost", "server_port": 12001, "SERVER_PORT": 0, "sensor": 0,
        "publishing_frequency": 0.0, "array_topic": "sensone_sensor_data", "frame_id": "ft_sensor",
        "imu_frame_id": "ft_sensor_imu", "imu_raw_units": "g_dps",
        "supervisor_topic": "/supervisor_status_data", "stamp": "sample",
    }  # fmt: skip
    assert {name: ROWS[name].default for name in contract} == contract
    assert all(row.check(row.default) == row.default for row in PARAMETERS)


def test_the_configuration_file_says_the_same() -> None:
    pairs = (line.split("#")[0].partition(":") for line in CONFIG.read_text().splitlines())
    given = {name.strip(): yaml.safe_load(value) for name, _, value in pairs if value.strip()}
    assert {name: row.check(given.pop(name)) for name, row in ROWS.items() if name in given} == {
        name: row.default for name, row in ROWS.items() if name != "SERVER_PORT"
    }
    assert not given


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("server_host", ""), ("server_host", 5), ("server_port", 0), ("server_port", 65536),
        ("server_port", "12001"), ("server_port", True), ("server_port", 12001.0), ("server_port", None),
        ("sensor", -1), ("sensor", 256), ("publishing_frequency", -1.0), ("publishing_frequency", math.nan),
        ("publishing_frequency", math.inf), ("publishing_frequency", True), ("publishing_frequency", "fast"),
        ("imu_raw_units", "SI"), ("imu_raw_units", ""), ("array_topic", ""), ("frame_id", ""),
        ("orientation_covariance", 0.1), ("orientation_covariance", [0.1] * 9),
        ("orientation_covariance", "abc"), ("orientation_covariance", [0.1, 0.1, math.nan]),
        ("linear_acceleration_covariance", [True, False, True]), ("diagnostics.stale_after", 0.0),
        ("tool_mass", -0.1), ("tool_mass", "1"), ("tool_mass", True), ("bias", [0.0] * 5), ("bias", 0.0),
        ("tool_center_of_gravity", [0.0] * 9), ("tool_center_of_gravity", [0.0, 0.0, math.nan]),
        ("tool_center_of_gravity", [0.0, 0.0, -11.0]),
        ("wrench_frames", [1.0, 2.0, 3.0]), ("wrench_frames", 5), ("wrench_frames", ["tool0", 5]),
        ("filter.cutoff", -1.0), ("filter.cutoff", "10"),
        ("gravity_source", "accelerometer"), ("orientation.mounting", [0.0] * 3), ("rest.duration", 0.0),
        ("accelerometer.scale", [1.0, 0.4, 1.0]), ("sensor_offset", [10**400] * 6),
    ],
)  # fmt: skip
def test_wrong_values_are_named(name: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=f"parameter {name} is .*: it must be "):
        ROWS[name].check(value)


def test_what_is_taken_and_what_else_is_said() -> None:
    checked = ROWS["publishing_frequency"].check(100)
    assert (checked, type(checked)) == (100.0, float), "a whole number is a number"
    values: tuple[Any, ...] = ([1, 2, 3], array("d", [1, 2, 3]))
    for value in values:
        assert ROWS["orientation_covariance"].check(value) == tuple(map(float, value))
    for name, wrong, words in (
        ("bias", [1.0], "it must be 6 numbers from -1e\\+06 to 1e\\+06"),
        ("identify.file", "", "it must be text that is not empty"),
        ("gravity_source", "accelerometer", "it must be one of none, imu, topic_pose"),
    ):
        with pytest.raises(ParameterError, match=words):
            ROWS[name].check(wrong)


@pytest.mark.parametrize("rounded", [1.0000000000000002, 1.0, 0.9999999999999998, -1.0000000000000002])
def test_a_rotation_may_be_rounded(rounded: float) -> None:
    row, mounting = ROWS["orientation.mounting"], (0.0, 0.0, 0.0, rounded)
    values = {row.name: row.default for row in PARAMETERS} | {row.name: row.check(mounting)}
    assert gather(values).mounting == (0.0, 0.0, 0.0, math.copysign(1.0, rounded))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gravity": (0.0, 0.05, 0.0)}, "set tool_mass to 0"),
        ({"orientation.mounting": (0.5, 0.5, 0.5, 0.6)}, "a quaternion of length 1"),
        ({"orientation.mounting": (0.0, 0.0, 0.0, 0.0)}, "a quaternion of length 1"),
        ({"filter.cutoff": 0.01}, "parameter filter.cutoff is 0.01: it must be 0, for none, or at least"),
    ],
)
def test_values_that_do_not_go_together(changes: dict[str, Any], words: str) -> None:
    values = {row.name: row.default for row in PARAMETERS} | changes
    with pytest.raises(ParameterError, match=words):
        gather(values)


def test_every_parameter_describes_itself() -> None:
    for row in PARAMETERS:
        described = descriptor(row.type, row.description)
        assert described.description
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


def test_no_value_of_any_parameter_ends_the_node() -> None:
    server = Server()
    server.hold(UP)
    with Node(server) as node:
        heard = node.hear("wrench_compensated")
        node.run(1.0)
        names = node.call("list_parameters", ListParameters.Request()).result.names
        assert {*ROWS, "settings.fir", "use_sim_time"} <= {*names}
        for name in names:
            (before,) = node.call("get_parameters", GetParameters.Request(names=[name])).values
            length = max(len(getattr(before, f"{kind}_array_value")) for kind in ("double", "string"))
            for value in hostile_values(length or 3):
                parameters = [Parameter(name=name, value=value)]
                results = node.call("set_parameters", SetParameters.Request(parameters=parameters)).results
                request = SetParametersAtomically.Request(parameters=parameters)
                again = node.call("set_parameters_atomically", request).result
                if value.type > ParameterType.PARAMETER_STRING_ARRAY:  # nothing is set of a type that is none
                    assert (results, again.successful) == ([], False)
                    continue
                (result,) = results
                assert again.successful == result.successful, (name, value)
                if result.successful:
                    restored = SetParameters.Request(parameters=[Parameter(name=name, value=before)])
                    assert node.call("set_parameters", restored).results[0].successful, (name, value)
                else:
                    assert result.reason, (name, value)
                values = node.call("get_parameters", GetParameters.Request(names=[name])).values
                assert values == [before], (name, value)
            assert node.fresh(heard, 0.05), name


def test_limits_and_covariances_can_be_set_while_it_runs() -> None:
    server = Server()
    with Node(server) as node:
        imu, wrenches, temperatures = node.hear("imu/data_raw"), node.hear("wrench"), node.hear("temperature")
        node.run(0.2)
        for name, value in (
            ("angular_velocity_covariance", [0.5, 0.25, 0.125]),
            ("linear_acceleration_covariance", [1, 2, 3]),
            ("temperature_variance", 0.5),
            ("diagnostics.temperature_warn", 20.0),
            ("publishing_frequency", 10.0),
        ):
            node.set(name, value)
        for messages in (imu, wrenches, temperatures):
            messages.clear()
        server.changes = {"process_data": encode(61, {"temperature": 25.0})}
        node.run(2.0)
        assert len(wrenches) in range(19, 23)
        assert list(imu[-1].angular_velocity_covariance)[::4] == [0.5, 0.25, 0.125]
        assert list(imu[-1].linear_acceleration_covariance)[::4] == [1.0, 2.0, 3.0]
        assert imu[-1].orientation_covariance[0] == -1.0
        assert temperatures[-1].variance == 0.5
        node.until("25.0 °C", sensor="warn")
        node.set("publishing_frequency", 0)
        assert len(node.fresh(wrenches, 0.5)) == 50
        node.refuse_value("diagnostics.lost_warn", 0, "lost_warn out of range")
        node.refuse_value(
            "linear_acceleration_covariance", [1.0, 2.0], "it must be 3 numbers from -1e+12 to 1e+12"
        )


def test_what_is_warned_of_at_start() -> None:
    given = {"publish_frequency": 100.0, "settings.sinc_lenght": 64, "tool_frame": 1, "use_sim_time": True}
    with Node(Server(), **given) as node:
        assert "unknown parameter publish_frequency" in node.log
        assert "did you mean 'publishing_frequency'?" in node.log
        assert "did you mean 'settings.sinc_length'?" in node.log
        assert "unknown parameter tool_frame is ignored; ros2 param list" in node.log  # no guess at tool_mass
        assert "use_sim_time is true, but a real sensor has no simulation time" in node.log
        assert node.log.count("unknown parameter") == 3
    with Node(Server(), sensor=0, **{"qos_overrides./wrench.publisher.depth": 3}) as node:
        assert "unknown parameter" not in node.log
        assert "use_sim_time" not in node.log
        node.refuse_value("use_sim_time", True, "a real sensor has no simulation time")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        *(
            ({name: "/ft"}, f"parameter {name} is '/ft': frames have no leading slash, give 'ft'")
            for name in ("frame_id", "imu_frame_id", "orientation.base_frame")
        ),
        ({"settings.sinc_length": 1}, "settings.sinc_length"),
        ({"tool_mass": -1.0}, "tool_mass"),
        ({"gravity": "[0.0, 0.0, 0.0]"}, "gravity"),
    ],
)
def test_a_wrong_parameter_ends_the_start_with_a_sentence(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(StartError, match=words) as caught:
        Node(Server(), gravity_source="topic_imu", **wrong)
    assert "\n" not in str(caught.value)
