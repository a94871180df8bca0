"""The golden vectors: what docs/protocol.md says in bytes is what the Python code does."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from bota_ethercat.accounting import StreamAccounting, StreamCounts
from bota_ethercat.client import Client
from bota_ethercat.framing import DataMessage, encode_data
from bota_ethercat.pdo import ImuUnits, SampleDecoder
from bota_ethercat.text.json_text import JsonObject
from tests.bridge.scripted_server import MemoryServer, ScriptedChannel
from tests.golden_vectors import (
    ACCOUNTED,
    BEGIN_NS,
    BROKEN,
    CHANNELS,
    DATA,
    JSON,
    READ,
    STREAMS,
    ReadStream,
    Vector,
    expected,
    outcomes,
    same_sample,
)


def test_samples() -> None:
    for vector in DATA:
        message = vector.outcome
        assert isinstance(message, DataMessage)
        assert encode_data(*message) == vector.wire, vector.name
        for units, sample in ((ImuUnits.G_DPS, vector.sample), (ImuUnits.SI, vector.sample_si)):
            assert sample is not None
            decoded = SampleDecoder(len(message.process_data), units).decode(message.process_data)
            assert same_sample(decoded, sample), (vector.name, decoded)


def test_each_alone_and_whether_what_follows_is_read() -> None:
    for vector in (*DATA, *JSON, *BROKEN):
        assert outcomes([vector.wire]) == [vector.outcome], vector.name
        after = [vector.outcome] if vector.outcome == "broken" else [vector.outcome, JSON[0].outcome]
        assert outcomes([vector.wire + JSON[0].wire]) == after, vector.name


@pytest.mark.parametrize("vectors", STREAMS.values(), ids=STREAMS)
def test_streams_cut_at_every_byte(vectors: list[Vector]) -> None:
    wire = b"".join(vector.wire for vector in vectors)
    for cut in range(len(wire) + 1):
        assert outcomes([wire[:cut], wire[cut:]]) == expected(vectors), cut
    assert outcomes([bytes((byte,)) for byte in wire]) == expected(vectors)


def test_accounting() -> None:
    for stream in ACCOUNTED:
        accounting = StreamAccounting(every=stream.every, fresh_only=stream.fresh_only)
        accounting.rate_hz = stream.rate_hz
        for step in stream.frames:
            if step == "begin":
                accounting.begin()
            else:
                sequence, monotonic_ns, flags, kind = step
                if flags or not accounting.count_next(sequence, monotonic_ns):
                    assert accounting.count(*step[:3]).name == kind.upper(), (stream.name, step)
        assert accounting.counts == StreamCounts(**stream.counts), stream.name


class PythonPlayer:
    def __init__(self, stream: ReadStream) -> None:
        self.server = MemoryServer()
        self.server.now_ns = BEGIN_NS - 10**10
        self.max_age_s = stream.max_age_ms * 1e-3
        self.client = Client(
            1, every=stream.every, sensors=stream.sensors, channel=ScriptedChannel(self.server)
        )
        self.counts: dict[int, StreamCounts] = {}

    def now(self, now_ns: int) -> None:
        assert now_ns >= self.server.now_ns
        self.server.now_ns = now_ns

    def connect(self, description: JsonObject) -> None:
        self.end()
        while self.client.session.connected:
            self.client.poll()
        self.server.listens, self.server.description = True, description
        self.client.connect()

    def send(self, message: bytes) -> None:
        self.server.send_raw(message)

    def end(self) -> None:
        """Nobody takes a connection until the next is told to be made."""
        self.server.listens = False
        self.server.drop()

    def read(self, sensor: int) -> dict[str, object]:
        reading = self.client.latest(sensor, max_age_s=self.max_age_s)
        before = self.counts.get(sensor, StreamCounts())
        counts = self.counts[sensor] = replace(self.client.session.state(sensor).accounting.counts)
        return {
            **reading._asdict(),
            "condition": reading.condition.name.lower(),
            "sequence": reading.frame and reading.frame.sequence,
            "age_ns": None if math.isinf(reading.age_s) else round(reading.age_s * 1e9),
            "measured_ns": [reading.measured_ns(channel) for channel in CHANNELS],
            "withheld": counts.withheld - before.withheld,
            "lost": counts.lost - before.lost,
        }


@pytest.mark.parametrize("stream", READ, ids=lambda stream: stream.name)
def test_readings(stream: ReadStream) -> None:
    stream.play(PythonPlayer(stream))


def test_every_count_is_documented() -> None:
    page = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
    assert all(f"\n- `{count}`: " in page for count in StreamCounts.__slots__)
