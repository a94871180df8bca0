"""CANopen over EtherCAT: the SDO server. Upload and download, expedited, normal and segmented.

Source: ETG.1000.6. Bytes in, bytes out: what follows the mailbox header. The SDO Information service is in
`sdo_information.py`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, Protocol

from ethercat_server.ethercat.slave.abort_codes import AbortCode
from ethercat_server.virtual_sensor.slave.mailbox import MailboxError, MailboxRequestError
from ethercat_server.virtual_sensor.slave.objects import SdoAbortError

COE_HEADER: Final = 2
SDO_HEADER: Final = 8
SERVICE_REQUEST, SERVICE_RESPONSE, SERVICE_INFORMATION = 2, 3, 8
_SEGMENT_MINIMUM = 7

# Command specifiers, in the top three bits of the command.
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 0, 1, 2, 3, 4
_DOWNLOADED = 3
_SIZE_INDICATED, _EXPEDITED, _COMPLETE, _TOGGLE = 0x01, 0x02, 0x10, 0x10


class Objects(Protocol):
    """What the server reads and writes; each call may raise SdoAbortError."""

    def read(self, index: int, subindex: int) -> bytes:
        """The bytes of an entry."""

    def length(self, index: int, subindex: int) -> int:
        """Bytes of an entry."""

    def check_download(self, index: int, subindex: int, length: int) -> None:
        """Whether `length` bytes could be written."""

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an entry."""


class Information(Protocol):
    """The SDO Information service."""

    def answer(self, request: bytes, room: int) -> list[bytes]:
        """The replies to one request, `room` bytes at most each."""


@dataclass
class _Transfer:
    """A segmented transfer under way."""

    index: int
    subindex: int
    upload: bool
    data: bytearray
    size: int
    toggle: int = 0


class CoeServer:
    """Answers CoE requests one at a time."""

    def __init__(self, objects: Objects, information: Information) -> None:
        self._objects = objects
        self._information = information
        self._transfer: _Transfer | None = None

    def answer(self, message: bytes, room: int) -> list[bytes]:
        """The replies to `message`, each at most `room` bytes.

        MailboxRequestError if it is no CoE request.
        """
        if len(message) < COE_HEADER:
            raise MailboxRequestError(MailboxError.TOO_SHORT)
        service = message[1] >> 4
        if service == SERVICE_INFORMATION:
            head = struct.pack("<H", SERVICE_INFORMATION << 12)
            return [head + r for r in self._information.answer(message[COE_HEADER:], room - COE_HEADER)]
        if service != SERVICE_REQUEST:
            raise MailboxRequestError(MailboxError.INVALID_HEADER)
        request = message[COE_HEADER:]
        # A segment may be shorter than the full SDO header; nothing else may.
        if len(request) < 1 or (request[0] >> 5 in (_DOWNLOAD, _UPLOAD) and len(request) < SDO_HEADER):
            raise MailboxRequestError(MailboxError.TOO_SHORT)
        index, subindex = struct.unpack_from("<HB", request.ljust(SDO_HEADER, b"\0"), 1)
        if self._transfer is not None and request[0] >> 5 in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT):
            index, subindex = self._transfer.index, self._transfer.subindex
        try:
            reply = self._sdo(request, index, subindex, room - COE_HEADER)
        except SdoAbortError as abort:
            self._transfer = None
            head = struct.pack("<H", SERVICE_REQUEST << 12)  # an abort is coded as a request
            return [head + struct.pack("<BHBI", _ABORT << 5, index, subindex, abort.code)]
        return [struct.pack("<H", SERVICE_RESPONSE << 12) + reply] if reply else []

    def _sdo(self, request: bytes, index: int, subindex: int, room: int) -> bytes:
        command = request[0]
        specifier = command >> 5
        if specifier == _ABORT:
            self._transfer = None
            return b""
        if specifier in (_UPLOAD, _DOWNLOAD):
            self._transfer = None
            if command & _COMPLETE:
                raise SdoAbortError(AbortCode.UNSUPPORTED_ACCESS)
            if specifier == _UPLOAD:
                return self._upload(index, subindex, room)
            return self._download(request, index, subindex)
        transfer = self._transfer
        if transfer is None or specifier not in (_UPLOAD_SEGMENT, _DOWNLOAD_SEGMENT):
            raise SdoAbortError(AbortCode.UNKNOWN_COMMAND)
        if transfer.upload != (specifier == _UPLOAD_SEGMENT):
            raise SdoAbortError(AbortCode.UNKNOWN_COMMAND)
        if command & _TOGGLE != transfer.toggle:
            raise SdoAbortError(AbortCode.TOGGLE_NOT_CHANGED)
        if transfer.upload:
            return self._upload_segment(transfer, room)
        return self._download_segment(transfer, request)

    def _upload(self, index: int, subindex: int, room: int) -> bytes:
        data = self._objects.read(index, subindex)
        if 0 < len(data) <= 4:
            command = _UPLOAD << 5 | (4 - len(data)) << 2 | _EXPEDITED | _SIZE_INDICATED
            return struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0")
        first = data[: room - SDO_HEADER]
        if len(first) < len(data):
            rest = bytearray(data[len(first) :])
            self._transfer = _Transfer(index, subindex, True, rest, len(data))
        return struct.pack("<BHBI", _UPLOAD << 5 | _SIZE_INDICATED, index, subindex, len(data)) + first

    def _upload_segment(self, transfer: _Transfer, room: int) -> bytes:
        part = bytes(transfer.data[: room - 1])
        del transfer.data[: len(part)]
        command = transfer.toggle | max(_SEGMENT_MINIMUM - len(part), 0) << 1 | (not transfer.data)
        transfer.toggle ^= _TOGGLE
        if not transfer.data:
            self._transfer = None
        return bytes([command]) + part.ljust(_SEGMENT_MINIMUM, b"\0")

    def _download(self, request: bytes, index: int, subindex: int) -> bytes:
        command = request[0]
        if command & _EXPEDITED:
            if command & _SIZE_INDICATED:
                size = 4 - (command >> 2 & 3)
            else:  # the client leaves it to the server
                size = min(self._objects.length(index, subindex), 4)
            self._objects.write(index, subindex, request[4 : 4 + size])
        else:
            (size,) = struct.unpack_from("<I", request, 4)
            data = request[SDO_HEADER : SDO_HEADER + size]
            self._objects.check_download(index, subindex, size)
            if len(data) < size:
                self._transfer = _Transfer(index, subindex, False, bytearray(data), size)
            else:
                self._objects.write(index, subindex, data)
        return struct.pack("<BHBI", _DOWNLOADED << 5, index, subindex, 0)

    def _download_segment(self, transfer: _Transfer, request: bytes) -> bytes:
        command = request[0]
        data = request[1:]
        if len(data) <= _SEGMENT_MINIMUM:
            data = data[: _SEGMENT_MINIMUM - (command >> 1 & 7)]
        transfer.data += data
        if len(transfer.data) > transfer.size:
            raise SdoAbortError(AbortCode.TOO_LONG)
        if command & 1:
            self._transfer = None
            if len(transfer.data) != transfer.size:
                raise SdoAbortError(AbortCode.LENGTH_MISMATCH)
            self._objects.write(transfer.index, transfer.subindex, bytes(transfer.data))
        reply = bytes([_DOWNLOAD << 5 | transfer.toggle]) + bytes(_SEGMENT_MINIMUM)
        transfer.toggle ^= _TOGGLE
        return reply
