"""The mailbox of a slave, and CANopen over EtherCAT (CoE) in it: objects, SDO server, their descriptions.

Requests come out of sync manager 0, replies go into sync manager 1; duplicates are dropped, lost replies
repeated. Source: ETG.1000.4 and ETG.1000.6. A message is: length u16, address u16, channel and priority u8,
type (4 bits) and counter (3 bits) u8, then `length` bytes.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from typing import Final

from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import AbortCode, abort_meaning
from ethercat_server.ethercat.slave.sii import MailboxProtocol
from ethercat_server.sensor.objects.dictionary import TITLES, Access, ObjectEntry
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
            self._written.full = False
            self._request(self._written.content)
        if self._replies:
            self._last = self._replies.popleft()
            kind, address, body = self._last
            self._counter = self._counter % 7 + 1
            self._last_reply = HEADER.pack(len(body), address, 0, kind | self._counter << 4) + body
            self._read.load(self._last_reply)

    def raise_emergency(self, code: int, register: int, data: bytes) -> None:
        """Put a CoE emergency before all that the master has not read yet; the mailbox must be on."""
        body = struct.pack("<HHB5s", _COE_EMERGENCY << 12, code, register, data)
        if self._read.full and self._last is not None:
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


Address = tuple[int, int]  # index and sub-index of an object entry


class TransferRefusedError(Exception):
    """The slave aborts the SDO transfer with `code`."""

    def __init__(self, code: int) -> None:
        super().__init__(abort_meaning(code))
        self.code = code


class ObjectTable:
    """The object entries of a slave, and their values unless computed."""

    def __init__(self, entries: dict[Address, ObjectEntry], values: dict[Address, bytes]) -> None:
        self.entries = entries
        self.values = values

    def entry(self, index: int, subindex: int) -> ObjectEntry:
        row = self.entries.get((index, subindex))
        if row is None:
            exists = any(known == index for known, _ in self.entries)
            raise TransferRefusedError(AbortCode.NO_SUBINDEX if exists else AbortCode.NO_OBJECT)
        return row

    def size(self, row: ObjectEntry) -> int:
        return row.type.size or len(self.values[row.address])

    def number(self, address: Address) -> float:
        value = self.entries[address].type.unpack(self.values[address])
        assert not isinstance(value, str)
        return value

    def read(self, index: int, subindex: int) -> bytes:
        return self.values[self.entry(index, subindex).address]

    def write(self, index: int, subindex: int, data: bytes, state: AlState) -> None:
        self.check_write(self.entry(index, subindex), len(data), state)
        self.values[index, subindex] = data

    def check_write(self, row: ObjectEntry, length: int, state: AlState) -> None:
        """TransferRefusedError if `length` bytes cannot be written to `row` in `state`, whatever they are."""
        if row.access is Access.RO:
            raise TransferRefusedError(AbortCode.READ_ONLY)
        if row.access is Access.RW_PREOP and state is not AlState.PREOP:
            raise TransferRefusedError(AbortCode.NOT_IN_THIS_STATE)
        if length != self.size(row):
            raise TransferRefusedError(AbortCode.TOO_LONG if length > self.size(row) else AbortCode.TOO_SHORT)


_COE_HEADER: Final = struct.Struct("<H")
_SDO_HEADER_SIZE: Final = 8
_REQUEST, _RESPONSE, _INFORMATION = 2, 3, 8  # services in the CoE header
# Command specifiers, in the top three bits of the command.
_DOWNLOAD, _UPLOAD, _DOWNLOADED, _ABORT = 1, 2, 3, 4
_SIZE_INDICATED, _EXPEDITED, _COMPLETE = 0x01, 0x02, 0x10
_INFO_HEADER: Final = struct.Struct("<BBH")
# Requests of the SDO Information service, with the shortest body of each; a response is one more.
_LIST, _OBJECT, _ENTRY, _INFO_ERROR = 1, 3, 5, 7
_SHORTEST: Final = {_LIST: 2, _OBJECT: 2, _ENTRY: 4}
_INCOMPLETE: Final = 0x80
_ALL: Final = 1  # the list of all objects
_VARIABLE, _ARRAY, _RECORD = 7, 8, 9
_READ_ALWAYS = 0x07
_WRITE: Final = {Access.RO: 0, Access.RW: 0x38, Access.RW_PREOP: 0x08}


class CoeServer:
    """Answers CoE requests one at a time: SDO upload and download, expedited and normal, SDO Information.

    No object is too long for the mailbox, so there are no segments; a list that is goes out in fragments.
    `state` gives the AL state.
    """

    def __init__(self, objects: ObjectTable, state: Callable[[], AlState]) -> None:
        self._objects = objects
        self._state = state

    def answer(self, message: bytes, room: int) -> list[bytes]:
        """The replies to `message`, each at most `room` bytes; MailboxError if it is no CoE request."""
        if len(message) < _COE_HEADER.size:
            raise MailboxError(TOO_SHORT)
        service, request, room = message[1] >> 4, message[_COE_HEADER.size :], room - _COE_HEADER.size
        if service == _INFORMATION:
            return [_COE_HEADER.pack(service << 12) + reply for reply in self._information(request, room)]
        if service != _REQUEST:
            raise MailboxError(INVALID_HEADER)
        if len(request) < _SDO_HEADER_SIZE:
            raise MailboxError(TOO_SHORT)
        index, subindex = struct.unpack_from("<HB", request, 1)
        try:
            reply = self._sdo(request, index, subindex)
        except TransferRefusedError as abort:
            # An abort is coded as a request.
            return [struct.pack("<HBHBI", _REQUEST << 12, _ABORT << 5, index, subindex, abort.code)]
        return [_COE_HEADER.pack(_RESPONSE << 12) + reply] if reply else []

    def _sdo(self, request: bytes, index: int, subindex: int) -> bytes:
        command, specifier = request[0], request[0] >> 5
        if specifier == _ABORT:
            return b""
        if specifier not in (_UPLOAD, _DOWNLOAD):
            raise TransferRefusedError(AbortCode.UNKNOWN_COMMAND)
        if command & _COMPLETE:
            raise TransferRefusedError(AbortCode.UNSUPPORTED_ACCESS)
        if specifier == _DOWNLOAD:
            return self._download(request, index, subindex)
        data = self._objects.read(index, subindex)
        if 0 < len(data) <= 4:
            command = _UPLOAD << 5 | (4 - len(data)) << 2 | _EXPEDITED | _SIZE_INDICATED
            return struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0")
        return struct.pack("<BHBI", _UPLOAD << 5 | _SIZE_INDICATED, index, subindex, len(data)) + data

    def _download(self, request: bytes, index: int, subindex: int) -> bytes:
        command = request[0]
        if command & _EXPEDITED:
            data = request[4 : 8 - (command >> 2 & 3)]
        else:
            (size,) = struct.unpack_from("<I", request, 4)
            data = request[_SDO_HEADER_SIZE : _SDO_HEADER_SIZE + size]
        self._objects.write(index, subindex, data, self._state())
        return struct.pack("<BHBI", _DOWNLOADED << 5, index, subindex, 0)

    def _information(self, request: bytes, room: int) -> list[bytes]:
        if len(request) < _INFO_HEADER.size:
            raise MailboxError(TOO_SHORT)
        operation, body = request[0] & ~_INCOMPLETE, request[_INFO_HEADER.size :]
        room -= _INFO_HEADER.size
        try:
            if operation not in _SHORTEST:
                raise TransferRefusedError(AbortCode.UNKNOWN_COMMAND)
            if len(body) < _SHORTEST[operation]:
                raise MailboxError(TOO_SHORT)
            (index,) = struct.unpack_from("<H", body)
            if operation == _LIST:
                found, room = self._list(index), room & ~1
            else:
                found = (self._object(index) if operation == _OBJECT else self._entry(index, body[2]))[:room]
        except TransferRefusedError as abort:
            return [_INFO_HEADER.pack(_INFO_ERROR, 0, 0) + struct.pack("<I", abort.code)]
        parts = [found[at : at + room] for at in range(0, len(found), room)]
        return [
            _INFO_HEADER.pack(operation + 1 | (_INCOMPLETE if left else 0), 0, left) + part
            for left, part in zip(reversed(range(len(parts))), parts, strict=True)
        ]

    def _list(self, kind: int) -> bytes:
        if kind != _ALL:
            raise TransferRefusedError(AbortCode.UNSUPPORTED_ACCESS)
        indices = sorted({index for index, _ in self._objects.entries})
        return struct.pack(f"<H{len(indices)}H", kind, *indices)

    def _object(self, index: int) -> bytes:
        rows = [row for (known, _), row in self._objects.entries.items() if known == index]
        if not rows:
            raise TransferRefusedError(AbortCode.NO_OBJECT)
        types = {row.type for row in rows if row.subindex}
        code = _VARIABLE if not types else _ARRAY if len(types) == 1 else _RECORD
        kind = 0 if code == _RECORD else rows[-1].type.coe_code
        head = struct.pack("<HHBB", index, kind, max(row.subindex for row in rows), code)
        return head + TITLES.get(index, rows[-1].name).encode("ascii")

    def _entry(self, index: int, subindex: int) -> bytes:
        row = self._objects.entry(index, subindex)
        access, bits = _READ_ALWAYS | _WRITE[row.access], self._objects.size(row) * 8
        head = struct.pack("<HBBHHH", index, subindex, 0, row.type.coe_code, bits, access)
        return head + row.name.encode("ascii")
