"""CANopen over EtherCAT: the SDO Information service, which tells a master what objects there are.

Source: ETG.1000.6. Lists of objects, object descriptions, entry descriptions; a list too long for the mailbox
goes out in fragments.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Final

from ethercat_server.ethercat.slave.abort_codes import AbortCode
from ethercat_server.sensor.objects.dictionary import Access, ObjectEntry
from ethercat_server.virtual_sensor.slave.device import Device
from ethercat_server.virtual_sensor.slave.mailbox import MailboxError, MailboxRequestError
from ethercat_server.virtual_sensor.slave.objects import ObjectTable, SdoAbortError

HEADER: Final = struct.Struct("<BBH")
LIST_REQUEST, LIST_RESPONSE = 1, 2
OBJECT_REQUEST, OBJECT_RESPONSE = 3, 4
ENTRY_REQUEST, ENTRY_RESPONSE = 5, 6
ERROR = 7
INCOMPLETE: Final = 0x80

LIST_LENGTHS, LIST_ALL, LIST_RXPDO, LIST_TXPDO, LIST_BACKUP, LIST_SETTINGS = range(6)
_VARIABLE, _ARRAY, _RECORD = 7, 8, 9
_TYPE_RECORD_OF: Final = {0x1018: 0x0023, 0x1600: 0x0021, 0x1A00: 0x0021, 0x1A01: 0x0021}
"""Data types of the objects whose structure the standard names."""

_READ_ALWAYS = 0x07
_WRITE: Final = {Access.RO: 0, Access.RW: 0x38, Access.RW_PREOP: 0x08}
_RXPDO_MAPPABLE, _TXPDO_MAPPABLE = 0x40, 0x80


class SdoInformation:
    """Describes the objects of a device; `names` are those of objects that have parts, by index."""

    def __init__(self, dictionary: ObjectTable, device: Device, names: Mapping[int, str]) -> None:
        self._dictionary = dictionary
        self._names = names
        self._outputs, self._inputs = device.output_entries, device.input_entries
        self._indices = sorted({index for index, _ in dictionary.entries})

    def answer(self, request: bytes, room: int) -> list[bytes]:
        """The replies to one request, `room` bytes at most each; MailboxRequestError if it is too short."""
        if len(request) < HEADER.size:
            raise MailboxRequestError(MailboxError.TOO_SHORT)
        operation = request[0] & ~INCOMPLETE
        body = request[HEADER.size :]
        needed = {LIST_REQUEST: 2, OBJECT_REQUEST: 2, ENTRY_REQUEST: 4}.get(operation)
        try:
            if needed is None:
                raise SdoAbortError(AbortCode.UNKNOWN_COMMAND)
            if len(body) < needed:
                raise MailboxRequestError(MailboxError.TOO_SHORT)
            (index,) = struct.unpack_from("<H", body)
            if operation == LIST_REQUEST:
                return self._fragments(self._list(index), room)
            if operation == OBJECT_REQUEST:
                return [HEADER.pack(OBJECT_RESPONSE, 0, 0) + self._object(index)[: room - HEADER.size]]
            entry = self._entry(index, body[2])
            return [HEADER.pack(ENTRY_RESPONSE, 0, 0) + entry[: room - HEADER.size]]
        except SdoAbortError as abort:
            return [HEADER.pack(ERROR, 0, 0) + struct.pack("<I", abort.code)]

    @staticmethod
    def _fragments(data: bytes, room: int) -> list[bytes]:
        step = (room - HEADER.size) & ~1
        parts = [data[at : at + step] for at in range(0, len(data), step)]
        last = len(parts) - 1
        return [
            HEADER.pack(LIST_RESPONSE | (INCOMPLETE if number < last else 0), 0, last - number) + part
            for number, part in enumerate(parts)
        ]

    def _list(self, kind: int) -> bytes:
        lists = {
            LIST_ALL: self._indices,
            LIST_RXPDO: sorted({entry.index for entry in self._outputs}),
            LIST_TXPDO: sorted({entry.index for entry in self._inputs}),
            LIST_BACKUP: self._having(Access.RW, Access.RW_PREOP),
            LIST_SETTINGS: self._having(Access.RW_PREOP),
        }
        if kind == LIST_LENGTHS:
            return struct.pack("<H5H", kind, *(len(found) for found in lists.values()))
        if kind not in lists:
            raise SdoAbortError(AbortCode.UNSUPPORTED_ACCESS)
        return struct.pack(f"<H{len(lists[kind])}H", kind, *lists[kind])

    def _having(self, *accesses: Access) -> list[int]:
        rows = self._dictionary.entries.values()
        return sorted({row.index for row in rows if row.access in accesses and row.index >= 0x8000})

    def _object(self, index: int) -> bytes:
        rows = [row for (known, _), row in self._dictionary.entries.items() if known == index]
        if not rows:
            raise SdoAbortError(AbortCode.NO_OBJECT)
        parts = [row for row in rows if row.subindex]
        if not parts:
            kind, code, name = rows[0].type.coe_code, _VARIABLE, rows[0].name
        else:
            types = {row.type for row in parts}
            code = _ARRAY if len(types) == 1 and index not in _TYPE_RECORD_OF else _RECORD
            kind = _TYPE_RECORD_OF.get(index, parts[0].type.coe_code if code == _ARRAY else 0)
            name = self._names.get(index, parts[0].name)
        highest = max(row.subindex for row in rows)
        return struct.pack("<HHBB", index, kind, highest, code) + name.encode("ascii")

    def _entry(self, index: int, subindex: int) -> bytes:
        row = self._dictionary.entry(index, subindex)
        bits = self._dictionary.size(row) * 8
        head = struct.pack("<HBBHHH", index, subindex, 0, row.type.coe_code, bits, self._access(row))
        return head + row.name.encode("ascii")

    def _access(self, row: ObjectEntry) -> int:
        bits = _READ_ALWAYS | _WRITE[row.access]
        if row in self._outputs:
            bits |= _RXPDO_MAPPABLE
        if row in self._inputs:
            bits |= _TXPDO_MAPPABLE
        return bits
