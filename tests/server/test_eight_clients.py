"""Eight clients at 800 Hz, half of them odd: the others lose nothing, the odd are told what they missed."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from scripts._odd_clients import EIGHT
from tests.server.running import Client, Server, needs_bus, server, wait_until

pytestmark = [pytest.mark.bus, needs_bus]
ALL_FOR_S = 2.0
"""How long all eight are at work at least."""


class OddClient:
    """One of them, in a process of its own."""

    def __init__(self, manner: str, port: int) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "scripts._odd_clients", manner, str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        tells = manner not in {"noise", "churn"}
        self.address = self.process.stdout.readline().strip() if tells else ""

    def finish(self) -> dict[str, Any]:
        """Let it end; what came to it."""
        said, _ = self.process.communicate("\n", timeout=30)
        assert self.process.returncode == 0
        found: dict[str, Any] = json.loads(said) if self.address else {}
        return found

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


class Eight:
    """The clients and the server's view of them."""

    def __init__(self, running: Server, control: Client) -> None:
        self.control = control
        self.clients = [OddClient(manner, running.port) for manner in EIGHT]
        self.stopped, self.slow, self.noise, self.churn, *self.honest = self.clients

    def row(self, client: OddClient) -> dict[str, Any] | None:
        """What `status` says of a client; None once it is closed."""
        rows = self.control.ask("status")["clients"]
        return next((row for row in rows if row["peer"] == client.address), None)

    def withheld_or_closed(self, client: OddClient) -> bool:
        row = self.row(client)
        return row is None or row["withheld"] > 0


@pytest.fixture
def eight() -> Iterator[Eight]:
    with (
        server("virtual", "--virtual", "--signal clock --ppm 150") as running,
        running.connect() as control,
        contextlib.ExitStack() as cleanup,
    ):
        clients = Eight(running, control)
        for client in clients.clients:
            cleanup.callback(client.kill)
        yield clients


def test_the_honest_lose_nothing_and_the_odd_know_what_they_missed(eight: Eight) -> None:
    eight.stopped.process.send_signal(signal.SIGSTOP)
    time.sleep(ALL_FOR_S)
    for odd in (eight.stopped, eight.slow):
        wait_until(lambda odd=odd: eight.withheld_or_closed(odd), "frames to be withheld")  # type: ignore[misc]
    rows = [eight.row(client) for client in (eight.stopped, eight.slow)]
    eight.stopped.process.send_signal(signal.SIGCONT)
    if rows[0] is not None:
        caught_up = rows[0]["sent"] + 600  # the server keeps 256 frames for it, its kernel some more

        def is_live_again() -> bool:
            now = eight.row(eight.stopped)
            return now is not None and now["sent"] > caught_up

        wait_until(is_live_again, "the stopped one to read on")
    resumed, trickled = eight.stopped.finish(), eight.slow.finish()
    heard = [client.finish() for client in eight.honest]
    for client in (eight.noise, eight.churn):
        client.finish()

    status = eight.control.ask("status")
    for one in heard:
        assert one["frames"] > ALL_FOR_S * 800 * 0.8
        assert one["jumps"] == [], "the server withheld frames from a client that reads"
        assert one["lost"] <= status["sensors"][0]["lost_samples"], "lost on the way, not by the server"
        assert one["unflagged"] <= 1 + one["frames"] // 1000, (
            "a starved sensor process answers at a time that nobody can know"
        )
    for one, row in ((resumed, rows[0]), (trickled, rows[1])):
        assert one["jumps"] or row is None, "frames were withheld and nothing tells of it"
        assert all(missed > 0 and told for missed, told in one["jumps"]), "the first frame after it has GAP"
