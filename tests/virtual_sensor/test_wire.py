"""Frames: parsing, and what hostile ones do (nothing)."""

import struct

from hypothesis import given, settings
from hypothesis import strategies as st

from ethercat_server.ethercat import wire
from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.options import SensorOptions, parse_chain, slaves_in
from tests.virtual_sensor.raw_master import INIT, OP, RawMaster, do

DATAGRAMS = st.lists(
    st.tuples(
        st.integers(0, 20),
        st.sampled_from([0, 1, 0xFFFF, 0x1001]),
        st.one_of(st.integers(0, 0xFFFF), st.sampled_from([0x0120, 0x0500, 0x0600, 0x0800, 0x1000, 0x1080])),
        st.binary(max_size=140),
    ),
    min_size=1,
    max_size=8,
)


def test_what_is_built_is_parsed() -> None:
    frame = wire.build((Command.BRD, 0, 0x0130, b"ab"), (Command.LRW, 2, 1, b"xyz"))
    first, second = wire.parse(frame, len(frame))
    assert (first.command, first.ado, first.length) == (Command.BRD, 0x0130, 2)
    assert bytes(frame[second.data : second.end]) == b"xyz"
    assert (second.adp, second.ado, second.number) == (2, 1, 1)
    assert wire.parse(frame, len(frame) - 1) == [], "its header promises more"
    frame[12:14] = b"\x08\x00"
    assert wire.parse(frame, len(frame)) == [], "another Ethernet type"


def test_a_broken_datagram_leaves_those_before_it_alone() -> None:
    master = RawMaster()
    frame = wire.build((Command.BRD, 0, 0x0130, bytes(2)), (Command.BRD, 0, 0x0130, bytes(2)))
    second = wire.parse(frame, len(frame))[1]
    struct.pack_into("<H", frame, second.header + 6, 0x07FF)
    assert master.bus.process(frame, len(frame), master.now)
    assert frame[second.header - 2 : second.header] == b"\1\0"
    assert frame[second.data : second.end + 2] == bytes(4)


@given(st.binary(max_size=200))
def test_noise_never_crashes_it(noise: bytes) -> None:
    master = RawMaster()
    for head in (b"", b"\xff" * 12 + b"\x88\xa4"):
        frame = bytearray(head + noise)
        before = len(frame)
        master.bus.process(frame, before, master.now)
        assert len(frame) == before


@settings(max_examples=60, deadline=None)
@given(st.lists(DATAGRAMS, min_size=1, max_size=4), st.integers(0, 2))
def test_hostile_datagrams_never_crash_it(frames: list[list[tuple[int, int, int, bytes]]], chop: int) -> None:
    master = RawMaster(SensorOptions(), *slaves_in(parse_chain("EK1100:OP,EL3102:PREOP,DRIVE:OP")))
    master.count = 1
    master.go(OP)
    master.write(0x0010, b"\x01\x10")
    for datagrams in frames:
        frame = wire.build(*datagrams)
        del frame[len(frame) - chop :]
        size = len(frame)
        master.bus.process(frame, size, master.now)
        master.wait(1_000_000)
        assert len(frame) == size
    for place in range(1, 4):
        do(master, f"power cycle 0 #{place}")
    master.wait(1)
    assert [master.read16(0x0130, place) for place in range(1, 4)] == [INIT] * 3
    # Whatever they did, a master that starts afresh is served.
    master.write(0x0600, bytes(48))
    master.write(0x0500, b"\2")
    master.write(0x0500, b"\0")
    master.write(0x0800, bytes(32))
    assert master.request(0x11)[0] == 1
    assert master.request(0x11) == (1, 0)
    master.go(OP)
    assert master.cycle()[1] == 3
