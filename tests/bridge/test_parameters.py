"""The table of parameters: what each may be, and the sentence where it is not."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bridge.parameters import PARAMETERS, ParameterError

pytestmark = pytest.mark.ros
ROWS = {row.name: row for row in PARAMETERS}
CONFIG = Path(__file__).parents[2] / "ros2_bridge" / "config" / "bridge.yaml"


def test_defaults_are_the_contracts() -> None:
    defaults = {name: row.default for name, row in ROWS.items()}
    assert defaults == {
        "server_host": "localhost", "server_port": 12001, "SERVER_PORT": 0, "sensor": 0,
        "publishing_frequency": 0.0, "array_topic": "/sensone_sensor_data", "imu_raw_units": "g_dps",
    }  # fmt: skip
    assert all(row.check(row.default) == row.default for row in PARAMETERS)


def test_the_configuration_file_says_the_same() -> None:
    pairs = (line.split("#")[0].partition(":") for line in CONFIG.read_text().splitlines())
    given = {name.strip(): value.strip() for name, _, value in pairs if value.strip()}
    assert given == {name: str(row.default) for name, row in ROWS.items() if name != "SERVER_PORT"}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("server_host", ""), ("server_host", 5), ("server_port", 0), ("server_port", 65536),
        ("server_port", "12001"), ("server_port", True), ("server_port", 12001.0), ("server_port", None),
        ("sensor", -1), ("sensor", 256), ("publishing_frequency", -1.0), ("publishing_frequency", math.nan),
        ("publishing_frequency", math.inf), ("publishing_frequency", True), ("publishing_frequency", "fast"),
        ("imu_raw_units", "SI"), ("imu_raw_units", ""), ("array_topic", ""),
    ],
)  # fmt: skip
def test_wrong_values_are_named(name: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=f"parameter {name} is .*: it must be "):
        ROWS[name].check(value)


def test_a_whole_number_is_a_number() -> None:
    checked = ROWS["publishing_frequency"].check(100)
    assert checked == 100.0
    assert isinstance(checked, float)


def test_every_parameter_describes_itself() -> None:
    for row in PARAMETERS:
        descriptor = row.descriptor()
        assert descriptor.description
        assert descriptor.read_only
        if isinstance(row.default, int | float):
            assert descriptor.integer_range or descriptor.floating_point_range, row.name
