"""EtherCAT frames and datagrams: parsing in place, with every length checked. No sockets.

Source: ETG.1000.4. An Ethernet frame of type 0x88A4 carries a 2-byte header (length in 11 bits, type 1 in
the top 4) and datagrams: command u8, index u8, address u32, length and flags u16, interrupt u16, data,
working counter u16. All little-endian.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

ETHERTYPE: Final = 0x88A4
_ETHERTYPE_BYTES: Final = ETHERTYPE.to_bytes(2, "big")
ETHERNET_HEADER: Final = 14
FRAME_HEADER: Final = ETHERNET_HEADER + 2
DATAGRAM_HEADER: Final = 10
COUNTER_SIZE: Final = 2
TYPE_DATAGRAMS: Final = 1
SOURCE_ADDRESS: Final = 6
# Source address of the frames of this project, and of SOEM.
SOURCE: Final = b"\x01" * 6
# Offset of the first datagram's index in a frame.
DATAGRAM_INDEX: Final = FRAME_HEADER + 1
# Offset of the first datagram's data.
FIRST_DATA: Final = FRAME_HEADER + DATAGRAM_HEADER
# Duration of a byte at 100 Mbit/s.
BYTE_NS: Final = 80
# Bytes on Ethernet, without the checksum.
SHORTEST_FRAME: Final = 60
# Set in the first byte of the source address by the first slave that a frame passes.
PROCESSED_BIT: Final = 0x02

_LENGTH_MASK = 0x07FF
_MORE_FOLLOW = 0x8000
_DATAGRAM = struct.Struct("<BBHHHH")
_U16 = struct.Struct("<H")


class Command(IntEnum):
    """Datagram commands."""

    NOP = 0
    APRD = 1
    APWR = 2
    APRW = 3
    FPRD = 4
    FPWR = 5
    FPRW = 6
    BRD = 7
    BWR = 8
    BRW = 9
    LRD = 10
    LWR = 11
    LRW = 12
    ARMW = 13
    FRMW = 14


_BY_STATION: Final = (Command.FPRD, Command.FPWR, Command.FPRW)


class Datagram(NamedTuple):
    """Where one datagram lies in its frame, and its header as it was received."""

    command: int
    number: int  # the index, which slaves do not change
    adp: int
    ado: int
    header: int  # offset of the first byte of the datagram in the frame
    data: int  # offset of its data
    length: int  # bytes of data

    @property
    def end(self) -> int:
        """Offset of the working counter, which follows the data."""
        return self.data + self.length


def parse(frame: bytes | bytearray | memoryview, size: int) -> list[Datagram]:
    """The whole datagrams in the first `size` bytes of `frame`, in order.

    Empty if it is not an EtherCAT frame with datagrams. A datagram that does not fit ends the list.
    """
    if size < FRAME_HEADER or frame[12:14] != _ETHERTYPE_BYTES:
        return []
    header = _U16.unpack_from(frame, ETHERNET_HEADER)[0]
    if header >> 12 != TYPE_DATAGRAMS:
        return []
    end = FRAME_HEADER + (header & _LENGTH_MASK)
    if end > size:
        return []
    found: list[Datagram] = []
    at = FRAME_HEADER
    while at + DATAGRAM_HEADER + COUNTER_SIZE <= end:
        command, index, adp, ado, length_and_flags, _ = _DATAGRAM.unpack_from(frame, at)
        length = length_and_flags & _LENGTH_MASK
        data = at + DATAGRAM_HEADER
        following = data + length + COUNTER_SIZE
        if following > end:
            break
        found.append(Datagram(command, index, adp, ado, at, data, length))
        if not length_and_flags & _MORE_FOLLOW:
            break
        at = following
    return found


def build(
    *datagrams: tuple[int, int, int, bytes],
    source: bytes = SOURCE,
    first_index: int = 0,
) -> bytearray:
    """A frame of (command, ADP, ADO, data) datagrams.

    ADP and ADO of a logical command are the low and the high word of its address. ValueError if the
    datagrams do not fit one frame.
    """
    body = bytearray()
    for number, (command, adp, ado, data) in enumerate(datagrams):
        more = _MORE_FOLLOW if number < len(datagrams) - 1 else 0
        if len(data) > _LENGTH_MASK:
            raise ValueError(f"datagram of {len(data)} bytes: at most {_LENGTH_MASK} fit")
        index = (first_index + number) & 0xFF
        body += _DATAGRAM.pack(command, index, adp & 0xFFFF, ado & 0xFFFF, len(data) | more, 0)
        body += data + b"\0\0"
    if len(body) > _LENGTH_MASK:
        raise ValueError(f"datagrams of {len(body)} bytes: at most {_LENGTH_MASK} fit one frame")
    header = _U16.pack(len(body) | TYPE_DATAGRAMS << 12)
    return bytearray(b"\xff" * 6 + source + _ETHERTYPE_BYTES + header + body)


def is_answer(frame: bytes, sent: bytes | bytearray, size: int) -> bool:
    """Whether `frame` begins with the datagram of `size` bytes that `sent` begins with.

    Slaves count up the position in it, but leave a station address, and the register's, alone.
    """
    if len(frame) < FIRST_DATA + size + COUNTER_SIZE or frame[12:14] != _ETHERTYPE_BYTES:
        return False
    command, index, adp, ado, length, _ = _DATAGRAM.unpack_from(frame, FRAME_HEADER)
    asked = _DATAGRAM.unpack_from(sent, FRAME_HEADER)
    same_station = adp == asked[2] or command not in _BY_STATION
    return same_station and (command, index, ado, length & _LENGTH_MASK) == (*asked[:2], asked[3], size)
