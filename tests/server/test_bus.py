"""Datagrams and exchanges on a wire in memory: answers matched by index, late and foreign frames dropped."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence
from typing import cast

import pytest

from bota_ethercat.framing import DataFlag
from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.ethercat.backend import Backend
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.exchange import DUPLICATE, FIRST_INDEX, MOST_IN_FLIGHT, read_clock
from ethercat_server.ethercat.exchange import Exchange as Taken
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import DATAGRAM_INDEX, Command, build, parse
from ethercat_server.sampling.observation import DistributedClock
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine, SimulatedClock
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.sensor import Firmware
from tests.simulation import Simulation, asked, check_frames, fresh, life_of, more_if_long

STATION = 0x1001
LRW_OR_NOT = pytest.mark.parametrize("lrw", [True, False], ids=["LRW", "LRD and LWR"])
INDICES = 0x100 - FIRST_INDEX
Answer = Callable[[bytearray], list[bytes]]


def take_lrw_away(life: Firmware) -> None:
    """Let it have a controller that does not know LRW."""
    life.esc.has_lrw = False
    life.esc.memory[reg.FEATURES + 1] |= reg.NO_LRW >> 8


class ScriptedWire:
    """A wire on which every frame is answered as a test says; waiting takes simulated time only."""

    ifname = "scripted"

    def __init__(self, answer: Answer = lambda _: []) -> None:
        self.clock = SimulatedClock(Machine(wake_ns=0))
        self.answer = answer
        self.sent: list[bytes] = []
        self._coming: list[bytes] = []

    def send(self, frame: bytearray) -> None:
        self.sent.append(bytes(frame))
        self._coming += self.answer(bytearray(frame))

    def receive(self, timeout_s: float) -> bytes | None:
        if self._coming:
            return self._coming.pop(0)
        self.clock.sleep(max(timeout_s, 0))
        return None


def scripted(answer: Answer = lambda _: []) -> tuple[Bus, ScriptedWire]:
    wire = ScriptedWire(answer)
    bus = Bus(cast(Backend, wire))
    bus.stations = [STATION]
    return bus, wire


def done(frame: bytearray, data: bytes = b"", wkc: int = 1) -> bytes:
    """The frame as it comes back from slaves that did what it asks."""
    datagram = parse(frame, len(frame))[0]
    frame[datagram.data : datagram.data + len(data)] = data
    frame[datagram.end : datagram.end + 2] = wkc.to_bytes(2, "little")
    return bytes(frame)


def test_what_is_on_the_wire_is_a_datagram_of_the_standard() -> None:
    bus, wire = scripted()
    assert not bus.finish(bus.write_register(0, 0x0120, b"\x02\x00"))
    (frame,) = wire.sent
    assert frame[12:14] == b"\x88\xa4"
    assert len(frame) == 60
    assert int.from_bytes(frame[14:16], "little") == 0x1000 | 14
    assert frame[16] == Command.FPWR
    assert frame[18:24] == STATION.to_bytes(2, "little") + b"\x20\x01" + b"\x02\x00"
    assert frame[26:30] == b"\x02\x00\x00\x00", "data, then the working counter"
    bus.finish(bus.read_at(3, 0x0130, 2))
    assert wire.sent[1][16:20] == bytes((Command.APRD, wire.sent[1][17], 0xFD, 0xFF)), "minus the position"


def test_a_slave_that_did_not_do_it_and_a_lost_frame_are_no_answer() -> None:
    for answer, nothing in ((lambda frame: [done(frame, wkc=0)], b""), (lambda _: [], None)):
        bus, _ = scripted(answer)
        assert not bus.finish(bus.write_register(0, 0x1000, b"\1"))
        assert bus.finish(bus.read_register(0, 0x0130, 2)) == nothing
    assert bus.count_slaves() == 0


def test_the_clock_of_a_slave_is_what_its_master_set_and_the_way_through_all_its_links() -> None:
    """A delay is part of the offset; a port without a link, or a time that cannot be, is no way."""
    registers = {
        reg.DC_OFFSET: struct.pack("<QI", 5_000_000_000, 300),
        reg.DC_RECEIVE_TIMES: struct.pack("<4I", 0xFFFFFF00, 0x300, 0x500, 0x700),
    }

    def read(links: int) -> DistributedClock | None:
        def answer(frame: bytearray) -> list[bytes]:
            ado = parse(frame, len(frame))[0].ado
            return [done(frame, {**registers, reg.DL_STATUS: links.to_bytes(2, "little")}[ado])]

        bus, _ = scripted(answer)
        return bus.finish(read_clock(bus, 0, 100))

    found = read(0b0111 << 4)
    assert found is not None
    assert found[:2] == ((5_000_000_000 - 300) % 2**32, 0x600)
    for links, loop_ns in ((0b0011, 0x400), (0b1111, 0x800), (0b0001, 0)):
        found = read(links << 4)
        assert found is not None
        assert found.loop_delay_ns == loop_ns
    registers[reg.DC_RECEIVE_TIMES] = struct.pack("<4I", 0, 0x300, 1_000_000, 0)
    found = read(0b0111 << 4)
    assert found is not None
    assert found.loop_delay_ns == 0x300


def foreign_frames() -> list[bytes]:
    soem = bytes(build((Command.LRW, 0, 0, b"\4\0"), first_index=3).ljust(60, b"\0"))
    short = b"\xff" * 6 + b"\x01" * 6 + b"\x88\xa4"
    other = bytes(build((Command.FPRD, STATION, 0x0130, b"\4\0\0"), first_index=0x81).ljust(60, b"\0"))
    return [soem, short, b"", other, bytes(60)]


def test_neither_late_nor_foreign_frames_are_taken_for_the_answer() -> None:
    late: list[bytes] = []

    def answer(frame: bytearray) -> list[bytes]:
        answers = [*late, *foreign_frames(), done(frame, b"\x02\x00")]
        late[:] = [done(frame, b"\x04\x00")]
        return answers

    bus, _ = scripted(answer)
    assert [bus.finish(bus.read_register(0, 0x0130, 2)) for _ in range(5)] == [b"\x02\x00"] * 5


def test_duplicates_of_answers_are_not_taken_for_those_of_other_registers() -> None:
    """However late: when the index is in use again."""
    duplicates: list[bytes] = []

    def answer(frame: bytearray) -> list[bytes]:
        duplicates.append(done(frame, bytes(frame[18:22])))
        return [*duplicates[-20:], duplicates[-1]]

    bus, wire = scripted(answer)
    bus.stations += [STATION + 1]
    for ado in range(0x0100, 0x0180, 2):
        for number in (0, 1):
            found = bus.finish(bus.read_register(number, ado, 4))
            assert found == (STATION + number).to_bytes(2, "little") + ado.to_bytes(2, "little")
    assert len(wire.sent) == 128


def test_indices_are_none_of_soems() -> None:
    bus, wire = scripted()
    for _ in range(300):
        bus.finish(bus.read_register(0, 0x0130, 2))
    assert {frame[17] for frame in wire.sent} == set(range(0x80, 0x90))


def operational() -> tuple[Bus, MemoryBackend]:
    bus = Bus(backend := MemoryBackend())
    bring_up(bus, asked(), lambda: None)
    backend.become(Machine(frame_jitter_ns=0))
    return bus, backend


def answers(bus: Bus, backend: MemoryBackend) -> bytes:
    """The answer to an exchange of `bus`, not taken yet."""
    bus.process_data.send()
    answer = backend.receive(0.01)
    assert answer is not None
    return answer


def awaited(exchange: Taken | None) -> Taken:
    """An answer that was awaited, and was not taken before."""
    assert exchange is not None
    assert exchange is not DUPLICATE
    return exchange


def test_an_answer_that_comes_again_is_a_duplicate_until_its_index_is_in_use_again() -> None:
    bus, backend = operational()
    process_data = bus.process_data
    answer = answers(bus, backend)
    assert awaited(process_data.match(answer, 1))
    assert process_data.match(answer, 1) is process_data.match(answer, 1) is DUPLICATE
    for _ in range(INDICES):
        later = answers(bus, backend)
        assert process_data.match(answer, 1) in (DUPLICATE, None)
        assert awaited(process_data.match(later, 1))
        assert process_data.match(later, 1) is DUPLICATE
    assert process_data.in_flight == process_data.lost == 0


def test_an_answer_whose_index_is_in_use_again_is_not_taken_for_the_later_one() -> None:
    bus, backend = operational()
    process_data = bus.process_data
    late = answers(bus, backend)
    backend.clock.sleep(0.2)
    assert process_data.lost == 1
    for _ in range(INDICES - 1):
        assert awaited(process_data.match(answers(bus, backend), 1))
    current = answers(bus, backend)
    assert current[DATAGRAM_INDEX] == late[DATAGRAM_INDEX]
    assert process_data.match(late, 1) is None
    assert awaited(process_data.match(current, 1)).frame == current
    assert process_data.duplicates == 0, "it was given up, not taken"


def test_exchanges_are_counted_when_they_are_sent_and_when_they_are_answered() -> None:
    bus, backend = operational()
    process_data = bus.process_data
    sent, answered = process_data.sent, process_data.answered
    answers(bus, backend)  # which is not taken: its index stays in use for 100 ms
    for _ in range(INDICES + 5):
        assert awaited(process_data.match(answers(bus, backend), 1))
    assert process_data.sent - sent == INDICES + 6
    assert process_data.answered - answered == INDICES + 5
    backend.clock.sleep(0.2)
    assert (process_data.lost, process_data.answered - answered) == (1, INDICES + 5), "a lost one is none"
    for _ in range(2 * MOST_IN_FLIGHT):
        process_data.send()
    assert process_data.in_flight == MOST_IN_FLIGHT
    assert process_data.sent - sent == INDICES + 6 + MOST_IN_FLIGHT, "no more are sent"


@pytest.mark.parametrize(("late_s", "wait_s"), [(0.06, 0.16), (10.0, 0.25)])
def test_late_answers_make_datagrams_wait_longer_until_they_are_in_time_again(
    late_s: float, wait_s: float
) -> None:
    """For twice as long as the late one took; never for long."""
    bus, wire = scripted()

    def waited_s() -> float:
        began_ns, wire.answer = wire.clock.now_ns, lambda _: []
        assert bus.finish(bus.read_register(0, 0x0130, 2)) is None
        return (wire.clock.now_ns - began_ns) / 1e9

    def answered_after(seconds: float) -> bool:
        def answer(frame: bytearray) -> list[bytes]:
            wire.clock.sleep(seconds)
            return [done(frame)]

        wire.answer = answer
        return bus.finish(bus.read_register(0, 0x0130, 2)) is not None

    usual_s = waited_s()
    wire.clock.sleep(late_s)
    wire.answer = lambda _: [done(bytearray(wire.sent[-2]))]
    assert bus.finish(bus.read_register(0, 0x0130, 2)) is None
    assert waited_s() == pytest.approx(wait_s, rel=0.01)
    assert answered_after(0.15)
    assert waited_s() == pytest.approx(0.25, rel=0.01)
    assert answered_after(0.0)
    assert waited_s() == pytest.approx(0.125, rel=0.01)
    assert all(answered_after(0.0) for _ in range(10))
    assert waited_s() == pytest.approx(usual_s, rel=0.01)


# -- whatever comes from the wire the loop goes on

Change = Callable[[bytes], list[bytes]]


class HostileWire(MemoryBackend):
    """Makes of each frame that arrives what `change` makes of it; the program needs `read_ns` for each."""

    change: Change = staticmethod(lambda frame: [frame])
    read_ns = 0

    def __init__(self, *sensors: SensorOptions) -> None:
        super().__init__(*sensors)
        self._waiting: list[bytes] = []

    def receive(self, timeout_s: float) -> bytes | None:
        if not self._waiting and (frame := super().receive(timeout_s)) is not None:
            self._waiting = self.change(frame)
        if not self._waiting:
            return None
        self.clock.advance(self.clock.now_ns + self.read_ns)
        return self._waiting.pop(0)


@pytest.mark.parametrize(("copies", "read_us"), [(2, 20), (2, 400), (4, 20), (4, 100)])
def test_of_frames_that_arrive_several_times_each_counts_once(copies: int, read_us: int) -> None:
    wire = HostileWire(SensorOptions(signal="clock", ppm=170.0))
    wire.change = lambda frame: [frame] * copies
    wire.read_ns = read_us * 1000
    running = Simulation(backend=wire)
    client = running.connect()
    running.run(2.0)
    check_frames(running.frames)
    assert len(fresh(running.frames)) >= 1595
    status = running.status()
    sensor = status["sensors"][0]
    assert (sensor["invalid"], sensor["lost_samples"], sensor["recoveries"]) == (0, 0, 0)
    assert status["duplicate_frames"] == pytest.approx((copies - 1) * status["cycles"], abs=2 * copies)
    assert status["lost_frames"] == 0
    assert running.events == []
    assert status["exchange_us"]["p99"] < 2 * copies * read_us + 100
    running.command("power cycle 0.1")
    client.ask("subscribe")
    client.wait_event("sensor_back")
    assert client.ask("sdo_read", name="Sampling rate")["value"] == 800
    client.fresh(20)


@LRW_OR_NOT
def test_a_working_counter_that_cannot_be_is_no_complete_exchange(lrw: bool) -> None:
    wire = HostileWire(SensorOptions(signal="clock"))
    if not lrw:
        take_lrw_away(life_of(wire))
    running = Simulation(backend=wire)
    running.run(0.3)
    # One adds 1 for what is read, and 1 for what is written, twice in an LRW: these add up to 3, or more.
    for counters in [(4,), (0xFFFF,)] if lrw else [(3, 0), (0, 2), (2, 1), (0xFFFF, 0xFFFF), (1, 0xFFFF)]:

        def change(frame: bytes, counters: Sequence[int] = counters) -> list[bytes]:
            changed = bytearray(frame)
            if changed[DATAGRAM_INDEX] >= FIRST_INDEX:
                for datagram, counter in zip(parse(frame, len(frame)), counters, strict=False):
                    changed[datagram.end : datagram.end + 2] = counter.to_bytes(2, "little")
            return [bytes(changed)]

        wire.change = change
        running.frames.clear()
        running.run(0.1)
        assert all(frame.flags & DataFlag.INVALID for frame in running.frames[5:])
        assert 3 < running.frames[-1].wkc <= 0xFFFF
        wire.change = HostileWire.change
        running.run(0.1)
        assert running.frames[-1].flags == 0
        check_frames(running.frames)


@LRW_OR_NOT
@pytest.mark.parametrize("seed", more_if_long([1], range(50)))
def test_no_bytes_from_the_wire_end_the_loop(seed: int, lrw: bool, caplog: pytest.LogCaptureFixture) -> None:
    chance = random.Random(seed)
    wire = HostileWire(SensorOptions(), SensorOptions(serial=2))
    if not lrw:
        take_lrw_away(life_of(wire))
    running = Simulation(backend=wire)
    running.run(0.7)  # until event times are in use

    def change(frame: bytes) -> list[bytes]:
        changed = bytearray(frame)
        kind = chance.randrange(12)
        if kind == 0:
            del changed[chance.randrange(len(changed)) :]
        elif kind == 1:
            changed += chance.randbytes(chance.randrange(1, 100))
        elif kind == 2:
            changed = bytearray(chance.randbytes(chance.randrange(1515)))
        elif kind < 6:
            for _ in range(chance.randrange(1, 9)):
                changed[chance.randrange(len(changed))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
        elif kind < 9:
            for datagram in parse(frame, len(frame)):
                if chance.random() < 0.5:
                    changed[datagram.end : datagram.end + 2] = chance.randbytes(2)
                if chance.random() < 0.5:
                    changed[datagram.data : datagram.end] = chance.randbytes(datagram.length)
        return [bytes(changed)] * chance.choice((0, 1, 1, 1, 2))

    wire.change = change
    client = running.subscribe()
    for second in range(2):
        for action in ("sdo_read", "status", "describe"):
            client.send(action, **({"name": "Sampling rate"} if action == "sdo_read" else {}))
        running.command(("power cycle 0.05", "safeop 0x1B")[second % 2])
        running.run(1.0)
    wire.change = HostileWire.change
    running.command("power cycle 0.1 @0")
    running.command("power cycle 0.1 @1")
    running.run_until(lambda: all(sensor.streams for sensor in running.sensors), "both are back")
    assert len(client.fresh(50)) == 50
    assert not [record for record in caplog.records if record.exc_info]
