"""Real pysoem over a veth pair takes the virtual sensor for a Bota sensor."""

from __future__ import annotations

import functools
import json
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import pytest

from ethercat_server.objects import Access
from ethercat_server.virtual_sensor.dictionary import entries_of
from ethercat_server.virtual_sensor.signals import decode_clock
from protocol.pdo import encode
from tests.virtual_sensor.conftest import SensorProcess

pysoem = pytest.importorskip("pysoem", reason="pysoem is not installed")
pytestmark = pytest.mark.bus

Start = Callable[..., SensorProcess]
_PATIENCE = 20.0


@pytest.fixture
def open_master(veth: tuple[str, str]) -> Iterator[Callable[[], Any]]:
    masters: list[Any] = []

    def opened() -> Any:
        master = pysoem.Master()
        try:
            master.open(veth[1])
        except ConnectionError as error:
            pytest.skip(f"pysoem cannot open {veth[1]}: {error}")
        masters.append(master)
        return master

    yield opened
    for master in masters:
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


T = TypeVar("T")


def patiently(call: Callable[[], T]) -> T:
    """What `call` gives, tried again while pysoem runs out of its own short patience on a busy machine."""
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            return call()
        except (pysoem.WkcError, pysoem.SdoInfoError, pysoem.ConfigMapError) as error:
            if time.monotonic() > end:
                raise AssertionError("still failing") from error


def read(slave: Any, index: int, subindex: int) -> bytes:
    data: bytes = patiently(lambda: slave.sdo_read(index, subindex))
    return data


def write(slave: Any, index: int, subindex: int, data: bytes) -> None:
    patiently(lambda: slave.sdo_write(index, subindex, data))


def find(master: Any, count: int) -> None:
    """config_init until all slaves are there."""
    end = time.monotonic() + _PATIENCE
    while (found := master.config_init()) != count:
        assert time.monotonic() < end, f"{found} slaves instead of {count}"


def reach_op(master: Any) -> None:
    master.state = pysoem.OP_STATE
    master.write_state()
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        exchange(master)
        if master.state_check(pysoem.OP_STATE, 20_000) == pysoem.OP_STATE:
            return
    pytest.fail("OP not reached")


def bring_up(master: Any, count: int = 1) -> None:
    find(master, count)
    patiently(master.config_map)
    for slave in master.slaves:
        patiently(
            functools.partial(slave._fpwr, 0x0420, b"\0\0")
        )  # no watchdog: this machine may stand still for longer
    assert master.state_check(pysoem.SAFEOP_STATE, 2_000_000) == pysoem.SAFEOP_STATE
    reach_op(master)


@pytest.mark.parametrize("size", [61, 77])
def test_to_op_with_the_clock_signal(
    size: int, veth: tuple[str, str], start: Start, open_master: Callable[[], Any]
) -> None:
    start(veth[0], "--pdo", str(size), "--signal", "clock", "--serial", "42")
    master = open_master()
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


def test_the_whole_dictionary(veth: tuple[str, str], start: Start, open_master: Callable[[], Any]) -> None:
    start(veth[0], "--pdo", "77")
    master = open_master()
    bring_up(master)
    slave = master.slaves[0]
    entries = entries_of(77)
    sizes = {}
    for (index, subindex), row in entries.items():
        data = read(slave, index, subindex)
        assert len(data) == (row.type.size or len(data))
        sizes[index, subindex] = len(data) * 8
    for (index, subindex), row in entries.items():
        if row.access is Access.RW_PREOP:
            value = read(slave, index, subindex)
            with pytest.raises(pysoem.SdoError) as caught:
                write(slave, index, subindex, value)
            assert caught.value.abort_code == 0x08000022
    # Last, because the gap at 0x6000:03 leaves an error in SOEM's ring that the next call would raise.
    variables, parts = set(), {}
    for thing in patiently(lambda: slave.od):
        variables.add((thing.index, 0))
        for number, entry in enumerate(patiently(functools.partial(getattr, thing, "entries"))):
            if (thing.index, number) in entries:
                parts[thing.index, number] = entry.bit_length
    assert variables | set(parts) == set(entries)
    assert all(sizes[address] == bits for address, bits in parts.items())


def test_configuration_in_preop(veth: tuple[str, str], start: Start, open_master: Callable[[], Any]) -> None:
    start(veth[0])
    master = open_master()
    find(master, 1)

    def configure(position: int) -> None:
        slave = master.slaves[position]
        write(slave, 0x8006, 4, b"\0")
        write(slave, 0x8006, 1, struct.pack("<H", 128))

    master.slaves[0].config_func = configure
    patiently(master.config_map)
    assert read(master.slaves[0], 0x8011, 0) == struct.pack("<H", 400)
    with pytest.raises(pysoem.SdoError) as caught:
        read(master.slaves[0], 0x8003, 1)
    assert caught.value.abort_code == 0x06020000


def test_a_chain_of_three(veth: tuple[str, str], start: Start, open_master: Callable[[], Any]) -> None:
    start(veth[0], "--sensors", "3", "--model", "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8", "--signal", "constant")
    master = open_master()
    bring_up(master, 3)
    # Not `slave.name`: SOEM copies the SII of the slave before if vendor, product and revision are the same.
    names = [read(slave, 0x1008, 0).rstrip(b"\0") for slave in master.slaves]
    assert names == [b"BFT-SENS-ECAT-M8", b"BFT-ROKS-ECAT-M8", b"BFT-ROKS-ECAT-M8"]
    assert exchange(master) == master.expected_wkc == 9
    assert len({slave.input for slave in master.slaves}) == 1
    serials = [struct.unpack("<I", read(slave, 0x1018, 4))[0] for slave in master.slaves]
    assert serials == [1, 2, 3]


def test_a_power_cycle_is_recovered_from(
    veth: tuple[str, str], start: Start, open_master: Callable[[], Any]
) -> None:
    sensor = start(veth[0], "--sensors", "2")
    master = open_master()
    bring_up(master, 2)
    assert sensor.command("power off @1") == "ok"
    assert exchange(master) == 3
    assert sensor.command("power on @1") == "ok"
    slave = master.slaves[1]
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        exchange(master)
        master.read_state()
        if slave.state == pysoem.OP_STATE and exchange(master) == 6:
            break
        if slave.state == pysoem.SAFEOP_STATE + pysoem.STATE_ERROR:
            slave.state = pysoem.SAFEOP_STATE + pysoem.STATE_ACK
            slave.write_state()
        elif slave.state == pysoem.SAFEOP_STATE:
            slave.state = pysoem.OP_STATE
            slave.write_state()
        elif slave.state > pysoem.NONE_STATE:
            slave.reconfig(100_000)
        else:
            slave.recover(100_000)
    else:
        pytest.fail("not recovered")


def test_safeop_with_error_is_seen_and_cleared(
    veth: tuple[str, str], start: Start, open_master: Callable[[], Any]
) -> None:
    sensor = start(veth[0])
    master = open_master()
    bring_up(master)
    assert sensor.command("safeop 0x8042") == "ok"
    assert exchange(master) == 1
    master.read_state()
    slave = master.slaves[0]
    assert slave.state == pysoem.SAFEOP_STATE + pysoem.STATE_ERROR
    assert slave.al_status == 0x8042
    slave.state = pysoem.SAFEOP_STATE + pysoem.STATE_ACK
    slave.write_state()
    reach_op(master)
    assert exchange(master) == 3


def test_an_interface_down_for_a_while(
    veth: tuple[str, str], start: Start, open_master: Callable[[], Any]
) -> None:
    start(veth[0])
    for state in ("down", "up"):
        subprocess.run(["ip", "link", "set", veth[0], state], check=True)
    master = open_master()
    bring_up(master)
    assert exchange(master) == 3


def test_the_wire_is_quiet_when_told(
    veth: tuple[str, str], start: Start, open_master: Callable[[], Any]
) -> None:
    sensor = start(veth[0])
    sensor.command("deaf")
    master = open_master()
    assert master.config_init() == -1
    sensor.command("hear")
    bring_up(master)
    answer = json.loads(sensor.command("stats").removeprefix("ok "))
    assert answer["frames_lost"] > 0
    assert answer["sensors"][0]["al_state"] == "OP"
    assert answer["sensors"][0]["calibration_writes"] == 0
