"""The server as an ordinary user with the capabilities that its unit gives, and with one of them missing."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from tests import rights
from tests.server.running import ATTEMPTS, Server, Veth, needs_bus, starved, virtual_sensor
from tests.systemd.staging import CAPABILITIES, SERVER_UNIT, values

pytestmark = [pytest.mark.bus, needs_bus]

NOBODY = 65534
BITS = {"CAP_NET_ADMIN": 12, "CAP_NET_RAW": 13, "CAP_IPC_LOCK": 14, "CAP_SYS_NICE": 23}


def with_capabilities(capabilities: Iterable[str]) -> list[str]:
    """A command that becomes the one behind it: another user, no right beyond `capabilities`."""
    given = ",".join(["-all", *(f"+{name.removeprefix('CAP_').lower()}" for name in capabilities)])
    return [
        "prlimit", "--memlock=65536", "--rtprio=0",
        "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--no-new-privs",
        f"--inh-caps={given}", f"--ambient-caps={given}", f"--bounding-set={given}",
    ]  # fmt: skip


def confined(ifname: str, capabilities: Iterable[str]) -> Server:
    """The server with no more than `capabilities`; skips where it cannot be started like this at all."""
    rights.need(*with_capabilities(CAPABILITIES))
    under = [*rights.readable(), *with_capabilities(capabilities)]
    return Server(ifname, under=under, python=rights.PYTHON)


@contextlib.contextmanager
def streaming(ifname: str, capabilities: Iterable[str]) -> Iterator[Server]:
    """The same, once it streams; started again where the sensor was starved."""
    for attempt in range(ATTEMPTS):
        server = confined(ifname, capabilities)
        try:
            server.wait_streaming()
        except AssertionError:
            if attempt == ATTEMPTS - 1 or not starved(server.said()):
                raise
        else:
            yield server
            return
        finally:
            server.close()


def of_process(pid: int) -> dict[str, str]:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return {key: value.strip() for key, _, value in (line.partition(":") for line in lines)}


def test_the_units_capabilities_are_enough_for_everything() -> None:
    (ambient,) = values(SERVER_UNIT, "AmbientCapabilities")
    given = ambient.split()
    expected = sum(1 << BITS[name] for name in given)
    with virtual_sensor() as (veth, _), streaming(veth.near, given) as server:
        process = of_process(server.process.pid)
        assert process["Uid"].split() == [str(NOBODY)] * 4
        for kind in ("CapEff", "CapPrm", "CapBnd", "CapAmb"):
            assert int(process[kind], 16) == expected, kind
        assert process["NoNewPrivs"] == "1"
        assert os.sched_getscheduler(server.process.pid) == os.SCHED_FIFO
        assert int(process["VmLck"].split()[0]) > 0
        assert "not granted" not in server.said()
        with server.connect() as client:
            assert client.ask("subscribe")["ok"]
            client.fresh(10)
            server.signal(signal.SIGTERM)
            client.receive_all()
            assert client.events[-1]["event"] == "shutting_down"
        assert server.wait() == 0


@pytest.mark.parametrize("missing", ["CAP_NET_RAW", "CAP_NET_ADMIN"])
def test_without_the_rights_to_the_interface_it_ends(missing: str) -> None:
    with Veth() as veth:
        server = confined(veth.near, [name for name in CAPABILITIES if name != missing])
        try:
            assert server.wait() == 1
            assert f"{missing} missing" in server.said()
        finally:
            server.close()


def test_without_the_rights_to_real_time_it_says_so_and_streams() -> None:
    with virtual_sensor() as (veth, _):
        for missing in ("real-time priority 80 (CAP_SYS_NICE)", "locked memory (CAP_IPC_LOCK)"):
            given = [name for name in CAPABILITIES if name not in missing]
            with streaming(veth.near, given) as server:
                server.signal(signal.SIGTERM)
                assert server.wait() == 0
                assert f"not granted: {missing}; " in server.said()
