"""Readiness, watchdog, reload: what systemd and an administrator see of a server, in simulated time.

Of a real one, with real signals: see test_real_bus.py.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from ethercat_server.daemon.options import parse_options
from ethercat_server.daemon.service import Notifier, Policy, Service
from tests.server.running import WATCHDOG_US, Manager
from tests.simulation import Bench


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    with contextlib.closing(Manager(tmp_path)) as found, found.environment():
        yield found


class Administered(Bench):
    """With a configuration file and a log."""

    def __init__(self, directory: Path, caplog: pytest.LogCaptureFixture) -> None:
        super().__init__()
        self._file, self._log = directory / "c.toml", caplog
        self._file.write_text("[server]\n")
        arguments = ["memory", "1", "--config", str(self._file)]
        self.notifier = self.cycle._watchdog = Notifier()
        self.service = Service(arguments, Policy(parse_options(arguments)), self.server, self.notifier)
        caplog.set_level("INFO")
        self.service.ready()

    def reload(self, text: str, *expected: str) -> None:
        """Change the file, and reload it until the log says what is expected."""
        self._log.clear()
        self._file.write_text(text)
        self.service.reload()
        self.service.every_second()
        reading = self.service._reading
        assert reading is not None, "the loop does not wait for it"
        reading.join()
        self.service.every_second()
        self.run_until(lambda: all(words in self._log.text for words in expected), str(expected))
        assert "Traceback" not in self._log.text


@pytest.fixture
def server(tmp_path: Path, caplog: pytest.LogCaptureFixture, manager: Manager) -> Iterator[Administered]:
    found = Administered(tmp_path, caplog)
    assert found.notifier._socket is not None
    with found.notifier._socket:
        yield found


def test_systemd_is_told_ready_and_a_status_that_changes(server: Administered, manager: Manager) -> None:
    assert manager.told == ["READY=1", "STATUS=streaming 1 of 1 sensors; 2 clients"]
    server.service.every_second()
    assert len(manager.told) == 2, "it has not changed"
    server.connect().ask("describe")
    server.command("power off")
    server.listener.wait_event("sensor_lost")
    server.service.every_second()
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
    notifier = Notifier()
    notifier.send("READY=1")
    notifier.feed()
    assert notifier.feed_every_ns > 10**15, "the watchdog is another process's"


def test_a_reload_puts_in_force_what_can_be_and_names_the_rest(server: Administered) -> None:
    server.reload("[server]\n", "configuration reloaded: [server]: no changes")
    idle = server.connect()
    server.reload(
        "[server]\nidle_timeout_s = 0.2\nrt_priority = 3\n[sensor]\nfir = true\n",
        "changed idle_timeout_s",
        "a change of [server] rt_priority requires a restart",
        "sensor 0: applied fir = True",
        "has sent no request for 0.2 s",
    )
    server.run_until(lambda: idle.at_end, "the idle client closed")
    assert not server.listener.at_end, "this one has subscribed"
    assert server.listener.ask("describe")["sensors"][0]["settings"]["fir"] is True


def test_a_reload_that_fails_changes_nothing(server: Administered) -> None:
    unchanged = "reload failed, the configuration is unchanged: "
    hub = server.hub
    before = hub.limits, hub.permissions.control_uids
    server.reload(
        "[server]\ncontrol_users = ['no-such-user']\n", unchanged, "no-such-user: there is no such user"
    )
    server.reload("[server\n", unchanged, "not valid TOML")
    server.reload(
        "[server]\nidle_timeout_s = 5\n[sensor]\nfir = true\nimu_active = 3\n"
        "[sensor.BFT-SENS-ECAT-M8]\nfir = false\n[sensor.0]\nfast = true\n",
        unchanged + "the settings for sensor 0",
    )
    assert (hub.limits, hub.permissions.control_uids) == before
    settings = server.listener.ask("describe")["sensors"][0]["settings"]
    assert (settings["fir"], settings["imu_active"]) == (False, 1)
    assert len(server.listener.fresh(50)) == 50, "the stream goes on"
    server.reload("[server]\nidle_timeout_s = 5\n", "changed idle_timeout_s")
    assert hub.limits.idle_ns == 5e9


def test_a_reload_gives_rights_and_takes_them(server: Administered) -> None:
    nobody = server.connect(4711)
    assert nobody.ask("configure", settings={"fir": True})["error"]["code"] == "denied"
    server.reload("[server]\ncontrol_users = ['4711']\n", "changed control_users")
    assert nobody.ask("configure", settings={"imu_active": 3})["ok"]
    server.reload("[server]\n", "changed control_users")
    assert nobody.ask("configure", settings={"imu_active": 1})["error"]["code"] == "denied"


def test_a_reload_tries_again_what_could_not_be_put_in_force(server: Administered) -> None:
    server.command("power off")
    server.listener.wait_event("sensor_lost")
    server.reload(
        "[sensor]\nsinc_length = 128\n",
        "sensor 0: could not apply sinc_length = 128, the next reload tries again",
    )
    wanted = "[sensor]\nsinc_length = 256\nfir = true\n"
    server.reload(wanted, "sensor 0: could not apply sinc_length = 256, fir = True, the")
    server.command("power on")
    server.listener.wait_event("sensor_back")
    server.reload(wanted, "sensor 0: applied sinc_length = 256, fir = True")
    found = server.listener.ask("describe")["sensors"][0]
    assert (found["rate_hz"], found["settings"]["fir"]) == (200, True)
    server.reload("[sensor]\nsinc_length = 256\n", "sensor 0: applied fir = False\n")


def test_a_reload_names_a_table_that_no_sensor_has_and_puts_the_rest_in_force(
    server: Administered,
) -> None:
    server.reload(
        "[sensor]\nimu_active = 3\n[sensor.4]\nfir = true\n[sensor.5]\nfir = true\n",
        "sensor 0: applied imu_active = 3",
        "settings for sensor 4, 5, but the bus has only 0: BFT-SENS-ECAT-M8",
    )
