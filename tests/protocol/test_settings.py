"""The settings, what they mean by the filter tables of Bota's manual, and the warnings register."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.errors import SettingError
from bota_ethercat.sensor.filters import ACCELERATION_FILTERS, ANGULAR_RATE_FILTERS, FORCE_TORQUE_FILTERS
from bota_ethercat.sensor.meaning import NOT_IN_TABLE, meaning, value_meaning
from bota_ethercat.sensor.warnings_register import WARNINGS, Severity, explain
from bota_ethercat.settings import (
    SETTINGS,
    check_combination,
    check_settings,
    sampling_rate_hz,
    start_up_defaults,
)

# As printed in Bota's manual: SINC filter, gyroscope, accelerometer.
FORCE_TORQUE = """
32 1600 418.5 62.5
51 1003 265.5 39.5
64 800 209.5 31.5
128 400 105.0 16.0
205 250 65.5 10.0
256 200 52.5 8.0
341 150 39.5 6.0
"""
ANGULAR_RATE = """
3 184 2.9 1
4 92 3.9 1
5 41 5.9 1
6 20 9.9 1
7 10 17.85 1
8 5 33.48 1
9 3600 0.17 8
"""
ACCELERATION = """
1 460 1.94 1 250
2 184 5.80 1 250
3 92 7.80 1 250
4 41 11.80 1 250
5 20 19.80 1 250
6 10 35.70 1 250
7 5 66.96 1 250
8 460 1.94 1 250
"""


def rows(table: str) -> list[list[float]]:
    return [[float(word) for word in line.split()] for line in table.strip().splitlines()]


def test_the_tables_are_the_manuals() -> None:
    assert [list(row) for row in FORCE_TORQUE_FILTERS.values()] == rows(FORCE_TORQUE)
    assert [list(row)[:4] for row in ANGULAR_RATE_FILTERS.values()] == rows(ANGULAR_RATE)
    assert [list(row) for row in ACCELERATION_FILTERS.values()] == rows(ACCELERATION)
    assert list(SETTINGS["acceleration_filter"].choices) == list(ACCELERATION_FILTERS)
    assert list(SETTINGS["angular_rate_filter"].choices) == list(ANGULAR_RATE_FILTERS)
    for length, row in FORCE_TORQUE_FILTERS.items():
        assert abs(row.rate_hz - 51200 / length) < 1
        assert sampling_rate_hz(length) == row.rate_hz


def test_a_set_of_settings_means_what_its_rows_say() -> None:
    found = meaning(start_up_defaults())
    assert (found.rate_hz, found.cutoff_hz) == (800, 209.5)
    assert found.acceleration is not None
    assert found.angular_rate is not None
    assert (found.acceleration.delay_ms, found.angular_rate.delay_ms) == (1.94, 2.9)
    assert meaning({**start_up_defaults(), "fir": True}).cutoff_hz == 31.5


@pytest.mark.parametrize(
    "settings",
    [
        {"sinc_length": 100, "fir": False},
        {"sinc_length": 64},
        {"sinc_length": 64, "fir": True, "fast": True},
        {},
    ],
)
def test_what_is_not_in_the_tables_is_said_to_be_not_in_them(settings: dict[str, bool | int]) -> None:
    found = meaning(settings)
    assert (found.cutoff_hz, found.acceleration) == (None, None)
    assert NOT_IN_TABLE in found.lines()[1]


def test_every_value_has_a_meaning() -> None:
    for name, setting in SETTINGS.items():
        for value in setting.choices:
            assert value_meaning(name, value)
    assert value_meaning("sinc_length", 64) == "800 Hz; cut-off 209.5 Hz with FIR off, 31.5 Hz with FIR on"
    assert value_meaning("sinc_length", 100) == f"512 Hz (51200 / length); cut-off {NOT_IN_TABLE}"
    with pytest.raises(KeyError):
        value_meaning("colour", 1)


def test_warnings_are_the_tables() -> None:
    assert [row.flag for row in WARNINGS] == [1 << bit for bit in range(7)]
    assert [row.severity for row in explain(0b1100001)] == [Severity.ERROR, Severity.WARNING, Severity.FATAL]
    assert explain(0) == []
    (reserved,) = explain(1 << 31)
    assert (reserved.severity, "31" in reserved.meaning) == (Severity.WARNING, True)


@given(st.integers(0, 2**32 - 1))
def test_every_set_bit_is_explained_once(register: int) -> None:
    found = explain(register)
    assert sum(row.flag for row in found) == register
    assert all(row.meaning and row.remedy for row in found)


def test_settings_and_defaults_are_the_contracts() -> None:
    contract = {
        "calibration_matrix": True, "temperature_compensation": False, "imu_active": 1,
        "coordinate_system": None, "inertia_compensation": None, "orientation_estimation": None,
        "acceleration_range_g": 2, "angular_rate_range_dps": 250, "acceleration_filter": 1,
        "angular_rate_filter": 3, "sinc_length": 64, "fir": False, "fast": False, "chop": False,
    }  # fmt: skip
    assert [(name, setting.default) for name, setting in SETTINGS.items()] == list(contract.items())
    defaults = start_up_defaults()
    assert defaults == {name: value for name, value in contract.items() if value is not None}
    assert check_settings(defaults) == defaults
    check_combination(defaults)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("imu_active", 4), ("imu_active", True), ("acceleration_range_g", 3), ("acceleration_range_g", "2"),
        ("angular_rate_range_dps", 0), ("acceleration_filter", 9), ("angular_rate_filter", 2),
        ("sinc_length", 0), ("sinc_length", 64.0), ("fir", 1), ("chop", None), ("fast", "true"), ("gain", 1),
    ],
)  # fmt: skip
def test_wrong_values_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(SettingError, match=name):
        check_settings({name: value})


def test_contradictions_are_refused() -> None:
    with pytest.raises(SettingError, match="FIR"):
        check_combination({"fast": True, "fir": False})
    check_combination({"fast": True, "fir": True})


def test_command_line_text() -> None:
    for name, text, value in (
        ("fir", "on", True), ("fir", " No ", False), ("sinc_length", "0x40", 64), ("imu_active", "0", 0),
    ):  # fmt: skip
        assert SETTINGS[name].parse(text) == value
        assert type(SETTINGS[name].parse(text)) is type(value)
    for name, text in (("fir", "2"), ("sinc_length", "many"), ("imu_active", "7")):
        with pytest.raises(SettingError, match=name):
            SETTINGS[name].parse(text)
