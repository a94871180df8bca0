"""The whole doctor on real frames: a veth pair with the virtual sensor on its far end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.doctor.running import MODULE, doctor, levels
from tests.server.commands import command, stats
from tests.server.running import Program, Veth, needs_bus, server, virtual_sensor, wait_until

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, Program]
QUICK = ("--json", "--seconds", "0.2")
NEW_BRIDGE = ("link", "add", "{bridge}", "type", "bridge")
LOOK = ("--json", "--seconds", "0")


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """Two sensors of different models."""
    models = "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8"
    with virtual_sensor("--model", models, "--serial", "10,20") as (veth, sensor):
        yield veth, sensor


def promiscuous(veth: Veth) -> bool:
    return "promiscuity 0" not in veth.ip("-d", "link", "show", veth.near)


def test_sensors_are_found_and_left_as_they_are(bench: Bench) -> None:
    veth, sensor = bench
    before = [stats(sensor, place) for place in range(2)]
    ended = doctor(veth.near, *QUICK)
    found = ended.findings("bus")
    assert found["slaves"]["values"] == {"slaves": 2}
    assert [found[f"slave {n}"]["found"].partition(", a ")[0] for n in range(2)] == [
        "BFT-SENS-ECAT-M8, serial 10",
        "BFT-ROKS-ECAT-M8, serial 20",
    ]
    assert set(levels(found).values()) == {"ok"}
    for place in range(2):
        now = stats(sensor, place)
        assert (now["al_state"], now["al_error"]) == ("INIT", False)
        assert now["sdo_write_count"] == before[place]["sdo_write_count"] == 0
    assert not promiscuous(veth)


def test_what_is_measured(bench: Bench) -> None:
    veth, _ = bench
    found = doctor(veth.near, *QUICK).findings("measurement")
    assert set(found) == {
        "scheduling", "wake-ups", "exchanges", "messages", "age of data", "card meanwhile", "bus meanwhile",
    }  # fmt: skip
    exchange, message, age = (found[name]["values"] for name in ("exchanges", "messages", "age of data"))
    assert exchange["exchanges"] == found["wake-ups"]["values"]["wake_ups"] > 50
    assert 0 < exchange["p50"] <= exchange["p99"] <= exchange["max"]
    assert age["p50"] > exchange["p50"] / 2 + message["p50"] / 2
    assert "124 bytes" in found["exchanges"]["found"], "as long as the process data of two"
    assert found["card meanwhile"]["level"] == found["bus meanwhile"]["level"] == "ok"


def test_the_interface_is_told_for_what_it_is(bench: Bench) -> None:
    veth, _ = bench
    ended = doctor(veth.near, *LOOK)
    interface, others = ended.findings("interface"), ended.findings("who else")
    assert interface["link"]["values"]["kind"] == "veth"
    assert interface["driver"]["values"]["driver"] == "veth"
    assert interface["coalescing"]["level"] == "ok"
    assert others["addresses"]["level"] in {"ok", "note"}, "nothing but a link-local address"
    assert others["listeners"]["level"] in {"ok", "warning"}


def test_a_sensor_that_lost_its_master_is_told_and_left_so() -> None:
    with virtual_sensor() as (veth, sensor):
        with server(veth.near, "--rt-priority", "0") as running:
            running.process.kill()
            running.process.wait()
        # As its watchdog does, unless the server was just bringing it back when it ended.
        command(sensor, "safeop 0x1B")
        for _ in range(2):
            ended = doctor(veth.near, *QUICK)
            found = ended.findings("bus")
            assert found["slave 0"]["level"] == "ok", "its EEPROM belonged to the firmware, and does again"
            assert found["slave 0 state"]["level"] == "note"
            assert found["slave 0 state"]["found"].startswith("SAFEOP with AL status 0x001B")
            now = stats(sensor)
            assert (now["al_state"], now["al_error"], now["al_status_code"]) == ("SAFEOP", True, 0x1B)


def test_damaged_frames_are_told_with_their_cable() -> None:
    with virtual_sensor("--sensors", "2") as (veth, sensor):
        command(sensor, "flap @1")
        lost = doctor(veth.near, *LOOK).findings("bus")
        assert lost["slave 1 errors"]["found"] == "link lost 1 times between slave 0 and slave 1"
        assert lost["slave 1 errors"]["level"] == "note"
        command(sensor, "damage 3 @1")
        ended = doctor(veth.near, *LOOK)
        found = ended.findings("bus")
        assert ended.code >= 3
        assert found["slaves"]["values"] == {"slaves": 2}, "it tries again"
        assert found["slave 1 errors"]["level"] == "warning"
        assert "3 damaged between slave 0 and slave 1" in found["slave 1 errors"]["found"]
        assert found["slave 0 errors"]["level"] == "note", "damage that others found"


def test_frames_damaged_while_it_measures_are_bad(bench: Bench) -> None:
    veth, sensor = bench
    running = subprocess.Popen(
        [sys.executable, "-m", MODULE, veth.near, "--seconds", "2"], stdout=subprocess.PIPE, text=True
    )
    assert running.stdout is not None
    while "slave 1 errors" not in running.stdout.readline():
        pass
    command(sensor, "damage 5 1")
    out, _ = running.communicate(timeout=30)
    assert running.returncode == 4
    line = next(line for line in out.splitlines() if "bus meanwhile" in line)
    assert line.split()[0] == "bad"
    assert "5 damaged between slave 0 and slave 1" in " ".join(out.split())


def test_devices_that_the_server_would_refuse() -> None:
    with virtual_sensor() as (veth, sensor):
        command(sensor, "swap EK1100 5")
        ended = doctor(veth.near, *LOOK)
        assert ended.code == 4
        assert ended.findings("bus")["slave 0"]["level"] == "bad"
        assert "EK1100, serial 5" in ended.findings("bus")["slave 0"]["found"]


def test_nothing_answers() -> None:
    with virtual_sensor() as (veth, sensor):
        command(sensor, "deaf")
        ended = doctor(veth.near, *QUICK)
    assert ended.code == 4
    assert ended.findings("bus")["slaves"]["found"] == "no EtherCAT slave answers"
    measured = ended.findings("measurement")
    assert measured["wake-ups"]["values"]["wake_ups"] > 0, "the machine is measured all the same"
    assert measured["exchanges"]["level"] == measured["age of data"]["level"] == "skipped"


def test_a_sensor_that_goes_away_while_it_measures() -> None:
    with virtual_sensor() as (veth, sensor):
        command(sensor, "deaf-after 600")
        ended = doctor(veth.near, "--json", "--seconds", "1")
    assert ended.code == 4
    assert ended.findings("measurement")["exchanges"]["level"] == "bad"
    assert ended.findings("measurement")["bus meanwhile"]["level"] == "bad"


@pytest.mark.parametrize(
    ("commands", "link", "why"),
    [
        ([("link", "set", "{near}", "down")], "bad", "it is down"),
        ([("link", "set", "{far}", "down")], "bad", "it has no carrier"),
        ([("address", "add", "192.0.2.77/32", "dev", "{near}")], "ok", "it carries IP"),
        ([NEW_BRIDGE, ("link", "set", "{near}", "master", "{bridge}")], "ok", "part of a bridge"),
    ],
    ids=["down", "no carrier", "with an address", "in a bridge"],
)  # fmt: skip
def test_interfaces_where_no_frame_is_sent(commands: list[tuple[str, ...]], link: str, why: str) -> None:
    with contextlib.ExitStack() as cleanup:
        veth, sensor = cleanup.enter_context(virtual_sensor())
        names = {"near": veth.near, "far": veth.far, "bridge": f"eb{os.getpid()}"}
        bridge = ["ip", "link", "del", names["bridge"]]
        cleanup.callback(subprocess.run, bridge, check=False, capture_output=True)
        for words in commands:
            veth.ip(*(word.format(**names) for word in words))
        before = stats(sensor)
        ended = doctor(veth.near, *QUICK)
        assert ended.code >= 3
        assert ended.findings("interface")["link"]["level"] == link
        assert ended.findings("bus")["slaves"]["level"] == "skipped"
        assert why in ended.findings("bus")["slaves"]["found"]
        others = levels(ended.findings("who else"))
        assert others["addresses"] == ("warning" if why == "it carries IP" else others["addresses"])
        assert others["membership"] == ("bad" if why == "part of a bridge" else "ok")
        assert ended.findings("measurement")["wake-ups"]["values"]["wake_ups"] > 0
        if link == "ok":
            answer = command(sensor, "stats")
            assert '"frames":0' in answer, answer
            assert stats(sensor)["al_state"] == before["al_state"]


def test_another_master_is_not_disturbed(bench: Bench) -> None:
    veth, sensor = bench
    ended = doctor(veth.far, *QUICK)
    assert ended.code == 4
    found = ended.findings("bus")["slaves"]
    assert found["level"] == "bad"
    assert f"process {sensor.process.pid}" in found["found"]
    assert found["commands"] == [f"sudo kill {sensor.process.pid}"]


def is_running(pid: str) -> bool:
    """Whether this process is there and no zombie, whose parent need not be quick."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_stopped_while_it_measures_it_leaves_nothing_behind(bench: Bench) -> None:
    veth, sensor = bench
    running = subprocess.Popen(
        [sys.executable, "-m", MODULE, veth.near, "--seconds", "60"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stdout is not None
    while "slave 1 errors" not in running.stdout.readline():
        pass

    def children() -> list[str]:
        return Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()

    wait_until(lambda: bool(children()), "the receiver")
    receivers = children()
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=20)
    assert (running.returncode, err) == (1, "ethercat-doctor: stopped\n")
    wait_until(lambda: not any(is_running(pid) for pid in receivers), "the receiver's end")
    assert stats(sensor)["al_state"] == "INIT"
    assert not promiscuous(veth)


def test_two_doctors_at_once(bench: Bench) -> None:
    veth, _ = bench
    # It measures until it is stopped: the second takes its time to start on a busy machine.
    first = subprocess.Popen(
        [sys.executable, "-m", MODULE, veth.near, "--seconds", "90"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert first.stdout is not None
    said = ""
    while "slave 1 errors" not in said:
        line = first.stdout.readline()
        assert line, said
        said += line
    second = doctor(veth.near, *LOOK).findings("bus")["slaves"]
    first.send_signal(signal.SIGINT)
    _, err = first.communicate(timeout=20)
    assert f"process {first.pid}" in second["found"]
    assert "2 slaves answer" in said
    assert (first.returncode, err) == (1, "ethercat-doctor: stopped\n")


def test_without_rights_it_says_what_it_skipped(bench: Bench) -> None:
    veth, sensor = bench
    before = command(sensor, "stats")
    ended = doctor(veth.near, *QUICK, module="tests.doctor.as_nobody")
    assert not ended.json["root"]
    assert ended.findings("bus")["slaves"]["found"] == (
        "could not look: CAP_NET_RAW and CAP_NET_ADMIN missing; run with sudo"
    )
    assert ended.findings("rights")["capabilities"]["level"] == "note"
    assert ended.findings("measurement")["scheduling"]["values"] == {"real_time": False}
    assert ended.findings("measurement")["wake-ups"]["values"]["wake_ups"] > 0
    assert ended.findings("interface")["driver"]["values"]["driver"] == "veth", "this needs no rights"
    assert before.partition("sensors")[0] == command(sensor, "stats").partition("sensors")[0], (
        "no frame was sent"
    )


def test_root_without_capabilities_is_no_root(bench: Bench) -> None:
    veth, _ = bench
    confined = ("setpriv", "--bounding-set=-all", "--inh-caps=-all", "--ambient-caps=-all")
    ended = doctor(veth.near, *QUICK, under=confined)
    assert "CAP_NET_RAW and CAP_NET_ADMIN missing" in ended.findings("bus")["slaves"]["found"]
    virtual = doctor("virtual", *LOOK, under=confined)
    assert virtual.code in {0, 3}
    assert "there is no virtual bus: CAP_NET_RAW" in virtual.findings("bus")["slaves"]["found"]
    assert virtual.err == ""


def test_virtual_brings_a_bus_of_its_own_and_takes_it_away() -> None:
    ended = doctor("virtual", *QUICK)
    assert ended.findings("bus")["slave 0"]["found"].startswith("BFT-SENS-ECAT-M8, serial 1")
    assert ended.findings("measurement")["age of data"]["values"]["p50"] > 0
    assert ended.json["interface"] == "virtual"
    assert "ecat" not in str([row["commands"] for row in ended.json["findings"]]), (
        "what is gone needs no mending"
    )


def test_a_terminal_gets_colour(bench: Bench) -> None:
    veth, _ = bench
    shown = subprocess.run(
        ["script", "-qec", f"{sys.executable} -m {MODULE} {veth.near} --seconds 0", "/dev/null"],
        capture_output=True, text=True, check=False, env={**os.environ, "TERM": "xterm", "NO_COLOR": ""},
    )  # fmt: skip
    assert "\x1b[32mok" in shown.stdout


def test_a_terminal_is_told_what_takes_a_while(bench: Bench) -> None:
    veth, _ = bench
    shown = subprocess.run(
        ["script", "-qec", f"{sys.executable} -m {MODULE} {veth.near} --seconds 0.1", "/dev/null"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "measuring for 0.1 s ..." in shown.stdout
    assert "measuring" not in doctor(veth.near, "--seconds", "0.1").out
