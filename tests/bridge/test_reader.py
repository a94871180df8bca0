"""The reader in memory: no sockets, threads, ROS or real time. What it publishes, logs and waits for."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, cast

import pytest

from bota_ethercat.errors import ConnectionFailedError, UnreachableError
from bota_ethercat.framing import DataMessage, FrameDecoder, encode_data, encode_json
from bota_ethercat.pdo import Sample, encode
from bota_ethercat.text.json_text import JsonObject
from bridge.parameters.table import DEFAULTS
from bridge.stream.link import sentence
from bridge.stream.reader import Reader
from tests.bridge.conftest import Log
from tests.bridge.scripted_server import description, process_data
from tests.server.running import wait_until

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


class Memory:
    """A `Channel`. The other end of each connection is a list of steps; requests are answered at once."""

    is_near = True
    own = ("memory", 0)

    def __init__(self, clock: Clock, attempts: Sequence[Sequence[Step] | Exception]) -> None:
        self.monotonic_ns, self.wait = clock.monotonic_ns, clock.wait
        self.description = description()
        self.on_over: Callable[[], None] = lambda: None
        self._clock, self._attempts = clock, list(attempts)
        self._steps: list[Step] = []
        self._rest = b""

    def connect(self, timeout_s: float) -> bool:
        attempt = self._attempts.pop(0) if self._attempts else UnreachableError("the test is over")
        if isinstance(attempt, Exception):
            if not self._attempts:
                self.on_over()
            raise attempt
        self._steps, self._rest = list(attempt), b""
        return True

    def send(self, data: bytes) -> None:
        decoder = FrameDecoder()
        decoder.feed(data)
        message = cast(JsonObject, decoder.next_message())
        reply = {"reply": message["action"], "id": message["id"], "ok": True, **self.description}
        self._steps.insert(0, encode_json(reply))

    def receive(self, buffer: memoryview, timeout_s: float) -> int:
        while not self._rest and timeout_s > 0:
            step = self._steps.pop(0) if self._steps else ConnectionFailedError("the server closed it")
            if isinstance(step, float):
                self._clock.sleep(step)
            elif isinstance(step, bytes):
                self._rest = step
            elif step is None:
                self._clock.sleep(timeout_s)
                return 0
            else:
                raise step
        data, self._rest = self._rest[: len(buffer)], self._rest[len(buffer) :]
        buffer[: len(data)] = data
        return len(data)

    def shutdown(self) -> None: ...

    def close(self) -> None: ...

    def fileno(self) -> int:
        return -1


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
        self.channel = Memory(self.clock, attempts)
        chosen = DEFAULTS._replace(**parameters)
        self.reader = Reader(
            chosen, self.outputs, self.log, self.failures.append, channel=self.channel, clock=self.clock
        )
        self.channel.on_over = self.reader.client.close

    def run(self) -> list[float]:
        """Run until the attempts are used up; the numbers that were published."""
        self.reader.run()
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


def test_attempts_to_connect_back_off_and_one_line_says_so() -> None:
    bench = Bench(*[UnreachableError("refused") for _ in range(8)])
    bench.run()
    assert bench.clock.pauses == pytest.approx([0.1, 0.15, 0.225, 0.3375, 0.50625, 0.759375, 1.0])
    assert bench.log.lines == ["no server at localhost:12001: refused; trying until there is one"]
    assert bench.reader.link.problem == "refused"


def test_after_a_connection_that_lasted_the_next_attempt_comes_soon() -> None:
    down = [UnreachableError("refused") for _ in range(4)]
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


def test_a_sample_with_an_impossible_time_is_not_published() -> None:
    bench = Bench()
    bench = Bench([bench.frame(1, stamp_ns=2**64 - 1), bench.frame(2, 10**9)])
    assert bench.run() == [2.0]
    assert "a sample with the impossible time 18446744073709551615 ns was not published" in lines(bench)


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
def test_a_server_that_does_not_fit_is_named_once_and_tried_again(
    changes: dict[str, Any], words: str
) -> None:
    bench = Bench([], [], [], UnreachableError("the test is over"))
    bench.channel.description = description(**changes)
    bench.run()
    (line,) = bench.log.lines
    assert line.startswith("connection to localhost:12001 ended: ")
    assert line.endswith("; connecting again")
    assert words in line
    assert line.isprintable()
    assert len(line) < 400


def test_an_error_of_ours_is_reported() -> None:
    bench = Bench([LookupError("a defect")])
    bench.reader.start()
    wait_until(lambda: bench.failures, "the failure")
    assert bench.reader.stop()
    assert bench.failures == ["the reader failed: LookupError: a defect"]
