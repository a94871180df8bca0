"""Streaming clients of every manner, one a process: `_odd_clients.py MANNER PORT`. They end with their input.

`honest` reads all the time; `stopped` too, until it gets SIGSTOP. `slow` reads a byte a second, and properly
for a while once its input has ended. These print at the end what came. `noise` sends random bytes and `churn`
connects and closes, over and over.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import select
import socket
import sys
import time
from collections.abc import Callable, Mapping
from typing import Final

from ethercat_server.virtual_sensor.signals import decode_clock
from protocol.control import request
from protocol.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from protocol.pdo import SampleDecoder

EIGHT: Final = ("stopped", "slow", "noise", "churn", "honest", "honest", "honest", "honest")
"""Of every odd manner one, and as many honest ones."""
_PAUSE_S: Final = 0.005
_READ_ON_S: Final = 2.0
_SMALL_BUFFER: Final = 4096
_OLD: Final = int(DataFlag.REPEATED | DataFlag.INVALID)


class Tally:
    """What came, in fixed memory but for the jumps."""

    def __init__(self) -> None:
        self.frames = self.lost = self.unflagged = 0
        self.jumps: list[tuple[int, bool]] = []
        """Where the sequence jumps because frames were withheld: by how much, and whether GAP told of it."""
        self.address = ""
        self._decode = SampleDecoder(61).decode
        self._sequence = self._number = -1
        self._gap = False

    def take(self, frame: DataMessage) -> None:
        """One frame."""
        gap = bool(frame.flags & DataFlag.GAP)
        if self._sequence >= 0 and frame.sequence != self._sequence + 1:
            self.jumps.append((frame.sequence - self._sequence - 1, gap))
        self._sequence = frame.sequence
        self._gap |= gap
        if frame.flags & _OLD:
            return
        number = decode_clock(self._decode(frame.process_data).array).number
        if self.frames:
            self.lost += number - self._number - 1
            self.unflagged += number != self._number + 1 and not self._gap
        self._number, self._gap = number, False
        self.frames += 1

    def summary(self) -> str:
        """For whoever started this process."""
        return json.dumps({name: value for name, value in vars(self).items() if not name.startswith("_")})


def input_ended(within_s: float = 0.0) -> bool:
    """Whether whoever started this process wants it to end."""
    return bool(select.select((sys.stdin,), (), (), within_s)[0])


def connect(port: int, receive_buffer: int = 0) -> socket.socket:
    """A connection to the server."""
    sock = socket.socket()
    if receive_buffer:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    sock.connect(("127.0.0.1", port))
    return sock


def subscribe(port: int, receive_buffer: int = 0) -> tuple[socket.socket, Tally]:
    """A connection that gets every frame, so that none is missing from the sequence but what is withheld."""
    sock, tally = connect(port, receive_buffer), Tally()
    tally.address = "{}:{}".format(*sock.getsockname())
    sock.sendall(encode_json(request("subscribe", fresh_only=False)))
    return sock, tally


def read(sock: socket.socket, tally: Tally, decoder: FrameDecoder, until: Callable[[], bool]) -> None:
    """Take what comes until then or until the server ends it."""
    waiting = {sock: True}
    while not until() and waiting:
        readable, _, _ = select.select((*waiting, sys.stdin), (), (), 0.1)
        if sock not in readable:
            continue
        data = b""
        with contextlib.suppress(ConnectionError):
            data = sock.recv(65536)
        if not data:
            waiting.clear()
        decoder.feed(data)
        for message in decoder:
            if isinstance(message, DataMessage):
                tally.take(message)


def honest(port: int, receive_buffer: int = 0) -> None:
    """Reads all the time."""
    sock, tally = subscribe(port, receive_buffer)
    print(tally.address, flush=True)
    read(sock, tally, FrameDecoder(), input_ended)
    print(tally.summary(), flush=True)


def stopped(port: int) -> None:
    """Honest, but what waits for it while it is stopped is the server's and not its own kernel's."""
    honest(port, _SMALL_BUFFER)


def slow(port: int) -> None:
    """Reads a byte a second."""
    sock, tally = subscribe(port, _SMALL_BUFFER)
    print(tally.address, flush=True)
    decoder = FrameDecoder()
    while not input_ended(within_s=1.0):
        with contextlib.suppress(ConnectionError):
            decoder.feed(sock.recv(1))
    ending = time.monotonic() + _READ_ON_S
    read(sock, tally, decoder, lambda: time.monotonic() > ending)
    print(tally.summary(), flush=True)


def noise(port: int) -> None:
    """Sends what is no message."""
    rng, sock = random.Random(port), connect(port)
    while not input_ended(within_s=_PAUSE_S):
        with contextlib.suppress(BlockingIOError):
            try:
                sock.send(rng.randbytes(rng.choice((4, 60, 4000))), socket.MSG_DONTWAIT)
            except ConnectionError:
                sock.close()
                sock = connect(port)


def churn(port: int) -> None:
    """Connects and closes."""
    while not input_ended(within_s=_PAUSE_S):
        connect(port).close()


MANNERS: Final[Mapping[str, Callable[[int], None]]] = {
    "honest": honest,
    "stopped": stopped,
    "slow": slow,
    "noise": noise,
    "churn": churn,
}


def main() -> None:
    """Be a client of that manner until the input ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("manner", choices=MANNERS)
    parser.add_argument("port", type=int)
    arguments = parser.parse_args()
    MANNERS[arguments.manner](arguments.port)


if __name__ == "__main__":
    main()
