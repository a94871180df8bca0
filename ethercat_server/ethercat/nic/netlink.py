"""Questions to the kernel about links, addresses and routes (linux/rtnetlink.h). Need no rights."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

GET_LINK, GET_ADDRESS, GET_ROUTE = 18, 22, 26
_REQUEST, _DUMP = 0x1, 0x300
_ERROR, _DONE = 2, 3
_HEADER: Final = struct.Struct("=IHHII")
"""Length, type, flags, sequence number, port."""
_ATTRIBUTE: Final = struct.Struct("=HH")
_TYPE: Final = 0x3FFF
_BUFFER: Final = 65536


class Answer(NamedTuple):
    """One message of the kernel's."""

    body: tuple[int, ...]
    """Its fixed part."""
    attributes: dict[int, bytes]
    """Its variable part, by type."""


def ask(kind: int, layout: struct.Struct, *values: int, all_of_them: bool = False) -> Iterator[Answer]:
    """The answers to a request of this kind; OSError or struct.error if the kernel refuses it."""
    flags = _REQUEST | _DUMP if all_of_them else _REQUEST
    request = _HEADER.pack(_HEADER.size + layout.size, kind, flags, 0, 0) + layout.pack(*values)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as asked:
        asked.setblocking(False)  # the kernel answers before send returns
        asked.send(request)
        while True:
            data = asked.recv(_BUFFER)
            at = 0
            while at + _HEADER.size <= len(data):
                size, found, *_ = _HEADER.unpack_from(data, at)
                if found == _DONE:
                    return
                if found == _ERROR or size < _HEADER.size:
                    raise OSError("the kernel refuses the request")
                yield _answer(data[at + _HEADER.size : at + size], layout)
                at += size + 3 & ~3
            if not all_of_them:
                return


def _answer(data: bytes, layout: struct.Struct) -> Answer:
    found, at = {}, layout.size
    while at + _ATTRIBUTE.size <= len(data):
        length, attribute = _ATTRIBUTE.unpack_from(data, at)
        found[attribute & _TYPE] = data[at + _ATTRIBUTE.size : at + length]
        at += max(_ATTRIBUTE.size, length + 3 & ~3)
    return Answer(layout.unpack_from(data), found)
