"""The warnings register and the settings."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.errors import SettingError
from bota_ethercat.sensor.warnings_register import WARNINGS, Severity, explain
from bota_ethercat.settings import (
    SETTINGS,
    check_combination,
    check_settings,
    sampling_rate_hz,
    start_up_defaults,
)


def test_warnings_are_the_tables() -> None:
    assert [row.flag for row in WARNINGS] == [1 << bit for bit in range(7)]
    assert [row.severity for row in explain(0b1100001)] == [Severity.ERROR, Severity.WARNING, Severity.FATAL]
    assert explain(0) == []


def test_reserved_bits_are_told_by_number() -> None:
    (row,) = explain(1 << 31)
    assert "31" in row.meaning
    assert row.severity is Severity.WARNING


@given(st.integers(0, 2**32 - 1))
def test_every_set_bit_is_explained_once(register: int) -> None:
    found = explain(register)
    assert sum(row.flag for row in found) == register
    assert all(row.meaning and row.remedy for row in found)


def test_settings_are_the_contracts() -> None:
    assert list(SETTINGS) == [
        "calibration_matrix", "temperature_compensation", "imu_active", "coordinate_system",
        "inertia_compensation", "orientation_estimation", "acceleration_range_g", "angular_rate_range_dps",
        "acceleration_filter", "angular_rate_filter", "sinc_length", "fir", "fast", "chop",
    ]  # fmt: skip


def test_defaults_are_the_notes() -> None:
    note = {
        "calibration_matrix": True, "temperature_compensation": False, "imu_active": 1,
        "acceleration_range_g": 2, "angular_rate_range_dps": 250, "acceleration_filter": 1,
        "angular_rate_filter": 3, "fir": False, "fast": False, "chop": False, "sinc_length": 64,
    }  # fmt: skip
    defaults = start_up_defaults()
    assert {name: defaults[name] for name in note} == note
    assert check_settings(defaults) == defaults
    check_combination(defaults)


@pytest.mark.parametrize(
    ("sinc_length", "hz"), [(32, 1600), (51, 1003), (64, 800), (128, 400), (205, 250), (256, 200), (341, 150)]
)
def test_rates_are_the_tables(sinc_length: int, hz: int) -> None:
    assert sampling_rate_hz(sinc_length) == hz
    assert abs(hz - 51200 / sinc_length) < 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("imu_active", 4), ("imu_active", True), ("acceleration_range_g", 3), ("acceleration_range_g", "2"),
        ("angular_rate_range_dps", 0), ("acceleration_filter", 9), ("angular_rate_filter", 2),
        ("sinc_length", 0), ("sinc_length", 64.0), ("fir", 1), ("chop", None), ("fast", "true"),
    ],
)  # fmt: skip
def test_wrong_values_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(SettingError, match=name):
        check_settings({name: value})


def test_unknown_settings_and_contradictions_are_refused() -> None:
    with pytest.raises(SettingError, match="gain"):
        check_settings({"gain": 1})
    with pytest.raises(SettingError, match="FIR"):
        check_combination({"fast": True, "fir": False})
    check_combination({"fast": True, "fir": True})


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [("fir", "on", True), ("fir", " No ", False), ("sinc_length", "0x40", 64), ("imu_active", "0", 0)],
)
def test_command_line_text(name: str, text: str, value: Any) -> None:
    assert SETTINGS[name].parse(text) is value or SETTINGS[name].parse(text) == value


@pytest.mark.parametrize(("name", "text"), [("fir", "2"), ("sinc_length", "many"), ("imu_active", "7")])
def test_wrong_command_line_text(name: str, text: str) -> None:
    with pytest.raises(SettingError, match=name):
        SETTINGS[name].parse(text)
