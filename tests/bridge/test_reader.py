"""The reader in memory: no sockets, threads, ROS or real time. What it publishes, logs and waits for."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from bridge.parameters.table import Parameters
from bridge.stream.connection import Connection
from bridge.stream.events import sentence
from bridge.stream.reader import Reader
from protocol.errors import ConnectionFailedError, UnreachableError
from protocol.framing import DataFlag, DataMessage, encode_data, encode_json
from protocol.pdo import ImuUnits, Sample, encode
from protocol.text.json_text import JsonObject
from tests.bridge.conftest import Log, wait_until
from tests.bridge.scripted_server import description, process_data

PERIOD_NS = 1_250_000
Step = bytes | float | None | Exception
"""Bytes that arrive, seconds that pass before the next, None for silence, or how it ends."""


class Clock:
    """Only moves on when it is told to, or waited for: it notes the pauses, and lets them pass."""

    def __init__(self) -> None:
        self.ns = 5 * 10**9
        self.pauses: list[float] = []

    def monotonic(self) -> float:
        return self.ns / 1e9

    def monotonic_ns(self) -> int:
        return self.ns

    def time_ns(self) -> int:
        return self.ns

    def sleep(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        self.pauses.append(seconds)
        self.sleep(seconds)
        return event.is_set()


class Memory(Connection):
    """A connection whose other end is a list of steps; it answers requests as a server does."""

    def __init__(self, clock: Clock, steps: Sequence[Step], answer: Callable[[str], JsonObject]) -> None:
        from protocol.framing import FrameDecoder

        self._replies, self._decoder = {}, FrameDecoder()
        self._clock, self._steps, self._answer = clock, list(steps), answer
        self._ids = itertools.count(1)
        self._send_lock = threading.Lock()
        self.same_machine = True
        self.is_closed = False

    def send(self, message: JsonObject) -> None:
        action = str(message["action"])
        reply = {"reply": action, "id": message["id"], "ok": True, **self._answer(action)}
        self._steps.insert(0, encode_json(reply))

    def receive(self, *, wait: bool = True) -> bool | None:
        while self._steps:
            step = self._steps.pop(0)
            if isinstance(step, float):
                self._clock.sleep(step)
            elif isinstance(step, bytes):
                self._decoder.feed(step)
                return False
            elif step is None:
                return None
            else:
                raise step
        raise ConnectionFailedError("the server closed it")

    def shutdown(self) -> None:
        self.is_closed = True

    def close(self) -> None:
        self.is_closed = True


class Output:
    """Notes the samples."""

    fields = ("force",)

    def __init__(self) -> None:
        self.samples: list[tuple[float, int]] = []
        self.followed: list[float] = []

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        self.samples.append((sample.force[0], frame.stamp_ns))

    def follow(self, sample: Sample, frame: DataMessage) -> None:
        self.followed.append(sample.force[0])


class Outputs:
    """One output that somebody has subscribed to."""

    def __init__(self) -> None:
        self.output = Output()
        self.wanted = (self.output,)
        self.partly: list[Sample] = []

    def publish_finite(self, sample: Sample, frame: DataMessage) -> None:
        self.partly.append(sample)


class Bench:
    """A reader, and the attempts to connect that it is to make: the steps of a connection, or an error."""

    def __init__(self, *attempts: Sequence[Step] | Exception, **parameters: Any) -> None:
        self.clock = Clock()
        self.outputs = Outputs()
        self.log = Log(None)
        self.failures: list[str] = []
        self.description = description()
        self.connections: list[Memory] = []
        self._attempts = list(attempts)
        chosen = Parameters("localhost", 12001, 0, 0.0, "array", ImuUnits.G_DPS)._replace(**parameters)
        self.reader = Reader(
            chosen, self.outputs, self.log, self.failures.append,
            connect=self._connect, clock=self.clock,
        )  # fmt: skip

    def _connect(self, host: str, port: int) -> Connection:
        assert (host, port) == ("localhost", 12001)
        if not self._attempts:
            self.reader._stopping.set()
            raise UnreachableError("the test is over")
        attempt = self._attempts.pop(0)
        if isinstance(attempt, Exception):
            raise attempt
        self.connections.append(Memory(self.clock, attempt, lambda _action: self.description))
        return self.connections[-1]

    def run(self) -> list[float]:
        """Run until the attempts are used up; the numbers that were published."""
        self.reader.run()
        assert all(connection.is_closed for connection in self.connections)
        return [number for number, _ in self.outputs.output.samples]

    def frame(self, number: float, after_ns: int = 0, **changes: Any) -> bytes:
        """Sample `number` (its sequence too), taken `after_ns` after the bench began."""
        at = self.clock.ns + after_ns
        message = DataMessage(round(number), 10**18 + at, at, 0, 0, 3, process_data(number))
        return encode_data(*message._replace(**changes))


def lines(bench: Bench) -> str:
    return "\n".join(bench.log.lines)


def test_every_sample_once_with_its_stamp() -> None:
    bench = Bench([])
    stream = [bench.frame(number, number * PERIOD_NS) for number in range(3)]
    bench = Bench([stream[0] + stream[1], stream[1], stream[2][:30], stream[2][30:]])
    assert bench.run() == [0.0, 1.0, 2.0]
    at = bench.outputs.output.samples[0][1]
    assert [stamp - at for _, stamp in bench.outputs.output.samples] == [0, PERIOD_NS, 2 * PERIOD_NS]
    assert "connected to localhost:12001: sensor 0 (BFT-SENS-ECAT-M8, serial 1, 800 Hz, OP)" in lines(bench)


def test_what_is_not_new_is_not_published() -> None:
    bench = Bench()
    flags = (DataFlag.REPEATED, DataFlag.INVALID, DataFlag.INVALID | DataFlag.REPEATED | DataFlag.GAP)
    stream = [bench.frame(n, n, flags=int(flag)) for n, flag in enumerate(flags, 1)]
    bench = Bench([*stream, bench.frame(4, 4, sensor=1), bench.frame(5, 5)])
    assert bench.run() == [5.0]


def test_attempts_to_connect_back_off_and_one_line_says_so() -> None:
    bench = Bench(*[UnreachableError("refused")] * 8)
    bench.run()
    assert bench.clock.pauses == pytest.approx([0.1, 0.15, 0.225, 0.3375, 0.50625, 0.759375, 1.0, 1.0])
    assert bench.log.lines == ["no server at localhost:12001: refused; trying until there is one"]
    assert bench.reader.link.problem == "the test is over"


def test_after_a_connection_that_lasted_the_next_attempt_comes_soon() -> None:
    down = [UnreachableError("refused")] * 4
    bench = Bench(*down, [1.5, ConnectionFailedError("reset")], [0.5])
    bench.run()
    assert bench.clock.pauses[4:6] == pytest.approx([0.1, 0.15])
    assert "connection to localhost:12001 ended: reset; connecting again" in bench.log.lines
    assert sum("connected again" in line for line in bench.log.lines) == 1


@pytest.mark.parametrize(
    "garbage",
    [b"\xff" * 1000, b"\0\0\0\0", b"\0\0\0\x02\x02[", b"\0\0\0\x05\x01abcd", b"\0\0\0\x05\x09abcd"],
)
def test_garbage_ends_the_connection_and_the_next_one_works(garbage: bytes) -> None:
    bench = Bench()
    first, second, third = (bench.frame(number, number * 10**9) for number in (1, 2, 3))
    bench = Bench([first, garbage + second], [third])
    assert bench.run() == [1.0, 3.0]
    assert "is not this protocol" in lines(bench)


def test_an_impossible_time_is_garbage() -> None:
    bench = Bench()
    bench = Bench([bench.frame(1, stamp_ns=2**64 - 1)], [bench.frame(2, 10**9)])
    assert bench.run() == [2.0]
    assert "a frame has the impossible time 18446744073709551615 ns" in lines(bench)


def test_after_a_stall_nothing_old_is_published() -> None:
    bench = Bench()
    stream = [bench.frame(number, number * PERIOD_NS) for number in range(1000)]
    now = 960 * PERIOD_NS / 1e9  # when the node goes on, 960 frames are waiting
    bench = Bench([stream[0], now, b"".join(stream[1:960]), *stream[960:]])
    assert bench.run() == [0.0, *range(959, 1000)]
    assert bench.reader.counts.stale == 958


def test_silence_and_its_end_are_logged_once() -> None:
    bench = Bench()
    bench = Bench([None, None, None, bench.frame(1), bench.frame(2, 1)])
    bench.run()
    assert bench.log.lines[1:3] == [
        "nothing came from localhost:12001 for 1 s",
        "localhost:12001 sends again",
    ]


def test_numbers_that_are_not_finite_are_counted_and_logged_every_ten_seconds() -> None:
    bench = Bench()
    frames = [
        bench.frame(n, n * 10**9, process_data=encode(61, {"torque.y": value}))
        for n, value in enumerate([math.nan, math.inf, -math.inf, math.nan] * 3)
    ]
    bench = Bench([step for frame in frames for step in (frame, 1.0)])
    assert bench.run() == []
    assert len(bench.outputs.partly) == bench.reader.not_finite == 12
    said = [line for line in bench.log.lines if "not finite" in line]
    assert [line.split("(")[1] for line in said] == ["1 so far)", "11 so far)"]


def test_a_limit_to_the_rate_follows_what_it_leaves_out() -> None:
    bench = Bench()
    stream = [bench.frame(number, number * PERIOD_NS) for number in range(80)]
    bench = Bench(stream, publishing_frequency=100.0)
    published = bench.run()
    assert len(published) <= 12
    assert sorted([*published, *bench.outputs.output.followed]) == list(range(80))


def test_events_reach_the_log_and_the_link() -> None:
    lost = {"event": "sensor_lost", "sensor": 0, "message": "no power"}
    other = {"event": "sensor_lost", "sensor": 1}
    odd: list[JsonObject] = [
        {"event": "some\x1b[2Jthing", "detail": "{0}"},
        {"neither": "event nor reply"},
        {"event": ["odd"]},
    ]
    bench = Bench([encode_json(message) for message in (lost, other, *odd)])
    seen: list[str | None] = []
    bench.reader.link.on_change = lambda: seen.append(bench.reader.link.lost)
    bench.run()
    assert seen == [None, "no power", None]
    text = lines(bench)
    assert text.count("no power") == 1
    assert "the server sent the event some?[2Jthing, which this version does not know" in text


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({"event": "sensor_lost", "reason": "wkc"}, "the server has lost the sensor"),
        (
            {"event": "sensor_back", "lost_s": 1.25, "settings": {"fir": True}},
            "the sensor is back after 1.25 s",
        ),
        ({"event": "sensor_back", "lost_s": "long"}, "the sensor is back"),
        (
            {"event": "reconfigured", "settings": {"fir": True, "sinc_length": 128, "chop": False}},
            "the sensor was reconfigured: fir true, sinc_length 128",
        ),
        ({"event": "reconfigured", "settings": {"chop": False}}, "the sensor was reconfigured"),
        (
            {"event": "offset_changed", "offset": [1, 2, 3, 0.1, 0.2, 0.3]},
            "the sensor's own offset is Fx 1.0000 Fy 2.0000 Fz 3.0000 Mx 0.1000 My 0.2000 Mz 0.3000 (N, Nm) "
            "now",
        ),
        ({"event": "offset_changed", "offset": [1]}, "the sensor's own offset is no longer known"),
        ({"event": "emergency", "code": 4096}, "the sensor reports an emergency"),
        ({"event": "emergency", "message": "too hot"}, "the sensor reports an emergency: too hot"),
        ({"event": "shutting_down"}, "the server is shutting down"),
    ],
)
def test_an_event_is_a_sentence(message: JsonObject, said: str) -> None:
    assert sentence(message, {"sinc_length": 64, "chop": False}) == said


def test_a_server_without_the_sensor_is_tried_again() -> None:
    bench = Bench([], [])
    bench.description = description(sensors=[])
    bench.run()
    assert bench.log.lines == [
        "connection to localhost:12001 ended: the server has no sensor 0 (it has: none): set the parameter "
        "'sensor' to one it has; connecting again"
    ]


def test_an_error_of_ours_is_reported() -> None:
    bench = Bench([LookupError("a defect")])
    bench.reader.start()
    wait_until(lambda: bench.failures, "the failure")
    assert bench.reader.stop()
    assert bench.failures == ["the reader failed: LookupError: a defect"]
