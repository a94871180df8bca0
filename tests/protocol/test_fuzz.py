"""Whatever bytes arrive: only documented errors, bounded memory, nothing valid lost, however they are cut."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.control import ACTIONS, ErrorCode, error_reply, parse_request, reply
from bota_ethercat.errors import BadMessageError, ProtocolError, RemoteProtocolError, RequestError
from bota_ethercat.framing import DataMessage, FrameDecoder, encode_json
from bota_ethercat.text.bare_json import BareJsonDecoder, encode_bare_json
from bota_ethercat.text.json_text import JsonObject, parse_json_object
from tests.hostile_bytes import BARE, FRAMED, HOSTILE_TEXTS, framed, in_chunks, mutate

SEED: Final = int(os.environ.get("FUZZ_SEED", "20261121"))
LIMIT: Final = 16384
BUFFER: Final = 65536
"""What a FrameDecoder starts with."""

Decoder = FrameDecoder | BareJsonDecoder
Outcome = DataMessage | JsonObject | tuple[str, str]
"""A message, or the kind and the text of an error."""


def server_side() -> FrameDecoder:
    return FrameDecoder(max_json_length=LIMIT, accept_data=False)


def client_side() -> FrameDecoder:
    return FrameDecoder(max_json_length=LIMIT)


def bare_side() -> BareJsonDecoder:
    return BareJsonDecoder(max_json_length=LIMIT)


def outcomes(decoder: Decoder, chunks: Sequence[bytes]) -> list[Outcome]:
    """All that comes of it; anything undocumented escapes and fails the test."""
    found: list[Outcome] = []
    for chunk in chunks:
        decoder.feed(chunk)
        held = len(decoder._buffer)
        bound = LIMIT + 5 + len(chunk)
        assert held <= (max(BUFFER, bound) if isinstance(decoder, FrameDecoder) else bound)
        drain(decoder, found)
        assert decoder.pending <= LIMIT + 5
    if isinstance(decoder, BareJsonDecoder):
        decoder.end_of_input()
        drain(decoder, found)
        assert decoder.pending == 0
    return found


def drain(decoder: Decoder, found: list[Outcome]) -> None:
    while True:
        try:
            message = decoder.next_message()
        except BadMessageError as error:
            found.append(("bad", str(error)))
            continue
        except RemoteProtocolError as error:
            if not found or found[-1] != ("broken", str(error)):
                found.append(("broken", str(error)))
            return
        if message is None:
            return
        found.append(message)


def check(make: Callable[[], Decoder], valid: bytes, rest: bytes, chunks: Sequence[bytes]) -> None:
    """`valid` are whole messages, `rest` is anything; `chunks` are both, cut anywhere."""
    expected = outcomes(make(), [valid])
    assert not any(isinstance(outcome, tuple) and outcome[0] == "broken" for outcome in expected)
    whole = outcomes(make(), [valid + rest])
    assert whole[: len(expected)] == expected, "valid messages before the first bad one are lost"
    assert outcomes(make(), chunks) == whole, "it matters how the bytes are cut"


# -- found by hypothesis

seeds = st.integers(0, 2**32)
hostile_texts = st.sampled_from(HOSTILE_TEXTS) | st.binary(max_size=60)
bare_pieces = st.lists(st.sampled_from(BARE) | hostile_texts | st.just(b"\n"), max_size=6).map(b"".join)
framed_pieces = st.lists(
    st.sampled_from(FRAMED) | hostile_texts.map(framed) | st.binary(max_size=20), max_size=6
).map(b"".join)


@pytest.mark.parametrize("make", [client_side, server_side])
@given(st.lists(st.sampled_from(FRAMED[:-2]), max_size=4), framed_pieces, seeds)
def test_framed(make: Callable[[], Decoder], valid: list[bytes], rest: bytes, seed: int) -> None:
    rng, start = random.Random(seed), b"".join(valid)
    check(make, start, rest, in_chunks(rng, start + rest))
    if rest:
        broken = mutate(rng, rest, FRAMED)
        check(make, start, broken, in_chunks(rng, start + broken))


@given(st.lists(st.sampled_from(BARE), max_size=4), bare_pieces, seeds)
def test_bare(valid: list[bytes], rest: bytes, seed: int) -> None:
    rng, start = random.Random(seed), b"".join(valid)
    check(bare_side, start, rest, in_chunks(rng, start + rest))
    if rest:
        broken = mutate(rng, rest, BARE)
        check(bare_side, start, broken, in_chunks(rng, start + broken))


keys = st.sampled_from(["action", "id", "sensors", "every", "fresh_only", "settings", "target"]) | st.text()
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.sampled_from([*ACTIONS]),
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=8,
)
requests = st.builds(lambda action, more: {"action": action, **more}, st.sampled_from([*ACTIONS]),
                     st.dictionaries(keys, values, max_size=3))  # fmt: skip


@given(requests | st.dictionaries(keys, values, max_size=4))
def test_any_object_is_a_checked_request_or_a_refusal_with_a_code(message: JsonObject) -> None:
    request, refusal = None, None
    try:
        request = parse_request(message)
    except RequestError as error:
        refusal = error
    if request is None:
        assert refusal is not None
        assert refusal.code in list(ErrorCode)
        assert len(str(refusal)) < 1000, "a refusal does not repeat all that was sent"
        return
    assert request.values.keys() == ACTIONS[request.action].parameters.keys()
    assert (request.has_id, request.id) == ("id" in message, message.get("id"))


def test_whatever_is_understood_can_be_answered_and_the_answer_read() -> None:
    for text in HOSTILE_TEXTS:
        assert len(text) <= LIMIT, "the server would not read it"
        message = None
        try:
            message = parse_json_object(text)
            answer = reply(parse_request(message))
        except ProtocolError as error:
            answer = error_reply(message, ErrorCode.BAD_REQUEST, str(error))
        assert outcomes(FrameDecoder(), [encode_json(answer)]) == [answer], text
        assert outcomes(BareJsonDecoder(), [encode_bare_json(answer)]) == [answer], text


@pytest.mark.parametrize(("make", "poison"), [(client_side, b"\xff" * 5), (bare_side, b"x" * (LIMIT + 1))])
def test_a_broken_decoder_keeps_nothing_of_what_it_is_still_given(
    make: Callable[[], Decoder], poison: bytes
) -> None:
    decoder = make()
    outcomes(decoder, [poison])
    for _ in range(100):
        decoder.feed(bytes(10_000))
    assert decoder.pending == 0
    assert len(decoder._buffer) <= BUFFER


# -- many, fast


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def storm(count: int, seed: int) -> None:
    """Streams of valid, hostile and mutated messages, `count` in all; memory stays what it was."""
    rng, done, resident = random.Random(seed), 0, 0.0
    kinds = (client_side, FRAMED), (server_side, FRAMED[:-2]), (bare_side, BARE)
    while done < count:
        make, good = rng.choice(kinds)
        valid = b"".join(rng.choices(good, k=rng.randint(0, 4)))
        rest = []
        for _ in range(rng.randint(1, 6)):
            piece = rng.choice(good)
            if rng.random() < 0.05:
                piece = rng.choice(HOSTILE_TEXTS)
                piece = piece if good is BARE else framed(piece)
            rest.append(mutate(rng, piece, good) if rng.random() < 0.6 and piece else piece)
        spoilt = b"".join(rest)
        check(make, valid, spoilt, in_chunks(rng, valid + spoilt))
        if done < count // 4 <= done + len(rest):
            resident = resident_mb()
        done += len(rest)
    assert resident_mb() - resident < 4, f"memory grew from {resident} MB"


def test_a_storm_of_mutations() -> None:
    storm(2_000, SEED)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_million_mutations() -> None:
    print(f"FUZZ_SEED={SEED}")
    began = time.monotonic()
    storm(1_000_000, SEED)
    print(f"{time.monotonic() - began:.0f} s")
