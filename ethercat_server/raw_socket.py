"""The raw socket under SOEM: single datagrams, and frames that come too late told apart.

SOEM's own single datagrams wait by spinning, or by the kernel's jiffies, and do not say whether a slave
refused or the frame got lost. These here sleep, for as long as they are told. Their frames carry numbers
that SOEM does not use, so it throws away what comes of them later.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import struct
import time
from typing import Final

APRD: Final = 1
"""EtherCAT command: auto increment physical read, addressed by minus the place on the bus."""
APWR: Final = 2
"""EtherCAT command: auto increment physical write."""
FPRD: Final = 4
"""EtherCAT command: configured address physical read."""
FPWR: Final = 5
"""EtherCAT command: configured address physical write."""

BRD: Final = 7
"""EtherCAT command: broadcast read."""

SOEM_INDICES: Final = 16
"""SOEM numbers its frames modulo this."""
_OWN_INDICES: Final = 0x80
"""The numbers from here on are this file's."""
_MOST_DROPPED: Final = 16
_LONGEST_FRAME: Final = 1514
_SHORTEST_FRAME: Final = 60

# Ethernet header, EtherCAT header; command, index, station, register, length and flags, interrupt.
_HEAD: Final = struct.Struct("<6s6s2sHBBHHHH")
_INDEX_OFFSET: Final = 17
_BROADCAST: Final = b"\xff" * 6
_SOURCE: Final = b"\x01" * 6
"""As SOEM has it: slaves look at no addresses."""
_ETHERTYPE: Final = b"\x88\xa4"
_TYPE_DATAGRAMS: Final = 0x1000
_LENGTH_MASK: Final = 0x07FF
_DATAGRAM_OVERHEAD: Final = 12
_WKC_SIZE: Final = 2


class RawSocket:
    """A second handle to the AF_PACKET socket `fd` that SOEM opened. Closing it leaves SOEM's open."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._socket = socket.socket(fileno=os.dup(fd))
        self._next = 0

    def set_blocking(self, blocking: bool) -> None:
        """Blocking for SOEM's own waits, which would otherwise spin; non-blocking for those of this file."""
        os.set_blocking(self.fd, blocking)

    def wait(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s` for a frame; whether there is one."""
        return bool(select.select((self.fd,), (), (), timeout_s)[0])

    def datagram(
        self, command: int, station: int, register: int, data: bytes, timeout_s: float
    ) -> tuple[int, bytes] | None:
        """Send one datagram and wait for it: its working counter and data; None if it does not come back."""
        self._next = (self._next + 1) % _OWN_INDICES
        index = _OWN_INDICES + self._next
        size = len(data)
        length = _DATAGRAM_OVERHEAD + size
        head = _HEAD.pack(
            _BROADCAST, _SOURCE, _ETHERTYPE, _TYPE_DATAGRAMS | length,
            command, index, station, register, size, 0,
        )  # fmt: skip
        deadline = time.monotonic() + timeout_s
        with contextlib.suppress(OSError):  # the link is down
            self._socket.send((head + data + bytes(_WKC_SIZE)).ljust(_SHORTEST_FRAME, b"\0"))
            while (left := deadline - time.monotonic()) > 0 and self.wait(left):
                frame = self._socket.recv(_LONGEST_FRAME)
                end = _HEAD.size + size
                if len(frame) < end + _WKC_SIZE:
                    continue
                *_, its_command, its_index, _, _, its_length, _ = _HEAD.unpack_from(frame)
                if (its_command, its_index, its_length & _LENGTH_MASK) == (command, index, size):
                    wkc = int.from_bytes(frame[end : end + _WKC_SIZE], "little")
                    return wkc, frame[_HEAD.size : end]
        return None

    def find(self, index: int | None, timeout_s: float) -> int | None:
        """The number of the frame that is next to be received, dropping all that do not have `index`.

        With None any of SOEM's frames will do. Waits at most `timeout_s`; None if none comes. The socket
        must be non-blocking.
        """
        deadline = time.monotonic() + timeout_s
        with contextlib.suppress(OSError):  # nothing there any more, or the link is down
            while True:
                head = self._socket.recv(_INDEX_OFFSET + 1, socket.MSG_PEEK)
                found = head[_INDEX_OFFSET] if len(head) > _INDEX_OFFSET else _OWN_INDICES
                if found == index or (index is None and found < SOEM_INDICES):
                    return found
                self._socket.recv(1)
                left = deadline - time.monotonic()
                if left <= 0 or not self.wait(left):
                    break
        return None

    def drop(self, quiet_s: float) -> None:
        """Drop everything that comes until nothing has come for `quiet_s`, within bounds."""
        with contextlib.suppress(OSError):
            for _ in range(_MOST_DROPPED):
                if not self.wait(quiet_s):
                    break
                self._socket.recv(1)

    def close(self) -> None:
        """Close this handle."""
        self._socket.close()


def packet_sockets() -> set[int]:
    """Descriptors of this process that are AF_PACKET sockets."""
    found = set()
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - plain descriptor numbers
        fd = int(name)
        try:
            if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                continue
        except OSError:
            continue  # the descriptor of the listing itself
        with socket.socket(fileno=os.dup(fd)) as duplicate:
            if duplicate.family == socket.AF_PACKET:
                found.add(fd)
    return found
