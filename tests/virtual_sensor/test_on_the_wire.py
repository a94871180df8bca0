"""Real pysoem over a veth pair: SOEM's own start-up, SDO and SDO Information requests, and the raw socket.

What does not depend on SOEM or the kernel is tested in memory, in the other files.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import pysoem
import pytest

from bota_ethercat.pdo import encode
from ethercat_server.ethercat import wire
from ethercat_server.ethercat.wire import Command
from scripts.benchmarks.records import decode_clock
from tests.server.running import VirtualSensor, wait_until
from tests.virtual_sensor.conftest import Start

pytestmark = pytest.mark.bus

Bench = Callable[..., tuple[VirtualSensor, Any]]
_PATIENCE = 20.0
SOL_PACKET, PACKET_AUXDATA, ETH_P_ALL = 263, 8, 3


@pytest.fixture
def bench(veth: tuple[str, str], start: Start, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Starts a virtual sensor with these arguments, and opens a master on the other end."""
    master = pysoem.Master()
    # SOEM takes a frame for lost after 2 ms, in which a busy machine may not let the sensor's process run.
    for name in ("ret", "safe", "eeprom", "tx_mailbox"):
        monkeypatch.setattr(pysoem.settings.timeouts, name, 500_000)

    def made(*arguments: str) -> tuple[VirtualSensor, Any]:
        sensor = start(veth[0], *arguments)
        try:
            master.open(veth[1])
        except ConnectionError as error:
            pytest.skip(f"pysoem cannot open {veth[1]}: {error}")
        return sensor, master

    yield made
    master.close()


def exchange(master: Any) -> int:
    """A process data exchange whose frame came back; its working counter."""
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        master.send_processdata()
        counter: int = master.receive_processdata(100_000)
        if counter >= 0:
            return counter
    pytest.fail("no frame came back")


def read(slave: Any, index: int, subindex: int) -> bytes:
    data: bytes = slave.sdo_read(index, subindex)
    return data


def register(slave: Any, address: int, layout: str) -> int:
    return int(struct.unpack(layout, slave._fprd(address, struct.calcsize(layout)))[0])


def reach_op(master: Any) -> None:
    master.state = pysoem.OP_STATE
    master.write_state()
    op = pysoem.OP_STATE
    wait_until(lambda: exchange(master) >= 0 and master.state_check(op, 20_000) == op, "OP", _PATIENCE)


def bring_up(master: Any, count: int = 1) -> None:
    assert master.config_init() == count
    master.config_map()
    for slave in master.slaves:
        slave._fpwr(0x0420, b"\0\0")  # no watchdog: this machine may stand still for longer
    assert master.state_check(pysoem.SAFEOP_STATE, 2_000_000) == pysoem.SAFEOP_STATE
    reach_op(master)


@pytest.mark.parametrize("size", [61, 77])
def test_to_op_with_the_clock_signal(size: int, bench: Bench) -> None:
    _, master = bench("--pdo", str(size), "--signal", "clock", "--serial", "42")
    bring_up(master)
    slave = master.slaves[0]
    assert (slave.name, slave.man, slave.id, slave.rev) == ("BFT-SENS-ECAT-M8", 0xB07A, 1, 3)
    assert master.expected_wkc == 3
    previous = decode_clock((0.0, 0.0, 0.0, 0.0))
    for _ in range(200):
        before = time.monotonic_ns()
        assert exchange(master) == 3
        data = slave.input
        assert len(data) == size
        load = struct.unpack_from("<4f", data, 5)
        fields = dict(zip(("force.x", "force.y", "force.z", "torque.x"), load, strict=True))
        assert data == encode(size, {**fields, "acceleration.z": 1.0, "temperature": 35.0})
        reading = decode_clock(load)
        assert reading.number >= previous.number
        assert reading.instant_ns <= time.monotonic_ns() % (2**20 * 10**9)
        # Not older than one period when the frame went out.
        assert reading.instant_ns > before % (2**20 * 10**9) - 1_250_001
        previous = reading


@pytest.mark.parametrize("state", ["", ":OP"])
def test_a_chain_with_foreign_slaves(state: str, bench: Bench) -> None:
    chain = ",".join(kind + state for kind in ("EK1100", "BOTA", "EL3102", "DRIVE", "BOTA"))
    models = ("--model", "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8", "--signal", "constant", "--noise", "none")
    sensor, master = bench("--chain", chain, *models)
    assert sensor.said().endswith(", beside EK1100, EL3102, DRIVE\n")
    bring_up(master, 5)
    coupler, bota, terminal, drive, last = master.slaves
    drive.output = struct.pack("<Hi", 0x06, 0)
    # Not `slave.name` of the last: SOEM copies the SII of another of the same vendor, product and revision.
    names = ["EK1100", "BFT-SENS-ECAT-M8", "EL3102", "DRIVE"]
    assert [slave.name for slave in master.slaves[:4]] == names
    assert read(last, 0x1008, 0).rstrip(b"\0") == b"BFT-ROKS-ECAT-M8"
    serials = [struct.unpack("<I", read(slave, 0x1018, 4))[0] for slave in (bota, last)]
    assert serials == [serials[0], serials[0] + 1]
    assert (coupler.man, coupler.id) == (2, 0x044C2C52)
    assert (terminal.man, terminal.id) == (2, 0x0C1E3052)
    sizes = [(len(s.output), len(s.input)) for s in master.slaves]
    assert sizes == [(0, 0), (1, 61), (0, 6), (6, 2), (1, 61)]
    assert exchange(master) == master.expected_wkc == 3 + 1 + 3 + 3
    assert struct.unpack_from("<f", bota.input, 5) == (1.5,)
    assert bota.input == last.input
    assert abs(struct.unpack("<BhBh", terminal.input)[1]) <= 0x4000
    drive.output = struct.pack("<Hi", 0x0F, 1000)
    exchange(master)
    exchange(master)
    assert struct.unpack_from("<H", drive.input)[0] & 0x6F == 0x27
    assert read(drive, 0x1008, 0) == b"DRIVE"


def test_soem_sets_distributed_clocks_up(bench: Bench) -> None:
    _, master = bench("--chain", "EK1100,BOTA,DRIVE")
    assert master.config_init() == 3
    master.config_map()
    assert master.config_dc()
    delays = [register(slave, 0x0928, "<I") for slave in master.slaves]
    assert 0 == delays[0] < delays[1] < delays[2]
    began = time.monotonic_ns()
    times = [register(slave, 0x0910, "<Q") for slave in master.slaves]
    assert times == sorted(times)
    assert times[-1] - times[0] < time.monotonic_ns() - began, "one system time"
    reach_op(master)


@pytest.mark.parametrize("tag", ["8100e000", "81006005", "88a80005"])
def test_an_answer_has_the_vlan_tag_of_its_frame(tag: str, veth: tuple[str, str], start: Start) -> None:
    start(veth[0])
    frame = wire.build((Command.BRD, 0, 0x0000, bytes(34)))
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as raw:
        raw.setsockopt(SOL_PACKET, PACKET_AUXDATA, 1)
        raw.bind((veth[1], ETH_P_ALL))
        raw.settimeout(_PATIENCE)
        raw.send(frame[:12] + bytes.fromhex(tag) + frame[12:])
        while (answer := raw.recvmsg(2048, 64))[0][12:14] != frame[12:14]:
            pass
    data, [(_, _, auxiliary)], *_ = answer
    end = wire.parse(data, len(data))[0].end
    assert data[end : end + 2] == b"\1\0", "the working counter"
    *_, control, kind = struct.unpack("=IIIHHHH", auxiliary)
    assert f"{kind:04x}{control:04x}" == tag
