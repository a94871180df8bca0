"""The loop against a scripted bus: stalls, lost frames, sockets' turn. The real bus is in test_end_to_end."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

import pytest

from ethercat_server.bus import Bus
from ethercat_server.cycle import Cycle
from ethercat_server.hub import Hub
from ethercat_server.jobs import Jobs
from ethercat_server.notify import Notifier
from ethercat_server.recovery import Recovery
from ethercat_server.stream import SensorStream
from protocol.framing import DataMessage, FrameDecoder

PERIOD_NS = 5_000_000
"""Long, so that a slow machine keeps up."""


class ScriptedBus:
    """A sensor on the real clock, without a wire."""

    def __init__(self) -> None:
        self.started_ns = time.monotonic_ns()
        self.exchanges: list[int] = []
        self.lose: set[int] = set()
        self.timeout_s = 0.0

    def send(self) -> None:
        self.exchanges.append(time.monotonic_ns())

    def receive(self, timeout_s: float) -> int:
        self.timeout_s = timeout_s
        return -1 if len(self.exchanges) in self.lose else 3

    def process_data(self, _slave: int) -> bytes:
        number = (self.exchanges[-1] - self.started_ns) // PERIOD_NS
        return number.to_bytes(61, "little")


class ScriptedHub:
    """Counts its turns and keeps what is published."""

    def __init__(self, on_serve: Callable[[int], None]) -> None:
        self.turns = 0
        self.frames: list[DataMessage] = []
        self._on_serve = on_serve

    def serve(self, _until_ns: int) -> None:
        self.turns += 1
        self._on_serve(self.turns)

    def publish(self, frame: bytes, _place: int, _flags: int, _now_ns: int) -> None:
        decoder = FrameDecoder()
        decoder.feed(frame)
        message = decoder.next_message()
        assert isinstance(message, DataMessage)
        self.frames.append(message)


class NoTrouble:
    """A recovery that never has anything to do."""

    alive_wkc = 3
    all_lost = False

    def attend(self, _wkc: int, _now_ns: int) -> None:
        pass


def run(
    turns: int, on_serve: Callable[[int], None], bus: ScriptedBus, stream: SensorStream | None = None
) -> tuple[dict[str, Any], ScriptedHub]:
    def stop_at_the_end(turn: int) -> None:
        on_serve(turn)
        if turn == turns:
            cycle.stop()

    hub = ScriptedHub(stop_at_the_end)
    stream = stream or SensorStream(0, PERIOD_NS)
    cycle = Cycle(
        cast(Bus, bus),
        [stream],
        cast(Hub, hub),
        cast(Recovery, NoTrouble()),
        Jobs(cast(Bus, bus), []),
        Notifier(),
    )
    cycle.run()
    return cycle.status(), hub


def numbers(hub: ScriptedHub) -> list[int]:
    return [int.from_bytes(frame.process_data, "little") for frame in hub.frames if not frame.flags & 3]


def test_a_stall_is_counted_and_followed_by_no_burst() -> None:
    bus = ScriptedBus()
    stall_periods = 30

    def stall(turn: int) -> None:
        if turn == 150:
            bus.exchanges.clear()
            time.sleep(stall_periods * PERIOD_NS / 1e9)

    status, hub = run(300, stall, bus)
    assert status["missed_deadlines"] >= stall_periods - 2
    # Afterwards the polls come at the sensor's pace: making up for the stall would take 30 at once.
    right_after = [moment for moment in bus.exchanges if moment < bus.exchanges[0] + 3 * PERIOD_NS]
    assert len(right_after) < stall_periods / 2
    assert status["sensors"][0]["lost_samples"] >= stall_periods - 3
    got = numbers(hub)
    assert got == sorted(set(got)), "nothing twice, nothing out of order"


def test_lost_frames_cost_no_sample_when_the_next_exchange_comes_in_time() -> None:
    bus = ScriptedBus()
    bus.lose = set(range(200, 400, 20))
    status, hub = run(500, lambda _: None, bus)
    assert status["lost_frames"] == len(bus.lose)
    fetched = [(moment - bus.started_ns) // PERIOD_NS for moment in bus.exchanges]
    lost = {fetched[exchange - 1] for exchange in bus.lose}
    seen = {number for place, number in enumerate(fetched, 1) if place not in bus.lose}
    got = numbers(hub)
    assert got == [number for number in sorted(seen) if number >= got[0]], "all that a frame brought, once"
    assert got[0] < 200, "it has followed the sensor since before"
    assert lost & seen, "a lost frame is followed by another, in time for the same sample"


def test_a_frame_may_take_as_long_as_the_rate_in_force_allows() -> None:
    bus, stream = ScriptedBus(), SensorStream(0, PERIOD_NS)
    seen: list[float] = []

    def change(turn: int) -> None:
        if turn == 10:
            seen.append(bus.timeout_s)
            stream.recover(PERIOD_NS / 4)  # as after a change of settings

    run(6000, change, bus, stream)  # it looks once a second
    seen.append(bus.timeout_s)
    assert seen == pytest.approx([0.75e-9 * PERIOD_NS, 0.75e-9 * PERIOD_NS / 4], rel=0.2)


def test_the_sockets_have_their_turn_even_if_every_deadline_has_passed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus = ScriptedBus()
    receive = bus.receive

    def receive_slowly(timeout_s: float) -> int:
        time.sleep(2 * PERIOD_NS / 1e9)
        return receive(timeout_s)

    monkeypatch.setattr(bus, "receive", receive_slowly)
    _, hub = run(10, lambda _: None, bus)
    assert hub.turns == 10


def test_status_distributions_count_every_cycle() -> None:
    status, _ = run(60, lambda _: None, ScriptedBus())
    assert status["cycles"] >= 60
    for name in ("wake_us", "exchange_us"):
        everything, recent = status[name], status["last_10s"][name]
        assert set(everything) == {"p50", "p99", "p999", "max"}
        assert everything == recent, "a short run lies within the last ten seconds"
