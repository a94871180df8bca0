"""A server on a stationary sensor, with a client that listens and one that asks. In simulated time."""

from __future__ import annotations

from typing import Any

from bota_ethercat.text.json_text import JsonObject
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation

AT_REST = SensorOptions(signal="rest")


def error(reply: dict[str, Any]) -> dict[str, Any]:
    """The error of a request that was refused."""
    assert reply["ok"] is False, reply
    found: dict[str, Any] = reply["error"]
    return found


class Bench:
    """The two clients; `client` has subscribed."""

    def __init__(self, *sensors: SensorOptions, backend: MemoryBackend | None = None, **asked: Any) -> None:
        self.simulation = Simulation(*(sensors or (AT_REST,)), backend=backend, **asked)
        self.client, self.asking = self.simulation.connect(), self.simulation.connect()
        self.client.ask("subscribe")
        self.client.fresh(50)
        self.command, self.stats = self.simulation.command, self.simulation.stats

    def wait_event(self, name: str) -> JsonObject:
        """See `Client`."""
        return self.client.wait_event(name)

    def start_again(self, **asked: Any) -> Bench:
        """End this server and start another one on the same sensors; see `Simulation` for `asked`."""
        self.simulation.close()
        return Bench(backend=self.simulation.backend, **asked)
