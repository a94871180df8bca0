"""Clients that mean no good, run as a process: `hostile_clients.py PORT COUNT SEED` makes COUNT connections.

Each is of a random kind. With `crowd` for the seed all COUNT are there at once and ask without pause for some
seconds. Prints at the end how many there were of each kind and what the server answered.
"""

from __future__ import annotations

import collections
import contextlib
import errno
import itertools
import json
import os
import random
import select
import socket
import struct
import sys
import time
from collections.abc import Callable

from ethercat_server.serving.connection import MAX_REQUEST_LENGTH
from protocol.control import request
from protocol.framing import encode_json
from protocol.text.bare_json import encode_bare_json
from tests.hostile_bytes import BARE, FRAMED, HOSTILE_TEXTS, framed, mutate
from tests.server.as_another_user import NO_OTHER_USER, become_nobody

MOST_HELD = 8
"""Connections that are left hanging at a time: half of what one user may have."""
CROWD_S = 3.0
FIRST_UID, USERS, OF_ONE_USER = 60_000, 1_000, 4
"""The connections come from many users, because one may not have many."""
_RESET = struct.pack("ii", 1, 0)
_SHUTDOWN = request("shutdown")

held: collections.deque[socket.socket] = collections.deque()
answers: collections.Counter[str] = collections.Counter()
KINDS: list[Callable[[socket.socket, random.Random], None]] = []


def kind(
    function: Callable[[socket.socket, random.Random], None],
) -> Callable[[socket.socket, random.Random], None]:
    """One way to be a nuisance. The connection is closed afterwards unless it is held."""
    KINDS.append(function)
    return function


def hold(sock: socket.socket) -> None:
    """Leave it open and say no more; the oldest one is closed."""
    held.append(sock)
    if len(held) > MOST_HELD:
        held.popleft().close()


def reset(sock: socket.socket) -> None:
    """Close it with RST."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
    sock.close()


def hear(sock: socket.socket, seconds: float = 0.01, until: bytes = b"") -> bytes:
    """What the server answers within the time, or until it ends the connection or has said `until`."""
    deadline, found = time.monotonic() + seconds, b""
    with contextlib.suppress(TimeoutError):
        while (left := deadline - time.monotonic()) > 0:
            sock.settimeout(left)
            if not (data := sock.recv(65536)):
                break
            found += data
            if until and until in found:
                break
    answers["refusals"] += found.count(b'"ok":false')
    answers["grants"] += found.count(b'"ok":true')
    return found


@kind
def random_bytes(sock: socket.socket, rng: random.Random) -> None:
    sock.sendall(rng.randbytes(rng.choice((1, 4, 5, 100, 4000))))
    hear(sock)


@kind
def mutated_requests(sock: socket.socket, rng: random.Random) -> None:
    good = rng.choice((FRAMED, BARE))
    sock.sendall(b"".join(mutate(rng, rng.choice(good), good) for _ in range(rng.randint(1, 4))))
    hear(sock)


@kind
def connect_and_close(sock: socket.socket, _rng: random.Random) -> None:
    sock.close()


@kind
def half_close(sock: socket.socket, rng: random.Random) -> None:
    sock.sendall(rng.choice((encode_json, encode_bare_json))(request("status")))
    sock.shutdown(socket.SHUT_WR)
    began = time.monotonic()
    if not hear(sock, 20):
        assert time.monotonic() - began < 20, "neither an answer nor an end"
        raise ConnectionAbortedError("one too many: not let in")
    answers["heard after a half close"] += 1


@kind
def half_close_at_once(sock: socket.socket, _rng: random.Random) -> None:
    sock.shutdown(socket.SHUT_WR)
    assert hear(sock, 20) == b""


@kind
def reset_with_a_request(sock: socket.socket, rng: random.Random) -> None:
    sock.sendall(rng.choice(FRAMED[:-2]) * rng.randint(0, 3))
    reset(sock)


@kind
def half_a_message_then_silence(sock: socket.socket, rng: random.Random) -> None:
    whole = rng.choice((*FRAMED[:3], *BARE[:3]))
    sock.sendall(whole[: rng.randrange(1, len(whole))])
    hold(sock)


@kind
def silence(sock: socket.socket, _rng: random.Random) -> None:
    hold(sock)


@kind
def huge_length(sock: socket.socket, rng: random.Random) -> None:
    sock.sendall(struct.pack(">IB", rng.choice((16386, 2**24, 2**32 - 1)), 2) + b"{" * 1000)
    hear(sock)


@kind
def json_bomb(sock: socket.socket, rng: random.Random) -> None:
    text = rng.choice(HOSTILE_TEXTS)
    sock.sendall(framed(text) if rng.random() < 0.5 else b"{" + text + b"\n")
    hear(sock)


@kind
def flood(sock: socket.socket, rng: random.Random) -> None:
    with contextlib.suppress(BlockingIOError):
        sock.setblocking(False)
        sock.send(rng.choice((encode_json, encode_bare_json))(request("status")) * rng.randint(50, 2000))
    if rng.random() < 0.5:
        hold(sock)  # the answers wait for ever


@kind
def asks_much_and_reads_nothing(sock: socket.socket, _rng: random.Random) -> None:
    sock.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        sock.send(encode_json(request("describe", "x" * (MAX_REQUEST_LENGTH - 60))) * 90)
    hold(sock)


@kind
def subscribe_and_vanish(sock: socket.socket, rng: random.Random) -> None:
    sock.sendall(encode_json(request("subscribe", every=rng.choice((1, 7)), fresh_only=False)))
    if rng.random() < 0.5:
        hear(sock)
    rng.choice((reset, hold, socket.socket.close))(sock)


@kind
def byte_by_byte(sock: socket.socket, rng: random.Random) -> None:
    for byte in rng.choice((FRAMED[0], BARE[0])):
        sock.sendall(bytes((byte,)))
        if rng.random() < 0.1:
            time.sleep(0.001)
    assert b'"ok":true' in hear(sock, 20, until=b'"ok":true')


@kind
def shut_it_down(sock: socket.socket, rng: random.Random) -> None:
    forged = {**_SHUTDOWN, "uid": 0, "user": "root"}
    message = rng.choice((_SHUTDOWN, forged))
    sock.sendall(rng.choice((encode_json, encode_bare_json))(message) * rng.randint(1, 3))
    rng.choice((reset, socket.socket.close, hear))(sock)


def crowd(port: int, count: int) -> None:
    """All ask as much as they can, all kinds of requests, and read the answers."""
    room = MAX_REQUEST_LENGTH - 60
    asked = [encode_json(m) for m in (request("status"), request("describe", "x" * room), request("no"))]
    asked.append(encode_json(request("sdo_read", index=0x1008)))
    asked.append(framed(b'{"action":"describe","id":[' + b",".join([b"1e15"] * (room // 5)) + b"]}"))
    waiting = {socket.create_connection(("127.0.0.1", port), timeout=20): b"" for _ in range(count)}
    ending = time.monotonic() + CROWD_S
    for turn in itertools.count():
        if time.monotonic() > ending or not waiting:
            break
        readable, writable, _ = select.select(waiting, waiting, (), 0.1)
        for sock in readable:
            hear_some(sock)
        for sock in writable:
            whole = waiting[sock] or asked[turn % len(asked)] * 4
            waiting[sock] = whole[sock.send(whole, socket.MSG_DONTWAIT) :]
        time.sleep(0.001)
    print(json.dumps({"done": {"crowd": count}, "answers": answers}))


def hear_some(sock: socket.socket) -> None:
    """What there is; ConnectionError once the server has closed it."""
    if not (data := sock.recv(65536)):
        raise ConnectionError
    answers["refusals"] += data.count(b'"ok":false')
    answers["grants"] += data.count(b'"ok":true')


def main() -> None:
    """Make the connections."""
    port, count = int(sys.argv[1]), int(sys.argv[2])
    if sys.argv[3] == "crowd":
        become_nobody()
        crowd(port, count)
        return
    am_root = NO_OTHER_USER is None
    "x".encode("idna")  # what connecting by name loads, while this user can still read it
    rng = random.Random(int(sys.argv[3]))
    done: collections.Counter[str] = collections.Counter()
    for number in range(count):
        nuisance = KINDS[number] if number < len(KINDS) else rng.choice(KINDS)
        if am_root and number % OF_ONE_USER == 0:
            # A socket belongs to whoever its maker was at that moment.
            os.seteuid(0)
            os.seteuid(FIRST_UID + number // OF_ONE_USER % USERS)
        host = "::1" if rng.random() < 0.1 and socket.has_ipv6 else "127.0.0.1"
        try:
            sock = socket.create_connection((host, port), timeout=20)
            nuisance(sock, rng)
        except ConnectionError:
            answers["cut off"] += 1
        except OSError as error:
            # One too many is closed at once, and then the socket is not connected any more.
            if error.errno == errno.ENOTCONN:
                answers["cut off"] += 1
            elif isinstance(error, TimeoutError) or host == "127.0.0.1":
                raise
        if sock not in held:
            sock.close()
        done[nuisance.__name__] += 1
    for sock in held:
        sock.close()
    print(json.dumps({"done": done, "answers": answers}))


if __name__ == "__main__":
    main()
