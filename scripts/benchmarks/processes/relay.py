"""A slow network card: EtherCAT frames between a new interface and an existing one, delayed on both ways.

A USB adapter holds every frame back, but keeps them in order and has several under way. The last bit of a
delay is waited for busily, because this stands for hardware, which is punctual. The new interface is one end
of a veth pair that the kernel removes when this process ends.
"""

from __future__ import annotations

import argparse
import math
import random
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from ethercat_server.virtual_sensor.link import open_interface
from ethercat_server.virtual_sensor.virtual_bus import veth_pair
from scripts.benchmarks.records import steady

_BUSY_NS: Final = 60_000
"""Select may wake as late as this."""
_LONGEST_FRAME: Final = 1600
_SO_TIMESTAMPNS: Final = 35
_TIMESPEC: Final = struct.Struct("qq")
_ANCILLARY: Final = socket.CMSG_SPACE(_TIMESPEC.size)
_SOL_PACKET, _PACKET_IGNORE_OUTGOING = 263, 23


class Delay:
    """The frames under way in one direction; times are ns of any one clock."""

    def __init__(self, delay_ns: int, jitter_ns: int = 0, seed: int = 0) -> None:
        self._shortest_ns = delay_ns - jitter_ns
        self._range_ns = 2 * jitter_ns
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


class Way:
    """One direction: what arrives at `source` leaves from `target` after `delay`."""

    def __init__(self, source: socket.socket, target: socket.socket, delay: Delay) -> None:
        self.source = source
        self.delay = delay
        self._send = target.send
        source.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
        source.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def receive(self) -> None:
        """Take all that has arrived. The kernel noted when; that this process wakes late delays nothing."""
        with suppress(BlockingIOError):
            while True:
                frame, ((_, _, stamp),), _, _ = self.source.recvmsg(_LONGEST_FRAME, _ANCILLARY)
                seconds, nanoseconds = _TIMESPEC.unpack(stamp)
                ago_ns = time.time_ns() - (seconds * 1_000_000_000 + nanoseconds)
                self.delay.put(frame, time.monotonic_ns() - max(0, ago_ns))

    def send(self) -> None:
        """Send all that is due. A full or closed interface loses frames, as a card does."""
        while self.delay.due_ns <= time.monotonic_ns():
            with suppress(OSError):
                self._send(self.delay.take())


def relay(ways: Sequence[Way]) -> None:
    """Forward frames until the process ends."""
    sources = [way.source for way in ways]
    while True:
        left_ns = min(way.delay.due_ns for way in ways) - _BUSY_NS - time.monotonic_ns()
        if left_ns > 0:
            select.select(sources, (), (), left_ns * 1e-9 if left_ns < math.inf else None)
        for way in ways:
            way.receive()
            way.send()


def main() -> None:
    """Forward frames between `near`, which is made, and `far`; delay and jitter are those of each way.

    The file `ready` appears when it begins; SIGTERM ends it.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("ready", type=Path)
    parser.add_argument("--near", required=True)
    parser.add_argument("--far", required=True)
    parser.add_argument("--delay-us", type=float, required=True)
    parser.add_argument("--jitter-us", type=float, default=0.0)
    parser.add_argument("--priority", type=int, default=0)
    arguments = parser.parse_args()
    delay_ns, jitter_ns = (round(1000 * value) for value in (arguments.delay_us, arguments.jitter_us))
    # Before this process leaves the namespace in which that interface is.
    with open_interface(arguments.far) as bus, veth_pair(arguments.near) as end, open_interface(end) as card:
        ways = [
            Way(source, target, Delay(delay_ns, jitter_ns, seed))
            for seed, (source, target) in enumerate(((card, bus), (bus, card)))
        ]
        steady(arguments.priority)
        arguments.ready.touch()
        relay(ways)


if __name__ == "__main__":
    main()
