"""Whatever comes from the wire: duplicates, counters that cannot be, any bytes. The loop goes on."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from bota_ethercat.framing import DataFlag
from ethercat_server.ethercat.exchange import FIRST_INDEX
from ethercat_server.ethercat.wire import DATAGRAM_INDEX, parse
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation, check_frames, fresh, more_if_long

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


def take_lrw_away(wire: MemoryBackend) -> None:
    life = wire.sensors.sensors[0].life
    assert life is not None
    life.esc.take_lrw_away()


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


@pytest.mark.parametrize("lrw", [True, False], ids=["LRW", "LRD and LWR"])
def test_a_working_counter_that_cannot_be_is_no_complete_exchange(lrw: bool) -> None:
    wire = HostileWire(SensorOptions(signal="clock"))
    if not lrw:
        take_lrw_away(wire)
    running = Simulation(backend=wire)
    running.run(0.3)

    def change(frame: bytes) -> list[bytes]:
        changed = bytearray(frame)
        if changed[DATAGRAM_INDEX] >= FIRST_INDEX:
            for datagram in parse(frame, len(frame))[: 2 - lrw]:
                changed[datagram.end : datagram.end + 2] = b"\xff\xff"
        return [bytes(changed)]

    wire.change = change
    running.frames.clear()
    running.run(0.3)
    assert all(frame.flags & DataFlag.INVALID for frame in running.frames[5:])
    assert running.frames[-1].wkc == 0xFFFF
    wire.change = HostileWire.change
    running.run(0.3)
    assert running.frames[-1].flags == 0
    check_frames(running.frames)


@pytest.mark.parametrize("lrw", [True, False], ids=["LRW", "LRD and LWR"])
@pytest.mark.parametrize("seed", more_if_long([1, 2], range(50)))
def test_no_bytes_from_the_wire_end_the_loop(seed: int, lrw: bool, caplog: pytest.LogCaptureFixture) -> None:
    chance = random.Random(seed)
    wire = HostileWire(SensorOptions(), SensorOptions(serial=2))
    if not lrw:
        take_lrw_away(wire)
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
    client = running.connect()
    client.ask("subscribe")
    for second in range(6):
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
