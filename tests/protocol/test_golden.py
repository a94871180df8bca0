"""The golden vectors: what docs/protocol.md says in bytes is what the Python code does."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest

import bota_ethercat.accounting
from bota_ethercat.accounting import StreamAccounting, StreamCounts
from bota_ethercat.errors import BadMessageError, RemoteProtocolError
from bota_ethercat.framing import DataMessage, FrameDecoder, encode_data
from bota_ethercat.pdo import ImuUnits, SampleDecoder
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


def test_each_alone() -> None:
    for vector in (*DATA, *JSON, *BROKEN):
        assert outcomes([vector.wire]) == [vector.outcome], vector.name


def test_samples() -> None:
    for vector in DATA:
        message = vector.outcome
        assert isinstance(message, DataMessage)
        assert encode_data(*message) == vector.wire, vector.name
        for units, sample in ((ImuUnits.G_DPS, vector.sample), (ImuUnits.SI, vector.sample_si)):
            assert sample is not None
            decoded = SampleDecoder(len(message.process_data), units).decode(message.process_data)
            assert same_sample(decoded, sample), (vector.name, decoded)


def test_what_follows_is_read_or_not() -> None:
    for vector in BROKEN:
        after = expected([vector, JSON[0]])
        assert len(after) == (2 if vector.outcome == "refused" else 1), vector.name
        assert outcomes([vector.wire + JSON[0].wire]) == after, vector.name


@pytest.mark.parametrize("vectors", STREAMS.values(), ids=STREAMS)
def test_streams_cut_at_every_byte(vectors: list[Vector]) -> None:
    wire = b"".join(vector.wire for vector in vectors)
    for cut in range(len(wire) + 1):
        assert outcomes([wire[:cut], wire[cut:]]) == expected(vectors), cut
    assert outcomes([bytes((byte,)) for byte in wire]) == expected(vectors)


def accounting_of(stream: AccountedStream) -> StreamAccounting:
    accounting = StreamAccounting(every=stream.every, fresh_only=stream.fresh_only)
    accounting.rate_hz = stream.rate_hz
    return accounting


def test_accounting() -> None:
    for stream in ACCOUNTED:
        accounting = accounting_of(stream)
        for step in stream.steps:
            if step is None:
                accounting.begin()
            else:
                sequence, monotonic_ns, flags, kind = step
                if flags or not accounting.take_next(sequence, monotonic_ns):
                    assert accounting.take(*step[:3]).name == kind.upper(), (stream.name, step)
        assert accounting.counts == StreamCounts(**stream.counts), stream.name


def test_the_words_are_those_of_the_documentation() -> None:
    page = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
    words = re.findall(r"^(\w+): (.*(?:\n    .*)*)", bota_ethercat.accounting.__doc__ or "", re.MULTILINE)
    assert {word for word, _ in words} == set(StreamCounts.__slots__)
    for word, meaning in words:
        assert f"| `{word}` | {' '.join(meaning.split())} |" in page, word
