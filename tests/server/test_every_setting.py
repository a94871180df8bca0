"""Every value of a setting takes effect while the sensor streams; any other is refused. In simulated time."""

from __future__ import annotations

from typing import Any

import pytest

from bota_ethercat.sensor.filters import FORCE_TORQUE_FILTERS
from bota_ethercat.sensor.meaning import value_meaning
from bota_ethercat.settings import SETTINGS
from tests.server.bench import Bench

IMU = ("acceleration_filter", "angular_rate_filter", "acceleration_range_g", "angular_rate_range_dps")


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench()


def configure(bench: Bench, **settings: object) -> dict[str, Any]:
    reply = bench.asking.ask("configure", settings=settings)
    assert reply["ok"], reply
    return reply


@pytest.mark.parametrize("fir", [False, True])
def test_every_sinc_length_of_the_table_gives_its_rate(bench: Bench, fir: bool) -> None:
    for length, row in FORCE_TORQUE_FILTERS.items():
        reply = configure(bench, sinc_length=length, fir=fir)
        assert reply["rate_hz"] == row.rate_hz
        assert bench.asking.ask("sdo_read", name="Sampling rate")["value"] == row.rate_hz
        described = bench.asking.ask("describe")["sensors"][0]
        assert described["meaning"]["sinc_length"].startswith(f"{row.rate_hz} Hz; cut-off")
    configure(bench, sinc_length=64, fir=False)


@pytest.mark.parametrize("name", IMU)
def test_every_filter_and_range_of_the_imu_takes(bench: Bench, name: str) -> None:
    default = SETTINGS[name].default
    for value in SETTINGS[name].choices or ():
        reply = configure(bench, **{name: value})
        assert reply["settings"][name] == value
        described = bench.asking.ask("describe")["sensors"][0]
        assert described["meaning"][name] == value_meaning(name, value)
    configure(bench, **{name: default})


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"sinc_length": 0}, "sinc_length is 0: it must be a whole number from 32 to 2048"),
        ({"sinc_length": 50000}, "sinc_length is 50000: it must be a whole number from 32 to 2048"),
        ({"angular_rate_filter": 2}, "angular_rate_filter is 2: it must be a whole number from 3 to 9"),
        ({"acceleration_filter": 9}, "acceleration_filter is 9: it must be a whole number from 1 to 8"),
        ({"acceleration_range_g": 3}, "acceleration_range_g is 3: it must be one of 2, 4, 8, 16"),
        ({"colour": 1}, "no setting 'colour': the settings are calibration_matrix, "),
        ({"fast": True}, "fast is true but fir is false"),
        ({"fast": True, "fir": False}, "fast is true but fir is false"),
        ({"sinc_length": 128, "colour": 1}, "no setting 'colour'"),
    ],
)
def test_what_cannot_be_is_refused_and_the_sensor_untouched(
    bench: Bench, settings: dict[str, object], said: str
) -> None:
    before = bench.stats()["sdo_write_count"]
    reply = bench.asking.ask("configure", settings=settings)
    assert reply["ok"] is False
    assert reply["error"]["code"] == "bad_request"
    assert said in reply["error"]["message"]
    assert bench.stats()["sdo_write_count"] == before
