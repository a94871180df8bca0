"""The distributed clock: local and system time, event times, and their faults."""

from __future__ import annotations

import struct

import pytest

from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.virtual_sensor.raw_master import OP, PREOP, RawMaster, chain, do

MS = 1_000_000
PERIOD = 1_250_000
START = 5_000_000_123
LATCH = 0x81  # activate register: enabled, with events


def prepared(dc: str = "", state: int = OP, **options: object) -> RawMaster:
    """A sensor with the signal `clock`, whose SM3 latches events."""
    sensor = SensorOptions(signal="clock", dc=dc, **options)  # type: ignore[arg-type]
    master = RawMaster(sensor, start=START).go(state)
    assert master.write(0x081E, bytes([LATCH])) == 1
    return master


def look(master: RawMaster) -> tuple[int, int, int]:
    """One frame: instant of the sample in its data, system time, event time."""
    answer = master.frame(
        (Command.LRW, 0, 0, bytes(1 + master.pdo_size)),
        (Command.APRD, 0, 0x0910, bytes(4)),
        (Command.APRD, 0, 0x09FC, bytes(4)),
    )
    assert answer is not None
    (data, _), (system, _), (event, counter) = answer
    assert counter == 1
    seconds, us, ns = struct.unpack_from("<fff", data, 1 + 5 + 4)
    instant = int(seconds) * 10**9 + int(us) * 1000 + int(ns)
    return instant, int.from_bytes(system, "little"), int.from_bytes(event, "little")


def test_a_frame_has_one_time_in_all_its_datagrams_and_slaves() -> None:
    """The delay is that of the reference clock to the slave."""
    master = RawMaster(*chain(3), start=START)
    for position in range(3):
        master.write(0x0928, struct.pack("<I", 700 * position), position)
    answer = master.frame(*((Command.APRD, -position, 0x0910, bytes(8)) for position in (0, 1, 2, 0)))
    assert answer is not None
    assert {data for data, _ in answer} == {struct.pack("<Q", master.now - START)}


def test_32_bits() -> None:
    master = RawMaster(SensorOptions(dc="32-bit+at=4294967295"), start=START)
    assert master.read16(0x0008) & 0x0C == 0x04
    assert master.write(0x0920, b"\xff" * 8) == 1
    assert master.read(0x0920, 8) == b"\xff" * 4 + bytes(4)
    assert struct.unpack("<Q", master.read(0x0910, 8))[0] < MS, "it has wrapped"
    assert master.write(0x0924, bytes(4)) == 0


def test_no_distributed_clock() -> None:
    master = prepared("none")
    assert master.read16(0x0008) & 0x0C == 0
    assert master.write(0x0900, bytes(4)) == master.write(0x0910, bytes(4)) == master.write(0x0920, b"1") == 0
    master.wait(10 * MS)
    look(master)
    assert master.read(0x0900, 0x100) == bytes(0x100)
    assert obey(master.bus, "dc late 5").startswith("error: that slave has no distributed clock")


@pytest.mark.parametrize("ppm", [0.0, 180.0, -250.0])
@pytest.mark.parametrize("dc", ["", "ppm=-30+at=4294000000"])
def test_event_times_are_those_of_the_sample_in_the_data(dc: str, ppm: float) -> None:
    """Also across the wrap of the 32 bits, and when several samples came between two frames."""
    master = prepared(dc, ppm=ppm)
    life = master.bus.sensors[0].life
    assert life is not None
    local = life.esc.clock.local
    master.wait(4 * MS)
    made = life.sampler.made
    samples = set()
    for step in (777_777, 100_001, 5 * PERIOD + 333):
        for _ in range(40):
            master.wait(step)
            began = master.now + 1000
            instant, system, change = look(master)
            samples.add(instant)
            assert system == local.at(began) & 0xFFFFFFFF
            following = life.sampler.clock.instant(life.sampler.number_at(instant) + 1)
            if began < following < master.bus.now:  # it came within the frame, behind the data
                instant = following
            assert change == local.at(instant) & 0xFFFFFFFF
    assert life.sampler.made - made == len(samples), "no sample was computed twice"


def test_events_are_latched_from_safeop_on_if_the_activate_register_says_so() -> None:
    master = RawMaster(SensorOptions(signal="clock"), start=START).go(OP)
    master.wait(3 * MS)
    assert look(master)[2] == 0
    assert master.write(0x081E, bytes([LATCH])) == 1
    instant = look(master)[0]
    assert look(master)[2] == 0, "the sample came before"
    master.wait(PERIOD)
    assert look(master)[2] == instant + PERIOD - START
    before = look(master)[2]
    for change in (lambda: master.write(0x081E, b"\x01"), lambda: master.request(PREOP)):
        change()
        master.wait(5 * MS)
        assert master.read(0x09FC, 4) == before.to_bytes(4, "little")


def test_a_skipped_sample_is_no_event_and_a_repeated_one_is() -> None:
    master, changes = prepared(), set()
    do(master, "skip 60")
    for _ in range(50):
        master.wait(PERIOD)
        instant, _, change = look(master)
        assert change == instant - START
    do(master, "skip 0", "stick")
    for _ in range(10):
        master.wait(PERIOD)
        changes.add(look(master)[2])
    assert len(changes) == 10


def test_faults_of_the_event_times() -> None:
    master = prepared()
    number = 0

    def off(fault: str) -> int:
        """What is added to the time, in a frame in the middle between two samples."""
        nonlocal number
        do(master, f"dc {fault}")
        number += 2
        master.wait(START + 10 * MS + number * PERIOD + PERIOD // 2 - master.now)
        instant, _, change = look(master)
        return change - (instant - START)

    for fault, found in (("late 50.5", 50_500), ("ok", 0), ("late -7", -7000), ("ok", 0)):
        assert off(fault) == found
    assert [off(fault) for fault in ("stuck", "stuck", "ok")] == [-2 * PERIOD, -4 * PERIOD, 0]
    do(master, "dc no-events")
    master.wait(10 * MS)
    assert look(master)[2] == 0
    stuck, shown = prepared("stuck"), set()
    for _ in range(10):
        stuck.wait(PERIOD)
        shown.add(look(stuck)[2])
    assert len(shown - {0}) == 1, "from power-on: the first event"


def test_faults_of_the_local_clock() -> None:
    master = prepared()
    master.wait(3 * MS)
    change = look(master)[2]
    do(master, "dc at 5000000000")
    _, system, event = look(master)
    assert event == change, "of the time before the jump"
    assert abs(system - (5_000_000_000 & 0xFFFFFFFF)) < 10_000
    do(master, "dc ppm 100")
    before = look(master)[1]
    master.wait(10 * MS - 1000)
    assert look(master)[1] - before in range(10 * MS + 500, 10 * MS + 12_000)
    do(master, "power cycle 0")
    master.wait(1)
    assert look(master)[2] == 0, "all is as in the options again"
