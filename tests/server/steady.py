"""A virtual sensor with the priority of a real one, held up by no other work on the machine."""

from __future__ import annotations

import contextlib
import json
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ethercat_server.daemon.server_settings import DEFAULT_RT_PRIORITY
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus
from tests.server.running import PATIENCE_S, Client, Server, server


class SteadySensor:
    """The bus's interface, and the command socket of what is on it."""

    def __init__(self, ifname: str, control: Path) -> None:
        self.ifname = ifname
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(PATIENCE_S)
        self._socket.connect(str(control))
        self._answers = self._socket.makefile()

    def command(self, text: str) -> str:
        """Give the sensor a command; returns its answer."""
        self._socket.sendall(text.encode() + b"\n")
        answer = self._answers.readline().strip()
        assert answer.startswith("ok"), answer
        return answer[3:]

    def stats(self, position: int = 0) -> dict[str, Any]:
        """What a sensor says of itself."""
        found: dict[str, Any] = json.loads(self.command("stats"))["sensors"][position]
        return found

    def close(self) -> None:
        self._answers.close()
        self._socket.close()


@contextlib.contextmanager
def steady_sensor(arguments: str = "--signal rest") -> Iterator[SteadySensor]:
    with tempfile.TemporaryDirectory() as directory:
        control = Path(directory) / "control"
        with VirtualBus(f"{arguments} --control {control}", DEFAULT_RT_PRIORITY) as bus:
            sensor = SteadySensor(bus.ifname, control)
            try:
                yield sensor
            finally:
                sensor.close()


class SteadyBench:
    """A server on such a sensor, a client that has subscribed and one that asks."""

    def __init__(self, sensor: SteadySensor, running: Server, listener: Client, asking: Client) -> None:
        self.sensor, self.running, self.client, self.asking = sensor, running, listener, asking
        listener.ask("subscribe")
        listener.fresh(50)

    def command(self, text: str) -> str:
        return self.sensor.command(text)

    def wait_event(self, name: str) -> dict[str, Any]:
        return self.client.wait_event(name)


@contextlib.contextmanager
def steady_bench(sensor: SteadySensor) -> Iterator[SteadyBench]:
    with server(sensor.ifname) as running, running.connect() as listener, running.connect() as asking:
        yield SteadyBench(sensor, running, listener, asking)
