"""The two mailboxes of a slave by single datagrams: a CoE message out, CoE messages in.

Emergencies come in among the answers to requests: each goes to the bus's `emergencies`.
"""

from __future__ import annotations

import contextlib
import struct
from typing import Final, Protocol

from ethercat_server.errors import BusError
from ethercat_server.ethercat.clock import Clock
from ethercat_server.ethercat.mailbox.emergencies import Emergencies
from ethercat_server.ethercat.mailbox.emergency import Emergency
from ethercat_server.ethercat.slave.registers import MAILBOX_FULL, MAILBOX_IN_STATUS

_SHORTEST: Final = 16
_LONGEST: Final = 1486
_HEADER: Final = struct.Struct("<HHBB")
_TYPE_COE: Final = 3


class MessageLostError(Exception):
    """A message was taken from the mailbox and lost on its way."""


class Slaves(Protocol):
    """A `Bus`, or its slaves by their positions: `ByPosition`."""

    @property
    def clock(self) -> Clock:
        """Of the bus."""
        ...

    @property
    def emergencies(self) -> Emergencies:
        """Where they go."""
        ...

    def read_register(self, number: int, address: int, size: int, /) -> bytes | None:
        """See `Datagrams`."""
        ...

    def write_register(self, number: int, address: int, data: bytes, /) -> bool:
        """See `Datagrams`."""
        ...


class Mailbox:
    """Of the sensor `number`. `areas`: offset and size of the one to the slave and the one from it.

    A sensor has one, whoever uses it: the slave drops a request that reuses the last counter.
    """

    def __init__(self, bus: Slaves, number: int, areas: tuple[tuple[int, int], tuple[int, int]]) -> None:
        self._bus, self.number = bus, number
        self.clock = bus.clock
        (self._out, self._out_size), (self._in, self._in_size) = areas
        if not all(_SHORTEST <= size <= _LONGEST for _, size in areas):
            raise BusError(
                f"sensor {number} has mailboxes of {self._out_size} and {self._in_size} bytes, which no "
                "frame can carry: power it off and on"
            )
        self.most = self._out_size - _HEADER.size
        """Bytes of a CoE message that fit."""
        self._counter = 0
        self.is_in_use = False
        """Whether somebody waits for an answer."""

    def look(self) -> None:
        """Read what the sensor says unasked. Who waits for an answer does that too: it is left to them."""
        if not self.is_in_use:
            with contextlib.suppress(MessageLostError):
                self.take()

    def put(self, body: bytes) -> bool:
        """Send a CoE message; False if that failed. It has another counter than the one before."""
        self._counter = self._counter % 7 + 1
        header = _HEADER.pack(len(body), 0, 0, _TYPE_COE | self._counter << 4)
        return self._bus.write_register(self.number, self._out, (header + body).ljust(self._out_size, b"\0"))

    def take(self) -> bytes | None:
        """The CoE message that is there; None if none is, empty if it is of another protocol.

        MessageLostError if the datagram that took it did not come back in time.
        """
        status = self._bus.read_register(self.number, MAILBOX_IN_STATUS, 1)
        if status is None or not status[0] & MAILBOX_FULL:
            return None
        message = self._bus.read_register(self.number, self._in, self._in_size)
        if message is None:
            raise MessageLostError
        length, _, _, kind = _HEADER.unpack_from(message)
        if kind & 0x0F != _TYPE_COE:
            return b""
        body = message[_HEADER.size : _HEADER.size + length]
        if (emergency := Emergency.parse(body)) is not None:
            self._bus.emergencies.note(self.number, emergency)
        return body
