"""The golden vectors: what docs/protocol.md says in bytes is what the Python code does."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest

import protocol.accounting
from protocol.accounting import StreamAccounting, StreamCounts
from protocol.errors import BadMessageError, RemoteProtocolError
from protocol.framing import DataMessage, FrameDecoder, encode_data
from protocol.pdo import ImuUnits, SampleDecoder
from tests.golden_vectors import (
    ACCOUNTED,
    BROKEN,
    DATA,
    JSON,
    STREAMS,
    AccountedStream,
    Outcome,
    Vector,
    expected,
    same_sample,
)


def outcomes(chunks: Sequence[bytes]) -> list[Outcome]:
    decoder, found = FrameDecoder(), list[Outcome]()
    for chunk in chunks:
        decoder.feed(chunk)
        while True:
            try:
                message = decoder.next_message()
            except BadMessageError:
                found.append("refused")
                continue
            except RemoteProtocolError:
                return [*found, "broken"]
            if message is None:
                break
            found.append(message)
    return found


def name(vector: Vector) -> str:
    return vector.name


@pytest.mark.parametrize("vector", [*DATA, *JSON, *BROKEN], ids=name)
def test_each_alone(vector: Vector) -> None:
    assert outcomes([vector.wire]) == [vector.outcome]


@pytest.mark.parametrize("vector", DATA, ids=name)
def test_samples(vector: Vector) -> None:
    message = vector.outcome
    assert isinstance(message, DataMessage)
    assert encode_data(*message) == vector.wire
    for units, sample in ((ImuUnits.G_DPS, vector.sample), (ImuUnits.SI, vector.sample_si)):
        assert sample is not None
        decoded = SampleDecoder(len(message.process_data), units).decode(message.process_data)
        assert same_sample(decoded, sample), decoded


@pytest.mark.parametrize("vector", BROKEN, ids=name)
def test_what_follows_is_read_or_not(vector: Vector) -> None:
    after = expected([vector, JSON[0]])
    assert len(after) == (2 if vector.outcome == "refused" else 1)
    assert outcomes([vector.wire + JSON[0].wire]) == after


@pytest.mark.parametrize("vectors", STREAMS.values(), ids=STREAMS)
def test_streams_cut_at_every_byte(vectors: list[Vector]) -> None:
    wire = b"".join(vector.wire for vector in vectors)
    for cut in range(len(wire) + 1):
        assert outcomes([wire[:cut], wire[cut:]]) == expected(vectors), cut
    assert outcomes([bytes((byte,)) for byte in wire]) == expected(vectors)


@pytest.mark.parametrize("stream", ACCOUNTED, ids=[stream.name for stream in ACCOUNTED])
def test_accounting(stream: AccountedStream) -> None:
    accounting = StreamAccounting(every=stream.every, fresh_only=stream.fresh_only)
    accounting.rate_hz = stream.rate_hz
    for step in stream.steps:
        if step is None:
            accounting.begin()
        else:
            *head, kind = step
            assert accounting.take(*head).name == kind.upper(), step
    assert accounting.counts == StreamCounts(**stream.counts)


@pytest.mark.parametrize("stream", ACCOUNTED, ids=[stream.name for stream in ACCOUNTED])
def test_selecting_new_frames_counts_the_same(stream: AccountedStream) -> None:
    accounting = StreamAccounting(every=stream.every, fresh_only=stream.fresh_only)
    accounting.rate_hz = stream.rate_hz
    for step in stream.steps:
        if step is None:
            accounting.begin()
            continue
        sequence, monotonic_ns, flags, kind = step
        frames = [DataMessage(sequence, 0, monotonic_ns, sensor, flags, 3, b"") for sensor in (6, 5, 7)]
        assert accounting.select_new(frames, sensor=5) == ([frames[1]] if kind == "new" else [])
    assert accounting.counts == StreamCounts(**stream.counts)


def test_the_words_are_those_of_the_documentation() -> None:
    page = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
    words = re.findall(r"^(\w+): (.*(?:\n    .*)*)", protocol.accounting.__doc__ or "", re.MULTILINE)
    assert {word for word, _ in words} == set(StreamCounts.__slots__)
    for word, meaning in words:
        assert f"| `{word}` | {' '.join(meaning.split())} |" in page, word
