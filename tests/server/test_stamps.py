"""Stamps of the whole server, by polling and by distributed clocks: what it reads and writes of these.

How event times are judged is in test_sample_clock.py.
"""

from __future__ import annotations

import itertools
import logging
import random
import struct
from collections.abc import Callable, Sequence
from statistics import median
from types import SimpleNamespace
from typing import Any

import pytest

from bota_ethercat.framing import DataFlag, DataMessage
from ethercat_server.errors import SetUpError
from ethercat_server.ethercat.clock import StampClocks
from ethercat_server.ethercat.exchange import LATCHED, Area, fit_a_frame, latched_datagrams, make_frames
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import Command, Datagram, parse
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation, fresh, life_of, more_if_long, reading

SETTLED_S = 2.0


def simulation(*dc: str, sinc_length: int = 64, machine: Machine | None = None) -> Simulation:
    return Simulation(
        *(SensorOptions(serial=n, signal="clock", ppm=150.0, dc=each) for n, each in enumerate(dc, 1)),
        settings={"sinc_length": sinc_length}, machine=machine,
    )  # fmt: skip


def stamps(running: Simulation, number: int = 0) -> str:
    stamped: str = running.status()["sensors"][number]["clock"]["stamps"]
    return stamped


def errors_ns(frames: Sequence[DataMessage]) -> list[int]:
    return [frame.monotonic_ns - reading(frame).instant_ns for frame in fresh(frames)]


def settled(*dc: str, sinc_length: int = 64) -> Simulation:
    """One whose samples are dated by hardware."""
    running = simulation(*dc, sinc_length=sinc_length)
    running.run(SETTLED_S)
    assert stamps(running) == "hardware"
    return running


def test_samples_are_dated_by_the_slave_controller(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    running = settled("ppm=40+at=4294000000")
    assert caplog.text.count("time-stamped by the distributed clock") == 1
    cycles, count = running.status()["cycles"], len(running.frames)
    running.run(1.0)
    errors = errors_ns(running.frames)[count:]
    assert max(errors) - min(errors) < 10_000
    assert running.status()["cycles"] - cycles < 1.06 * len(errors)
    assert running.status()["sensors"][0]["lost_samples"] == 0


@pytest.mark.parametrize("dc", ["none", "no-events"])
def test_a_controller_without_it_is_polled_as_before(dc: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    running = simulation(dc)
    running.run(SETTLED_S)
    assert stamps(running) == "polling"
    assert ("stand still" in caplog.text) is (dc == "no-events")
    read = {datagram.ado for datagram in sent(running) if datagram.command == Command.FPRD}
    assert reg.DC_SYSTEM_TIME not in read, "what is of no use is not asked for"


def sent(running: Simulation) -> list[Datagram]:
    content = bytes(running.bus.process_data._frames[0].content)
    return parse(content, len(content))


def test_registers_that_stop_in_operation_cost_no_sample(caplog: pytest.LogCaptureFixture) -> None:
    running = settled("")
    running.command("dc stuck")
    running.run(SETTLED_S)
    assert stamps(running) == "polling"
    assert caplog.text.count("its samples are time-stamped by polling") == 1
    status = running.status()["sensors"][0]
    assert (status["lost_samples"], status["invalid"], status["recoveries"]) == (0, 0, 0)


def test_each_sensor_of_a_bus_has_its_own_clock() -> None:
    running = settled("ppm=40", "none", "ppm=-40+at=4000000000")
    assert [stamps(running, number) for number in range(3)] == ["hardware", "polling", "hardware"]


@pytest.mark.parametrize("seed", more_if_long([1, 2], range(1, 7)))
def test_lost_frames_at_the_start_do_not_cost_event_times(seed: int) -> None:
    running = Simulation(SensorOptions(signal="clock"), machine=Machine(seed=seed, lost=0.1))
    running.backend.become(Machine())
    running.run(SETTLED_S)
    assert stamps(running) == "hardware"


@pytest.mark.parametrize(
    ("change", "leaves_op"),
    more_if_long([("offset", True), ("latch", False)], itertools.product(("offset", "latch"), (False, True))),
)
def test_what_another_master_writes_meanwhile_ends_event_times_for_a_while_only(
    change: str, leaves_op: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """It has gone: nobody else puts right what it has left in the controller."""
    caplog.set_level(logging.INFO)
    running = settled("", sinc_length=256)
    esc, at = life_of(running.backend).esc, reg.SYNC_MANAGER + 3 * reg.SYNC_MANAGER_SIZE + reg.SM_ACTIVATE

    def write() -> None:
        if change == "offset":
            esc.write(reg.DC_OFFSET, struct.pack("<QI", 10**18 + 2**31, 350))
        else:
            esc.write(at, bytes([esc.memory[at] & ~reg.SM_LATCH_PDI]))

    if leaves_op:
        esc.write(reg.AL_CONTROL, bytes([1, 0]))
        while running.status()["sensors"][0]["recoveries"] == 0:
            running.run(0.01)
    write()
    running.run(8.0)
    assert stamps(running) == "polling"
    running.run(10.0)
    assert stamps(running) == "hardware"
    assert max(map(abs, errors_ns(running.frames)[-400:])) < 10_000
    assert running.status()["sensors"][0]["lost_samples"] == 0
    assert caplog.text.count("by the distributed clock of its slave controller again") == 1


@pytest.mark.parametrize(
    ("sensors", "sinc_length"), more_if_long([(1, 32), (2, 64)], itertools.product((1, 2, 8), (32, 64)))
)
def test_a_stop_of_the_machine_costs_neither_stamps_nor_the_count(sensors: int, sinc_length: int) -> None:
    """The next sample may come between the pass of the process data and that of its event."""
    options = [SensorOptions(serial=n, signal="clock", ppm=150.0 - 37 * n) for n in range(sensors)]
    running = Simulation(*options, settings={"sinc_length": sinc_length})
    running.run(SETTLED_S)
    assert {stamps(running, number) for number in range(sensors)} == {"hardware"}
    chance, count, at_s = random.Random(1), len(running.frames), 0.0
    seconds = 5.0 / sensors
    while (at_s := at_s + chance.uniform(0.005, 0.05)) < seconds:
        running.at(at_s, lambda: running.clock.stall(chance.uniform(0.5e6, 5e6)))
    running.run(seconds)
    for number in range(sensors):
        frames = [frame for frame in fresh(running.frames[count:]) if frame.sensor == number]
        for before, after in itertools.pairwise(frames):
            missing = reading(after).number - reading(before).number - 1
            assert bool(after.flags & DataFlag.GAP) is (missing > 0)
        assert max(map(abs, errors_ns(frames[1:]))) <= 10_000


def areas(count: int, size: int = 61) -> list[list[Area]]:
    inputs = [(n * size, (n + 1) * size) for n in range(count)]
    return [[Area(*each, reg.FMMU_READ)] for each in inputs]


@pytest.mark.parametrize("lrw", [True, False])
@pytest.mark.parametrize("count", [1, 8, 15, 16, 40])
def test_frames_carry_the_latched_times_of_the_sensors_in_them(count: int, lrw: bool) -> None:
    stations = [None if number % 5 == 4 else 0x1001 + number for number in range(count)]
    frames = make_frames(areas(count), stations, lrw=lrw)
    assert sorted(each.number for frame in frames for each in frame.inputs) == list(range(count))
    for frame in frames:
        assert len(frame.content) <= 1514
        datagrams = {datagram.data: datagram for datagram in parse(frame.content, len(frame.content))}
        assert datagrams[frame.tag].command == Command.NOP
        for inputs in frame.inputs:
            station = stations[inputs.number]
            if station is None:
                assert inputs.latched == 0
                continue
            first = datagrams[inputs.latched]
            second = datagrams[inputs.latched + LATCHED.size - 6]
            assert (first.adp, first.ado, first.length) == (station, reg.DC_SYSTEM_TIME, 4)
            assert (second.adp, second.ado, second.length) == (station, reg.DC_PDI_CHANGE_EVENT, 4)
            assert len(latched_datagrams(station)) == 2


def test_process_data_that_no_frame_can_carry_is_an_error() -> None:
    whole = [Area(0, 1400, reg.FMMU_READ)]
    assert fit_a_frame(whole, lrw=True)
    assert not fit_a_frame(whole, lrw=False)
    torn = [[Area(0, 61, reg.FMMU_READ), Area(2000, 2010, reg.FMMU_READ)]]
    with pytest.raises(SetUpError, match="lies among that of others"):
        make_frames(torn, [None], lrw=True)


# -- a machine that wakes late over answers: the kernel says when they had arrived, and stamps are right

WAKES_NS = 120_000


def error_ns(
    monkeypatch: pytest.MonkeyPatch, dc: str, arrived_ns: Callable[[], int] | None, slew: float = 0.0
) -> float:
    """Of the stamps of a second, by a kernel that says `arrived_ns` of each answer (None: the truth)."""
    running = simulation(dc, machine=Machine(slew=slew))
    backend, receive = running.backend, running.backend.receive

    def late(timeout_s: float) -> bytes | None:
        if (frame := receive(timeout_s)) is not None:
            backend.clock.advance(backend.clock.now_ns + WAKES_NS)
        return frame

    monkeypatch.setattr(backend, "receive", late)
    if arrived_ns is not None:
        monkeypatch.setattr(backend, "arrived_ns", arrived_ns)
    running.run(SETTLED_S)
    count = len(running.frames)
    running.run(1.0)
    status = running.status()["sensors"][0]
    assert status["lost_samples"] == status["invalid"] == 0
    assert stamps(running) == ("polling" if dc == "none" else "hardware")
    return median(errors_ns(running.frames[count:]))


@pytest.mark.parametrize("slew", [0.0, 0.1, -0.1])
@pytest.mark.parametrize("dc", ["", "none"])
def test_stamps_do_not_depend_on_how_late_the_machine_wakes(
    monkeypatch: pytest.MonkeyPatch, dc: str, slew: float
) -> None:
    """The kernel says it by CLOCK_REALTIME, in which the time that an answer waited is slewed."""
    assert abs(error_ns(monkeypatch, dc, None, slew)) < WAKES_NS / 30


@pytest.mark.parametrize("wrong", more_if_long([0, 1 << 80], [0, -5, 1 << 80]))
def test_an_arrival_that_cannot_be_is_not_used(monkeypatch: pytest.MonkeyPatch, wrong: int) -> None:
    half = error_ns(monkeypatch, "", lambda: wrong)
    assert WAKES_NS / 3 < half < WAKES_NS * 2 / 3, "half of the wake-up counts as the way out"


@pytest.mark.parametrize("count", more_if_long([3], [1, 3]))
def test_neither_the_length_of_a_frame_nor_the_slaves_behind_are_in_a_stamp(count: int) -> None:
    running = settled(*[""] * count)
    running.frames.clear()
    running.run(1.0)
    for number in range(count):
        assert abs(median(errors_ns([frame for frame in running.frames if frame.sensor == number]))) < 500


class HeldUp:
    """Clocks of a machine with CLOCK_MONOTONIC slewed, which may hold a program up at each read."""

    def __init__(self) -> None:
        self.now_ns = 5 * 10**9
        self.holds_ns: Callable[[], int] = lambda: 100

    def raw_ns(self) -> int:
        now_ns = self.now_ns
        self.now_ns += self.holds_ns()
        return now_ns

    def monotonic_ns(self) -> int:
        return self.slewed_ns(self.raw_ns())

    def time_ns(self) -> int:
        return self.monotonic_ns() + 10**18

    @staticmethod
    def slewed_ns(raw_ns: int) -> int:
        return raw_ns + raw_ns // 2000 + 10**9

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


def test_stamps_follow_a_slewed_clock_also_where_reading_it_is_held_up() -> None:
    clock, chance = HeldUp(), random.Random(58)
    clocks = StampClocks(clock)
    clock.sleep(1.0)
    clocks.follow()
    assert clocks.rate == pytest.approx(1.0005, abs=1e-6), "at the first look"
    clock.holds_ns = lambda: chance.randrange(1_000_000) if chance.random() < 0.1 else 100
    for _ in range(1000):
        clock.sleep(0.001)
        now_ns = clock.now_ns
        assert abs(clocks.monotonic_ns(now_ns) - clock.slewed_ns(now_ns)) < 10_000


def test_an_instant_is_converted_by_the_clocks_of_now() -> None:
    """Of a sensor that gives nothing new, which has no other reason to follow them."""
    clock: Any = SimpleNamespace(now_ns=10**9)
    clock.raw_ns = lambda: clock.now_ns
    clock.time_ns = clock.monotonic_ns = lambda: round(1.05 * clock.now_ns)
    clocks = StampClocks(clock)
    for _ in range(3):
        clock.now_ns += 10**9
        assert clocks.monotonic_ns(clock.now_ns) == pytest.approx(clock.monotonic_ns(), abs=2)


@pytest.mark.parametrize("set_ns", [0, 400, 10**6, -(10**6), 3600 * 10**9, -3600 * 10**9])
def test_only_a_wall_clock_that_was_set_has_another_difference(set_ns: int) -> None:
    """However long reading it is held up; nobody can tell less than what lies between two reads."""
    clock: Any = HeldUp()
    monotonic_ns, set_by = clock.monotonic_ns, [0]
    clock.time_ns = lambda: monotonic_ns() + 10**18 + set_by[0]
    clocks = StampClocks(clock)
    before_ns = clocks.realtime_ns
    assert before_ns == pytest.approx(10**18, abs=1)
    set_by[0] = set_ns
    clock.holds_ns = lambda: 300 if set_ns else 5 * 10**8
    for _ in range(3):
        clocks.follow_realtime()
        expected = before_ns + (set_ns if abs(set_ns) > 10**5 else 0)
        assert clocks.realtime_ns == pytest.approx(expected, abs=1000 if set_ns else 0)
