"""The stream: what the reader publishes, logs and waits for, in simulated time; and which frames are news."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
from collections.abc import Iterable, Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import WRENCH, Values, encode
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat_bridge.parameters.table import Parameters
from bota_ethercat_bridge.stream.frame_selector import (
    BACKLOG_NS,
    FRESH_NS,
    FrameCounts,
    FrameSelector,
    RateLimit,
)
from bota_ethercat_bridge.stream.link import NodeClock, sentence
from bota_ethercat_bridge.stream.reader import NO_FLAGS, Outputs, Reader
from tests.bridge.scripted_server import MemoryServer, ScriptedChannel
from tests.bridge.simulated_node import DEFAULTS, Node, Server, stamp_ns
from tests.descriptions import description

PERIOD_NS = 1_250_000


@pytest.fixture
def quiet() -> Server:
    """A server that sends what the test sends."""
    server = Server()
    server.paused = True
    return server


@pytest.fixture
def node(quiet: Server) -> Iterator[Node]:
    with Node(quiet) as started:
        started.hear("wrench")
        started.run(0.2)
        yield started


def feed(node: Node, server: Server, *chunks: bytes) -> list[float]:
    for chunk in chunks:
        server.send_raw(chunk)
        node.settle()
    return [message.wrench.force.x for message in node.hear("wrench")]


def test_every_fresh_sample_once_with_its_stamp(node: Node, quiet: Server) -> None:
    begin = 10**18
    stream = [quiet.frame(number, stamp_ns=begin + number) for number in range(3)]
    chunks = stream[0] + stream[1], stream[1], stream[2][:30], stream[2][30:]
    assert feed(node, quiet, *chunks) == [0.0, 1.0, 2.0]
    assert [stamp_ns(message) - begin for message in node.hear("wrench")] == [0, 1, 2]
    assert "connected to localhost:12001: sensor 0 (BFT-SENS-ECAT-M8, serial 100, 100 Hz, OP)" in node.log


def test_attempts_to_connect_back_off_and_one_line_says_so(quiet: Server) -> None:
    quiet.listens = False
    with Node(quiet) as node:
        node.run(5.0)
        pauses = [after - before for before, after in itertools.pairwise(quiet.attempted_s)]
        assert pauses[:8] == pytest.approx([0.1, 0.15, 0.225, 0.3375, 0.50625, 0.759, 1.0, 1.0], abs=0.011)
        assert node.log == (
            "no server at localhost:12001 (Connection refused): start ethercat-server, or give its address "
            "(the node keeps trying)"
        )
        quiet.listens = True
        node.run(2.0)  # after a connection that lasted the next attempt comes soon
        quiet.drop()
        node.run(0.2)
        assert "connection to localhost:12001 ended: the server closed it; connecting again" in node.log
        assert node.log.count("connected again") == 1
        assert quiet.connections == 2


@pytest.mark.parametrize(
    "garbage",
    [b"\xff" * 1000, b"\0\0\0\0", b"\0\0\0\x02\x02[", b"\0\0\0\x05\x01abcd", b"\0\0\0\x05\x09abcd"],
)
def test_garbage_ends_only_its_connection(node: Node, quiet: Server, garbage: bytes) -> None:
    feed(node, quiet, quiet.frame(1), garbage + quiet.frame(2))
    assert "is not this protocol" in node.log
    node.run(1.5)
    assert feed(node, quiet, quiet.frame(3)) == [1.0, 3.0]


@pytest.mark.parametrize("impossible_ns", [0, 2**64 - 1])
def test_a_sample_with_an_impossible_time_is_not_published(
    node: Node, quiet: Server, impossible_ns: int
) -> None:
    assert feed(node, quiet, quiet.frame(1, stamp_ns=impossible_ns), quiet.frame(2)) == [2.0]
    assert f"a sample with the impossible time {impossible_ns} ns was not published" in node.log


def test_what_is_not_finite_is_counted_and_logged_now_and_then(node: Node, quiet: Server) -> None:
    for value in (math.nan, math.inf, -math.inf):
        assert feed(node, quiet, quiet.frame(0, process_data=encode(61, {"torque.y": value}))) == []
    assert node.node.reader.not_finite == 3
    assert [line for line in node.log.splitlines() if "not finite" in line] == [
        "a sample with numbers that are not finite was not published (1 so far)"
    ]


def test_events_reach_the_log_and_the_link(node: Node, quiet: Server) -> None:
    seen: list[str | None] = []
    link = node.node.reader.link
    link.on_change = lambda: seen.append(link.lost)
    quiet.send_json({"event": "sensor_lost", "sensor": 0, "message": "no power"})
    quiet.send_json({"event": "sensor_lost", "sensor": 1})
    quiet.send_json({"event": "some\x1b[2Jthing", "detail": "{0}"})
    quiet.send_json({"neither": "event nor reply"})
    quiet.send_json({"event": ["odd"]})
    node.settle()
    assert seen == ["no power"]
    assert node.log.count("no power") == 1
    assert "the server sent the event some?[2Jthing, which this version does not know" in node.log


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({"event": "sensor_lost", "reason": "wkc"}, "the sensor is lost"),
        ({"event": "sensor_back", "lost_s": 1.25}, "the sensor is back after 1.25 s"),
        ({"event": "sensor_back", "lost_s": "long"}, "the sensor is back"),
        ({"event": "emergency", "code": 4096}, "the sensor reports an emergency"),
        ({"event": "emergency", "message": "too hot"}, "too hot"),
        ({"event": "shutting_down"}, "the server is shutting down"),
        (
            {"event": "reconfigured", "settings": {"fir": True, "sinc_length": 128, "chop": False}},
            "the settings of the sensor have changed: fir true, sinc_length 128",
        ),
        (
            {"event": "offset_changed", "sensor": 1, "offset": [1, 2, 3, 0.1, 0.2, 0.3]},
            "the offset of sensor 1 has changed: it is Fx 1.0000 Fy 2.0000 Fz 3.0000 Mx 0.1000 My 0.2000 "
            "Mz 0.3000 (N, Nm)",
        ),
        ({"event": "offset_changed"}, "the offset of the sensor is being changed"),
    ],
)
def test_an_event_is_a_sentence(message: JsonObject, said: str) -> None:
    assert sentence(message, {"sinc_length": 64, "chop": False}) == said


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"protocol": 2}, "speaks protocol 2"),
        ({"protocol": "\x1b[2J" * 100}, "protocol"),
        ({"sensors": None}, "no sensor 0 (it has: none)"),
        ({"sensors": [1, "x", None, {"sensor": False}]}, "no sensor 0 (it has: none)"),
        ({"sensors": [{"sensor": 3}]}, "no sensor 0 (it has: 3): set the parameter 'sensor' to one it has"),
    ],
)
def test_a_server_that_does_not_fit_is_named_once(quiet: Server, changes: dict[str, Any], words: str) -> None:
    quiet.description = description(**changes)
    with Node(quiet) as node:
        node.run(3.0)
        (line,) = node.log.splitlines()
    assert quiet.connections > 2
    assert line.startswith("connection to localhost:12001 ended: ")
    assert line.endswith("; connecting again")
    assert words in line
    assert line.isprintable()
    assert len(line) < 400


# The steady way and the general one.

_COMMON = 12
_RARE: tuple[dict[str, Any], ...] = (
    {"flags": DataFlag.GAP}, {"flags": DataFlag.REPEATED}, {"flags": DataFlag.INVALID},
    {"skip": 2}, {"skip": -3}, {"skip": -10**6}, {"sensor": 1}, {"stamp_ns": 0}, {"late_ns": 70_000_000},
    {"late_ns": -3_000_000}, {"values": {"warnings": 8}}, {"values": {"status": 1}}, {"size": 77},
    {"values": {"force.x": math.nan}}, {"values": {"acceleration.x": math.inf}},
    {"values": {"force_torque_saturated": 4}}, {"event": {"event": "sensor_lost", "sensor": 0}},
    {"event": {"event": "sensor_back", "sensor": 0}}, {"pause_ns": 80_000_000}, {"pause_ns": 300_000_000},
    {"cut": 40}, {"stuck": True}, {"drop": True},
)  # fmt: skip


class Collector:
    """An output that keeps what it gets."""

    parts, topics = (WRENCH,), ()

    def __init__(self) -> None:
        self.got: list[object] = []

    def is_wanted(self) -> bool:
        return True

    def publish(self, values: Values, frame: DataMessage) -> None:
        self.got.append((tuple(map(str, values)), frame))

    def observe(self, values: Values, frame: DataMessage) -> None:
        self.got.append((tuple(map(str, values)), frame, "observed"))

    def configure(self, parameters: Parameters) -> None:
        raise AssertionError


def play(script: list[int], *, steady: bool, limit_hz: float, same_clock: bool) -> list[object]:
    """What a reader publishes and knows of a stream in which these come: common samples and rare things."""
    server, output, said = MemoryServer(), Collector(), list[str]()
    parameters = dataclasses.replace(DEFAULTS, publishing_frequency=limit_hz)
    outputs, channel = Outputs([output]), ScriptedChannel(server)
    channel.same_address = same_clock
    log = SimpleNamespace(info=said.append, warning=lambda text, **_: said.append(text))
    clock = cast("NodeClock", server)
    reader = Reader(parameters, outputs, log, said.append, channel=channel, clock=clock)
    outputs.refresh()
    if not steady:
        reader._read_steady = lambda timeout_s: None  # type: ignore[method-assign]
    reader.read(0.0)
    reader.read(0.0)
    held = bytearray()
    now_ns = server.now_ns
    for number, kind in enumerate(script):
        rare = _RARE[kind - _COMMON] if kind >= _COMMON else {}
        now_ns += PERIOD_NS + rare.get("pause_ns", 0)

        def arrive(number: int = number, rare: dict[str, Any] = rare) -> None:
            if "event" in rare:
                server.send_json(rare["event"])
            if rare.get("drop"):
                server.drop()
                return
            server.sequence += rare.get("skip", 0)
            sent = encode(rare.get("size", 61), {"force.x": float(number), **rare.get("values", {})})
            changes = {key: rare[key] for key in ("flags", "sensor", "stamp_ns") if key in rare}
            monotonic_ns = server.now_ns - 200_000 - rare.get("late_ns", 0)
            server.sequence = max(server.sequence, 1)
            whole = server.frame(0, process_data=sent, monotonic_ns=monotonic_ns, **changes)
            at = rare.get("cut", len(whole))
            held.extend(whole[:at])
            if not rare.get("stuck"):  # else it comes with the next
                server.send_raw(bytes(held))
                held.clear()
            held.extend(whole[at:])

        server.at(now_ns, arrive)
    while server.now_ns < now_ns + 10**9:
        reader.read(0.1)
    state = reader.client.session.state(0)
    reading = state.read(10**9, now_ns + 2 * 10**9, connected=True)
    return [
        *output.got, reader.counts, reader.saturated, reader.not_finite, reader.stamp_ns, reader.pop_ages(),
        reader.pop_flags(NO_FLAGS), reader.link.lost, repr(reading), state.accounting.new_ns, state.unread,
        reader.client._unread_ns > 0, server.connections,
    ]  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.integers(0, _COMMON + len(_RARE) - 1), min_size=5, max_size=80),
    st.sampled_from([0.0, 0.0, 300.0]),
    st.booleans(),
)
def test_the_steady_way_publishes_and_counts_what_the_general_one_does(
    script: list[int], limit_hz: float, same_clock: bool
) -> None:
    ways = [play(script, steady=way, limit_hz=limit_hz, same_clock=same_clock) for way in (False, True)]
    assert ways[0] == ways[1]


def test_nearly_all_samples_of_a_quiet_stream_go_the_steady_way(monkeypatch: pytest.MonkeyPatch) -> None:
    general = list[int]()
    select = Reader._select

    def note(reader: Reader, frames: list[DataMessage]) -> None:
        general.append(len(frames))
        select(reader, frames)

    monkeypatch.setattr(Reader, "_select", note)
    played = play([0] * 400, steady=True, limit_hz=0.0, same_clock=True)
    assert len(played) > 400
    assert sum(general) < 40


# Which frames are news.


class Selecting:
    """A stream of one sample a period, which began at time 0, on its way through a selector."""

    def __init__(self, *, same_clock: bool = True, limit_hz: float = 0.0) -> None:
        self.counts = FrameCounts()
        self.select = FrameSelector(self.counts, same_clock=same_clock, limit_hz=limit_hz)

    def of(self, numbers: Iterable[int], now_ns: int) -> list[int]:
        frames = [DataMessage(number, 0, number * PERIOD_NS, 0, 0, 3, b"") for number in numbers]
        return [frame.sequence for frame in self.select.select(frames, now_ns)]

    def one_by_one(self, begin: int, end: int, age_ns: int = 0) -> list[int]:
        return [n for i in range(begin, end) for n in self.of([i], age_ns + i * PERIOD_NS)]


def test_a_stall_gives_nothing_until_the_stream_is_fresh() -> None:
    selecting = Selecting()
    for start in range(0, 1500, 500):
        assert selecting.of(range(start, start + 500), 1600 * PERIOD_NS) == []
    assert selecting.of(range(1500, 1600), 1600 * PERIOD_NS) == [1599]
    assert selecting.counts.stale == 1599
    alone = Selecting()
    assert alone.of([1], PERIOD_NS + BACKLOG_NS + 1) == []
    assert alone.of([100], 100 * PERIOD_NS + FRESH_NS + 1) == []
    assert alone.of([101], 101 * PERIOD_NS + FRESH_NS) == [101]


@pytest.mark.parametrize("offset_ns", [0, -(10**15), 10**15])
@pytest.mark.parametrize("age_ns", [0, 5_000_000, 30_000_000])
def test_a_stall_costs_no_more_than_itself(offset_ns: int, age_ns: int) -> None:
    """Whatever is usual on this connection: what is queued after 60 ms gives one sample, the next passes.

    Between clocks that differ by `offset_ns` ages are relative.
    """
    selecting = Selecting(same_clock=not offset_ns)
    age_ns += offset_ns
    assert selecting.one_by_one(0, 8, age_ns) == list(range(8))
    for begin in (8, 1008):  # and again: nothing has changed for the rest of the connection
        now = begin + 48
        assert selecting.of(range(begin, now), age_ns + now * PERIOD_NS) == [now - 1]
        assert selecting.one_by_one(now, begin + 1000, age_ns) == list(range(now, begin + 1000))
    assert selecting.counts.stale == 2 * 47


@pytest.mark.parametrize("slower_ns", [80_000_000, 10**12])
def test_a_connection_that_has_become_slower_is_no_backlog_for_long(slower_ns: int) -> None:
    """Nor does a clock that is wrongly taken for ours silence the stream."""
    selecting = Selecting()
    selecting.one_by_one(0, 800)
    assert selecting.one_by_one(800, 900, slower_ns) == list(range(816, 900))  # 20 ms
    assert selecting.of(range(900, 1000), slower_ns + 1000 * PERIOD_NS) == [999]


def test_a_limit_takes_the_newest() -> None:
    selecting = Selecting(limit_hz=100)
    got, passed_over = list[int](), list[int]()
    for begin, end in ((0, 8), (8, 10), (10, 16)):
        got += selecting.of(range(begin, end), end * PERIOD_NS)
        passed_over += [frame.sequence for frame in selecting.select.passed_over]
    assert (got, passed_over) == ([7, 15], [*range(7), *range(8, 15)])
    assert selecting.counts.limited == 14


@pytest.mark.parametrize("limit_hz", [1.0, 99.9, 333.0, 799.0])
@pytest.mark.parametrize("rate_hz", [800, 997, 1333, 1700])
def test_a_limit_below_the_streams_rate_is_kept_and_reached(limit_hz: float, rate_hz: int) -> None:
    limit = RateLimit(limit_hz)
    passed = sum(limit.allows(i * 1_000_000_000 // rate_hz) for i in range(3 * rate_hz))
    assert 3 * limit_hz - 1 <= passed <= 3 * limit_hz + 2


@pytest.mark.parametrize("seed", range(4))
def test_a_limit_equal_to_the_streams_rate_lets_all_pass(seed: int) -> None:
    limit = RateLimit(800.0)
    jitter = random.Random(seed).randint
    assert all(limit.allows(i * PERIOD_NS + jitter(-200_000, 200_000)) for i in range(1, 20_000))


@given(st.lists(st.tuples(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1)), max_size=20))
def test_hostile_numbers_are_survived(rows: list[tuple[int, int]]) -> None:
    for limit_hz, same_clock in itertools.product((0.0, 100.0), (True, False)):
        select = FrameSelector(FrameCounts(), same_clock=same_clock, limit_hz=limit_hz)
        for sequence, monotonic_ns in rows:
            assert len(select.select([DataMessage(sequence, 0, monotonic_ns, 0, 0, 3, b"")], 10**12)) <= 1
