"""The mailbox: requests out of sync manager 0, replies into sync manager 1, duplicates and lost replies.

Source: ETG.1000.4 and ETG.1000.6. A message is: length u16, address u16, channel and priority u8, type
(4 bits) and counter (3 bits) u8, then `length` bytes.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from typing import Final

from ethercat_server.ethercat.slave.sii import MailboxProtocol
from ethercat_server.virtual_sensor.esc import SyncManager

HEADER: Final = struct.Struct("<HHBB")
_ERROR, _COE = 0, 3  # protocols, as numbered in the header
_COE_EMERGENCY: Final = 1  # service in the CoE header


# Details of a mailbox error reply.
UNSUPPORTED_PROTOCOL, INVALID_HEADER, TOO_SHORT, INVALID_SIZE = 0x02, 0x05, 0x06, 0x08


class MailboxError(Exception):
    """The request cannot be answered by its protocol; the reply is a mailbox error with this detail."""

    def __init__(self, detail: int) -> None:
        super().__init__(detail)
        self.detail = detail


class Mailbox:
    """Both directions of one slave's mailbox.

    `coe` answers a CoE request (what follows the mailbox header) with any number of replies; it may raise
    MailboxError.
    """

    def __init__(
        self,
        written: SyncManager,
        read: SyncManager,
        coe: Callable[[bytes, int], list[bytes]],
        protocols: MailboxProtocol,
    ) -> None:
        self._protocols = protocols
        self._written = written
        self._read = read
        self._coe = coe
        self._replies: deque[tuple[int, int, bytes]] = deque()  # type, address and body
        self._last: tuple[int, int, bytes] | None = None  # what is in the read mailbox, or was
        self._last_reply = b""
        self._last_counter = self._counter = 0
        self.mute = 0  # number of the next requests to drop: a fault

    def reset(self) -> None:
        self._replies.clear()
        self._last_reply = b""
        self._last_counter = self._counter = 0

    def work(self) -> None:
        """Put a pending reply into an empty read mailbox, or process the next request.

        While replies are pending the write mailbox stays full: the master has to read first.
        """
        if self._read.full:
            return
        if not self._replies and self._written.full:
            message = self._written.content()
            self._written.full = False
            self._request(message)
        if self._replies:
            self._last = self._replies.popleft()
            kind, address, body = self._last
            self._counter = self._counter % 7 + 1
            self._last_reply = HEADER.pack(len(body), address, 0, kind | self._counter << 4) + body
            self._read.load(self._last_reply)

    def raise_emergency(self, code: int, register: int, data: bytes) -> None:
        """Put a CoE emergency before all that the master has not read yet; the mailbox must be on."""
        body = struct.pack("<HHB5s", _COE_EMERGENCY << 12, code, register, data)
        if self._read.full and not self._read.open and self._last is not None:
            self._replies.appendleft(self._last)
            self._read.full = False
            self._counter = (self._counter - 2) % 7 + 1
        self._replies.appendleft((_COE, 0, body))
        self.work()

    def repeat(self) -> None:
        if not self._read.full and self._last_reply:
            self._read.load(self._last_reply)

    def _request(self, message: bytes) -> None:
        if len(message) < HEADER.size:
            return
        length, address, _, kind = HEADER.unpack_from(message)
        counter = kind >> 4 & 0x07
        if counter and counter == self._last_counter:
            return  # a duplicate
        self._last_counter = counter
        if self.mute:
            self.mute -= 1
            return
        try:
            if length > len(message) - HEADER.size:
                raise MailboxError(INVALID_SIZE)
            kind &= 0x0F
            if kind != _COE or MailboxProtocol.CoE not in self._protocols:
                raise MailboxError(UNSUPPORTED_PROTOCOL)
            replies = self._coe(message[HEADER.size : HEADER.size + length], self._read.length - HEADER.size)
        except MailboxError as fault:
            kind, replies = _ERROR, [struct.pack("<HH", 1, fault.detail)]
        self._replies += [(kind, address, reply) for reply in replies]
