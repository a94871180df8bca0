"""A slow network card: EtherCAT frames between a new interface and an existing one, delayed on both ways.

A USB adapter holds every frame back, but keeps them in order and has several under way. The last bit of a
delay is waited for busily, because this stands for hardware, which is punctual. The new interface is one end
of a veth pair that the kernel removes when this process ends.

Arguments: READY NEAR FAR DELAY_US JITTER_US PRIORITY; NEAR is made, the file READY appears when it begins,
delay and jitter are those of each way, SIGTERM ends it.
"""

from __future__ import annotations

import math
import random
import select
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from ethercat_server.virtual_sensor.link import open_interface
from ethercat_server.virtual_sensor.virtual_bus import veth_pair
from scripts.benchmarks.records import steady

_BUSY_NS: Final = 60_000  # select may wake as late as this
_LONGEST_FRAME: Final = 1600
_SO_TIMESTAMPNS: Final = 35
_TIMESPEC: Final = struct.Struct("qq")
_SOL_PACKET, _PACKET_IGNORE_OUTGOING = 263, 23


class Delay:
    """The frames under way in one direction; times are ns of any one clock."""

    def __init__(self, delay_ns: int, jitter_ns: int = 0, seed: int = 0) -> None:
        self._shortest_ns, self._range_ns = delay_ns - jitter_ns, 2 * jitter_ns
        self._random = random.Random(seed).random
        self._frames: deque[tuple[int, bytes]] = deque()
        self._last_ns = 0

    def put(self, frame: bytes, arrived_ns: int) -> None:
        """Take a frame; jitter does not let it overtake the one before."""
        due_ns = arrived_ns + self._shortest_ns + int(self._range_ns * self._random())
        self._last_ns = max(due_ns, self._last_ns)
        self._frames.append((self._last_ns, frame))

    @property
    def due_ns(self) -> float:
        """When the next frame leaves; infinity if there is none."""
        return self._frames[0][0] if self._frames else math.inf

    def take(self) -> bytes:
        """The next frame."""
        return self._frames.popleft()[1]


def receive(source: socket.socket, delay: Delay) -> None:
    """Take all that has arrived. The kernel noted when; that this process wakes late delays nothing."""
    with suppress(BlockingIOError):
        while True:
            frame, ((_, _, stamp),), _, _ = source.recvmsg(_LONGEST_FRAME, socket.CMSG_SPACE(_TIMESPEC.size))
            seconds, nanoseconds = _TIMESPEC.unpack(stamp)
            ago_ns = time.time_ns() - (seconds * 1_000_000_000 + nanoseconds)
            delay.put(frame, time.monotonic_ns() - max(0, ago_ns))


def relay(ways: Sequence[tuple[socket.socket, socket.socket, Delay]]) -> None:
    """Forward frames from the first to the second of each way until the process ends."""
    sources = [source for source, _, _ in ways]
    for source in sources:
        source.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
        source.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    while True:
        left_ns = min(delay.due_ns for _, _, delay in ways) - _BUSY_NS - time.monotonic_ns()
        if left_ns > 0:
            select.select(sources, (), (), left_ns * 1e-9 if left_ns < math.inf else None)
        for source, target, delay in ways:
            receive(source, delay)
            while delay.due_ns <= time.monotonic_ns():
                with suppress(OSError):  # a full or closed interface loses frames, as a card does
                    target.send(delay.take())


if __name__ == "__main__":
    ready, near, far, *times, priority = sys.argv[1:]
    delay_ns, jitter_ns = (round(1000 * float(each)) for each in times)
    # `far` before this process leaves the namespace in which that interface is.
    with open_interface(far) as bus, veth_pair(near) as end, open_interface(end) as card:
        steady(int(priority))
        Path(ready).touch()
        relay([(card, bus, Delay(delay_ns, jitter_ns, 0)), (bus, card, Delay(delay_ns, jitter_ns, 1))])
