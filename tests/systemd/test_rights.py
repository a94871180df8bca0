"""The server as an ordinary user with the capabilities that its unit gives, and with one of them missing."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable
from pathlib import Path

import pytest

from protocol.framing import DataFlag
from tests.server import readable
from tests.server.running import Server, needs_bus, virtual_sensor
from tests.systemd.confined import NOBODY, with_capabilities
from tests.systemd.staging import CAPABILITIES, SERVER_UNIT, values

pytestmark = [pytest.mark.bus, needs_bus]

BITS = {"CAP_NET_ADMIN": 12, "CAP_NET_RAW": 13, "CAP_IPC_LOCK": 14, "CAP_SYS_NICE": 23}


def confined(ifname: str, capabilities: Iterable[str]) -> Server:
    """The server with no more than `capabilities`; skips where it cannot be started like this at all."""
    readable.need(*with_capabilities(CAPABILITIES))
    under = [*readable.under(), *with_capabilities(capabilities)]
    return Server(ifname, under=under, python=readable.PYTHON)


def of_process(pid: int) -> dict[str, str]:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return {key: value.strip() for key, _, value in (line.partition(":") for line in lines)}


def test_the_units_capabilities_are_enough_for_everything() -> None:
    (ambient,) = values(SERVER_UNIT, "AmbientCapabilities")
    given = ambient.split()
    expected = sum(1 << BITS[name] for name in given)
    with virtual_sensor() as (veth, _):
        server = confined(veth.near, given)
        try:
            server.wait_streaming()
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
                frames = client.fresh(100)
                assert not any(frame.flags & DataFlag.INVALID for frame in frames)
                server.signal(signal.SIGTERM)
                client.receive_all()
                assert [event["event"] for event in client.events] == ["shutting_down"]
            assert server.wait() == 0
        finally:
            server.close()


@pytest.mark.parametrize(
    ("missing", "complaint", "exit_code"),
    [
        ("CAP_NET_RAW", "CAP_NET_RAW missing", 1),
        ("CAP_NET_ADMIN", "CAP_NET_ADMIN missing", 1),
        ("CAP_SYS_NICE", "not granted: real-time priority 80 (CAP_SYS_NICE); ", 0),
        ("CAP_IPC_LOCK", "not granted: locked memory (CAP_IPC_LOCK); ", 0),
    ],
)
def test_none_of_them_can_be_done_without(missing: str, complaint: str, exit_code: int) -> None:
    rest = [name for name in CAPABILITIES if name != missing]
    with virtual_sensor() as (veth, _):
        server = confined(veth.near, rest)
        try:
            if exit_code == 0:
                server.wait_streaming()
                server.signal(signal.SIGTERM)
            assert server.wait() == exit_code
            assert complaint in server.said()
        finally:
            server.close()
