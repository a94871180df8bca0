# SPDX-License-Identifier: Apache-2.0
"""Framing, without sockets: bytes in, messages out, and back.

The rules it keeps:

- A framed message is `length` u32 big-endian, `type` u8, body; length counts type and body.
- An impossible length is refused as soon as it is received: nothing is buffered for it.
- RemoteProtocolError is final: the decoder raises it again on every later call and buffers nothing.
- BadMessageError concerns one message: it has been consumed, and the next call goes on after it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum, IntFlag
from functools import cache, partial
from typing import Any, Final, NamedTuple, NoReturn

from bota_ethercat.errors import RemoteProtocolError
from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.text.json_text import JsonObject, encode_json_text, parse_json_object

MAX_JSON_LENGTH: Final = 65536  # of a control message, bytes
MAX_REQUEST_LENGTH: Final = 4096  # of one that the server takes


class MessageType(IntEnum):
    """The `type` byte."""

    DATA = 1
    JSON = 2
    TERMINAL = 3  # as DATA, of a terminal beside the sensors


class DataFlag(IntFlag):
    """The `flags` byte of a DATA message."""

    REPEATED = 1  # same process data as the frame before: nothing new from the sensor
    INVALID = 2  # working counter short; the process data is the last good one
    GAP = 4  # samples of this sensor were lost, or withheld from this client, since its previous frame


class DataMessage(NamedTuple):
    """One DATA message. Its fields are the wire's, in the wire's order."""

    sequence: int
    stamp_ns: int
    monotonic_ns: int
    sensor: int
    flags: int
    wkc: int
    process_data: bytes


class TerminalMessage(DataMessage):
    """One TERMINAL message: `sensor` is the number of the terminal."""


_LENGTH: Final = struct.Struct(">I")
_PREFIX: Final = struct.Struct(">IB")
_DATA_MESSAGE: Final = struct.Struct(">IBQQQBBH")
_DATA_OVERHEAD: Final = _DATA_MESSAGE.size - _LENGTH.size  # what `length` counts beside the process data
_DATA: Final = int(MessageType.DATA)
_TYPE_SIZE: Final = 1
# Offset of the flags byte in an encoded DATA message.
DATA_FLAGS_OFFSET: Final = _PREFIX.size + struct.calcsize(">QQQB")
_UNPACK_DATA: Final = {
    _DATA_OVERHEAD + size: struct.Struct(f">{_PREFIX.size}xQQQBBH{size}s").unpack_from for size in LAYOUTS
}
"""The fields of a whole DATA message, by its length."""
_DATA_LENGTHS: Final = frozenset(_UNPACK_DATA)
MAX_DATA_MESSAGE_SIZE: Final = _LENGTH.size + max(_DATA_LENGTHS)


def encode_data(
    sequence: int, stamp_ns: int, monotonic_ns: int, sensor: int, flags: int, wkc: int, process_data: bytes,
    kind: int = _DATA,
) -> bytes:  # fmt: skip
    """A whole DATA or TERMINAL message, ready to send. struct.error if a number does not fit its field."""
    return data_encoder(len(process_data), kind)(
        sequence, stamp_ns, monotonic_ns, sensor, flags, wkc, process_data
    )


@cache
def data_encoder(size: int, kind: int = _DATA) -> Callable[[int, int, int, int, int, int, bytes], bytes]:
    """`encode_data` for process data of `size` bytes: it takes the arguments in this order, and no `kind`."""
    return partial(struct.Struct(f"{_DATA_MESSAGE.format}{size}s").pack, _DATA_OVERHEAD + size, kind)


def encode_json(message: JsonObject) -> bytes:
    """A whole JSON message for a framed connection."""
    text = encode_json_text(message)
    return _PREFIX.pack(_TYPE_SIZE + len(text), MessageType.JSON) + text


class SingleData(NamedTuple):
    """Whole DATA messages of one size, in a decoder's own buffer."""

    buffer: bytearray  # where to read into, at its start
    size: int  # of a message
    prefix: bytes  # how each begins
    unpack: Callable[[bytearray, int], tuple[Any, ...]]  # the fields of `DataMessage` of one at an offset


class FrameDecoder:
    """Decodes a framed connection's bytes.

    Pass bytes to `feed`, or avoid a copy by reading into `get_buffer()` and calling `received()`. Then call
    `next_message()` until it returns None. The buffer never has more than one unfinished message and what was
    last received.
    """

    def __init__(
        self, *, max_json_length: int = MAX_JSON_LENGTH, accepts: Sequence[MessageType] = tuple(MessageType)
    ) -> None:
        """Of other types than those that it `accepts` a message is a violation of the protocol."""
        self._max_json_length = max_json_length
        self._accepts = accepts
        self._buffer = bytearray(65536)
        self._start = 0
        self._end = 0
        self._broken: str | None = None

    def get_buffer(self) -> memoryview:
        """Writable free space to read into; never empty."""
        if self._start == self._end:
            self._start = self._end = 0
        else:
            self._make_room(4096)
        return memoryview(self._buffer)[self._end :]

    def single(self, size: int) -> SingleData | None:
        """How to read DATA messages with `size` bytes of process data without `received`; None while part of
        a message waits. What is no such message goes to `received`.
        """
        if self.pending:
            return None
        self._start = self._end = 0
        length = _DATA_OVERHEAD + size
        prefix, unpack = _PREFIX.pack(length, _DATA), _UNPACK_DATA[length]
        return SingleData(self._buffer, _LENGTH.size + length, prefix, unpack)

    def received(self, count: int) -> None:
        """`count` bytes were written to the start of `get_buffer()`."""
        if self._broken is None:
            self._end += count

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Add received bytes."""
        if self._broken is not None:
            return
        self._make_room(len(data))
        self._buffer[self._end : self._end + len(data)] = data
        self._end += len(data)

    @property
    def pending(self) -> int:
        """Bytes buffered of an unfinished message."""
        return self._end - self._start

    def next_message(self) -> DataMessage | JsonObject | None:
        """The next whole message, or None if more bytes are needed.

        Raises RemoteProtocolError (answer it and close the connection) or BadMessageError (answer it and
        carry on).
        """
        if self._broken is not None:
            raise RemoteProtocolError(self._broken)
        available = self._end - self._start
        if available < _LENGTH.size:
            return None
        (length,) = _LENGTH.unpack_from(self._buffer, self._start)
        if not _TYPE_SIZE <= length <= max(self._max_json_length + _TYPE_SIZE, MAX_DATA_MESSAGE_SIZE):
            self._break(f"message length {length}: it must be from 1 to {self._max_json_length + _TYPE_SIZE}")
        if available < _PREFIX.size:
            return None
        kind = self._buffer[self._start + _LENGTH.size]
        if kind not in self._accepts:
            known = ", ".join(f"{each} ({each.name})" for each in self._accepts)
            self._break(f"message type {kind}: this side understands {known}")
        elif kind == MessageType.DATA:
            if length not in _DATA_LENGTHS:
                self._break(f"DATA message of length {length}: it must be one of {sorted(_DATA_LENGTHS)}")
        elif kind == MessageType.TERMINAL:
            if length < _DATA_OVERHEAD:
                self._break(f"TERMINAL message of length {length}: it must be at least {_DATA_OVERHEAD}")
        elif length > self._max_json_length + _TYPE_SIZE:
            self._break(f"JSON message of length {length}: it must be at most {self._max_json_length + 1}")
        if available < _LENGTH.size + length:
            return None
        start, self._start = self._start, self._start + _LENGTH.size + length
        if kind == MessageType.DATA:
            return DataMessage._make(_UNPACK_DATA[length](self._buffer, start))
        if kind == MessageType.TERMINAL:
            _, _, *head = _DATA_MESSAGE.unpack_from(self._buffer, start)
            data = bytes(self._buffer[start + _DATA_MESSAGE.size : self._start])
            return TerminalMessage._make([*head, data])
        return parse_json_object(bytes(self._buffer[start + _PREFIX.size : self._start]))

    def __iter__(self) -> Iterator[DataMessage | JsonObject]:
        """The whole messages received so far."""
        while (message := self.next_message()) is not None:
            yield message

    def next_data(self, into: list[DataMessage]) -> TerminalMessage | JsonObject | None:
        """Append the DATA messages that are next and whole to `into`; returns the message after them.

        As `next_message` until it returns something else, but faster, for streams. None and errors as there.
        """
        buffer, start, end = self._buffer, self._start, self._end
        if MessageType.DATA in self._accepts and self._broken is None:
            prefix_size, length_size = _PREFIX.size, _LENGTH.size
            while end - start >= prefix_size:
                length, kind = _PREFIX.unpack_from(buffer, start)
                unpack, after = _UNPACK_DATA.get(length), start + length_size + length
                if kind != _DATA or unpack is None or after > end:
                    break
                into.append(DataMessage._make(unpack(buffer, start)))
                self._start = start = after
            if start == end:
                return None
        message = self.next_message()
        assert not isinstance(message, DataMessage) or isinstance(message, TerminalMessage)  # taken above
        return message

    def _break(self, reason: str) -> NoReturn:
        self._broken = reason
        self._start = self._end = 0
        raise RemoteProtocolError(reason)

    def _make_room(self, count: int) -> None:
        if self._start == self._end:
            self._start = self._end = 0
        if len(self._buffer) - self._end >= count:
            return
        pending = self._end - self._start
        self._buffer[:pending] = self._buffer[self._start : self._end]
        self._start, self._end = 0, pending
        if len(self._buffer) - pending < count:
            self._buffer.extend(bytes(pending + count - len(self._buffer)))
