"""The golden vectors: what docs/protocol.md says in bytes is what the Python code does."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from protocol.errors import BadMessageError, RemoteProtocolError
from protocol.framing import DataMessage, FrameDecoder, encode_data
from protocol.pdo import ImuUnits, SampleDecoder
from tests.golden_vectors import BROKEN, DATA, JSON, STREAMS, Outcome, Vector, expected, same_sample


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
