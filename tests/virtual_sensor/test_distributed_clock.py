"""The distributed clock: local and system time, the control loop, event times, and their faults."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import pytest

from ethercat_server.ethercat.wire import Command
from ethercat_server.virtual_sensor.distributed_clock import _deviation
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.virtual_sensor.raw_master import OP, PREOP, SAFEOP, RawMaster, chain, do

MS = 1_000_000
PERIOD = 1_250_000
WRITE = 12_000
START = 5_000_000_123
LATCH = 0xC1  # activate register: enabled, with both kinds of events


def prepared(dc: str = "", state: int = OP, **options: object) -> RawMaster:
    """A sensor with the signal `clock`, whose SM3 latches events."""
    sensor = SensorOptions(signal="clock", dc=dc, **options)  # type: ignore[arg-type]
    master = RawMaster(sensor, start=START).go(state)
    assert master.write(0x081E, bytes([LATCH])) == 1
    return master


def look(master: RawMaster) -> tuple[int, int, int, int, int]:
    """One frame: instant of the sample in its data, system time, the three event times."""
    answer = master.frame(
        (Command.LRW, 0, 0, bytes(1 + master.pdo_size)),
        (Command.APRD, 0, 0x0910, bytes(4)),
        (Command.APRD, 0, 0x09F0, bytes(16)),
    )
    assert answer is not None
    (data, _), (system, _), (events, counter) = answer
    assert counter == 1
    seconds, us, ns = struct.unpack_from("<fff", data, 1 + 5 + 4)
    instant = int(seconds) * 10**9 + int(us) * 1000 + int(ns)
    ecat, start, change = struct.unpack("<I4xII", events)
    return instant, int.from_bytes(system, "little"), ecat, start, change


def looks(master: RawMaster, count: int, step: int = 777_777) -> Iterator[tuple[int, int, int, int, int]]:
    for _ in range(count):
        master.wait(step)
        yield look(master)


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


@pytest.mark.parametrize(("step", "frames", "close"), [(PERIOD, 1600, 50), (20 * MS, 1000, 1000)])
def test_drift_compensation_steers_the_local_clock(step: int, frames: int, close: int) -> None:
    """The first slave is the reference; the second is 70 ppm off, and 30 µs behind."""
    master = RawMaster(SensorOptions(dc="ppm=20"), SensorOptions(serial=2, dc="ppm=-50+at=0"), start=START)
    master.write(0x0920, struct.pack("<QI", 2**64 - 30_000, 700), 1)
    assert master.write(0x0930, struct.pack("<H", 0x1000), 1) == 1
    local = [slave.life.esc.clock.local for slave in master.bus.sensors if slave.life]
    apart: list[int] = []
    for _ in range(frames):
        master.wait(step)
        assert master.one(Command.ARMW, 0, 0x0910, bytes(4))[1] == 2
        apart.append(local[1].at(master.now) - local[0].at(master.now) - 30_000)
    assert apart[0] < -29_000
    assert all(abs(ns) < close for ns in apart[-10:])
    counter = struct.unpack("<h", master.read(0x0932, 2, 1))[0]
    assert _deviation(counter, 0x1000) == pytest.approx(70e-6, abs=1e-6)
    master.write(0x0930, struct.pack("<H", 0x1000), 1)
    assert master.read(0x092C, 4, 1) + master.read(0x0932, 2, 1) == bytes(6)
    now = master.now
    assert local[1].at(now + 10**9) - local[1].at(now) == 10**9 - 50_000, "its own rate again"


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
            instant, system, ecat, start, change = look(master)
            samples.add(instant)
            assert system == ecat == local.at(began) & 0xFFFFFFFF
            following = life.sampler.clock.instant(life.sampler.number_at(instant) + 1)
            if began < following < master.bus.now:  # it came within the frame, behind the data
                instant, following = following, following + PERIOD
            assert change == local.at(instant) & 0xFFFFFFFF
            assert start in {local.at(i - WRITE) & 0xFFFFFFFF for i in (instant, following)}
    assert life.sampler.made - made == len(samples), "no sample was computed twice"


def test_the_next_sample_may_come_within_the_frame() -> None:
    """The events are read some µs after the data."""
    master = prepared()
    instant = look(master)[0]
    after = 4 * PERIOD - 11_500  # its write has begun
    master.wait(instant + after - master.now)
    assert look(master)[3:] == (instant + 4 * PERIOD - WRITE - START, instant + 3 * PERIOD - START)
    master.wait(instant + 4 * PERIOD - 4000 - master.now)
    shown, _, ecat, _, change = look(master)
    assert (shown, change) == (instant + 3 * PERIOD, instant + 4 * PERIOD - START)
    assert ecat < change


def test_only_what_the_activate_register_says_is_latched() -> None:
    master = RawMaster(SensorOptions(signal="clock"), start=START).go(OP)
    master.wait(3 * MS)
    assert look(master)[2:] == (0, 0, 0)
    assert master.write(0x081E, b"\x41") == 1
    master.wait(3 * MS)
    _, system, *events = look(master)
    assert events == [system, 0, 0]
    assert master.write(0x081E, b"\x81") == 1
    instant = look(master)[0]
    assert look(master)[3:] == (0, 0), "the sample came before"
    master.wait(PERIOD)
    assert look(master)[2:] == (system, *(instant + PERIOD - START - ns for ns in (WRITE, 0)))
    assert master.write(0x081E, b"\x01") == 1
    before = look(master)[2:]
    master.wait(5 * MS)
    assert look(master)[2:] == before


def test_there_are_no_events_before_safeop() -> None:
    master = RawMaster(SensorOptions(signal="clock"), start=START).go(PREOP)
    master.set_up_process_data()
    assert master.write(0x081E, bytes([LATCH])) == 1
    master.wait(10 * MS)
    assert master.read(0x09F0, 16) == bytes(16)
    assert master.request(SAFEOP) == (SAFEOP, 0)
    began = master.now - START
    master.wait(10 * MS)
    assert look(master)[4] > began
    assert master.request(PREOP) == (PREOP, 0)
    before = master.read(0x09F0, 16)
    master.wait(10 * MS)
    assert master.read(0x09F0, 16) == before


def test_outputs_and_mailboxes_latch_too() -> None:
    master = RawMaster(start=START).go(OP)
    for manager in range(2):
        assert master.write(0x0806 + 8 * manager, bytes([LATCH])) == 1
    assert master.upload(0x1000, 0)
    assert 0 < struct.unpack("<I", master.read(0x09F0, 4))[0] < master.now - START
    assert master.write(0x0816, bytes([LATCH])) == 1
    frame = look(master)
    assert frame[2] == frame[1]
    assert all(0 < taken - frame[1] < 5000 for taken in frame[3:]), "within the frame that brought them"


def test_a_skipped_sample_is_no_event_and_a_repeated_one_is() -> None:
    master = prepared()
    do(master, "skip 60")
    assert all(change == instant - START for instant, _, _, _, change in looks(master, 50, PERIOD))
    do(master, "skip 0", "stick")
    assert len({change for *_, change in looks(master, 10, PERIOD)}) == 10


def test_faults_of_the_event_times() -> None:
    master = prepared()
    number = 0

    def off(fault: str) -> tuple[int, int]:
        """What is added to the times of start and end, in a frame in the middle between two samples."""
        nonlocal number
        do(master, f"dc {fault}")
        number += 2
        master.wait(START + 10 * MS + number * PERIOD + PERIOD // 2 - master.now)
        instant, _, _, start, change = look(master)
        return start + WRITE - (instant - START), change - (instant - START)

    for fault, found in (
        ("late 50.5", (50_500, 50_500)),
        ("late -7", (-7000, -7000)),
    ):
        assert off(fault) == found
        assert off("ok") == (0, 0)
    assert [off(fault) for fault in ("ok", "stuck", "stuck", "ok")] == [
        (0, 0), (0, -2 * PERIOD), (0, -4 * PERIOD), (0, 0)
    ]  # fmt: skip
    do(master, "dc no-events")
    master.wait(10 * MS)
    assert look(master)[2:] == (0, 0, 0)
    frames = list(looks(prepared("stuck"), 10, PERIOD))
    assert len({change for *_, change in frames[1:]} - {0}) == 1, "from power-on: the first event"
    assert len({start for *_, start, _ in frames}) == 10


def test_faults_of_the_local_clock() -> None:
    master = prepared()
    master.wait(3 * MS)
    *_, change = look(master)
    do(master, "dc at 5000000000")
    later = look(master)
    assert later[3:] == (change - WRITE, change), "of the time before the jump"
    assert abs(later[1] - (5_000_000_000 & 0xFFFFFFFF)) < 10_000
    do(master, "dc ppm 100")
    first, second = looks(master, 2, 10 * MS - 1000)
    assert second[1] - first[1] in range(10 * MS + 1000, 10 * MS + 12_000)
    do(master, "power cycle 0")
    master.wait(1)
    assert not any(look(master)[2:]), "all is as in the options again"
