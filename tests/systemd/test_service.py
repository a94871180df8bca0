"""The server as a real service of a running systemd, under everything that its unit forbids.

A copy of the unit goes into /run/systemd/system for the time of a test. It starts a copy of this server as
nobody, in the network namespace of the tests. The copy and Python are shown to it; nothing else is different.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import rights
from tests.server.running import Client, free_port, needs_bus, virtual_sensor, wait_until
from tests.systemd.test_installation import SERVER_UNIT

RUNTIME = Path("/run/systemd/system")
pytestmark = [
    pytest.mark.bus,
    needs_bus,
    pytest.mark.skipif(not os.access(RUNTIME, os.W_OK), reason="it takes root and a running systemd"),
]
WATCHDOG_PATIENCE_S = 60.0


def systemctl(*arguments: str) -> str:
    done = subprocess.run(["systemctl", *arguments], check=False, capture_output=True, text=True)
    assert done.returncode == 0, f"{arguments}: {done.stdout} {done.stderr}"
    return done.stdout.strip()


class Service:
    """An instance of the unit, on one interface."""

    def __init__(self, template: str, ifname: str, port: int) -> None:
        self.name = f"{template}@{ifname}.service"
        self.port = port

    def show(self, name: str) -> str:
        return systemctl("show", "--property", name, "--value", self.name)


@contextlib.contextmanager
def service(ifname: str, config: str = "", *, starts: bool = True) -> Iterator[Service]:
    """The unit, started on `ifname`; stopped and removed afterwards."""
    template = f"ethercat-test-{os.getpid()}"
    running = Service(template, ifname, free_port())
    text = SERVER_UNIT.read_text()
    program = f"{rights.PYTHON} -m ethercat_server.daemon.cli"
    text = text.replace("/opt/ethercat-server/bin/ethercat-server", program)
    # ProtectHome=yes shows nothing below home directories, not even what is bound there.
    text = text.replace("ProtectHome=yes", "ProtectHome=tmpfs").replace("User=ethercat", "User=nobody")
    text = text.replace("Group=ethercat\n", "")
    unit, settings = RUNTIME / f"{template}@.service", RUNTIME / f"{template}.toml"
    settings.write_text(config)
    shown = " ".join(
        str(path) for path in (rights.python_prefix(), rights.copy()) if not path.is_relative_to("/usr")
    )
    drop_in = f"""
[Service]
Environment=PORT={running.port} CONFIG={settings} PYTHONPATH={rights.copy()} PYTHONDONTWRITEBYTECODE=1
BindReadOnlyPaths={shown}
NetworkNamespacePath=/proc/{os.getpid()}/ns/net
"""
    unit.write_text(text + drop_in)
    try:
        systemctl("daemon-reload")
        started = subprocess.run(["systemctl", "start", running.name], check=False)
        assert (started.returncode == 0) is starts, systemctl("show", running.name)
        yield running
    finally:
        for action in ("stop", "reset-failed"):
            subprocess.run(["systemctl", action, running.name], check=False, capture_output=True)
        unit.unlink()
        settings.unlink()
        systemctl("daemon-reload")


def test_it_streams_and_shuts_down_as_a_service() -> None:
    with virtual_sensor() as (veth, _), service(veth.near) as running:
        assert running.show("ActiveState") == "active"
        assert running.show("NRestarts") == "0"
        with Client(running.port) as client:
            assert client.ask("subscribe")["ok"]
            client.fresh(100)
            assert client.ask("shutdown")["ok"]
        wait_until(lambda: running.show("ActiveState") == "inactive", "the service's end")
        assert running.show("Result") == "success"
        assert running.show("ExecMainStatus") == "0"


def test_on_a_virtual_bus_too_it_has_real_time_priority_and_locked_memory() -> None:
    with service("virtual") as running:
        process = int(running.show("MainPID"))
        assert os.sched_getscheduler(process) == os.SCHED_FIFO
        status = Path(f"/proc/{process}/status").read_text().splitlines()
        locked = next(line for line in status if line.startswith("VmLck"))
        assert int(locked.split()[1]) > 0


def test_a_wrong_configuration_is_not_tried_again() -> None:
    with virtual_sensor() as (veth, _), service(veth.near, "nonsense = 1\n", starts=False) as running:
        assert running.show("ExecMainStatus") == "2"
        assert running.show("ActiveState") == "failed"
        assert running.show("NRestarts") == "0"


def test_a_server_that_hangs_is_started_again() -> None:
    with virtual_sensor() as (veth, _), service(veth.near) as running:
        os.kill(int(running.show("MainPID")), signal.SIGSTOP)
        wait_until(lambda: running.show("NRestarts") == "1", "the watchdog", WATCHDOG_PATIENCE_S)
        wait_until(lambda: running.show("ActiveState") == "active", "the second start")
        with Client(running.port) as client:
            assert client.ask("subscribe")["ok"]
            client.fresh(100)
