"""Datagrams and exchanges on a wire in memory: answers matched by index, late and foreign frames dropped."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from bota_ethercat.pdo import LAYOUTS
from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.ethercat.backend import Backend
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.exchange import DUPLICATE, FIRST_INDEX
from ethercat_server.ethercat.exchange import Exchange as Taken
from ethercat_server.ethercat.late_answers import LateAnswers
from ethercat_server.ethercat.wire import DATAGRAM_INDEX, Command, build, parse, working_counter
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine, SimulatedClock, Wire
from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.exchanging import Exchange
from tests.simulation import Asked

STATION = 0x1001
INDICES = 0x100 - FIRST_INDEX
Answer = Callable[[bytearray], list[bytes]]


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


def test_a_datagram_brings_back_its_data() -> None:
    bus, _ = scripted(lambda frame: [done(frame, b"\x08\x00")])
    assert bus.read_register(0, 0x0130, 2) == b"\x08\x00"
    assert bus.read_at(0, 0x0130, 2) == b"\x08\x00"
    assert bus.count_slaves(2, 0.01) == 1


def test_what_is_on_the_wire_is_a_datagram_of_the_standard() -> None:
    bus, wire = scripted()
    assert not bus.write_register(0, 0x0120, b"\x02\x00")
    (frame,) = wire.sent
    assert frame[12:14] == b"\x88\xa4"
    assert len(frame) == 60
    assert int.from_bytes(frame[14:16], "little") == 0x1000 | 14
    assert frame[16] == Command.FPWR
    assert frame[18:24] == STATION.to_bytes(2, "little") + b"\x20\x01" + b"\x02\x00"
    assert frame[26:30] == b"\x02\x00\x00\x00", "data, then the working counter"
    bus.read_at(3, 0x0130, 2)
    assert wire.sent[1][16:20] == bytes((Command.APRD, wire.sent[1][17], 0xFD, 0xFF)), "minus the position"


def test_a_slave_that_did_not_do_it_and_a_lost_frame_are_no_answer() -> None:
    for answer in (lambda frame: [done(frame, wkc=0)], lambda _: []):
        bus, _ = scripted(answer)
        assert not bus.write_register(0, 0x1000, b"\1")
        assert bus.read_register(0, 0x0130, 2) is None
    assert bus.count_slaves(2, 0.01) == -1


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
    assert [bus.read_register(0, 0x0130, 2) for _ in range(5)] == [b"\x02\x00"] * 5


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
            found = bus.read_register(number, ado, 4)
            assert found == (STATION + number).to_bytes(2, "little") + ado.to_bytes(2, "little")
    assert len(wire.sent) == 128


def test_indices_are_none_of_soems() -> None:
    bus, wire = scripted()
    for _ in range(300):
        bus.read_register(0, 0x0130, 2)
    assert {frame[17] for frame in wire.sent} == set(range(0x80, 0x90))


def operational(
    *sensors: SensorOptions, machine: Machine | None = None, lrw: bool = True
) -> tuple[Bus, MemoryBackend]:
    backend = MemoryBackend(*sensors, machine=machine)
    if not lrw:
        life = backend.sensors.sensors[-1].life
        assert life is not None
        life.esc.take_lrw_away()
    bus = Bus(backend)
    bring_up(bus, Asked(), lambda: None)
    return bus, backend


def inputs(backend: MemoryBackend, position: int) -> bytes:
    """The process data that a sensor has now."""
    life = backend.sensors.sensors[position].life
    assert life is not None
    return life.inputs()


@pytest.mark.parametrize("lrw", [True, False], ids=["LRW", "LRD and LWR"])
def test_an_exchange_brings_every_sensors_process_data(lrw: bool) -> None:
    sensors = [
        SensorOptions(serial=n, pdo_size=size, signal="constant") for n, size in enumerate((61, 77, 61))
    ]
    bus, backend = operational(*sensors, lrw=lrw)
    exchange = Exchange(bus)
    assert exchange() == 9
    assert bus.process_data.counters == [(3,)] * 3
    for position, options in enumerate(sensors):
        assert exchange.inputs[position] == inputs(backend, position)
        assert len(exchange.inputs[position]) == options.pdo_size


@pytest.mark.parametrize(("lrw", "frames"), [(True, 2), (False, 3)], ids=["LRW", "LRD and LWR"])
def test_process_data_that_does_not_fit_one_frame_goes_in_several(lrw: bool, frames: int) -> None:
    sensors = (SensorOptions(serial=n, pdo_size=77, signal="constant") for n in range(20))
    bus, backend = operational(*sensors, lrw=lrw)
    sent: list[int] = []
    send = backend.send

    def noted(frame: bytearray) -> None:
        sent.append(len(frame))
        send(frame)

    cast(Any, bus.process_data)._send = noted
    exchange = Exchange(bus)
    assert exchange() == 60
    assert len(sent) == frames
    assert max(sent) <= 1514
    for position in range(20):
        assert exchange.inputs[position] == inputs(backend, position)


def test_a_lost_frame_is_a_miss_and_the_data_stay_those_of_before() -> None:
    bus, backend = operational(SensorOptions(signal="constant"))
    exchange = Exchange(bus)
    assert exchange() == 3
    before = exchange.inputs[0]
    backend.command("lose 1")
    assert exchange() == -1
    assert exchange.inputs[0] == before
    assert exchange() == 3


@pytest.mark.parametrize("late", [0.2, 0.9])
def test_a_frame_that_comes_too_late_is_never_taken_for_the_next_ones(late: float) -> None:
    bus, backend = operational(SensorOptions(signal="clock"))
    backend.wire = type(backend.wire)(Machine(seed=5, late=late, late_ns=15_000_000, frame_jitter_ns=0))
    seen: list[bytes] = []
    exchange = Exchange(bus)
    for _ in range(300):
        sent_ns = backend.clock.now_ns
        if exchange() == 3:
            instant_ns = decode_clock(LAYOUTS[61].struct.unpack(exchange.inputs[0])[2:8]).instant_ns
            assert sent_ns - 1_250_000 <= instant_ns <= backend.clock.now_ns
            seen.append(exchange.inputs[0])
        backend.clock.sleep(0.00125)
    assert len(seen) > 10
    assert len(set(seen)) > 0.9 * len(seen), "each brought what the sensor had then"


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
    process_data, backend.wire = bus.process_data, Wire(Machine(frame_jitter_ns=0))
    answer = answers(bus, backend)
    assert awaited(process_data.take(answer, 1))
    assert process_data.take(answer, 1) is process_data.take(answer, 1) is DUPLICATE
    for _ in range(INDICES):
        later = answers(bus, backend)
        assert process_data.take(answer, 1) in (DUPLICATE, None)
        assert awaited(process_data.take(later, 1))
        assert process_data.take(later, 1) is DUPLICATE
    assert process_data.in_flight == process_data.lost == 0


def test_an_answer_whose_index_is_in_use_again_is_not_taken_for_the_later_one() -> None:
    bus, backend = operational()
    process_data, backend.wire = bus.process_data, Wire(Machine(frame_jitter_ns=0))
    late = answers(bus, backend)
    backend.clock.sleep(0.2)
    assert process_data.lost == 1
    for _ in range(INDICES - 1):
        assert awaited(process_data.take(answers(bus, backend), 1))
    current = answers(bus, backend)
    assert current[DATAGRAM_INDEX] == late[DATAGRAM_INDEX]
    assert process_data.take(late, 1) is None
    assert awaited(process_data.take(current, 1)).frame == current
    assert process_data.duplicates == 0, "it was given up, not taken"


@pytest.mark.parametrize("lrw", [True, False], ids=["LRW", "LRD and LWR"])
def test_a_working_counter_that_cannot_be_is_above_the_highest(lrw: bool) -> None:
    bus, backend = operational(SensorOptions(), SensorOptions(serial=2), lrw=lrw)
    process_data = bus.process_data
    assert process_data.most_wkc == [6]
    for counters in [(7, 0), (0xFFFF, 0)] if lrw else [(6, 0), (0, 3), (4, 1), (0xFFFF, 0xFFFF), (2, 0xFFFF)]:
        answer = bytearray(answers(bus, backend))
        for datagram, counter in zip(parse(answer, len(answer)), counters, strict=False):
            answer[datagram.end : datagram.end + 2] = counter.to_bytes(2, "little")
        assert 6 < awaited(process_data.take(bytes(answer), 1)).wkc <= 0xFFFF


def test_a_late_answer_makes_datagrams_wait_longer_but_never_long() -> None:
    late, pending = LateAnswers(clock := SimulatedClock(Machine()), 0x80, 16), 0x80 + 3
    for stall_s in (0.01, 10.0):
        late.pending_ns[3] = clock.now_ns
        clock.sleep(stall_s)
        late.in_time(3)
        assert 0.02 <= late.timeout_s <= 0.25
        late.note(done(build((Command.NOP, 0, 0, b""), first_index=pending)))
        assert 0.02 <= late.timeout_s <= 0.25


def test_a_frame_that_is_cut_short_is_a_miss() -> None:
    bus, backend = operational(SensorOptions(signal="constant"))
    receive = backend.receive

    def cut(timeout_s: float) -> bytes | None:
        frame = receive(timeout_s)
        return frame[:40] if frame is not None else None

    cast(Any, backend).receive = cut
    assert Exchange(bus)() == -1


def test_working_counters_add_up() -> None:
    frame = bytearray(done(build((Command.BRD, 0, 0, b"\0\0")), wkc=7))
    assert working_counter(frame, parse(frame, len(frame))[0]) == 7
