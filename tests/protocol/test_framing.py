"""Messages, framed and as bare JSON lines: whole, in pieces, together, oversized, hostile.

Whatever bytes arrive: only documented errors, bounded memory, nothing valid lost, however they are cut. The
bytes of framed messages, which may be cut anywhere, and what is no message are in the golden vectors.
"""

from __future__ import annotations

import os
import random
import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.control import ACTIONS, ErrorCode, error_reply, parse_request, reply
from bota_ethercat.errors import BadMessageError, ProtocolError, RemoteProtocolError, RequestError
from bota_ethercat.framing import (
    MAX_DATA_MESSAGE_SIZE,
    MAX_JSON_LENGTH,
    DataFlag,
    DataMessage,
    FrameDecoder,
    MessageType,
    encode_data,
    encode_json,
)
from bota_ethercat.text.json_text import JsonObject, parse_json_object
from ethercat_server.serving.bare_json import BareJsonDecoder, encode_bare_json
from tests.hostile_bytes import BARE, FRAMED, HOSTILE_TEXTS, framed, in_chunks, mutate

SEED: Final = int(os.environ.get("FUZZ_SEED", "20261121"))
LIMIT: Final = 16384
BUFFER: Final = 65536
"""What a FrameDecoder starts with."""

SAMPLE = DataMessage(7, 1_700_000_000_000_000_000, 123_456_789, 3, int(DataFlag.GAP), 3, bytes(range(61)))
WITH_ORIENTATION = SAMPLE._replace(sequence=8, process_data=bytes(range(77)))
JSON: dict[str, Any] = {"reply": "describe", "id": [1, "é"], "ok": True, "nested": {"a": None}}

Decoder = FrameDecoder | BareJsonDecoder
Outcome = DataMessage | JsonObject | tuple[str, str]
"""A message, or the kind (`bad`: this message only, `broken`: for good) and the text of an error."""


server_side = partial(FrameDecoder, max_json_length=LIMIT, accepts=(MessageType.JSON,))
client_side = partial(FrameDecoder, max_json_length=LIMIT)
bare_side = partial(BareJsonDecoder, max_json_length=LIMIT)


def drain(decoder: Decoder, found: list[Outcome], take: Callable[[], Outcome | None] | None = None) -> None:
    take = take or decoder.next_message
    while True:
        try:
            message = take()
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


def outcomes(decoder: Decoder, chunks: Sequence[bytes]) -> list[Outcome]:
    """All that comes of it; anything undocumented escapes and fails the test."""
    found: list[Outcome] = []
    for chunk in chunks:
        decoder.feed(chunk)
        held, bound = len(decoder._buffer), LIMIT + 5 + len(chunk)
        assert held <= (max(BUFFER, bound) if isinstance(decoder, FrameDecoder) else bound)
        drain(decoder, found)
        assert decoder.pending <= LIMIT + 5
    if isinstance(decoder, BareJsonDecoder):
        decoder.end_of_input()
        drain(decoder, found)
        assert decoder.pending == 0
    return found


def kinds(found: Sequence[Outcome]) -> list[object]:
    return [each[0] if isinstance(each, tuple) and len(each) == 2 else each for each in found]


# -- framed


def test_reading_into_the_decoders_own_buffer_and_the_longest_message() -> None:
    longest = {"a": "x" * (MAX_JSON_LENGTH - 8)}
    messages: list[Any] = [SAMPLE, JSON, WITH_ORIENTATION, {}, longest, SAMPLE]
    assert len(encode(WITH_ORIENTATION)) == MAX_DATA_MESSAGE_SIZE
    decoder, got, rest = FrameDecoder(), [], b"".join(map(encode, messages)) * 100
    while rest:
        with decoder.get_buffer() as buffer:
            count = min(len(buffer), 10_007, len(rest))
            buffer[:count] = rest[:count]
        rest = rest[count:]
        decoder.received(count)
        got += list(decoder)
    assert got == messages * 100


@pytest.mark.parametrize(
    ("decoder", "wire", "words"),
    [
        (FrameDecoder(), b"GET / HTTP/1.1\r\n", "length"),
        (FrameDecoder(), struct.pack(">IB", 5, 4), "type 4"),
        (FrameDecoder(), struct.pack(">IB", 28, 3), "TERMINAL message of length"),
        (FrameDecoder(), struct.pack(">IB", 90 - 1, 1), "DATA message of length"),
        (FrameDecoder(max_json_length=80), encode_data(*SAMPLE) + struct.pack(">IB", 82, 2), "JSON"),
        (FrameDecoder(accepts=(MessageType.JSON,)), encode_data(*SAMPLE), "type 1"),
    ],
)  # fmt: skip
def test_what_is_no_message_ends_it_for_good(decoder: FrameDecoder, wire: bytes, words: str) -> None:
    """A limit for JSON holds though DATA may be longer; a server takes no DATA."""
    decoder.feed(encode_json(JSON) + wire)
    assert decoder.next_message() == JSON
    if words == "JSON":
        assert decoder.next_message() == SAMPLE
    with pytest.raises(RemoteProtocolError, match=words):
        decoder.next_message()
    decoder.feed(encode_json(JSON))
    with pytest.raises(RemoteProtocolError, match=words):
        decoder.next_message()


u64 = st.integers(0, 2**64 - 1)
u8, u16 = st.integers(0, 255), st.integers(0, 65535)
process_data = st.sampled_from((61, 77)).flatmap(lambda n: st.binary(min_size=n, max_size=n))
data_messages = st.builds(DataMessage, u64, u64, u64, u8, u8, u16, process_data)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
json_objects = st.dictionaries(st.text(), json_values, max_size=4)


def encode(message: Any) -> bytes:
    return encode_data(*message) if isinstance(message, DataMessage) else encode_json(message)


@given(
    st.lists(data_messages | json_objects, max_size=6),
    st.lists(st.integers(1, 200), min_size=1),
    st.lists(st.tuples(st.integers(0, 2000), st.integers(1, 255)), max_size=2),
    st.booleans(),
)
def test_round_trip_in_any_pieces_one_by_one_and_in_bulk(
    messages: list[Any], sizes: list[int], flips: list[tuple[int, int]], accept_data: bool
) -> None:
    """Where bytes were flipped both give the same."""
    stream = bytearray(b"".join(map(encode, messages)))
    for at, flip in flips:
        if at < len(stream):
            stream[at] ^= flip
    accepts = tuple(MessageType) if accept_data else (MessageType.JSON,)
    one, bulk = FrameDecoder(accepts=accepts), FrameDecoder(accepts=accepts)
    found: list[Any] = []
    found_in_bulk: list[Any] = []
    take_in_bulk = partial(bulk.next_data, found_in_bulk)
    at, turn = 0, 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
        for decoder in (one, bulk):
            decoder.feed(stream[at : at + size])
        drain(one, found)
        drain(bulk, found_in_bulk, take_in_bulk)
        assert found_in_bulk == found
        assert bulk.pending == one.pending
        at, turn = at + size, turn + 1
    if not flips and accept_data:
        assert found == messages


# -- bare JSON: one object a line, the newline optional

OBJECT: dict[str, Any] = {"action": "shutdown", "id": 'a "quoted" \\ } { text'}
LINE = encode_bare_json(OBJECT)


@pytest.mark.parametrize(
    ("chunks", "expected"),
    [
        ([LINE], [OBJECT]),
        ([LINE.rstrip()], [OBJECT]),
        ([LINE.rstrip() + b"  "], [OBJECT]),
        ([b'{"action": "shutdown"}'], [{"action": "shutdown"}]),  # the note's client
        ([bytes([byte]) for byte in LINE + LINE], [OBJECT, OBJECT]),  # in the middle of escapes, too
        ([LINE + b"\r\n \n" + LINE.rstrip() + LINE], [OBJECT] * 3),
        ([b"\n\n"], []),
        ([LINE + b'{"act', b'ion":1}'], [OBJECT, {"action": 1}]),
        ([LINE + b'{"action": "shu'], [OBJECT, "bad"]),  # half an object at the end
        ([b'{"a": "unclosed\n' + LINE], ["bad", OBJECT]),  # a broken line costs only itself
        ([b'{"a": }\n' + LINE], ["bad", OBJECT]),
        ([b"{{\n" + LINE], ["bad", OBJECT]),
        ([b'{\n "a": 1}\n' + LINE], ["bad", "bad", OBJECT]),  # pretty printing is no line
        ([b'{"a": "x\\\n' + LINE], ["bad", OBJECT]),
        ([b"nonsense\n" + LINE], ["bad", OBJECT]),
        ([b'{"a": "x\\', b"\n" + LINE], ["bad", OBJECT]),  # the backslash escapes no end of a line
    ],
)
def test_bare_lines(chunks: list[bytes], expected: list[object]) -> None:
    assert kinds(outcomes(bare_side(), chunks)) == expected


def test_a_bare_line_may_be_as_long_as_allowed_and_longer_is_final() -> None:
    assert outcomes(BareJsonDecoder(max_json_length=len(LINE) - 1), [LINE.rstrip()]) == [OBJECT]
    for end in (b"", b'"}', b'"}\n'):
        decoder = BareJsonDecoder(max_json_length=64)
        decoder.feed(b'{"a":"' + b"x" * 100 + end)
        for _ in range(2):
            with pytest.raises(RemoteProtocolError, match="64"):
                decoder.next_message()
        assert decoder.pending == 0


# -- any bytes: found by hypothesis


def check(make: Callable[[], Decoder], valid: bytes, rest: bytes, chunks: Sequence[bytes]) -> None:
    """`valid` are whole messages, `rest` is anything; `chunks` are both, cut anywhere."""
    expected = outcomes(make(), [valid])
    assert "broken" not in kinds(expected)
    whole = outcomes(make(), [valid + rest])
    assert whole[: len(expected)] == expected, "valid messages before the first bad one are lost"
    assert outcomes(make(), chunks) == whole, "it matters how the bytes are cut"


seeds = st.integers(0, 2**32)
hostile_texts = st.sampled_from(HOSTILE_TEXTS) | st.binary(max_size=60)
bare_pieces = st.lists(st.sampled_from(BARE) | hostile_texts | st.just(b"\n"), max_size=6).map(b"".join)
framed_pieces = st.lists(
    st.sampled_from(FRAMED) | hostile_texts.map(framed) | st.binary(max_size=20), max_size=6
).map(b"".join)


@pytest.mark.parametrize(
    ("make", "good", "pieces"),
    [
        (client_side, FRAMED[:-2], framed_pieces),
        (server_side, FRAMED[:-2], framed_pieces),
        (bare_side, BARE, bare_pieces),
    ],
)
@given(st.data(), seeds)
def test_any_bytes_are_messages_or_documented_errors_however_they_are_cut(
    make: Callable[[], Decoder], good: Sequence[bytes], pieces: Any, data: st.DataObject, seed: int
) -> None:
    rng, start = random.Random(seed), b"".join(data.draw(st.lists(st.sampled_from(good), max_size=4)))
    rest = data.draw(pieces)
    check(make, start, rest, in_chunks(rng, start + rest))
    if rest:
        broken = mutate(rng, rest, BARE if good is BARE else FRAMED)
        check(make, start, broken, in_chunks(rng, start + broken))


keys = st.sampled_from(["action", "id", "sensors", "every", "fresh_only", "settings", "target"]) | st.text()
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.sampled_from([*ACTIONS]),
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=8,
)
requests = st.builds(lambda action, more: {"action": action, **more}, st.sampled_from([*ACTIONS, "other"]),
                     st.dictionaries(keys, values, max_size=4))  # fmt: skip


@given(requests | st.dictionaries(keys, values, max_size=4))
def test_any_object_is_a_checked_request_or_a_refusal_with_a_code(message: JsonObject) -> None:
    try:
        request = parse_request(message)
    except RequestError as refusal:
        assert refusal.code in list(ErrorCode)  # noqa: PT017 - most are refused, some are not
        assert len(str(refusal)) < 1000, "a refusal does not repeat all that was sent"  # noqa: PT017
        return
    assert request.action == message["action"]
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
def test_a_broken_decoder_keeps_nothing_it_is_still_given(make: Callable[[], Decoder], poison: bytes) -> None:
    decoder = make()
    outcomes(decoder, [poison])
    for _ in range(100):
        decoder.feed(bytes(10_000))
    assert decoder.pending == 0
    assert len(decoder._buffer) <= BUFFER
