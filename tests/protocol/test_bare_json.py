"""Bare JSON connections: one object a line, the newline optional."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.errors import BadMessageError, ProtocolError, RemoteProtocolError
from bota_ethercat.text.bare_json import BareJsonDecoder, encode_bare_json

OBJECT: dict[str, Any] = {"action": "shutdown", "id": 'a "quoted" \\ } { text'}
LINE = encode_bare_json(OBJECT)
objects = st.dictionaries(st.text(), st.text() | st.integers() | st.lists(st.text(), max_size=3), max_size=4)


def feed(data: bytes, **options: Any) -> BareJsonDecoder:
    decoder = BareJsonDecoder(**options)
    decoder.feed(data)
    return decoder


def test_with_and_without_a_newline() -> None:
    assert list(feed(LINE)) == [OBJECT]
    assert list(feed(LINE.rstrip())) == [OBJECT]


def test_the_notes_client() -> None:
    assert list(feed(b'{"action": "shutdown"}')) == [{"action": "shutdown"}]


def test_byte_by_byte_including_split_escapes() -> None:
    decoder, got = BareJsonDecoder(), []
    for byte in LINE + LINE:
        decoder.feed(bytes([byte]))
        got += list(decoder)
    assert got == [OBJECT, OBJECT]


def test_several_at_once_with_any_line_ends() -> None:
    assert list(feed(LINE + b"\r\n \n" + LINE.rstrip() + LINE)) == [OBJECT] * 3
    assert feed(b"\n\n").next_message() is None


def test_bytes_that_follow_wait() -> None:
    decoder = feed(LINE + b'{"act')
    assert list(decoder) == [OBJECT]
    decoder.feed(b'ion":1}')
    assert list(decoder) == [{"action": 1}]


def test_pretty_printing_is_no_line() -> None:
    decoder = feed(json.dumps(OBJECT, indent=1).encode())
    with pytest.raises(BadMessageError):
        decoder.next_message()


def test_a_broken_line_costs_only_itself() -> None:
    for broken in (b'{"a": "unclosed\n', b'{"a": }\n', b"{{\n", b'{"a": "x\\\n', b"nonsense\n"):
        decoder = feed(broken + LINE)
        with pytest.raises(BadMessageError):
            decoder.next_message()
        assert decoder.next_message() == OBJECT, broken
        assert decoder.next_message() is None


def test_a_newline_after_a_backslash_ends_the_line_even_if_it_comes_later() -> None:
    decoder = feed(b'{"a": "x\\')
    assert decoder.next_message() is None
    decoder.feed(b"\n" + LINE)
    with pytest.raises(BadMessageError):
        decoder.next_message()
    assert decoder.next_message() == OBJECT


def test_end_of_input_reports_half_an_object() -> None:
    decoder = feed(LINE + b'{"action": "shu')
    assert list(decoder) == [OBJECT]
    decoder.end_of_input()
    with pytest.raises(BadMessageError):
        decoder.next_message()
    assert decoder.next_message() is None


def test_end_of_input_after_a_whole_object_is_silent() -> None:
    decoder = feed(LINE.rstrip() + b"  ")
    decoder.end_of_input()
    assert list(decoder) == [OBJECT]


@pytest.mark.parametrize("end", [b"", b'"}', b'"}\n'])
def test_too_long_is_final(end: bytes) -> None:
    decoder = feed(b'{"a":"' + b"x" * 100 + end, max_json_length=64)
    for _ in range(2):
        with pytest.raises(RemoteProtocolError, match="64"):
            decoder.next_message()
    assert decoder.pending == 0


def test_exactly_as_long_as_allowed() -> None:
    assert list(feed(LINE.rstrip(), max_json_length=len(LINE) - 1)) == [OBJECT]


@given(st.lists(objects, max_size=5), st.integers(1, 50), st.booleans())
def test_round_trip_in_any_pieces(messages: list[Any], size: int, newline: bool) -> None:
    stream = b"".join(encode_bare_json(m) if newline else encode_bare_json(m).rstrip() for m in messages)
    decoder, got = BareJsonDecoder(), []
    for at in range(0, len(stream), size):
        decoder.feed(stream[at : at + size])
        got += list(decoder)
    assert got == messages


@given(st.binary(max_size=300), st.integers(1, 40))
def test_garbage_never_escapes(garbage: bytes, size: int) -> None:
    decoder = BareJsonDecoder()
    for at in range(0, len(garbage), size):
        decoder.feed(garbage[at : at + size])
    decoder.end_of_input()
    for _ in range(len(garbage) + 1):
        try:
            if decoder.next_message() is None:
                break
        except ProtocolError:
            continue
    assert decoder.pending == 0
