"""The doctor on real interfaces and as other users: what only the kernel can answer.

What it makes of the answers is tested on made-up machines and simulated buses.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests import rights
from tests.doctor.running import MODULE, STARVED, doctor, doctor_here, doctor_of_nobody, levels
from tests.rights import NOBODY
from tests.server.running import (
    ATTEMPTS,
    PATIENCE_S,
    Veth,
    VirtualSensor,
    needs_bus,
    starved,
    virtual_sensor,
    wait_until,
)

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, VirtualSensor]
QUICK = ("--json", "--seconds", "0.2")
LOOK = ("--json", "--seconds", "0")


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """Two sensors of different models at 100 Hz, which takes little of the machine."""
    models = "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8"
    with virtual_sensor("--model", models, "--serial", "10,20", "--sinc", "512") as (veth, sensor):
        yield veth, sensor


def promiscuous(veth: Veth) -> bool:
    return "promiscuity 0" not in veth.ip("-d", "link", "show", veth.near)


def test_the_whole_doctor(bench: Bench) -> None:
    """pysoem's frames, a server with real-time scheduling, facts from the kernel."""
    veth, sensor = bench
    ended = doctor(veth.near, *QUICK)
    found = ended.findings("bus")
    assert found["slaves"]["values"] == {"slaves": 2}
    assert set(levels(found).values()) == {"ok"}
    measured = ended.findings("measurement")
    assert measured["scheduling"]["values"]["real_time"] in {True, False}  # as this user may
    assert measured["sensors"]["values"]["new_fresh"] > 0
    interface, others = ended.findings("interface"), ended.findings("other software")
    assert interface["link"]["values"]["kind"] == "veth"
    assert interface["driver"]["values"]["driver"] == "veth"
    assert interface["coalescing"]["level"] == "skipped", "the driver has none"
    assert others["addresses"]["level"] in {"ok", "note"}, "nothing but a link-local address"
    for position in range(2):
        now = sensor.stats(position)
        assert (now["al_state"], now["al_error"], now["sdo_write_count"]) == ("INIT", False, 0)
    assert not promiscuous(veth), "SOEM makes it so, and leaves it"


@contextlib.contextmanager
def measuring(ifname: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A doctor that has found two slaves and measures until it is stopped, and what it said so far."""
    command, pipe = [sys.executable, "-m", MODULE, ifname, "--seconds", "600"], subprocess.PIPE
    for _ in range(ATTEMPTS):
        with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as running:
            assert running.stdout is not None
            said = ""
            while (line := running.stdout.readline()) and not starved(said, STARVED):
                said += line
                if "slave 1 errors" in said:
                    yield running, said
                    return
            running.kill()
    pytest.fail(said)


@pytest.mark.long
def test_stopped_while_it_measures_it_leaves_nothing_behind(bench: Bench) -> None:
    """A signal from outside, sockets, and another doctor's look at them."""
    veth, sensor = bench
    with measuring(veth.near) as (running, said):
        wait_until(lambda: sensor.stats()["al_state"] == "OP", "its server")
        second = doctor_here(veth.near, *LOOK).findings("bus")["slaves"]
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=PATIENCE_S)
    assert f"process {running.pid}" in second["found"]
    assert "2 slaves answer" in said
    assert (running.returncode, err) == (1, "ethercat-doctor: stopped\n")
    assert sensor.stats()["al_state"] == "INIT"
    assert not promiscuous(veth)


def test_without_rights_it_says_what_it_skipped(bench: Bench) -> None:
    """Another user's rights, as the kernel grants them."""
    veth, sensor = bench
    before = sensor.command("stats")
    ended = doctor_of_nobody(veth.near, "--json", "--seconds", "0.02")
    assert not ended.json["root"]
    assert "CAP_NET_ADMIN and CAP_NET_RAW missing; run with sudo" in ended.findings("bus")["slaves"]["found"]
    assert ended.findings("rights")["capabilities"]["level"] == "note"
    assert ended.findings("measurement")["all"]["level"] == "skipped"
    assert ended.findings("interface")["driver"]["values"]["driver"] == "veth", "this needs no rights"
    assert before.partition("sensors")[0] == sensor.command("stats").partition("sensors")[0], (
        "no frame was sent"
    )


def test_another_user_sees_that_an_interface_is_in_use_but_not_by_whom(bench: Bench) -> None:
    """The kernel shows other users' sockets, but not whose they are."""
    become = ("setpriv", f"--reuid={NOBODY.pw_uid}", f"--regid={NOBODY.pw_gid}", "--clear-groups")
    rights.need(*become)
    script = f"from ethercat_server.access.adapters import find_holder; print(find_holder({bench[0].far!r}))"
    seen = subprocess.run(
        [*rights.readable(), *become, rights.PYTHON, "-c", script],
        capture_output=True,
        text=True,
        check=True,
    )
    assert seen.stdout == "another EtherCAT master\n"


def test_virtual_brings_a_bus_of_its_own_and_takes_it_away() -> None:
    """A network namespace and its interfaces."""
    ended = doctor_here("virtual", *QUICK)
    assert ended.findings("bus")["slave 0"]["found"].startswith("BFT-SENS-ECAT-M8, serial ")
    assert ended.findings("measurement")["age of data"]["values"]["p50"] > 0
    assert ended.json["interface"] == "virtual"
    assert "ecat" not in str([row["commands"] for row in ended.json["findings"]]), (
        "what is gone needs no mending"
    )
