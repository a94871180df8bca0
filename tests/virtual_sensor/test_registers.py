"""Registers, addressing and working counters."""

import struct

import pytest

from ethercat_server.ethercat.wire import Command
from tests.virtual_sensor.raw_master import OP, PREOP, SAFEOP, RawMaster, chain, fmmu


@pytest.mark.parametrize("register", [0x0000, 0x0008, 0x0012, 0x0110, 0x0130, 0x0134, 0x0140, 0x0220, 0x0904])
def test_read_only_registers_ignore_writes(register: int) -> None:
    master = RawMaster()
    before = master.read(register, 2)
    assert master.write(register, b"\xff\xff") == 0
    assert master.read(register, 2) == before


def test_what_commands_count() -> None:
    master = RawMaster().go(PREOP)
    assert master.one(Command.APRD, 0, 0x8000, b"ab") == (b"ab", 0), "beyond memory"
    assert master.one(Command.APRW, 0, 0x0F80, b"new!") == (bytes(4), 3)
    assert master.one(Command.BRW, 0, 0x0F80, b"\1\1\1\1")[1] == 3
    assert master.read(0x0F80, 4) == b"\1\1\1\1"
    assert master.frame((Command.NOP, 0, 0x0130, b"\0"), (15, 0, 0x0130, b"\0")) == [(b"\0", 0)] * 2
    assert master.one(Command.APRW, 0, 0x1000, b"") == (b"", 0), "no data"


@pytest.mark.parametrize(("command", "address"), [(Command.ARMW, -1), (Command.FRMW, 0x1002)])
def test_read_multiple_write(command: int, address: int) -> None:
    """The slaves behind the one that is read get what it has, those before it what the master sent."""
    master = RawMaster(*chain(3))
    master.write(0x0010, b"\x02\x10", 1)
    master.write(0x0F80, b"\xaa", 1)
    data, counter = master.one(command, address, 0x0F80, b"\x11")
    assert (data, counter) == (b"\xaa", 3)
    assert [master.read(0x0F80, 1, position) for position in range(3)] == [b"\x11", b"\xaa", b"\xaa"]
    for missed in (-3, 1):
        assert master.one(Command.APRD, missed, 0x0F80, b"\0") == (b"\0", 0)


def test_process_data_by_fmmu() -> None:
    master = RawMaster(*chain(2, signal="constant", last_bit=False)).go(OP)
    data, counter = master.cycle()
    assert counter == 6
    assert data[1:62] == data[63:124]
    assert struct.unpack_from("<f", data, 1 + 5) == (1.5,)
    assert master.one(Command.LRD, 1, 0, bytes(61)) == (data[1:62], 1)
    assert master.one(Command.LWR, 0, 0, b"\1")[1] == 1
    assert master.one(Command.LRW, 0x1000, 0, bytes(4)) == (bytes(4), 0)
    master.write(0x0600, fmmu(0, 1, 0x1100, 2) + fmmu(0, 61, 0x1180, 1))
    shared, counter = master.one(Command.LRW, 0, 0, b"\x07" + bytes(60))
    assert (shared[1:], counter) == (data[2:62], 3), "inputs and outputs may share logical addresses"
    assert master.upload(0x7000, 0) == b"\x07"


def test_process_data_needs_the_state() -> None:
    master = RawMaster().go(PREOP)
    master.set_up_process_data()
    assert master.cycle()[1] == 0
    master.request(SAFEOP)
    assert master.cycle(output=9)[1] == 3
    assert master.upload(0x7000, 0) == b"\0", "outputs are not taken in SAFEOP"
    master.request(OP)
    assert master.cycle(output=9)[1] == 3
    assert master.upload(0x7000, 0) == b"\x09"


def test_a_buffer_is_read_as_a_whole_and_in_its_direction() -> None:
    master = RawMaster().go(OP)
    for start, size, counted in ((0x1180, 61, 1), (0x1180, 20, 0), (0x1181, 60, 0), (0x117F, 62, 0)):
        assert master.one(Command.APRD, 0, start, bytes(size))[1] == counted
    assert master.one(Command.APRD, 0, 0x1100, b"x") == (b"x", 0)
    assert master.write(0x1180, bytes(61)) == 0


def test_an_enabled_sync_manager_keeps_its_area() -> None:
    master = RawMaster().go(PREOP)
    master.write(0x0800, struct.pack("<HH", 0x1400, 64))
    assert master.read(0x0800, 4) == struct.pack("<HH", 0x1000, 128)
