"""Readiness and watchdog: what systemd sees of a server, in simulated time.

Of a real one, with real signals: see test_real_bus.py.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from ethercat_server.daemon.server import SystemdNotifier
from tests.server.running import WATCHDOG_US, Manager
from tests.simulation import Bench


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    with contextlib.closing(Manager(tmp_path)) as found, found.environment():
        yield found


class Administered(Bench):
    """With a service manager."""

    def __init__(self) -> None:
        super().__init__()
        self.notifier = self.cycle._watchdog = SystemdNotifier()
        self.notifier.send("READY=1")
        self.notifier.update(self.server)


@pytest.fixture
def server(manager: Manager) -> Iterator[Administered]:
    found = Administered()
    assert found.notifier._socket is not None
    with found.notifier._socket:
        yield found


def test_systemd_is_told_ready_and_a_status_that_changes(server: Administered, manager: Manager) -> None:
    assert manager.told == ["READY=1", "STATUS=streaming 1 of 1 sensors; 2 clients"]
    server.notifier.update(server.server)
    assert len(manager.told) == 2, "it has not changed"
    server.connect().ask("describe")
    server.command("power off")
    server.listener.wait_event("sensor_lost")
    server.notifier.update(server.server)
    assert "STATUS=streaming 0 of 1 sensors, lost: 0; 3 clients" in manager.told
    server.notifier.send("STOPPING=1")
    assert manager.told[-1] == "STOPPING=1"


def test_the_watchdog_starves_when_the_loop_is_stuck(server: Administered, manager: Manager) -> None:
    feed_s = WATCHDOG_US * 1e-6 / 3
    for _ in range(4):
        fed = manager.told.count("WATCHDOG=1")
        server.run(3 * feed_s)
        assert 2 <= manager.told.count("WATCHDOG=1") - fed <= 4
    fed = manager.told.count("WATCHDOG=1")
    server.on_serve = lambda _: server.clock.stall(20 * feed_s * 1e9)
    server.run(20 * feed_s)
    assert manager.told.count("WATCHDOG=1") <= fed + 2


def test_without_systemd_nothing_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.setenv("WATCHDOG_USEC", "600000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    notifier = SystemdNotifier()
    notifier.send("READY=1")
    notifier.feed()
    assert notifier.feed_every_ns > 10**15, "the watchdog is another process's"
