"""Hundreds of hostile connections to a real server: one that only listens notices nothing of them."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ethercat_server.serving.connection import MAX_REQUEST_LENGTH
from ethercat_server.serving.permissions import MAX_CLIENTS_PER_USER
from protocol.control import request
from protocol.framing import DataFlag, encode_json
from tests.hostile_bytes import framed
from tests.server.running import Client, Server, needs_bus, server, wait_until
from tests.server.test_end_to_end import sample_number

pytestmark = [pytest.mark.bus, needs_bus]
NOT_NEW = DataFlag.REPEATED | DataFlag.INVALID
SEED = int(os.environ.get("FUZZ_SEED", "20261121"))
GROWTH_MB = 8
"""What the second half of the connections may add: those that hang at one time may be of a larger kind."""
LOG_LIMIT = 20_000
"""Characters that hostile clients may make the server log in ten seconds."""


@pytest.fixture(scope="module")
def one() -> Iterator[Server]:
    """One server for the tests that only look at its memory."""
    with server("virtual") as running:
        yield running


class Listener:
    """The honest subscriber: checks every frame as it comes and keeps none."""

    def __init__(self, client: Client) -> None:
        client.ask("subscribe")
        self._client = client
        self.samples = self.lost = self.unflagged = 0
        self._number = -1
        self._gap = False

    def listen(self, count: int) -> None:
        """Take the next frames."""
        for frame in self._client.collect(count):
            self._gap |= bool(frame.flags & DataFlag.GAP)
            if frame.flags & NOT_NEW:
                continue
            number = sample_number(frame)
            if self._number >= 0:
                assert number > self._number, "a sample came twice or out of order"
                skipped = number - self._number - 1
                self.lost += skipped
                self.unflagged += skipped > 0 and not self._gap
            self._number, self._gap = number, False
            self.samples += 1

    def check(self, status: dict[str, Any]) -> None:
        """Nothing was withheld, and what is lost was the bus's, and the server says so."""
        own_port = self._client.sock.getsockname()[1]
        (mine,) = [row for row in status["clients"] if row["peer"].endswith(f":{own_port}")]
        assert mine["withheld"] == 0
        assert self.unflagged <= 1 + self.samples // 1000, "a starved sensor answers when nobody can know"
        counted = status["sensors"][0]["lost_samples"]
        assert self.lost <= counted + 1 + self.samples // 100, "lost between server and client"


class Resources:
    """What the server's process takes."""

    def __init__(self, running: Server) -> None:
        self._proc = Path("/proc", str(running.process.pid))

    def resident_mb(self) -> float:
        return int((self._proc / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    def descriptors(self) -> int:
        return len(list((self._proc / "fd").iterdir()))


def attack(running: Server, listener: Listener, count: int, seed: int | str) -> Any:
    """Hostile connections, while the honest one listens; what they report."""
    command = [sys.executable, "-m", "tests.server.hostile_clients", str(running.port), str(count), str(seed)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as clients:
        try:
            while clients.poll() is None:
                listener.listen(100)
        finally:
            clients.kill()
        said, complaints = clients.communicate()
    assert clients.returncode == 0, f"seed {seed}: {complaints}"
    report = json.loads(said)
    assert sum(report["done"].values()) == count
    assert report["answers"]["grants"] > 0
    assert report["answers"]["refusals"] > 0
    assert "half_close" not in report["done"] or report["answers"].get("heard after a half close", 0) > 0
    print(f"seed {seed}: {report}")
    return report


def besiege(count: int) -> None:
    with server("virtual", "--virtual", "--signal clock --ppm 150") as running, running.connect() as client:
        resources, listener = Resources(running), Listener(client)
        listener.listen(200)
        descriptors, resident = resources.descriptors(), []
        for part in range(2):
            attack(running, listener, count // 2, SEED + part)
            listener.check(client.ask("status"))
            resident.append(resources.resident_mb())
        print(f"{listener.samples} samples, {listener.lost} lost; resident {resident} MB")
        assert resident[1] - resident[0] < GROWTH_MB, f"memory grows: {resident} MB"
        wait_until(lambda: resources.descriptors() == descriptors, "all connections to be closed")
        with running.connect() as other:
            assert other.ask("describe")["ok"]
        listener.listen(200)
        log = running.said()
        assert "Traceback" not in log
        assert len(log) < LOG_LIMIT * (1 + listener.samples // 8000), "the log can be flooded"
        assert client.ask("shutdown")["ok"]
        assert running.wait() == 0


def test_hostile_connections_harm_nobody() -> None:
    besiege(300)


def test_a_crowd_that_asks_without_pause_costs_no_samples() -> None:
    with server("virtual", "--virtual", "--signal clock --ppm 150") as running, running.connect() as client:
        listener = Listener(client)
        attack(running, listener, MAX_CLIENTS_PER_USER, "crowd")
        status = client.ask("status")
        listener.check(status)
        print(f"{listener.samples} samples, {listener.lost} lost")
        asked_in_time = status["sensors"][0]["recoveries"] == 0
        assert asked_in_time or status["lost_frames"], "or it was starved itself"


REFUSED = {
    "a length that is too great": b"\xff" * 5,
    "a line without end": b"{" * (MAX_REQUEST_LENGTH + 1),
    "no JSON": framed(b"[" * (MAX_REQUEST_LENGTH - 10)),
    "no JSON on a line": b"{" + b"x" * (MAX_REQUEST_LENGTH - 10) + b"\n",
    "no such action": encode_json(request("x" * (MAX_REQUEST_LENGTH - 100))),
    "a type that does not fit": encode_json(request("sdo_read", index=0x1008, type="f32")),
}


@pytest.mark.parametrize("sent", REFUSED.values(), ids=REFUSED)
def test_what_was_refused_leaves_nothing_behind(one: Server, sent: bytes) -> None:
    """The server collects no circles while the bus runs, and an exception that is kept easily makes one."""
    resources = Resources(one)

    def refuse(count: int) -> float:
        for _ in range(count):
            with socket.create_connection(("127.0.0.1", one.port), timeout=20) as sock:
                sock.sendall(sent)
                sock.shutdown(socket.SHUT_WR)
                assert b'"ok":false' in sock.recv(65536)
        return resources.resident_mb()

    before = refuse(100)
    assert refuse(500) - before < 0.5


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_ten_thousand_hostile_connections_harm_nobody() -> None:
    besiege(10_000)
