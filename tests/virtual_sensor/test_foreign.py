"""Foreign slaves on the virtual bus: start-up, objects, the drive, states left by another master."""

from __future__ import annotations

import struct

import pytest

from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.registers import pack_sync_manager as sync_manager
from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.foreign import ForeignSlave
from ethercat_server.virtual_sensor.options import KINDS, parse_chain, slaves_in
from tests.virtual_sensor.raw_master import INIT, OP, PREOP, SAFEOP, RawMaster, do, fmmu

MS = 1_000_000
ERROR = 0x10
OUTPUTS, INPUTS = 0x1100, 0x1180


def master_of(text: str) -> RawMaster:
    return RawMaster(*slaves_in(parse_chain(text)))


def foreign(master: RawMaster, place: int = 0) -> ForeignSlave:
    slave = master.bus.slaves[place]
    assert isinstance(slave, ForeignSlave)
    return slave


def drive_in(state: int) -> RawMaster:
    master = master_of("DRIVE")
    master.set_up_mailbox()
    assert master.request(PREOP) == (PREOP, 0)
    if state > PREOP:
        master.write(0x0810, sync_manager(OUTPUTS, 6, 0x64) + sync_manager(INPUTS, 2, 0x20))
        master.write(0x0600, fmmu(0, 6, OUTPUTS, 2) + fmmu(6, 2, INPUTS, 1))
        assert master.request(SAFEOP) == (SAFEOP, 0)
    if state == OP:
        assert master.request(OP) == (OP, 0)
    return master


def exchange(master: RawMaster, controlword: int, velocity: int = 0) -> int:
    """The statusword."""
    data, counter = master.one(Command.LRW, 0, 0, struct.pack("<Hi", controlword, velocity) + bytes(2))
    assert counter == 3
    return int.from_bytes(data[6:], "little")


def test_slaves_are_in_wire_order_and_sensors_numbered_among_themselves() -> None:
    master = master_of("ek1100, BOTA,EL3102,BOTA")
    assert [isinstance(slave, ForeignSlave) for slave in master.bus.slaves] == [True, False, True, False]
    assert [sensor.options.serial for sensor in master.bus.sensors] == [1, 2]
    do(master, "power off @1")
    assert master.bus.slaves[3].life is None
    without = master_of("EK1100,EL3102")
    assert without.one(Command.BRD, 0, 0x0130, bytes(2))[1] == 2
    assert obey(without.bus, "stick").startswith("error: that slave is no sensor")


def test_what_a_slave_needs_for_its_states() -> None:
    coupler = master_of("EK1100")
    for state in (PREOP, SAFEOP, OP, INIT):
        assert coupler.request(state) == (state, 0), "nothing"
    assert coupler.request(OP) == (INIT | ERROR, 0x0011)
    assert master_of("DRIVE").request(PREOP)[1] == 0x0016
    drive = drive_in(PREOP)
    assert drive.request(SAFEOP)[1] == 0x001D
    drive.write(0x0810, sync_manager(OUTPUTS, 6, 0x64) + sync_manager(INPUTS, 61, 0x20))
    assert drive.request(SAFEOP | ERROR)[1] == 0x001E


def test_objects_of_a_terminal() -> None:
    master = master_of("EL3102")
    master.set_up_mailbox()
    master.request(PREOP)
    assert master.upload(0x1008, 0) == b"EL3102"
    assert [master.upload(0x1C13, n) for n in (1, 2)] == [b"\x00\x1a", b"\x01\x1a"]
    assert [master.upload(0x1A01, n).hex() for n in (1, 2)] == ["08010231", "10020231"]
    master.write(0x0818, sync_manager(INPUTS, 6, 0x20))
    assert master.request(SAFEOP) == (SAFEOP, 0)
    values = []
    for _ in range(4):
        master.wait(250 * MS)
        values.append(struct.unpack("<BhBh", master.read(INPUTS, 6))[1])
    assert (min(values), max(values)) == (-0x4000, 0x4000), "5 V, of 10 V"


def test_a_drive_turns_when_enabled_and_while_process_data_comes() -> None:
    master = drive_in(OP)
    assert [exchange(master, word) & 0x6F for word in (0x00, 0x07, 0x0F)] == [0x40, 0x40, 0x27]
    assert not foreign(master).turning
    exchange(master, 0x0F, 1000)
    assert foreign(master).turning
    assert exchange(master, 0x00, 1000) & 0x6F == 0x40
    assert not foreign(master).turning
    exchange(master, 0x0F, 1000)
    for ms, turning in ((99, True), (2, False)):
        master.wait(ms * MS)
        assert foreign(master).turning == turning, "its watchdog's time is 100 ms"
    master.request(SAFEOP | ERROR)
    assert master.request(OP) == (OP, 0)
    assert not foreign(master).turning


@pytest.mark.parametrize("state", [AlState.PREOP, AlState.SAFEOP, AlState.OP])
@pytest.mark.parametrize("kind", ["BOTA", *KINDS])
def test_left_in_a_state_by_another_master(kind: str, state: AlState) -> None:
    master = master_of(f"EK1100,{kind}:{state.name}")
    assert master.one(Command.FPRD, 0x1002, 0x0130, bytes(2)) == (struct.pack("<H", state), 1)
    do(master, "power cycle 0 #1")
    master.wait(1)
    assert master.read16(0x0130, 1) == INIT


def test_a_drive_left_at_work_turns_and_records_what_is_written() -> None:
    master = master_of("EK1100,DRIVE:OP,BOTA:OP,DRIVE:OP")
    drives = foreign(master, 1), foreign(master, 3)
    master.wait(1000 * MS)
    for place in (1, 3):
        assert master.read16(0x0130, place) == OP, "its watchdog waits for outputs"
    assert all(drive.turning for drive in drives)
    assert not any(drive.writes for drive in drives), "reading is no writing"
    # All outputs, then all inputs: the second drive's outputs follow the sensor's.
    assert master.one(Command.LWR, 7, 0, struct.pack("<Hi", 0, 0))[1] == 1
    assert list(drives[1].writes) == [(OUTPUTS, bytes(6))]
    assert not drives[1].turning
    assert drives[0].turning
    assert not drives[0].writes
    master.one(Command.BWR, 0, 0x0120, b"\1\0")
    assert list(drives[0].writes) == [(0x0120, b"\1\0")]
    assert drives[0].write_count == 1


def test_power_and_cable_of_a_place() -> None:
    master = master_of("BOTA,DRIVE:OP,BOTA")
    for line, answering in (("disconnect", 1), ("connect", 3), ("power off", 1), ("power on", 3)):
        do(master, f"{line} #1")
        assert foreign(master, 1).turning == (line in ("disconnect", "connect")), "it has power"
        assert master.one(Command.BRD, 0, 0x0130, bytes(2))[1] == answering
        if line == "connect":
            assert master.read(0x0310, 1, 1) == b"\1"
    assert obey(master.bus, "power off #3").startswith("error: ")
    do(master, "error 0x1E #1")
    assert master.read16(0x0134, 1) == 0x001E
