"""What `describe` says of settings: cheap for one sensor, and never more than a message may have."""

from __future__ import annotations

from typing import cast

import pytest

from bota_ethercat.address import boot_id
from bota_ethercat.framing import encode_json
from bota_ethercat.sensor.meaning import value_meaning
from bota_ethercat.settings import SETTINGS, SettingValue, start_up_defaults
from bota_ethercat.text.json_text import MAX_JSON_LENGTH, JsonObject
from ethercat_server.acquisition.cycle import Cycle
from ethercat_server.sensor.sensor import Identity, Sensor
from ethercat_server.serving.actions import Actions
from ethercat_server.serving.connection import Connection
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.sensor_actions import SensorActions


def wordiest() -> dict[str, SettingValue]:
    """Of each setting the value that takes the most words."""
    return {
        name: max(
            (False, True) if setting.is_bool else setting.choices or (),
            key=lambda value, name=name: len(value_meaning(name, value)),
        )
        for name, setting in SETTINGS.items()
    }


def describe(count: int) -> JsonObject:
    sensors = [
        Sensor(position, Identity("B" * 20, 2**32 - 1, "H" * 12, "F" * 13), {}) for position in range(count)
    ]
    for sensor in sensors:
        sensor.set_in_force(wordiest())

    class OnSensors:
        handlers: dict[str, object] = {}  # noqa: RUF012

    OnSensors.sensors = sensors  # type: ignore[attr-defined]
    actions = Actions(cast(Hub, None), cast(Cycle, None), cast(SensorActions, OnSensors()))
    reply = actions.handle(cast(Connection, None), {"action": "describe", "id": "i" * 4000})
    assert reply is not None
    return reply


@pytest.mark.parametrize("count", [1, 16, 32, 33, 100])
def test_a_reply_never_outgrows_a_message(count: int) -> None:
    reply = describe(count)
    assert len(reply["sensors"]) == count
    assert len(encode_json(reply)) <= MAX_JSON_LENGTH
    assert all(("meaning" in row) == (count <= 32) for row in reply["sensors"])


def test_a_server_names_the_clock_of_its_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    assert describe(1)["boot_id"] == boot_id()
    monkeypatch.setattr("ethercat_server.serving.actions.boot_id", lambda: None)
    assert "boot_id" not in describe(1)


def test_every_setting_is_explained_and_only_when_it_changes() -> None:
    sensor = Sensor(0, Identity("", 0, "", ""), {})
    sensor.set_in_force(start_up_defaults())
    row = sensor.describe()
    assert row["meaning"].keys() == row["settings"].keys()
    assert row["meaning"]["sinc_length"].startswith("800 Hz; cut-off 209.5 Hz with FIR off")
    assert "delay 1.94 ms" in row["meaning"]["acceleration_filter"]
    assert sensor.describe()["meaning"] is row["meaning"], "nothing is worked out for a request"
    sensor.set_in_force({**sensor.settings, "sinc_length": 128})
    assert sensor.describe()["meaning"]["sinc_length"].startswith("400 Hz")
