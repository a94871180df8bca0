"""The doctor on real interfaces and as other users: what only the kernel can answer.

What it makes of the answers is tested on made-up machines and simulated buses.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import platform
import shlex
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator

import pytest

from ethercat_server.ethercat.nic import look_up, why_silent
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
    age = ended.findings("measurement")["age of data"]
    # Beside much other work 0.2 s may be too short to follow the sensor's clock.
    assert age["values"].get("p50", 0) > 0 or "once it follows the sensor's clock" in age["found"]
    assert ended.json["interface"] == "virtual"
    assert "ecat" not in str([row["commands"] for row in ended.json["findings"]]), (
        "what is gone needs no mending"
    )


ETH_P_ALL = 3
BPF = {"x86_64": 321, "aarch64": 280}  # the system call's number
BPF_PROG_LOAD, PROG_TYPE_XDP, XDP_DROP = 5, 6, 1
NEWLINK, REQUEST_ACK, NESTED, IFLA_XDP, XDP_FD, XDP_FLAGS = 16, 0x5, 0x8000, 43, 1, 3


def attach_xdp(ifname: str, mode: int) -> None:
    """Attach a program that drops every frame, and forget it, as a master does that ends."""
    code = ctypes.create_string_buffer(struct.pack("=BBhiBBhi", 0xB7, 0, 0, XDP_DROP, 0x95, 0, 0, 0))
    name = ctypes.create_string_buffer(b"GPL")
    asked = struct.pack("=IIQQ", PROG_TYPE_XDP, 2, ctypes.addressof(code), ctypes.addressof(name))
    libc = ctypes.CDLL(None, use_errno=True)
    program = libc.syscall(BPF[platform.machine()], BPF_PROG_LOAD, asked.ljust(128, b"\0"), 128)
    if program < 0 and ctypes.get_errno() in {errno.EPERM, errno.ENOSYS}:
        pytest.skip("no BPF programs may be loaded here")
    assert program >= 0, os.strerror(ctypes.get_errno())
    xdp = struct.pack("=HHiHHI", 8, XDP_FD, program, 8, XDP_FLAGS, mode)
    body = (
        struct.pack("=BxHiIIHH", 0, 0, look_up(ifname).ifindex, 0, 0, 4 + len(xdp), IFLA_XDP | 0x8000) + xdp
    )
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        kernel.send(struct.pack("=IHHII", 16 + len(body), NEWLINK, REQUEST_ACK, 1, 0) + body)
        (error,) = struct.unpack_from("=i", kernel.recv(4096), 16)
    os.close(program)
    assert error == 0, os.strerror(-error)


def obey(commands: list[str]) -> None:
    """Run what the doctor advises, as root."""
    for command in commands:
        sudo, *words = shlex.split(command)
        assert sudo == "sudo"
        subprocess.run(words, check=True)


@pytest.mark.parametrize(("mode", "name"), [(1 << 1, "xdpgeneric"), (1 << 2, "xdpdrv")])
def test_an_xdp_program_that_was_left_is_why_nothing_answers_until_its_command_removes_it(
    bench: Bench, mode: int, name: str
) -> None:
    near = bench[0].near
    attach_xdp(near, mode)
    ended = doctor_here(near, *LOOK)
    found, silent = ended.findings("other software")["XDP"], ended.findings("bus")["slaves"]
    command = f"sudo ip link set dev {near} {name} off"
    assert (found["level"], found["commands"]) == ("warning", [command])
    assert silent["found"] == "no EtherCAT slave answers"
    assert f"'{command}'" in silent["why"]
    obey(found["commands"])
    assert (look_up(near).xdp, why_silent(near)) == ((), "check cable and power")
    ended = doctor_here(near, *LOOK)
    assert ended.findings("other software")["XDP"]["level"] == "ok"
    assert ended.findings("bus")["slaves"]["values"] == {"slaves": 2}


def test_who_has_a_packet_socket_with_a_copy_of_each_frame_is_named_until_it_is_ended(bench: Bench) -> None:
    """On this interface, on all; not those on another interface or of another protocol."""
    near, far = bench[0].near, bench[0].far
    script = (
        "import socket, sys; name, protocol = sys.argv[1], int(sys.argv[2])\n"
        "s = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0 if name else protocol))\n"
        "if name: s.bind((name, protocol))\n"
        "print(flush=True); input()"
    )
    programs, pipe = [], subprocess.PIPE
    with contextlib.ExitStack() as stack:
        for name, protocol in ((near, ETH_P_ALL), ("", ETH_P_ALL), (far, ETH_P_ALL), (near, 0x88CC)):
            words = [sys.executable, "-c", script, name, str(protocol)]
            program = stack.enter_context(subprocess.Popen(words, stdin=pipe, stdout=pipe))
            stack.callback(program.kill)
            assert program.stdout is not None
            assert program.stdout.readline() == b"\n"
            programs.append(program)
        rows = [
            row for row in doctor_here(near, *LOOK).json["findings"]
            if row["check"] == "packet sockets" and row["commands"] and row["commands"][0].split()[-1]
            in {str(program.pid) for program in programs}
        ]  # fmt: skip
        first, second = programs[:2]
        assert {row["commands"][0]: row["level"] for row in rows} == {
            f"sudo kill {first.pid}": "warning",
            f"sudo kill {second.pid}": "note",
        }
        obey([command for row in rows for command in row["commands"]])
        assert [first.wait(PATIENCE_S), second.wait(PATIENCE_S)] == [-signal.SIGTERM] * 2
    assert doctor_here(near, *LOOK).findings("other software")["packet sockets"]["level"] in {"ok", "note"}
