"""A server that is killed and started again on the same port works at once; a client of before carries on."""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from protocol.errors import ConnectionFailedError
from tests.server.bench import Bench
from tests.server.running import Client, Server, needs_bus, virtual_sensor, wait_until


class Persistent:
    """A client that connects again by itself, in a thread."""

    def __init__(self, port: int) -> None:
        self.samples = self.connections = 0
        self._port = port
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.is_set():
            with contextlib.suppress(ConnectionFailedError):
                self._listen()
            self._ending.wait(0.02)

    def _listen(self) -> None:
        with Client(self._port) as client:
            client.ask("subscribe")
            self.connections += 1
            while not self._ending.is_set():
                self.samples += len(client.fresh(10))

    def close(self) -> None:
        self._ending.set()
        self._thread.join()


@pytest.fixture(params=["virtual", "a veth pair"])
def ifname(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "virtual":
        yield "virtual"
        return
    with virtual_sensor() as (veth, _):
        yield veth.near


@pytest.mark.bus
@needs_bus
def test_killed_and_started_again_on_the_same_port(ifname: str) -> None:
    with contextlib.ExitStack() as stack:
        running = Server(ifname)
        stack.callback(running.close)
        port = running.wait_streaming().port
        client = Persistent(port)
        stack.callback(client.close)
        for kills in range(1, 4):
            wait_until(lambda n=kills: client.connections >= n, "a connection")  # type: ignore[misc]
            before = client.samples
            wait_until(lambda n=before: client.samples >= n + 200, "samples")  # type: ignore[misc]
            running.signal(signal.SIGKILL)
            running.wait()
            running = Server(ifname, port=port)
            stack.callback(running.close)
            running.wait_streaming()
        wait_until(lambda: client.connections >= 4, "a connection")
        with running.connect() as other:
            other.ask("subscribe")
            assert len(other.fresh(100)) == 100
            assert other.ask("describe")["sensors"][0]["state"] == "OP"
            assert other.ask("shutdown")["ok"], "it knows whose connections these are"
        assert running.wait() == 0


@pytest.mark.bus
@needs_bus
def test_connections_that_the_killed_one_left_do_not_hold_the_port() -> None:
    with contextlib.ExitStack() as stack:
        running = Server("virtual")
        stack.callback(running.close)
        port = running.wait_streaming().port
        left = [stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(30)]
        for sock in left[:20]:
            sock.sendall(b'{"action":"describe"}')
            assert sock.recv(65536)
        running.signal(signal.SIGKILL)
        running.wait()
        again = Server("virtual", port=port)
        stack.callback(again.close)
        again.wait_streaming()
        time.sleep(0.1)
        with again.connect() as client:
            assert len(client.ask("status")["clients"]) == 1


def test_a_tare_that_was_not_saved_outlives_the_server_and_then_a_power_cut(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    bench = Bench()
    tared = bench.asking.ask("tare", samples=20, target=[5.0, 0, 0, 0, 0, 0])
    assert tared["ok"], tared
    caplog.clear()
    bench = bench.start_again()
    assert "sensor 0 has a tare in force (saved or not): Fx offset" in caplog.text
    bench.command("power cycle 0.3")
    bench.wait_event("sensor_back")
    held = bench.asking.ask("sdo_read", index=0x8000, subindex=1, type="f32")["value"]
    assert held == pytest.approx(tared["new_offset"][0])
