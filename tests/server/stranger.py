"""A client of another user than the server's: `stranger.py HOST PORT WHAT [ARGUMENT]`, run as a process.

`ask` sends the requests in ARGUMENT, a JSON list, and prints the replies. `stream` subscribes and prints how
many frames it has got once there are ARGUMENT. `hit` sends one of the requests in ARGUMENT and is gone at
once, in all the ways there are, over and over.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import struct
import sys
from collections.abc import Callable, Sequence

from bota_ethercat.control import request
from bota_ethercat.framing import DataMessage, FrameDecoder, encode_json
from bota_ethercat.text.bare_json import encode_bare_json
from tests.server.as_another_user import become_nobody

HITS = 6
"""Of each request, in each way to go."""
_RESET = struct.pack("ii", 1, 0)


def ask(sock: socket.socket, messages: Sequence[dict[str, object]]) -> None:
    decoder, replies = FrameDecoder(), 0
    for message in messages:
        sock.sendall(encode_json(message))
    while replies < len(messages):
        decoder.feed(sock.recv(65536) or sys.exit("the server closed the connection"))
        for answer in decoder:
            if isinstance(answer, dict) and "reply" in answer:
                print(json.dumps(answer))
                replies += 1


def stream(sock: socket.socket, count: int) -> None:
    decoder, frames = FrameDecoder(), 0
    sock.sendall(encode_json(request("subscribe")))
    while frames < count:
        decoder.feed(sock.recv(65536) or sys.exit("the server closed the connection"))
        frames += sum(isinstance(message, DataMessage) for message in decoder)
    print(frames)


def _close(sock: socket.socket) -> None:
    sock.close()


def _say_no_more_then_close(sock: socket.socket) -> None:
    sock.shutdown(socket.SHUT_WR)
    sock.close()


def _reset(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
    sock.close()


def _hear_no_more_then_close(sock: socket.socket) -> None:
    sock.shutdown(socket.SHUT_RD)
    sock.close()


GOING: Sequence[Callable[[socket.socket], None]] = (
    _close,
    _close,
    _say_no_more_then_close,
    _reset,
    _hear_no_more_then_close,
)


def hit(host: str, port: int, messages: Sequence[dict[str, object]]) -> None:
    for number, (message, go, _) in enumerate(itertools.product(messages, GOING, range(HITS))):
        encode = encode_bare_json if number % 3 == 0 else encode_json
        with contextlib.suppress(OSError):  # the server may be rid of it already
            sock = socket.create_connection((host, port), timeout=20)
            sock.sendall(encode(message))
            go(sock)


def main() -> None:
    """Do it."""
    host, port, what = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    argument = json.loads(sys.argv[4])
    become_nobody()
    if what == "hit":
        hit(host, port, argument)
        return
    with socket.create_connection((host, port), timeout=20) as sock:
        (ask if what == "ask" else stream)(sock, argument)


if __name__ == "__main__":
    main()
