"""The filter tables against the note's figures, and what a set of settings is said to mean."""

from __future__ import annotations

import pytest

from bota_ethercat.sensor.filters import ACCELERATION_FILTERS, ANGULAR_RATE_FILTERS, FORCE_TORQUE_FILTERS
from bota_ethercat.sensor.meaning import NOT_IN_TABLE, meaning, value_meaning
from bota_ethercat.settings import SETTINGS, sampling_rate_hz, start_up_defaults

# As printed in the note.
TABLE_III_4 = """
32 1600 418.5 62.5
51 1003 265.5 39.5
64 800 209.5 31.5
128 400 105.0 16.0
205 250 65.5 10.0
256 200 52.5 8.0
341 150 39.5 6.0
"""
TABLE_III_5 = """
3 184 2.9 1
4 92 3.9 1
5 41 5.9 1
6 20 9.9 1
7 10 17.85 1
8 5 33.48 1
9 3600 0.17 8
"""
TABLE_III_6 = """
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


def test_the_tables_are_the_notes() -> None:
    assert [list(row) for row in FORCE_TORQUE_FILTERS.values()] == rows(TABLE_III_4)
    assert [list(row)[:4] for row in ANGULAR_RATE_FILTERS.values()] == rows(TABLE_III_5)
    assert [list(row) for row in ACCELERATION_FILTERS.values()] == rows(TABLE_III_6)


def test_every_choice_of_a_filter_profile_is_in_the_tables() -> None:
    assert list(SETTINGS["acceleration_filter"].choices or ()) == list(ACCELERATION_FILTERS)
    assert list(SETTINGS["angular_rate_filter"].choices or ()) == list(ANGULAR_RATE_FILTERS)
    assert {length: sampling_rate_hz(length) for length in FORCE_TORQUE_FILTERS} == {
        int(row[0]): int(row[1]) for row in rows(TABLE_III_4)
    }


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
        for value in (False, True) if setting.is_bool else setting.choices or ():
            assert value_meaning(name, value)
    assert value_meaning("sinc_length", 64) == "800 Hz; cut-off 209.5 Hz with FIR off, 31.5 Hz with FIR on"
    assert value_meaning("sinc_length", 100) == f"512 Hz (51200 / length); cut-off {NOT_IN_TABLE}"
    with pytest.raises(KeyError):
        value_meaning("colour", 1)
