"""Framed messages: whole, in pieces, together, oversized, hostile."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.errors import BadMessageError, ProtocolError, RemoteProtocolError
from bota_ethercat.framing import (
    DATA_FLAGS_OFFSET,
    MAX_DATA_MESSAGE_SIZE,
    DataFlag,
    DataMessage,
    FrameDecoder,
    encode_data,
    encode_json,
)
from bota_ethercat.text.json_text import MAX_JSON_LENGTH

SAMPLE = DataMessage(7, 1_700_000_000_000_000_000, 123_456_789, 3, int(DataFlag.GAP), 3, bytes(range(61)))
WITH_ORIENTATION = SAMPLE._replace(sequence=8, process_data=bytes(range(77)))
JSON: dict[str, Any] = {"reply": "describe", "id": [1, "é"], "ok": True, "nested": {"a": None}}
MESSAGES: list[Any] = [SAMPLE, JSON, WITH_ORIENTATION, {}, SAMPLE]
STREAM = b"".join(encode_data(*m) if isinstance(m, DataMessage) else encode_json(m) for m in MESSAGES)

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


def drain(decoder: FrameDecoder) -> list[Any]:
    return list(decoder)


def test_data_message_on_the_wire_is_as_the_contract_says() -> None:
    wire = encode_data(*SAMPLE)
    assert wire == struct.pack(
        ">IBQQQBBH", 90, 1, 7, 1_700_000_000_000_000_000, 123_456_789, 3, 4, 3
    ) + bytes(range(61))  # fmt: skip
    assert wire[DATA_FLAGS_OFFSET] == DataFlag.GAP
    assert len(encode_data(*WITH_ORIENTATION)) == MAX_DATA_MESSAGE_SIZE == 110


def test_json_message_on_the_wire_is_as_the_contract_says() -> None:
    assert encode_json({"action": "shutdown"}) == b'\x00\x00\x00\x16\x02{"action":"shutdown"}'


def test_whole() -> None:
    decoder = FrameDecoder()
    decoder.feed(STREAM)
    assert drain(decoder) == MESSAGES
    assert decoder.pending == 0


def test_byte_by_byte() -> None:
    decoder, got = FrameDecoder(), []
    for byte in STREAM:
        decoder.feed(bytes([byte]))
        got += drain(decoder)
    assert got == MESSAGES


def test_every_split_in_two() -> None:
    for at in range(len(STREAM)):
        decoder = FrameDecoder()
        decoder.feed(STREAM[:at])
        got = drain(decoder)
        decoder.feed(STREAM[at:])
        assert got + drain(decoder) == MESSAGES


def test_bytes_that_follow_wait() -> None:
    decoder = FrameDecoder()
    decoder.feed(encode_json(JSON) + b"\x00\x00\x00")
    assert decoder.next_message() == JSON
    assert decoder.next_message() is None
    assert decoder.pending == 3


def test_reading_into_the_decoders_own_buffer() -> None:
    decoder, got, rest = FrameDecoder(), [], STREAM * 3000
    while rest:
        with decoder.get_buffer() as buffer:
            count = min(len(buffer), 10_007, len(rest))
            buffer[:count] = rest[:count]
        rest = rest[count:]
        decoder.received(count)
        got += drain(decoder)
    assert got == MESSAGES * 3000


def test_a_decoded_message_outlives_the_buffer() -> None:
    decoder = FrameDecoder()
    decoder.feed(encode_data(*SAMPLE))
    message = decoder.next_message()
    decoder.feed(encode_data(*WITH_ORIENTATION._replace(process_data=b"\xff" * 77)))
    assert drain(decoder)
    assert message == SAMPLE


@given(st.lists(data_messages | json_objects, max_size=6), st.lists(st.integers(1, 200), min_size=1))
def test_round_trip_in_any_pieces(messages: list[Any], sizes: list[int]) -> None:
    stream = b"".join(encode(message) for message in messages)
    decoder, got, at, turn = FrameDecoder(), [], 0, 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
        decoder.feed(stream[at : at + size])
        at, turn = at + size, turn + 1
        got += drain(decoder)
    assert got == messages


@pytest.mark.parametrize(
    ("wire", "words"),
    [
        (struct.pack(">I", 0), "length 0"),
        (struct.pack(">I", MAX_JSON_LENGTH + 2), "length"),
        (b"\xff\xff\xff\xff", "length"),
        (b"GET / HTTP/1.1\r\n", "length"),
        (struct.pack(">IB", 5, 0), "type 0"),
        (struct.pack(">IB", 5, 3), "type 3"),
        (struct.pack(">IB", 90 - 1, 1), "DATA message of length"),
        (struct.pack(">IB", 1, 1), "DATA message of length"),
    ],
)  # fmt: skip
def test_what_is_no_message_ends_it_at_once_and_for_good(wire: bytes, words: str) -> None:
    decoder = FrameDecoder()
    decoder.feed(encode_json(JSON) + wire)
    assert decoder.next_message() == JSON
    with pytest.raises(RemoteProtocolError, match=words):
        decoder.next_message()
    decoder.feed(encode_json(JSON))
    with pytest.raises(RemoteProtocolError, match=words):
        decoder.next_message()


def test_longest_json_message_passes_and_one_more_does_not() -> None:
    text = b'{"a":"' + b"x" * (MAX_JSON_LENGTH - 8) + b'"}'
    decoder = FrameDecoder()
    decoder.feed(struct.pack(">IB", 1 + len(text), 2) + text)
    message = decoder.next_message()
    assert isinstance(message, dict)
    assert len(message["a"]) == MAX_JSON_LENGTH - 8
    decoder.feed(struct.pack(">IB", 2 + len(text), 2))
    with pytest.raises(RemoteProtocolError):
        decoder.next_message()


def test_a_small_limit_holds_for_json_though_data_is_longer() -> None:
    decoder = FrameDecoder(max_json_length=10)
    decoder.feed(encode_data(*SAMPLE))
    assert decoder.next_message() == SAMPLE
    decoder.feed(struct.pack(">IB", 12, 2))
    with pytest.raises(RemoteProtocolError, match="JSON"):
        decoder.next_message()


def test_a_server_takes_no_data() -> None:
    decoder = FrameDecoder(accept_data=False)
    decoder.feed(encode_data(*SAMPLE))
    with pytest.raises(RemoteProtocolError, match="type 1"):
        decoder.next_message()


@pytest.mark.parametrize(
    "text",
    [
        b"", b"[]", b"null", b"1", b'"x"', b"{", b'{"a":}', b"\xff\xfe", b'{"a":NaN}', b'{"a":Infinity}',
        b'{"a":-Infinity}', b"{} {}", b"[" * 60000, b'{"a":' * 40 + b"1" + b"}" * 40,
        b'{"a":' + b"9" * 5000 + b"}",
    ],
)  # fmt: skip
def test_a_message_that_is_no_object_costs_only_itself(text: bytes) -> None:
    decoder = FrameDecoder()
    decoder.feed(struct.pack(">IB", 1 + len(text), 2) + text + encode_json(JSON))
    with pytest.raises(BadMessageError):
        decoder.next_message()
    assert decoder.next_message() == JSON


@given(st.binary(max_size=400))
def test_garbage_is_an_error_or_a_message_and_never_anything_else(garbage: bytes) -> None:
    decoder = FrameDecoder()
    decoder.feed(garbage)
    for _ in range(len(garbage) + 1):
        try:
            if decoder.next_message() is None:
                break
        except RemoteProtocolError:
            return
        except ProtocolError:
            continue
    assert decoder.pending <= len(garbage)


@given(st.integers(0, len(STREAM) - 1), st.integers(1, 255))
def test_a_flipped_byte_never_escapes_as_another_exception(at: int, flip: int) -> None:
    wire = bytearray(STREAM)
    wire[at] ^= flip
    decoder = FrameDecoder()
    decoder.feed(wire)
    for _ in range(len(wire)):
        try:
            if decoder.next_message() is None:
                return
        except RemoteProtocolError:
            return
        except BadMessageError:
            continue


def outcomes(decoder: FrameDecoder, *, with_take_data: bool) -> list[Any]:
    """What a decoder gives for the bytes it has: messages, and errors by their text."""
    got: list[Any] = []
    while True:
        try:
            message = decoder.take_data(got) if with_take_data else decoder.next_message()
        except BadMessageError as error:
            got.append(str(error))
            continue
        except RemoteProtocolError as error:
            return [*got, str(error)]
        if message is None:
            return got
        got.append(message)


@given(
    st.lists(data_messages | json_objects, max_size=6),
    st.lists(st.integers(1, 200), min_size=1),
    st.lists(st.tuples(st.integers(0, 2000), st.integers(1, 255)), max_size=2),
    st.booleans(),
)
def test_taking_data_in_bulk_is_the_same_as_one_by_one(
    messages: list[Any], sizes: list[int], flips: list[tuple[int, int]], accept_data: bool
) -> None:
    stream = bytearray(b"".join(encode(message) for message in messages))
    for at, flip in flips:
        if at < len(stream):
            stream[at] ^= flip
    one, bulk = FrameDecoder(accept_data=accept_data), FrameDecoder(accept_data=accept_data)
    at, turn = 0, 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
        for decoder in (one, bulk):
            decoder.feed(stream[at : at + size])
        assert outcomes(bulk, with_take_data=True) == outcomes(one, with_take_data=False)
        assert bulk.pending == one.pending
        at, turn = at + size, turn + 1
