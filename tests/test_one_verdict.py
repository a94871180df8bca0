"""One judge: monitor, doctor, report and node say the same of the same stream, each the way it takes it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import pytest

from bridge.diagnostics.compensation_state import CompensationState
from bridge.diagnostics.health import judge as judge_node
from bridge.diagnostics.health import stream_verdict
from bridge.diagnostics.observer import Observer
from bridge.stream.frame_selector import FrameCounts, FrameSelector
from bridge.stream.link import Link
from bridge.stream.reader import Reader
from bridge.stream.watch import Watch
from clients.monitor.model.server import Model
from clients.monitor.view.table import table
from clients.monitor.view.table import verdict as monitor_verdict
from clients.report.examine import examine
from clients.report.page.page import as_json
from ethercat_server.access.sensors import Sensors
from ethercat_server.doctor.bus.server_view import ServerView
from ethercat_server.doctor.finding import Level as Found
from protocol.accounting import NOT_NEW, StreamAccounting
from protocol.client.client import Client
from protocol.framing import DataFlag, DataMessage
from protocol.health.judge import Observation, judge
from protocol.health.limits import LIMITS
from protocol.health.observer import p99
from protocol.health.verdict import Level
from protocol.pdo import SampleDecoder, encode
from tests.clients.simulated import described, simulate, subject_of

PERIOD_NS = 1_250_000
START_NS = 10**12
BATCH_NS = 50_000_000
SECOND_NS = 10**9
COUNT = 800


class Stream(NamedTuple):
    """A second of one sensor's frames, and how old each is when it comes."""

    frames: Sequence[DataMessage]
    age_ns: int = 200_000

    @property
    def start_ns(self) -> int:
        return self.frames[0].monotonic_ns - 500_000 + self.age_ns

    def batches(self) -> Iterator[tuple[int, list[DataMessage]]]:
        """What has come in each twentieth of the second, and when its last frame came."""
        for number in range(SECOND_NS // BATCH_NS):
            begin_ns = self.start_ns + number * BATCH_NS
            batch = [f for f in self.frames if begin_ns <= f.monotonic_ns + self.age_ns < begin_ns + BATCH_NS]
            yield batch[-1].monotonic_ns + self.age_ns if batch else begin_ns + BATCH_NS, batch

    @property
    def end_ns(self) -> int:
        return self.start_ns + SECOND_NS


def frame(k: int, period_ns: float = PERIOD_NS, flags: int = 0, **values: float) -> DataMessage:
    moment_ns = START_NS + round(k * period_ns)
    noise = 0.01 * math.sin(k * k)
    data = {"force.z": -8 + noise, "torque.x": noise, "acceleration.z": 1.0, "temperature": 30.0, **values}
    return DataMessage(k, moment_ns, moment_ns, 0, flags, 3, encode(61, data))


def second(period_ns: float = PERIOD_NS, **changed: Mapping[int, DataMessage]) -> list[DataMessage]:
    other = changed.get("other", {})
    return [other.get(k) or frame(k, period_ns) for k in range(int(SECOND_NS / period_ns))]


def of_simulation(*commands: str) -> list[DataMessage]:
    """The last second of a virtual sensor's two, when the server has found its clock."""
    every = simulate(2.0, *commands, seed=1)
    return [f for f in every if f.monotonic_ns > every[-1].monotonic_ns - SECOND_NS + 2 * PERIOD_NS]


STREAMS: dict[str, tuple[Callable[[], Stream], Level, str]] = {
    "clean": (lambda: Stream(second()), Level.GOOD, "Nothing is wrong with the stream"),
    "clean, of the virtual sensor": (lambda: Stream(of_simulation()), Level.GOOD, "Nothing is wrong"),
    "skip 50": (lambda: Stream(of_simulation("skip 50")), Level.TROUBLE, "290 of 692 samples (42 %)"),
    "a few lost": (
        lambda: Stream([f if k != 400 else f._replace(flags=DataFlag.GAP)
                        for k, f in enumerate([*second()[:400], *(f._replace(sequence=f.sequence - 3) for f in
                                                                  second()[403:])])]),
        Level.LOOK, "3 of 800 samples (0.38 %) were lost",
    ),
    "one invalid frame": (
        lambda: Stream(second(other={400: frame(400, flags=DataFlag.INVALID)})),
        Level.LOOK, "1 frame was invalid, the sensor did not answer the bus: check its cable and power",
    ),
    "sensor lost": (
        lambda: Stream([f if f.sequence < 224 else f._replace(flags=DataFlag.INVALID) for f in second()]),
        Level.TROUBLE, "No new sample for 0.7 s, the sensor does not answer the bus: check its cable",
    ),
    "stuck": (
        lambda: Stream([f if f.sequence < 224 else f._replace(flags=DataFlag.REPEATED) for f in second()]),
        Level.TROUBLE, "No new sample for 0.7 s, the sensor repeats the same sample again and again",
    ),
    "slow rate": (
        lambda: Stream(second(1e9 / 760)), Level.LOOK, "760 samples a second instead of 800",
    ),
    "half the rate": (
        lambda: Stream(second(1e9 / 400)), Level.TROUBLE, "400 samples a second instead of 800",
    ),
    "old samples": (
        lambda: Stream(second(), age_ns=100_000_000), Level.TROUBLE, "Samples are 100.0 ms old on arrival",
    ),
    "a little old": (
        lambda: Stream(second(), age_ns=12_000_000), Level.LOOK, "Samples are 12.0 ms old on arrival (p99)",
    ),
    "saturated": (
        lambda: Stream(second(other={k: frame(k, force_torque_saturated=4) for k in range(400, 410)})),
        Level.TROUBLE, "Force/torque (ADC) saturated: Fz: reduce sensor loading",
    ),
    "overtemperature": (
        lambda: Stream(second(other={400: frame(400, warnings=0x20)})),
        Level.LOOK, "Overtemperature: power off the sensor and let it cool down",
    ),
    "hot": (
        lambda: Stream([frame(k, temperature=66.0) for k in range(COUNT)]),
        Level.LOOK, "The sensor has 66.0 °C: let it cool down",
    ),
    "repeated": (
        lambda: Stream(second(other={k: frame(k, flags=DataFlag.REPEATED) for k in range(400, 405)})),
        Level.LOOK, "5 frames were repeated, the sensor had nothing new: if it goes on, power-cycle it",
    ),
    "NaN": (
        lambda: Stream(second(other={400: frame(400, **cast(Any, {"force.z": math.nan}))})),
        Level.TROUBLE, "Samples have values that are not finite: power-cycle the sensor",
    ),
}  # fmt: skip

ROW = described()
STATUS = {
    "sensors": [{
        "sensor": 0, "fresh": 9, "repeated": 0, "invalid": 0, "lost_samples": 0, "recoveries": 0,
        "not_finite": 0, "clock": {"mode": "locked"},
    }],
    "uptime_s": 9.0, "cycles": 9, "missed_deadlines": 0, "lost_frames": 0, "clients": [],
}  # fmt: skip
Said = tuple[Level, str]


def monitor(stream: Stream) -> Said:
    model = Model("server")
    start_s = stream.start_ns * 1e-9
    model.connected({"version": "1", "sensors": [ROW]}, "", start_s)
    model.take_status(STATUS, start_s)
    for at_ns, frames in stream.batches():
        model.take(frames, at_ns * 1e-9)
        for newest in frames[-1:]:
            model.note_age(newest, at_ns)
    state = model.state(stream.end_ns * 1e-9)
    [sensor] = state.sensors
    verdict = sensor.verdict
    assert monitor_verdict(state)[0] is verdict.level
    assert table(state)[-1].startswith(f"{verdict.headline}: ")
    assert verdict.sentence in table(state)[-1]
    return verdict.level, verdict.sentence


def doctor(stream: Stream, after: Mapping[str, Any] = STATUS) -> Said:
    clock = SimpleNamespace(now_ns=stream.start_ns)
    clock.monotonic_ns = lambda: clock.now_ns

    def listen(_: float, on_frames: Callable[[Sequence[DataMessage]], None]) -> list[Any]:
        for at_ns, frames in stream.batches():
            clock.now_ns = at_ns
            on_frames(frames)
        clock.now_ns = stream.end_ns
        return []

    statuses = iter((STATUS, after))
    link = SimpleNamespace(
        clock=clock, listen=listen, same_machine=True, close=lambda: None,
        ask=lambda action: {"sensors": [ROW]} if action == "describe" else next(statuses),
    )  # fmt: skip
    view = ServerView(cast(Sensors, link), 1.0, own=False)
    [finding] = view.sensors()
    verdict = judge(view.observation(0))
    assert finding.values["verdict"] == verdict.level.key
    assert (
        finding.level
        is {Level.GOOD: Found.OK, Level.LOOK: Found.WARNING, Level.TROUBLE: Found.BAD}[verdict.level]
    )
    assert all(each.found in finding.found for each in verdict.findings)
    return verdict.level, verdict.sentence


def report(stream: Stream) -> Said:
    ages_us = [stream.age_ns / 1e3 for _, frames in stream.batches() if frames]
    examination = examine(replace(subject_of(stream.frames, ROW), age_p99_us=p99(ages_us)))
    verdict = examination.stream
    assert f'"stream": {{\n   "verdict": "{verdict.level.key}",' in as_json([examination])
    assert all(any(each.found in check.found for check in examination.checks) for each in verdict.findings)
    return verdict.level, verdict.sentence


def node(stream: Stream) -> Said:
    clock = SimpleNamespace(now_ns=stream.start_ns)
    clock.monotonic = lambda: clock.now_ns * 1e-9
    client, counts, watch = Client(1, sensors=[0]), FrameCounts(), Watch()
    client.session.same_machine = True
    link, accounting = Link(client, 0, cast(Any, clock)), StreamAccounting(counts)
    selector = FrameSelector(counts, same_clock=True)
    accounting.rate_hz = float(ROW["rate_hz"])
    reader = SimpleNamespace(link=link, counts=counts, watch=watch, not_finite=0, newest_ns=-1)
    observer = Observer(cast(Reader, reader), CompensationState)
    link.connected({"sensors": [ROW]})
    observer._poll = cast(Any, SimpleNamespace(collect=lambda _: None, status=STATUS, owed_s=lambda _: 0.0))
    observer.look(clock.monotonic())
    decode = SampleDecoder(61).decode
    for at_ns, frames in stream.batches():
        clock.now_ns = at_ns
        fresh = accounting.select_new(frames, 0)
        watch.see(fresh)
        for new in selector.select(fresh, at_ns) if fresh else ():
            watch.sample = decode(new.process_data)
            reader.not_finite += not watch.sample.is_finite
        reader.newest_ns = accounting.new_ns
        for newest in frames[-1:]:
            if not newest.flags & NOT_NEW:
                watch.ages.append(at_ns - newest.monotonic_ns)
        observer.look(clock.monotonic())
    clock.now_ns = stream.end_ns
    observer.measure(clock.monotonic())
    snapshot = observer.look(clock.monotonic())
    verdict = stream_verdict(snapshot, LIMITS)
    said = " ".join(status.message for status in judge_node(snapshot, LIMITS))
    assert not verdict.findings or verdict.sentence in said
    return verdict.level, verdict.sentence


@pytest.mark.parametrize(
    "seen",
    [
        Observation(silent_s=1.0, invalid=5),
        Observation(is_lost=True),
        Observation(samples=800, invalid=2),
        Observation(samples=800, recoveries=1),
    ],
)
def test_a_computer_that_stood_still_is_blamed_in_place_of_the_cable(seen: Observation) -> None:
    for missed, cable in ((0, True), (8, True), (24, False)):
        verdict = judge(seen._replace(nominal_hz=800.0, missed_deadlines=missed))
        assert ("its cable" in verdict.sentence) is cable
        assert ("computer stood still" in verdict.sentence) is not cable


def test_the_doctor_knows_whether_it_stood_still() -> None:
    [row] = cast(list[dict[str, Any]], STATUS["sensors"])
    row = {**row, "recoveries": 1}
    level, said = doctor(Stream(second()), {**STATUS, "missed_deadlines": 24, "sensors": [row]})
    assert level is Level.LOOK
    assert said.startswith(
        "The server lost the sensor once and has it back: the server's computer stood still"
    )


def test_the_documented_verdicts_are_these() -> None:
    rows = (Path(__file__).parent.parent / "docs" / "operations.md").read_text().splitlines()
    for row in (
        f"| no new sample | | for {LIMITS.stale_after:g} s |",
        f"| lost samples, invalid frames | any | above {100 * LIMITS.lost_error:g} %, and at least "
        f"{1000 * LIMITS.lost_error_s:g} ms together |",
        f"| rate off by | {100 * LIMITS.rate_tolerance:g} % | {100 * LIMITS.rate_error:g} % |",
        f"| age on arrival (p99) | {1000 * LIMITS.age_warn:g} ms | {1000 * LIMITS.age_error:g} ms |",
        f"| temperature | {LIMITS.temperature_warn:g} °C; below {LIMITS.coldest:g} °C | "
        f"{LIMITS.temperature_error:g} °C |",
    ):
        assert row in rows
    assert any(f"emergency in the last {LIMITS.emergency_s:g} s" in row for row in rows)


@pytest.mark.parametrize("name", STREAMS)
def test_the_same_stream_gets_one_verdict_and_one_sentence(name: str) -> None:
    make, level, words = STREAMS[name]
    stream = make()
    said = {program.__name__: program(stream) for program in (monitor, doctor, report, node)}
    assert len(set(said.values())) == 1, said
    assert said["monitor"][0] is level, said
    assert words in said["monitor"][1]
