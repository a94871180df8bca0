"""A server that root starts becomes another user before it serves anyone, and works on without privileges.

What a process may do only the kernel decides, so most of these are processes of a second user.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import signal
import socket
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from bota_ethercat.program.signals import Signals
from ethercat_server import server as assembly
from ethercat_server.daemon import server as daemon
from ethercat_server.daemon.options import parse_options
from ethercat_server.errors import ServerError, StopRequestedError, UsageError
from ethercat_server.process import privileges, realtime
from ethercat_server.process.privileges import User, user_to_become
from tests import rights
from tests.ended import completed, run_here
from tests.rights import IPC_LOCK, NOBODY, SYS_NICE, needs_another_user, without
from tests.server.running import (
    SLOW,
    Server,
    Veth,
    VirtualSensor,
    free_port,
    on_a_bus,
    server,
    virtual_sensor,
    wait_until,
)
from tests.systemd.test_installation import CAPABILITIES, SERVER_UNIT, values

BY_SUDO = ("env", f"SUDO_UID={NOBODY.pw_uid}", f"SUDO_GID={NOBODY.pw_gid}")
"""As if nobody had started it with sudo."""


# -- who


@pytest.fixture
def as_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)


@pytest.mark.usefixtures("as_root")
def test_it_becomes_who_ran_sudo_or_the_one_who_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    nobody = User(NOBODY.pw_uid, NOBODY.pw_gid, "nobody")
    monkeypatch.setenv("SUDO_UID", str(NOBODY.pw_uid))
    monkeypatch.setenv("SUDO_GID", "4711")
    assert user_to_become(None) == nobody._replace(gid=4711)
    assert user_to_become("nobody") == user_to_become(str(NOBODY.pw_uid)) == nobody
    assert user_to_become("root") is None
    monkeypatch.setenv("SUDO_UID", "4711")
    assert user_to_become(None) == User(4711, 4711, "")
    for of_nobody in ("0", "", "-1", "x"):
        monkeypatch.setenv("SUDO_UID", of_nobody)
        assert user_to_become(None) is None, of_nobody
    for unknown in ("no-such-user", "4294967295", "9" * 30, "9" * 5000):
        with pytest.raises(UsageError, match="there is no such user"):
            user_to_become(unknown)


def test_only_root_becomes_somebody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: NOBODY.pw_uid)
    monkeypatch.setenv("SUDO_UID", "4711")
    monkeypatch.setenv("SUDO_GID", "4711")
    assert user_to_become(None) is None, "as under systemd"
    assert user_to_become("nobody") is None
    with pytest.raises(UsageError, match="--user root: only root can become another user"):
        user_to_become("root")


# -- when


@pytest.mark.usefixtures("as_root")
def test_what_needs_root_is_done_before_a_frame_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    @contextlib.contextmanager
    def open_bus(ifname: str, **_: object) -> Iterator[MagicMock]:
        done.append(f"opened {ifname}")
        yield MagicMock()

    def bring_up(*_: object) -> None:
        done.append("brought up")
        raise StopRequestedError("enough")

    def prepare(_priority: int, _cpu: int | None, *, becomes_user: bool) -> None:
        done.append(f"prepared, becomes user: {becomes_user}")

    monkeypatch.setattr(daemon, "open_bus", open_bus)
    monkeypatch.setattr(assembly, "bring_up", bring_up)
    monkeypatch.setattr(realtime, "prepare", prepare)
    monkeypatch.setattr(daemon, "forbid_new_privileges", lambda: done.append("forbade new ones"))
    monkeypatch.setattr(daemon, "become", lambda user: done.append(f"became {user}"))
    words = ["ens5", str(free_port()), "--user", "nobody"]
    with pytest.raises(StopRequestedError):
        run_here(lambda _: daemon.serve(parse_options(words), Signals()))
    prepared = "prepared, becomes user: True"
    assert done == ["forbade new ones", "opened ens5", prepared, "became nobody", "brought up"]


# -- the server


def rows_of(process: int, task: str = "") -> dict[str, str]:
    folder = Path(f"/proc/{process}/task/{task or process}")
    lines = (folder / "status").read_text().splitlines()
    return {key: value.strip() for key, _, value in (line.partition(":") for line in lines)}


def check_unprivileged(process: int) -> None:
    """Each of its threads: none has what it could go back with."""
    groups = os.getgrouplist("nobody", NOBODY.pw_gid)
    for path in Path(f"/proc/{process}/task").iterdir():
        rows = rows_of(process, path.name)
        assert rows["Uid"].split() == [str(NOBODY.pw_uid)] * 4
        assert rows["Gid"].split() == [str(NOBODY.pw_gid)] * 4
        assert sorted(map(int, rows["Groups"].split())) == sorted(groups)
        assert not int(rows["CapEff"], 16) | int(rows["CapPrm"], 16) | int(rows["CapAmb"], 16)
        assert rows["NoNewPrivs"] == "1"


@pytest.fixture(scope="module")
def bench() -> Iterator[tuple[Veth, VirtualSensor]]:
    with virtual_sensor() as found:
        yield found


@pytest.fixture(scope="module")
def running(
    bench: tuple[Veth, VirtualSensor], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Server, Path]]:
    """It finds its Python unreadable where that is root's: it must need nothing of it any more."""
    config = tmp_path_factory.mktemp("privileges") / "c.toml"
    config.write_text("[server]\nidle_timeout_s = 50\n[sensor]\nsinc_length = 512\n")
    config.chmod(0o600)
    with server(bench[0].near, "--config", str(config), under=BY_SUDO) as found:
        yield found, config


@needs_another_user
@on_a_bus
def test_it_streams_and_recovers_without_privileges(
    running: tuple[Server, Path], bench: tuple[Veth, VirtualSensor]
) -> None:
    found, _ = running
    veth, sensor = bench
    check_unprivileged(found.process.pid)
    assert "running as user nobody from here on" in found.said()
    assert "running as root" not in found.said()
    with found.connect() as client:
        assert client.ask("subscribe")["ok"]
        client.fresh(50)
        sensor.command("power off")
        client.wait_event("sensor_lost")
        sensor.command("power on")
        client.wait_event("sensor_back")
        veth.ip("link", "set", veth.near, "down")
        # On a busy machine the sensor's process may have been starved and lost before.
        while f"{veth.near} is down" not in client.wait_event("sensor_lost")["reason"]:
            client.wait_event("sensor_back")
        veth.ip("link", "set", veth.near, "up")
        client.wait_event("sensor_back")
        client.fresh(50)
        assert client.ask("configure", settings={"fir": True})["ok"], "root may control it"
    with found.connect(NOBODY.pw_uid) as client:
        assert client.ask("configure", settings={"fir": False})["ok"], "and so may its own user"


@needs_another_user
@on_a_bus
def test_only_the_loop_has_real_time_priority(running: tuple[Server, Path]) -> None:
    found, _ = running
    if "not granted: SCHED_FIFO" in found.said():
        pytest.skip("no real-time priority here: run it as real root")
    tasks = [int(path.name) for path in Path(f"/proc/{found.process.pid}/task").iterdir()]
    policies = {task: os.sched_getscheduler(task) & ~os.SCHED_RESET_ON_FORK for task in tasks}
    assert policies.pop(found.process.pid) == os.SCHED_FIFO
    assert "locked memory" in found.said() or int(rows_of(found.process.pid)["VmLck"].split()[0]) > 0
    assert policies
    assert set(policies.values()) == {os.SCHED_OTHER}, "the log's"


@needs_another_user
@on_a_bus
@pytest.mark.parametrize("stuck", [False, True])
def test_the_virtual_sensor_becomes_the_same_user_and_goes_with_the_server(stuck: bool) -> None:
    """A stopped process does not end by itself; that of another user could not be killed."""
    with server("virtual", *SLOW, "--user", "nobody") as found:
        process = found.process.pid
        (child,) = Path(f"/proc/{process}/task/{process}/children").read_text().split()
        for each in (process, int(child)):
            check_unprivileged(each)
        with found.connect() as client:
            client.ask("subscribe")
            client.fresh(50)
        if stuck:
            os.kill(int(child), signal.SIGSTOP)
        found.signal(signal.SIGTERM)
        assert found.wait() == 0
        assert "Traceback" not in found.said()
        wait_until(lambda: found.ifname not in {name for _, name in socket.if_nameindex()}, "the veth pair")


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root")
@on_a_bus
def test_root_without_sudo_stays_root_and_is_told_how_not_to() -> None:
    with server("virtual", *SLOW) as found:
        assert rows_of(found.process.pid)["Uid"].split() == ["0"] * 4
        assert found.said().count("running as root: name a user with --user") == 1
        found.signal(signal.SIGTERM)
        assert found.wait() == 0


def test_what_cannot_be_given_up_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "initgroups", refuse)
    with pytest.raises(ServerError, match="cannot become user nobody: Operation not permitted"):
        privileges.become(User(NOBODY.pw_uid, NOBODY.pw_gid, pwd.getpwuid(NOBODY.pw_uid).pw_name))


# -- as its unit starts it: another user with four capabilities, or with one of them missing


@pytest.fixture(scope="module")
def spare() -> Iterator[Veth]:
    """With a sensor, and no server yet."""
    with virtual_sensor() as (veth, _):
        yield veth


def confined(capabilities: Iterable[str]) -> dict[str, Any]:
    """For `server`, which then has no more than these; skips where it cannot be started like this at all."""

    def become(capabilities: Iterable[str]) -> list[str]:
        given = ",".join(["-all", *(f"+{name.removeprefix('CAP_').lower()}" for name in capabilities)])
        return [
            "prlimit", "--memlock=65536", "--rtprio=0",
            "setpriv", f"--reuid={NOBODY.pw_uid}", f"--regid={NOBODY.pw_gid}", "--clear-groups",
            "--no-new-privs", f"--inh-caps={given}", f"--ambient-caps={given}", f"--bounding-set={given}",
        ]  # fmt: skip

    rights.need(*become(CAPABILITIES))
    return {"under": [*rights.readable(), *become(capabilities)], "python": rights.PYTHON}


@pytest.mark.long
@on_a_bus
def test_an_ordinary_user_has_a_virtual_bus_in_namespaces_of_its_own() -> None:
    limits = confined(())
    user = ("setpriv", f"--reuid={NOBODY.pw_uid}", f"--regid={NOBODY.pw_gid}", "--clear-groups")
    rights.need(*user, "unshare", "--user", "--net")
    with server("virtual", **limits) as found:
        assert rows_of(found.process.pid)["Uid"].split() == [str(NOBODY.pw_uid)] * 4
        assert found.ifname not in dict(socket.if_nameindex()).values()
        for uid in (None, NOBODY.pw_uid):
            with found.connect(uid) as client:
                assert client.ask("subscribe")["interface"] == found.ifname
                client.fresh(50)
                assert client.ask("configure", settings={"fir": uid is None})["ok"]
        found.signal(signal.SIGTERM)
        assert found.wait() == 0


@on_a_bus
def test_the_units_capabilities_are_enough_for_everything(spare: Veth) -> None:
    (ambient,) = values(SERVER_UNIT, "AmbientCapabilities")
    expected = sum(1 << getattr(rights, name.removeprefix("CAP_")) for name in ambient.split())
    with server(spare.near, *SLOW, **confined(ambient.split())) as found:
        process = rows_of(found.process.pid)
        assert process["Uid"].split() == [str(NOBODY.pw_uid)] * 4
        for kind in ("CapEff", "CapPrm", "CapBnd", "CapAmb"):
            assert int(process[kind], 16) == expected, kind
        assert process["NoNewPrivs"] == "1"
        assert os.sched_getscheduler(found.process.pid) == os.SCHED_FIFO
        assert int(process["VmLck"].split()[0]) > 0
        assert "not granted" not in found.said()
        with found.connect() as client:
            assert client.ask("subscribe")["ok"]
            client.fresh(10)
            found.signal(signal.SIGTERM)
            client.receive_all()
            assert client.events[-1]["event"] == "shutting_down"
        assert found.wait() == 0


@on_a_bus
@pytest.mark.parametrize("missing", ["CAP_NET_RAW", "CAP_NET_ADMIN"])
def test_without_the_rights_to_the_interface_it_ends(spare: Veth, missing: str) -> None:
    given = confined(name for name in CAPABILITIES if name != missing)
    with contextlib.closing(Server(spare.near, **given)) as found:
        assert found.wait() == 1
        assert f"{missing} missing" in found.said()


# -- what is asked of the kernel is granted where allowed, and said in one line where not

PROBE = """
import gc, json, logging, os, sys, threading
from ethercat_server.process import realtime
logging.basicConfig(format="%(message)s", stream=sys.stderr)
realtime.prepare({priority}, {cpu})
def scheduling():
    return [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, sorted(os.sched_getaffinity(0))]
def leave():
    realtime.leave()
    left.extend(scheduling())
left = []
thread = threading.Thread(target=leave)
thread.start()
thread.join()
locked = next(l for l in open("/proc/self/status") if l.startswith("VmLck")).split()[1]
slack = open("/proc/self/timerslack_ns").read().strip()
print(json.dumps(dict(own=scheduling(), thread=left, locked=int(locked), slack=slack, gc=gc.isenabled())))
"""


def probe(priority: int, cpu: int | None, *, capable: bool = True) -> tuple[dict[str, Any], str]:
    """What the process then has, and what it said."""
    drop = None if capable else without(IPC_LOCK, SYS_NICE)
    program = PROBE.format(priority=priority, cpu=cpu)
    done = completed(sys.executable, "-c", program, check=True, preexec_fn=drop)
    return json.loads(done.stdout), done.stderr.strip()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to be granted real-time scheduling")
def test_what_is_granted_a_thread_can_leave() -> None:
    cpus = sorted(os.sched_getaffinity(0))
    found, said = probe(40, cpus[0])
    if said:
        pytest.skip(
            f"root may not do everything here (a user namespace or container: run it as real root): {said}"
        )
    assert found["own"] == [os.SCHED_FIFO, 40, [cpus[0]]], "the loop keeps its own"
    assert found["thread"] == [os.SCHED_OTHER, 0, cpus]
    assert found["locked"] > 0
    assert found["gc"] is False


def test_not_granted_is_one_line_and_it_runs_on() -> None:
    limit = os.sysconf("SC_NPROCESSORS_CONF") + 5
    found, said = probe(40, limit, capable=False)
    assert found["own"][0] == os.SCHED_OTHER
    assert len(said.splitlines()) == 1
    assert said.startswith("not granted: ")
    assert f"CPU {limit}" in said
    assert "SCHED_FIFO 40 (" in said
    assert found["gc"] is False
    assert found["slack"] == "1000", "then at least the timer is made finer"
