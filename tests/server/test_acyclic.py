"""Registers and mailboxes while sensors stream: the loop is never entered twice, and no sample waits."""

from __future__ import annotations

import itertools
import statistics
import sys
from collections.abc import Callable, Iterator
from types import CodeType, FrameType
from typing import Any

import pytest

from ethercat_server.acquisition import cycle
from ethercat_server.acquisition.cycle import Cycle
from ethercat_server.ethercat import datagrams
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.sii import OF_FIRMWARE
from ethercat_server.ethercat.wire import Command, parse
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine, SimulatedClock
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.server.test_terminals import DIGITAL, reading, wait_for
from tests.simulation import Bench, Simulation, check_frames, fresh, life_of

CLOCK = SensorOptions(signal="clock")
EXCHANGE = Command.LRW
LEAST_NS = 90_000  # between a frame of this kind and the exchange that follows
LONGEST_NS = 21_000_000


def callers(frame: FrameType | None) -> Iterator[CodeType]:
    """Who called, from the inside out."""
    while frame is not None:
        yield frame.f_code
        frame = frame.f_back


def within_the_loop() -> list[str]:
    """The files of those who called, up to the loop; nothing outside it."""
    found = [(code.co_filename, code is Cycle.run.__code__) for code in callers(sys._getframe(2))]
    if not any(is_loop for _, is_loop in found):
        return []
    return [name for name, _ in itertools.takewhile(lambda row: not row[1], found)]


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How often the loop waited for a frame; fails where anything else in it does."""
    count = [0]
    receive, sleep = MemoryBackend.receive, SimulatedClock.sleep

    def receives(self: MemoryBackend, timeout_s: float) -> bytes | None:
        through = within_the_loop()
        assert set(through) <= {cycle.__file__}, f"the loop is entered again, through {through}"
        count[0] += bool(through)
        return receive(self, timeout_s)

    def sleeps(self: SimulatedClock, seconds: float) -> None:
        through = within_the_loop()
        assert not any("acyclic" in name or name == datagrams.__file__ for name in through), "a step waits"
        sleep(self, seconds)

    monkeypatch.setattr(MemoryBackend, "receive", receives)
    monkeypatch.setattr(SimulatedClock, "sleep", sleeps)
    return count


def ask_for_all(bench: Bench) -> None:
    assert bench.ask("sdo_read", index=0x8011, subindex=0)["ok"]
    assert bench.ask("sii_read", word=8, words=4)["ok"]
    assert bench.ask("configure", settings={"imu_active": 2})["ok"]
    assert bench.ask("configure", settings={"fir": True})["ok"], "by way of PREOP"
    bench.run(0.6)
    assert bench.ask("tare", samples=40)["ok"]


def lose_and_return(bench: Bench) -> None:
    for fault in ("power cycle 0.2", "safeop 0x1B", "deaf 0.2"):
        bench.command(fault)
        bench.listener.wait_event("sensor_lost")
        bench.listener.wait_event("sensor_back")


@pytest.mark.parametrize("does", [ask_for_all, lose_and_return])
def test_nothing_waits_inside_a_step_and_the_loop_is_never_entered_twice(
    waits: list[int], does: Callable[[Bench], None]
) -> None:
    does(Bench())
    assert waits[0] > 100


def test_terminals_and_other_slaves_are_watched_without_entering_the_loop_again(waits: list[int]) -> None:
    simulation = reading("BOTA,EL1008,EL3102", DIGITAL)
    wait_for(simulation, "OP")
    assert {row["state"] for row in simulation.others.rows} == {"INIT"}
    simulation.command("power cycle 0.2 #1")
    simulation.run(1.0)
    wait_for(simulation, "OP")
    assert waits[0] > 100


class Sends(list[tuple[int, bool]]):
    """When frames were sent, and whether each was an exchange."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__()
        send, clock = simulation.backend.send, simulation.clock

        def sends(frame: bytes | bytearray) -> None:
            self.append((clock.now_ns, parse(frame, len(frame))[0].command == EXCHANGE))
            send(frame)

        simulation.bus._send = simulation.bus.process_data._send = sends


def asks_without_pause(simulation: Simulation) -> Any:
    client = simulation.connect()
    for _ in range(20):
        assert client.ask("sdo_read", sensor=0, index=0x8011, subindex=0)["ok"]
    return client


@pytest.mark.parametrize("sensors", [1, 3])
def test_a_frame_is_sent_only_with_time_left_before_the_next_exchange(sensors: int) -> None:
    """So the samples come as they do without."""
    simulation = Simulation(*[SensorOptions(signal="clock", serial=n + 1) for n in range(sensors)])
    simulation.run(2.0)
    sends = Sends(simulation)
    asks_without_pause(simulation)
    others = [at for at, (_, is_exchange) in enumerate(sends[:-1]) if not is_exchange]
    assert len(others) >= 2 * 20 - 2, "two for each object"
    for at in others:
        following = next((ns for ns, is_exchange in sends[at:] if is_exchange), None)
        assert following is None or following - sends[at][0] >= LEAST_NS
    check_frames(frame for frame in simulation.frames if frame.sensor == 0)


def test_on_a_bus_that_leaves_no_time_a_frame_is_sent_every_20_ms() -> None:
    """A sensor that samples no more is looked at eight times a period; here the answers take most of that."""
    machine = Machine(wake_ns=0.0, frame_ns=80_000.0, frame_jitter_ns=0.0)
    simulation = Simulation(CLOCK, machine=machine, settings={"sinc_length": 51})
    simulation.run(2.0)
    simulation.command("stick")
    simulation.run(0.1)
    sends = Sends(simulation)
    asks_without_pause(simulation)
    others = [ns for ns, is_exchange in sends if not is_exchange]
    pauses_ns = [after - ns for ns, after in itertools.pairwise(others)]
    assert statistics.median(pauses_ns) >= 20_000_000, "there is hardly ever time for one"
    assert max(pauses_ns) <= LONGEST_NS


def test_a_lost_sensor_has_the_others_polled_no_more_often() -> None:
    simulation = Simulation(CLOCK, SensorOptions(signal="clock", serial=2))
    simulation.run(2.0)

    def exchanges() -> int:
        before = simulation.bus.process_data.sent
        simulation.run(0.5)
        return simulation.bus.process_data.sent - before

    both = exchanges()
    simulation.command("power off @1")
    simulation.run(0.5)
    assert exchanges() <= both


def test_a_lost_frame_while_event_times_are_tried_again_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once a second they are, after they were refused."""
    simulation = Simulation(CLOCK)
    events = simulation.streams[0].clock.events
    assert events is not None
    monkeypatch.setattr(type(events.trust), "is_due", lambda _self, _now_ns: True)
    send, lost = simulation.backend.send, list[int]()

    def loses(frame: bytes | bytearray) -> None:
        first = parse(frame, len(frame))[0]
        if first.command == Command.FPWR and first.ado % 8 == reg.SM_ACTIVATE and first.length == 1:
            lost.append(simulation.clock.now_ns)
            return
        send(frame)

    simulation.bus._send = loses
    simulation.run(3.0)
    assert len(lost) >= 2
    assert len(fresh(simulation.frames)) > 2000


def test_an_eeprom_whose_reading_is_cut_off_goes_back_to_its_firmware() -> None:
    """The sensor leaves OP meanwhile: nothing else gives it back then."""
    simulation = Simulation(SensorOptions(signal="clock", eeprom_ms=20.0))
    simulation.run(0.5)
    client = simulation.connect()
    client.send("sii_read", sensor=0, word=0, words=64)
    simulation.run(0.1)
    owner = life_of(simulation.backend).esc.memory
    assert owner[reg.SII_OWNER : reg.SII_OWNER + 1] != OF_FIRMWARE
    simulation.command("safeop 0x1B")
    simulation.run(0.5)
    assert owner[reg.SII_OWNER : reg.SII_OWNER + 1] == OF_FIRMWARE


def test_machines_that_lose_frames_get_every_answer() -> None:
    """A message that was on a lost frame is asked for again."""
    simulation = Simulation(CLOCK, machine=Machine(seed=4, lost=0.05))
    client = simulation.connect()
    for _ in range(30):
        read = client.ask("sdo_read", sensor=0, index=0x8011, subindex=0)
        assert read["hex"] == "2003", read
