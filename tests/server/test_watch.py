"""Who is told to be lost, and by what: `Recovery` on a bus whose answers are given, without time passing."""

from __future__ import annotations

import struct
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ethercat_server import ladder
from ethercat_server.al import AL_STATUS, AlState
from ethercat_server.bus import Bus
from ethercat_server.errors import BusError
from ethercat_server.ladder import Ladder
from ethercat_server.recovery import Recovery
from ethercat_server.sdo import finish
from ethercat_server.sensor import Sensor
from ethercat_server.stream import SensorStream

MS = 1_000_000
_ERROR_BIT = 0x10


class GivenBus:
    """Two sensors in the AL states given; None does not answer."""

    ifname, ifindex = "lo", 1
    reclaimed = False

    def __init__(self) -> None:
        self.states: list[AlState | None] = [AlState.OP, AlState.OP]
        self.error = 0
        """AL status code of all, with the error bit if there is one."""
        self.read = self.written = 0
        self.lose = 0
        """So many datagrams more are lost."""

    def read_register(self, place: int, address: int, size: int) -> bytes | None:
        if address != AL_STATUS:
            return bytes(size)
        self.read += 1
        if self.lose:
            self.lose -= 1
            return None
        state = self.states[place]
        if state is None:
            return None
        return struct.pack("<HHH", state | (_ERROR_BIT if self.error else 0), 0, self.error)

    def write_register(self, place: int, address: int, data: bytes) -> bool:
        self.written += 1
        return self.states[place] is not None

    def working_counter(self, place: int) -> int:
        return 3

    def reclaim(self, place: int) -> bool:
        self.reclaimed = True
        return False

    def be_patient(self, patient: bool) -> None:
        pass


class Watched:
    """A `Recovery` and a time that passes by exchanges only."""

    def __init__(self) -> None:
        self.bus = GivenBus()
        self.told: list[dict[str, Any]] = []
        sensors = [SimpleNamespace(place=n, identity="a sensor", state="OP") for n in range(2)]
        self.streams = [SimpleNamespace(alive=True) for _ in range(2)]
        self.recovery = Recovery(
            cast(Bus, self.bus),
            cast(list[Sensor], sensors),
            cast(list[SensorStream], self.streams),
            self.told.append,
        )
        self.now = time.monotonic_ns()

    def exchange(self, wkc: int, count: int = 1, after_ms: int = 1) -> None:
        for _ in range(count):
            self.now += after_ms * MS
            self.recovery.attend(wkc, self.now)

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
    assert not watched.streams[1].alive


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


def test_at_a_low_rate_too_one_lost_frame_is_no_lost_sensor() -> None:
    watched = Watched()
    for _ in range(3):
        watched.exchange(6, after_ms=40)
        watched.exchange(-1, after_ms=80)
    assert watched.lost() == []
    watched.exchange(-1, after_ms=40)
    assert [place for place, _ in watched.lost()] == [0, 1]


def test_a_refused_sensor_is_not_set_up_again_because_of_a_lost_datagram(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ladder, "_REFUSED_PAUSE_S", 0.001)
    bus = GivenBus()
    bus.states[0] = AlState.INIT
    waiting = Ladder(cast(Bus, bus), cast(Sensor, SimpleNamespace(place=0))).wait_for_removal()
    for reads in range(10, 100, 10):
        bus.lose = 1
        while bus.read < reads:
            next(waiting)
    assert not bus.written
    bus.states[0] = None
    while not bus.reclaimed:
        next(waiting)


def test_a_sensor_that_keeps_its_error_is_not_asked_for_op(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ladder, "_STATE_TIMEOUT_S", 0.01)
    bus = GivenBus()
    bus.states[0], bus.error = AlState.SAFEOP, 0x001B
    climbing = Ladder(cast(Bus, bus), cast(Sensor, SimpleNamespace(place=0)))._go(AlState.OP)
    with pytest.raises(BusError, match="sensor 0 keeps its error when that is acknowledged: it is in SAFEOP"):
        finish(climbing, pause_s=0.001)
    assert bus.written == 1
