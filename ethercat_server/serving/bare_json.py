"""Bare JSON connections, without sockets: one object a line, nothing else.

A message ends with its closing brace or with a newline, whichever is first, so a client that sends no newline
is understood and a malformed line affects no other.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Final

from bota_ethercat.errors import RemoteProtocolError
from bota_ethercat.framing import MAX_JSON_LENGTH
from bota_ethercat.text.json_text import JsonObject, encode_json_text, parse_json_object

BARE_JSON_FIRST_BYTE: Final = b"{"  # A connection that starts with this byte is a bare JSON connection

_BRACE: Final = ord("}")
_RAW_DECODE: Final = json.JSONDecoder().raw_decode


def encode_bare_json(message: JsonObject) -> bytes:
    """A whole message for a bare JSON connection: one line."""
    return encode_json_text(message) + b"\n"


class BareJsonDecoder:
    """Decodes a bare JSON connection's bytes: one JSON object a line, the newline optional.

    Same use as `FrameDecoder`: `feed`, then `next_message` until None. Call `end_of_input` when the peer
    has closed its side, so that a half-finished object is reported.
    """

    def __init__(self, *, max_json_length: int = MAX_JSON_LENGTH) -> None:
        self._max_json_length = max_json_length
        self._buffer = bytearray()
        self._broken: str | None = None
        self._ended = False

    @property
    def pending(self) -> int:
        """Bytes buffered of an unfinished message."""
        return len(self._buffer)

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Add received bytes."""
        if self._broken is None:
            self._buffer += data

    def end_of_input(self) -> None:
        """No more bytes will come."""
        self._ended = True

    def next_message(self) -> JsonObject | None:
        """The next whole message, or None; raises as `FrameDecoder.next_message`."""
        if self._broken is not None:
            raise RemoteProtocolError(self._broken)
        self._buffer = self._buffer.lstrip(b" \t\r\n")
        end = self._find_end()
        if end is not None and end <= self._max_json_length:
            text = bytes(self._buffer[:end])
            del self._buffer[:end]
            return parse_json_object(text)
        if end is not None or len(self._buffer) > self._max_json_length:
            self._broken = f"a line of more than {self._max_json_length} bytes"
            self._buffer.clear()
            raise RemoteProtocolError(self._broken)
        return None

    def __iter__(self) -> Iterator[JsonObject]:
        """The whole messages received so far."""
        while (message := self.next_message()) is not None:
            yield message

    def _find_end(self) -> int | None:
        """Where the first message ends: behind an object, else where the line or all input does."""
        line, newline, _ = self._buffer[: self._max_json_length + 1].partition(b"\n")
        if _BRACE in line and line.startswith(BARE_JSON_FIRST_BYTE):
            text = line.decode("utf-8", "surrogateescape")
            try:
                return len(text[: _RAW_DECODE(text)[1]].encode("utf-8", "surrogateescape"))
            except (ValueError, RecursionError):  # not whole yet, or malformed
                pass
        if newline or (self._ended and line):
            return len(line) + len(newline)
        return None
