"""Readiness, watchdog, reload: what systemd and an administrator see of a real server."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ethercat_server.process.notify import Notifier
from tests.server.commands import command
from tests.server.running import Server, needs_bus, server, virtual_sensor, wait_until

pytestmark = [pytest.mark.bus, needs_bus]


class Manager:
    """Stands for systemd: the notify socket, and what came through it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.setblocking(False)
        self.told: list[str] = []

    def receive(self) -> list[str]:
        while True:
            try:
                self.told.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return self.told

    def wait(self, text: str) -> None:
        wait_until(lambda: any(text in told for told in self.receive()), f"{text} in {self.told}")


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    made = Manager(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(made.path))
    monkeypatch.setenv("WATCHDOG_USEC", "600000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    with made.socket:
        yield made


def test_systemd_is_told_ready_status_watchdog_and_stopping(manager: Manager) -> None:
    with server("virtual") as running:
        manager.wait("READY=1")
        assert running.said().count("streaming"), "not before it streams"
        manager.wait("STATUS=streaming 1 of 1 sensors; 0 clients")
        fed = manager.receive().count("WATCHDOG=1")
        wait_until(lambda: manager.receive().count("WATCHDOG=1") >= fed + 4, "the watchdog is fed on")
        with running.connect() as client:
            client.ask("subscribe")
            manager.wait("1 clients")
        running.signal(signal.SIGTERM)
        assert running.wait() == 0
    manager.wait("STOPPING=1")
    assert manager.told.index("READY=1") < manager.told.index("STOPPING=1")


def test_the_watchdog_starves_when_the_loop_is_stuck(manager: Manager) -> None:
    with server("virtual") as running:
        manager.wait("WATCHDOG=1")
        running.signal(signal.SIGSTOP)
        time.sleep(0.1)
        manager.receive()
        fed = len(manager.told)
        time.sleep(1.0)
        assert manager.receive()[fed:] == []
        running.signal(signal.SIGCONT)
        wait_until(lambda: len(manager.receive()) > fed, "fed again")


def test_without_systemd_nothing_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.setenv("WATCHDOG_USEC", "600000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    notifier = Notifier()
    notifier.ready()
    notifier.feed()
    assert notifier.feed_every_ns > 10**15, "the watchdog is another process's"


def reload(running: Server, expected: str) -> None:
    before = len(running.said())
    running.signal(signal.SIGHUP)
    wait_until(lambda: expected in running.said()[before:], f"{expected!r} in {running.said()!r}")


def test_sighup_puts_in_force_what_can_be_and_names_the_rest(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[server]\n")
    with server("virtual", "--config", str(file)) as running, running.connect() as client:
        client.ask("subscribe")
        reload(running, "configuration reloaded: [server]: no changes")
        file.write_text("[server]\nidle_timeout_s = 0.2\nrt_priority = 3\n[sensor]\nfir = true\n")
        with running.connect() as idle:
            reload(running, "changed idle_timeout_s")
            assert "a change of [server] rt_priority requires a restart" in running.said()
            wait_until(lambda: "sensor 0: applied fir = True" in running.said(), "the sensor's setting")
            wait_until(lambda: "has sent no request for 0.2 s" in running.said(), "the idle client closed")
            idle.receive_all()
        file.write_text("[server]\ncontrol_users = ['no-such-user']\n")
        reload(running, "reload failed, the configuration is unchanged")
        assert "no-such-user: there is no such user" in running.said()
        file.write_text("[server\n")
        reload(running, "not valid TOML")
        frames = client.fresh(400)
        assert len(frames) == 400, "the stream goes on"


def test_sighup_refuses_tables_that_contradict_one_another_and_the_stream_goes_on(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[server]\n")
    with server("virtual", "--config", str(file)) as running, running.connect() as client:
        client.ask("subscribe")
        file.write_text(
            "[server]\nidle_timeout_s = 5\n[sensor]\nfir = true\nimu_active = 3\n"
            "[sensor.BFT-SENS-ECAT-M8]\nfir = false\n[sensor.0]\nfast = true\n"
        )
        reload(running, "reload failed, the configuration is unchanged: the settings for sensor 0")
        assert "Traceback" not in running.said()
        assert len(client.fresh(400)) == 400
        assert client.ask("describe")["sensors"][0]["settings"]["imu_active"] == 1, (
            "nothing of it is in force"
        )
        file.write_text("[server]\nidle_timeout_s = 5\n")
        reload(running, "changed idle_timeout_s")


def test_sighup_tries_again_what_could_not_be_put_in_force(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[server]\n")
    with virtual_sensor() as (veth, sensor), server(veth.near, "--config", str(file)) as running:
        command(sensor, "power off")
        running.wait_for("is lost")
        file.write_text("[sensor]\nsinc_length = 128\n")
        reload(running, "sensor 0: could not apply sinc_length = 128, the next reload tries again")
        file.write_text("[sensor]\nsinc_length = 256\nfir = true\n")
        reload(running, "sensor 0: could not apply sinc_length = 256, fir = True, the")
        command(sensor, "power on")
        running.wait_for("is back")
        reload(running, "sensor 0: applied sinc_length = 256, fir = True")
        with running.connect() as client:
            found = client.ask("describe")["sensors"][0]
            assert (found["rate_hz"], found["settings"]["fir"]) == (200, True)
        file.write_text("[sensor]\nsinc_length = 256\n")
        reload(running, "sensor 0: applied fir = False\n")


def test_sighup_tells_of_a_table_that_no_sensor_has_and_puts_the_rest_in_force(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[server]\n")
    with server("virtual", "--config", str(file)) as running:
        file.write_text("[sensor]\nimu_active = 3\n[sensor.4]\nfir = true\n[sensor.5]\nfir = true\n")
        reload(running, "sensor 0: applied imu_active = 3")
        assert "settings for sensor 4, 5, but the bus has only 0: BFT-SENS-ECAT-M8" in running.said()
