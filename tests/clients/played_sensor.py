"""A server with one sensor, played by a test: it answers by itself, and sends what it is told to."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

from bota_ethercat.control import Event, event
from bota_ethercat.framing import FrameDecoder, encode_data, encode_json
from bota_ethercat.pdo import encode
from bota_ethercat.text.json_text import JsonObject
from tests.bridge.scripted_server import Script
from tests.server.running import PATIENCE_S, wait_until

SETTINGS = {
    "calibration_matrix": True,
    "coordinate_system": False,
    "inertia_compensation": False,
    "orientation_estimation": False,
    "imu_active": 1,
}


def described(**changed: Any) -> JsonObject:
    """A sensor as `describe` has it."""
    settings = SETTINGS | {name: changed.pop(name) for name in SETTINGS if name in changed}
    sensor = {"sensor": 0, "name": "BFT-SENS-ECAT-M8", "serial": 7, "pdo_size": 61, "rate_hz": 800}
    return sensor | changed | {"settings": settings}


class PlayedSensor(Script):
    """Listens until `close`; a connection that subscribes stays, any other is for one request."""

    def __init__(self, port: int = 0, **sensor: Any) -> None:
        super().__init__()
        self.description["sensors"] = [described(**sensor)]
        zeros = dict.fromkeys(("old_offset", "new_offset", "residual", "deviation"), [0] * 6)
        self.answers["tare"] = lambda _: {"ok": True, **zeros}
        self.streams: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, name="played sensor")
        self._thread.start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):  # the listener was closed
            while True:
                self._asking, _ = self._listener.accept()
                self._asking.settimeout(PATIENCE_S)
                self.subscribed.clear()
                decoder, before = FrameDecoder(), len(self.requests)
                while len(self.requests) == before and (data := self._asking.recv(4096)):
                    self.receive(decoder, data)
                if self.subscribed.is_set():
                    self.streams.append(self._asking)
                else:
                    self._asking.close()

    def send_raw(self, data: bytes) -> None:
        self._asking.sendall(data)

    def send(self, *messages: bytes | JsonObject) -> None:
        """To the newest subscriber."""
        wait_until(lambda: bool(self.streams), "a subscriber")
        for message in messages:
            self.streams[-1].sendall(message if isinstance(message, bytes) else encode_json(message))

    def reconfigure(self, **changed: Any) -> None:
        row = described(**changed)
        self.description["sensors"] = [row]
        self.send(event(Event.RECONFIGURED, sensor=0, settings=row["settings"], rate_hz=row["rate_hz"]))

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(PATIENCE_S)
        for stream in self.streams:
            stream.close()


@contextlib.contextmanager
def played(port: int = 0, **sensor: Any) -> Iterator[PlayedSensor]:
    server = PlayedSensor(port, **sensor)
    try:
        yield server
    finally:
        server.close()


def frame(
    sequence: int, flags: int = 0, *, sensor: int = 0, age_s: float = 0.0, size: int = 61, **values: float
) -> bytes:
    """A DATA message; its force along x is its number. `values` by name, with `__` for the dot."""
    # A machine that has been up for less than `age_s` has no such instant yet.
    time.sleep(max(0.0, age_s - time.monotonic()))
    instant = time.monotonic_ns() - int(age_s * 1e9)
    data = encode(size, {"force.x": sequence, **{k.replace("__", "."): v for k, v in values.items()}})
    return encode_data(sequence, 5, instant, sensor, flags, 3, data)
