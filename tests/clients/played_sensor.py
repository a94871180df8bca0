"""A server with one sensor, which sends what a test tells it to."""

from __future__ import annotations

import time
from typing import Any

from bota_ethercat.control import Event, event
from bota_ethercat.framing import encode_data, encode_json
from bota_ethercat.pdo import encode
from bota_ethercat.text.json_text import JsonObject
from tests.bridge.scripted_server import ScriptedServer
from tests.server.running import wait_until

SETTINGS = {
    "calibration_matrix": True,
    "coordinate_system": False,
    "inertia_compensation": False,
    "orientation_estimation": False,
    "imu_active": 1,
}


def described(**changed: Any) -> JsonObject:
    settings = SETTINGS | {name: changed.pop(name) for name in SETTINGS if name in changed}
    sensor = {"sensor": 0, "name": "BFT-SENS-ECAT-M8", "serial": 7, "pdo_size": 61, "rate_hz": 800}
    return sensor | changed | {"settings": settings}


class PlayedSensor(ScriptedServer):
    """A server with this sensor, which can be tared and reconfigured."""

    def __init__(self, port: int = 0, **sensor: Any) -> None:
        super().__init__(port)
        self.description["sensors"] = [described(**sensor)]
        zeros = dict.fromkeys(("old_offset", "new_offset", "residual", "deviation"), [0] * 6)
        self.answers["tare"] = lambda _: {"ok": True, **zeros}

    def send(self, *messages: bytes | JsonObject) -> None:
        wait_until(lambda: bool(self.streams), "a subscriber")
        for message in messages:
            self.send_raw(message if isinstance(message, bytes) else encode_json(message))

    def reconfigure(self, **changed: Any) -> None:
        row = described(**changed)
        self.description["sensors"] = [row]
        self.send(event(Event.RECONFIGURED, sensor=0, settings=row["settings"], rate_hz=row["rate_hz"]))


def frame(
    sequence: int, flags: int = 0, *, sensor: int = 0, age_s: float = 0.0, size: int = 61, **values: float
) -> bytes:
    """A DATA message; its force along x is its number. `values` by name, with `__` for the dot."""
    # A machine that has been up for less than `age_s` has no such instant yet.
    time.sleep(max(0.0, age_s - time.monotonic()))
    instant = time.monotonic_ns() - int(age_s * 1e9)
    data = encode(size, {"force.x": sequence, **{k.replace("__", "."): v for k, v in values.items()}})
    return encode_data(sequence, 5, instant, sensor, flags, 3, data)
