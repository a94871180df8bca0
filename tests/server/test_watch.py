"""Who is told to be lost, and by what: `Recovery` on a bus whose answers are given, without time passing."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ethercat_server.acquisition.recovery import Recovery, SensorReturn
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import finish
from ethercat_server.ethercat.slave.controller import SlaveController
from ethercat_server.ethercat.slave.emergencies import Emergencies
from ethercat_server.sensor.scan import OtherSlaves
from ethercat_server.sensor.sensor import Identity, Sensor, SensorState
from ethercat_server.simulation.machine import Machine, SimulatedClock

MS = 1_000_000
_ERROR_BIT = 0x10


class GivenBus:
    """Two sensors in the AL states given; None does not answer."""

    ifname = "given"

    backend = SimpleNamespace(check_present=lambda: None, why_silent=lambda: "check cable and power")
    stations = (1, 2)
    process_data = SimpleNamespace(counters=[(3,), (3,)], inputs=[[]])

    def __init__(self) -> None:
        self.clock = SimulatedClock(Machine())
        self.emergencies = Emergencies(self.clock)
        mailboxes = [(0x1000, 128)] * 2
        self.slaves = [SlaveController(cast(Bus, self), n, mailboxes, self.emergencies) for n in range(2)]
        for slave in self.slaves:
            slave.attempts = 1
        self.looked_for = False
        self.states: list[AlState | None] = [AlState.OP, AlState.OP]
        self.error = 0
        """AL status code of all, with the error bit if there is one."""
        self.read = self.written = 0
        self.lose = 0
        """So many datagrams more are lost."""

    def read_register(self, position: int, address: int, size: int) -> bytes | None:
        if address != reg.AL_STATUS:
            return bytes(size)
        self.read += 1
        if self.lose:
            self.lose -= 1
            return None
        state = self.states[position]
        if state is None:
            return None
        return struct.pack("<HHH", state | (_ERROR_BIT if self.error else 0), 0, self.error)

    def write_register(self, position: int, address: int, data: bytes) -> bool:
        self.written += 1
        return self.states[position] is not None

    def read_at(self, position: int, address: int, size: int) -> bytes | None:
        self.looked_for = True
        return None


def a_sensor(position: int) -> Sensor:
    sensor = Sensor(position, Identity("a sensor", position, "", ""), {})
    sensor.enter(SensorState.STREAMING)
    return sensor


class Watched:
    """A `Recovery` and a time that passes by exchanges only."""

    def __init__(self) -> None:
        self.bus = GivenBus()
        self.told: list[dict[str, Any]] = []
        self.sensors = [a_sensor(position) for position in range(2)]
        self.recovery = Recovery(
            cast(Bus, self.bus),
            self.sensors,
            cast(list[SensorStream], [None, None]),
            self.told.append,
            OtherSlaves(cast(Bus, self.bus), ()),
        )
        self.now = self.bus.clock.now_ns

    def exchange(self, wkc: int, count: int = 1, after_ms: int = 1) -> None:
        for _ in range(count):
            self.now += after_ms * MS
            self.recovery.attend(wkc >= self.recovery.alive_wkc[0], self.now)

    def lost(self) -> list[tuple[int, str]]:
        return [(row["sensor"], row["reason"]) for row in self.told]


def test_one_that_dies_while_another_is_out_and_counted_is_lost_too() -> None:
    watched = Watched()
    watched.bus.states[0] = AlState.SAFEOP
    watched.exchange(6, 300)
    assert watched.lost() == [(0, "it is in SAFEOP")]
    # The one in SAFEOP is counted, so the working counter is the one of the other.
    watched.bus.states[1] = None
    watched.exchange(3, 300)
    assert watched.lost()[1:] == [(1, "it does not answer")]
    assert watched.sensors[1].state is SensorState.LOST


def test_one_that_leaves_op_while_another_is_out_is_lost_too() -> None:
    watched = Watched()
    watched.bus.states[1] = None
    watched.exchange(3, 10)
    watched.bus.states[0] = AlState.SAFEOP
    watched.exchange(3, 300)
    assert watched.lost() == [(1, "it does not answer"), (0, "it is in SAFEOP")]


def test_a_lost_datagram_is_no_lost_sensor() -> None:
    watched = Watched()
    for _ in range(10):
        watched.bus.lose = 1
        watched.exchange(6, 200)
    watched.bus.states[1] = None
    watched.exchange(3, 10)
    for _ in range(10):
        watched.bus.lose = 1
        watched.exchange(3, 200)
    assert watched.lost() == [(1, "it does not answer")]


def test_a_refused_sensor_is_not_set_up_again_because_of_a_lost_datagram() -> None:
    bus = GivenBus()
    bus.states[0] = AlState.INIT
    waiting = SensorReturn(cast(Bus, bus), a_sensor(0)).wait_for_removal()
    for reads in range(10, 100, 10):
        bus.lose = 1
        while bus.read < reads:
            next(waiting)
            bus.clock.sleep(0.001)
    assert not bus.written
    bus.states[0] = None
    while not bus.looked_for:
        next(waiting)
        bus.clock.sleep(0.001)


def test_a_sensor_that_keeps_its_error_is_not_asked_for_op() -> None:
    bus = GivenBus()
    bus.states[0], bus.error = AlState.SAFEOP, 0x001B
    climbing = bus.slaves[0].go(AlState.OP)
    with pytest.raises(
        BusError, match="sensor 0 keeps its error although it was acknowledged: it is in SAFEOP"
    ):
        finish(climbing, clock=bus.clock)
    assert bus.written == 1
