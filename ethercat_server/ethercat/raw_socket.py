"""The AF_PACKET socket under SOEM, for frames of our own.

SOEM's single datagrams wait by spinning or in the kernel's jiffies, and its exchange handles one frame at a
time; here the timeout is the caller's. The frames carry indices that SOEM does not use, so SOEM discards
those it receives.
"""

from __future__ import annotations

import fcntl
import os
import select
import socket
import stat
import struct
import time
from typing import Final

_LONGEST_FRAME: Final = 1514
_SIOCGSTAMPNS: Final = 0x80108907
_TIMESPEC: Final = struct.Struct("=qq")
_NS: Final = 1_000_000_000


class RawSocket:
    """A second handle to the AF_PACKET socket `fd` that SOEM opened. Closing it leaves SOEM's open."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._socket = socket.socket(fileno=os.dup(fd))

    def set_blocking(self, blocking: bool) -> None:
        """Blocking for SOEM's own waits, which would otherwise spin."""
        os.set_blocking(self._fd, blocking)

    def send(self, frame: bytes | bytearray) -> None:
        """Send an Ethernet frame; it is lost if the link is down."""
        try:
            self._socket.send(frame)
        except OSError:
            return

    def receive(self, timeout_s: float) -> bytes | None:
        """The next frame; None if none comes within `timeout_s`, or the link is down."""
        try:
            if select.select((self._fd,), (), (), timeout_s)[0]:
                return self._socket.recv(_LONGEST_FRAME)
        except OSError:
            return None
        return None

    def arrived_ns(self) -> int:
        """When the frame that was received last had arrived; see `arrived_ns`."""
        return arrived_ns(self._fd)

    def discard(self) -> None:
        """Discard the frames that have arrived."""
        while self.receive(0) is not None:
            pass

    def close(self) -> None:
        """Close this handle."""
        self._socket.close()


def arrived_ns(fd: int) -> int:
    """CLOCK_MONOTONIC when the packet that was received last from the socket `fd` had arrived.

    0 if the kernel does not say, as at the first call, which has it stamp packets. The stamp is in
    CLOCK_REALTIME: it is wrong if that was set in between.
    """
    try:
        seconds, ns = _TIMESPEC.unpack(fcntl.ioctl(fd, _SIOCGSTAMPNS, bytes(_TIMESPEC.size)))
    except OSError:
        return 0
    waited = time.time_ns() - int(seconds * _NS + ns)
    return time.monotonic_ns() - waited  # if anything comes between the two clocks, it is too late


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
