"""What runs for hours costs in its tenth hour what it cost in its second minute, in memory and in work.

In the hours between samples and reports are rare: enough for what keeps one thing more for each.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FrameType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import pytest

from bota_clients.monitor import words
from bota_clients.monitor.model import Model
from bota_clients.monitor.screen import table
from bota_clients.monitor.web.pages import Pages, WebModel
from bota_clients.record import recorder as recording
from bota_clients.replay.pacing import Pacing
from bota_ethercat.control import Event, event
from bota_ethercat.framing import DataMessage
from bota_ethercat.health import observer
from ethercat_server.virtual_sensor.options import SensorOptions
from scripts.demonstration import program as demo
from tests.bridge.simulated_node import Node, Server
from tests.clients.monitor_states import ADDRESS, OWN_PEER, PERIOD_NS, description, frame, status
from tests.simulation import Simulation
from tests.test_demo import arrive, told

MINUTE_S, HOURS_S = 60.0, 36_000.0
RUNNING = ExitStack()  # what is to be ended behind a test
APART, FAR_APART = 16, 16000  # samples at 800 Hz from one to the next in a minute, and in the hours
BATCH = 10
_NOT_KEPT = (type, ModuleType, BuiltinFunctionType, CodeType, FrameType)

# What passes a minute, and hours; what is kept meanwhile.
Soaked = tuple[Callable[[], object], Callable[[], object], Sequence[object]]


def size(*roots: object) -> int:
    """Bytes of all that they reach."""
    seen, waiting, total = set[int](), [*roots], 0
    while waiting:
        each = waiting.pop()
        if id(each) in seen or isinstance(
            each, type | ModuleType | BuiltinFunctionType | CodeType | FrameType
        ):
            continue
        seen.add(id(each))
        total += sys.getsizeof(each)
        waiting += (each.__closure__ or ()) if isinstance(each, FunctionType) else gc.get_referents(each)
    return total


def calls(act: Callable[[], object]) -> int:
    """How many calls of functions this takes."""
    counter = count()
    sys.setprofile(lambda _, what, __: what in ("call", "c_call") and next(counter))
    try:
        act()
    finally:
        sys.setprofile(None)
    return next(counter)


def fed(take: Callable[[list[DataMessage]], object], *kept: object, each_second: Any = None) -> Soaked:
    """`take` gets batches of frames, and `each_second` the newest of a second."""
    number = sequence = second = 0

    def run(seconds: float, apart: int, of: int) -> None:
        nonlocal number, sequence, second
        for _ in range(round(seconds * 1e9 / PERIOD_NS / apart / of)):
            frames = [
                frame(number + apart * n, {"force.z": n})._replace(sequence=sequence + n) for n in range(of)
            ]
            number, sequence = number + apart * of, sequence + of
            take(frames)
            if each_second and second != (second := number // 800):
                each_second(frames[-1])

    return lambda: run(MINUTE_S, APART, BATCH), lambda: run(HOURS_S, FAR_APART // 2, 2), kept


def monitor_shows(_: Path) -> Soaked:
    model = Model(ADDRESS)
    model.connected(description(), OWN_PEER, 1000.0)

    def take(frames: list[DataMessage]) -> None:
        model.note_unread(0.001, False, frames[-1].monotonic_ns * 1e-9)
        model.add_frames(frames, frames[-1].monotonic_ns * 1e-9)
        model.note_age(frames[-1], frames[-1].monotonic_ns + 200_000)

    def each_second(newest: DataMessage) -> None:
        now_s = newest.monotonic_ns * 1e-9
        model.add_status(status(sent=newest.sequence), now_s)
        model.add_event(event(Event.OFFSET_CHANGED, sensor=0, offset=[0.0] * 6), now_s)
        table(model.state(now_s))
        words.json_line(model.state(now_s), now_s)

    return fed(take, model, each_second=each_second)


def page_is_served(_: Path) -> Soaked:
    model = WebModel(ADDRESS)
    model.connected(description(), OWN_PEER, 1000.0)
    recorder: Any = SimpleNamespace(ended=lambda: None, running=False)
    pages = Pages(model, lambda *_: pytest.fail("nobody asked"), recorder)
    page, _slow = pages.join(), pages.join()
    assert page is not None

    def take(frames: list[DataMessage]) -> None:
        model.add_frames(frames, frames[-1].monotonic_ns * 1e-9)
        pages.collect(frames[-1].monotonic_ns * 1e-9)
        pages.points(page)

    return fed(take, pages, each_second=lambda newest: pages.state(newest.monotonic_ns * 1e-9))


def doctor_watches(_: Path) -> Soaked:
    watching = observer.StreamObserver(800.0, 10**12)

    def take(frames: list[DataMessage]) -> None:
        now_ns = frames[-1].monotonic_ns
        watching.add_frames(frames, now_ns)
        watching.note_age(frames[-1], now_ns + 200_000)
        watching.note_unread((now_ns % 997 * 1e-6, False), now_ns)

    return fed(take, watching)


def demo_shows(_: Path) -> Soaked:
    """And `check_subscription` counts."""
    shown = demo.Shown()

    def take(frames: list[DataMessage]) -> None:
        for each in frames:
            arrive(shown, each.sequence)
        told(shown, each.sequence, each.sequence)

    return fed(take, shown, each_second=lambda _: shown.line())


def recorder_records(folder: Path) -> Soaked:
    recorder, written = recording.Recorder(folder / "soak.mcap", "soak", {}, overwrite=False), 0
    RUNNING.callback(recorder.stop, "enough")

    def take(frames: list[DataMessage]) -> None:
        nonlocal written
        recorder.put([*frames])
        written += len(frames)
        while recorder.saved < written:
            time.sleep(0)

    writer = recorder._writer
    kept = [*vars(recorder).values(), *vars(writer).values(), *vars(writer._mcap).values()]
    return fed(take, *(each for each in kept if each not in (writer, writer._mcap, recorder._thread)))


def replay_repeats(_: Path) -> Soaked:
    pacing = Pacing(1.0, lambda: 10**12, lambda: 10**18)

    def take(frames: list[DataMessage]) -> None:
        for each in frames:
            pacing.due(each)

    return fed(take, pacing, each_second=lambda _: pacing.begin_again())


def node_publishes(_: Path) -> Soaked:
    server = Server()
    node = Node(server, tool_mass=0.8)
    for name in ("wrench_compensated", "/diagnostics"):
        node.hear(name)

    def run(seconds: float, silent_s: float = 0.0) -> None:
        for _ in range(round(seconds / (0.01 + silent_s))):
            server.now_ns += round(silent_s * 1e9)
            node.step()
            for topic in node.topics.values():
                topic.messages.clear()
                topic.serialized.clear()
            server.requests.clear()

    kept = [node.node.reader, node.node.monitor, node.node.compensation]
    return lambda: run(MINUTE_S / 12), lambda: run(HOURS_S, 100.0), kept


def server_samples(_: Path) -> Soaked:
    """For minutes, as each exchange is simulated."""
    simulation = Simulation(SensorOptions(signal="rest"), settings={"sinc_length": 1024})
    client = simulation.subscribe()
    simulation.note = lambda made: None  # type: ignore[method-assign]

    def run(seconds: int) -> None:
        for _ in range(seconds):
            simulation.run(1.0)
            client.frames.clear()
            client.send("status")
        client.replies.clear()

    run(60)
    return lambda: run(10), lambda: run(60), [simulation.server]


@pytest.mark.parametrize(
    "program",
    [demo_shows, monitor_shows, page_is_served, doctor_watches, recorder_records, replay_repeats,
     node_publishes, server_samples],
)  # fmt: skip
def test_the_tenth_hour_costs_what_the_second_minute_did(
    program: Callable[[Path], Soaked], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(observer, "_MAX_KEPT", 100)
    monkeypatch.setattr(recording, "FLUSH_S", 0.0)
    with RUNNING:
        minute, hours, kept = program(tmp_path)
        minute()
        before = calls(minute), size(*kept)
        hours()
        minute()
        after = calls(minute), size(*kept)
    assert after[0] <= 1.02 * before[0]
    assert after[1] <= 1.02 * before[1] + 4096
