"""What a server says of itself and of its sensors, in its reply to `describe`."""

from __future__ import annotations

from typing import Any

from bota_ethercat.control import PROTOCOL_VERSION
from bota_ethercat.settings import SETTINGS, sampling_rate_hz, start_up_defaults
from bota_ethercat.text.json_text import JsonObject

_AS_FOUND = dict.fromkeys(("coordinate_system", "inertia_compensation", "orientation_estimation"), False)


def sensor_row(sensor: int = 0, **changes: Any) -> JsonObject:
    """The row of a sensor; `changes` are those of its settings that have such a name, else the row's own."""
    changed = {name: changes.pop(name) for name in SETTINGS if name in changes}
    settings = start_up_defaults() | _AS_FOUND | changed
    row = {
        "sensor": sensor, "name": "BFT-SENS-ECAT-M8", "serial": 100 + sensor, "pdo_size": 61, "state": "OP",
        "rate_hz": sampling_rate_hz(settings["sinc_length"]), "hardware": "RM200V4_6adc", "firmware": "1.3.8",
        "settings": settings,
    }  # fmt: skip
    return row | changes


def description(*rows: JsonObject, **changes: Any) -> JsonObject:
    """The reply, but for what all replies have; by default of one sensor."""
    sensors = [*rows] or [sensor_row()]
    return {"protocol": PROTOCOL_VERSION, "version": "0.1.0", "sensors": sensors, **changes}
