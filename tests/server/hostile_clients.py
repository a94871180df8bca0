"""Clients that mean no good, on streams that never block: in memory, or real sockets.

Each kind is a generator that pauses for a turn where it waits: for the server's loop in memory, for a moment
at a real server.
"""

from __future__ import annotations

import collections
import contextlib
import errno
import random
import struct
from collections.abc import Callable, Generator, Iterable
from typing import Protocol

from bota_ethercat.control import request
from bota_ethercat.framing import encode_json
from bota_ethercat.text.bare_json import encode_bare_json
from ethercat_server.serving.connection import MAX_REQUEST_LENGTH
from tests.hostile_bytes import BARE, FRAMED, HOSTILE_TEXTS, framed, mutate

AT_ONCE, MOST_HELD = 10, 8
"""Connections that act, and that are left hanging: together somewhat more than one user may have."""
FIRST_UID, USERS, OF_ONE_USER = 60_000, 1_000, 20
"""The connections come from many users, because one may not have many."""
PATIENCE_TURNS = 50_000
_SHUTDOWN = request("shutdown")

Steps = Generator[None, None, None]


class Stream(Protocol):
    """The client's end of a connection; BlockingIOError for what cannot be done yet."""

    def send(self, data: bytes, /) -> int: ...
    def recv(self, size: int, /) -> bytes: ...
    def end_sending(self) -> None: ...
    def reset(self) -> None: ...
    def close(self) -> None: ...


class Client:
    """A hostile one."""

    def __init__(self, stream: Stream, chance: random.Random, answers: collections.Counter[str]) -> None:
        self.stream, self.chance, self.answers = stream, chance, answers
        self.is_held = False
        """It stays open and says no more."""

    def hold(self) -> None:
        self.is_held = True

    def send_some(self, data: bytes) -> int:
        """As much as can be sent now."""
        with contextlib.suppress(BlockingIOError):
            return self.stream.send(data)
        return 0

    def send(self, data: bytes) -> Steps:
        while data := data[self.send_some(data) :]:
            yield

    def hear_some(self) -> bytes | None:
        """What has come, None if nothing has, b"" at the end."""
        with contextlib.suppress(BlockingIOError):
            data = self.stream.recv(65536)
            self.answers["refusals"] += data.count(b'"ok":false')
            self.answers["grants"] += data.count(b'"ok":true')
            return data
        return None

    def hear(self, turns: int = 16, until: bytes = b"") -> Generator[None, None, bytes]:
        """What the server says in so many turns, or before it ends the connection or has said `until`."""
        found = b""
        for _ in range(turns):
            data = self.hear_some()
            found += data or b""
            if data == b"" or (until and until in found):
                return found
            yield
        assert turns < PATIENCE_TURNS, f"neither {until!r} nor an end; it said {found!r}"
        return found


Kind = Callable[[Client], Steps]
KINDS: list[Kind] = []


def kind(function: Kind) -> Kind:
    """One way to be a nuisance. The connection is closed afterwards unless it is held."""
    KINDS.append(function)
    return function


def any_form(client: Client, message: dict[str, object]) -> bytes:
    return client.chance.choice((encode_json, encode_bare_json))(message)


@kind
def random_bytes(client: Client) -> Steps:
    yield from client.send(client.chance.randbytes(client.chance.choice((1, 4, 5, 100, 4000))))
    yield from client.hear()


@kind
def mutated_requests(client: Client) -> Steps:
    chance = client.chance
    good = chance.choice((FRAMED, BARE))
    count = chance.randint(1, 4)
    yield from client.send(b"".join(mutate(chance, chance.choice(good), good) for _ in range(count)))
    yield from client.hear()


@kind
def connect_and_close(client: Client) -> Steps:
    yield from ()


@kind
def half_close(client: Client) -> Steps:
    yield from client.send(any_form(client, request("status")))
    client.stream.end_sending()
    if not (yield from client.hear(PATIENCE_TURNS)):
        raise ConnectionAbortedError("one too many: not let in")
    client.answers["heard after a half close"] += 1


@kind
def half_close_at_once(client: Client) -> Steps:
    client.stream.end_sending()
    assert (yield from client.hear(PATIENCE_TURNS)) == b""


@kind
def reset_with_a_request(client: Client) -> Steps:
    yield from client.send(client.chance.choice(FRAMED[:-2]) * client.chance.randint(0, 3))
    if client.chance.random() < 0.5:
        yield
    client.stream.reset()


@kind
def half_a_message_then_silence(client: Client) -> Steps:
    whole = client.chance.choice((*FRAMED[:3], *BARE[:3]))
    yield from client.send(whole[: client.chance.randrange(1, len(whole))])
    client.hold()


@kind
def silence(client: Client) -> Steps:
    client.hold()
    yield from ()


@kind
def huge_length(client: Client) -> Steps:
    length = client.chance.choice((16386, 2**24, 2**32 - 1))
    yield from client.send(struct.pack(">IB", length, 2) + b"{" * 1000)
    yield from client.hear()


@kind
def json_bomb(client: Client) -> Steps:
    text = client.chance.choice(HOSTILE_TEXTS)
    yield from client.send(framed(text) if client.chance.random() < 0.5 else b"{" + text + b"\n")
    yield from client.hear()


@kind
def flood(client: Client) -> Steps:
    client.send_some(any_form(client, request("status")) * client.chance.randint(50, 2000))
    if client.chance.random() < 0.5:
        client.hold()  # the answers wait for ever
    yield


@kind
def asks_much_and_reads_nothing(client: Client) -> Steps:
    client.send_some(encode_json(request("describe", "x" * (MAX_REQUEST_LENGTH - 60))) * 90)
    client.hold()
    yield


@kind
def subscribe_and_vanish(client: Client) -> Steps:
    every = client.chance.choice((1, 7))
    yield from client.send(encode_json(request("subscribe", every=every, fresh_only=False)))
    if client.chance.random() < 0.5:
        yield from client.hear()
    client.chance.choice((client.stream.reset, client.hold, client.stream.close))()


@kind
def byte_by_byte(client: Client) -> Steps:
    for byte in client.chance.choice((FRAMED[0], BARE[0])):
        yield from client.send(bytes((byte,)))
        if client.chance.random() < 0.1:
            yield
    if b'"ok":true' not in (yield from client.hear(PATIENCE_TURNS, until=b'"ok":true')):
        raise ConnectionAbortedError("one too many: not let in")


@kind
def shut_it_down(client: Client) -> Steps:
    message = client.chance.choice((_SHUTDOWN, {**_SHUTDOWN, "uid": 0, "user": "root"}))
    yield from client.send(any_form(client, message) * client.chance.randint(1, 3))
    if client.chance.random() < 0.5:
        yield
    how = client.chance.randrange(3)
    if how == 2:
        yield from client.hear()
    else:
        (client.stream.reset, client.stream.close)[how]()


def ask_without_pause(client: Client) -> Steps:
    """One of a crowd: asks as much as it can, all kinds of requests, and reads the answers. Without end."""
    room = MAX_REQUEST_LENGTH - 60
    plain = (request("status"), request("describe", "x" * room), request("no"), _SHUTDOWN)
    asked = [encode_json(message) for message in plain]
    asked.append(encode_json(request("sdo_read", index=0x1008)))
    asked.append(framed(b'{"action":"describe","id":[' + b",".join([b"1e15"] * (room // 5)) + b"]}"))
    while True:
        for some in asked:
            yield from client.send(some * 4)
            if client.hear_some() == b"":
                raise ConnectionAbortedError


class Siege:
    """`count` hostile connections of random kinds, some at a time; the first ones are of one kind each."""

    def __init__(
        self, connect: Callable[[int], Stream], count: int, seed: int, kinds: Iterable[Kind] = KINDS
    ) -> None:
        """`connect` makes a connection of a user."""
        self.done: collections.Counter[str] = collections.Counter()
        self.answers: collections.Counter[str] = collections.Counter()
        self._connect, self._count, self._kinds = connect, count, list(kinds)
        self._chance = random.Random(seed)
        self._acting: dict[Client, tuple[Kind, Steps]] = {}
        self._held: collections.deque[Client] = collections.deque()
        self._begun = 0

    def act(self) -> None:
        """A turn of each."""
        if self._begun < self._count and len(self._acting) < AT_ONCE and self._chance.random() < 0.6:
            self._begin()
        for client, (nuisance, steps) in list(self._acting.items()):
            try:
                next(steps)
                continue
            except StopIteration:
                pass
            except OSError as error:
                # One too many is closed at once, and then the socket is not connected any more.
                if not isinstance(error, ConnectionError) and error.errno != errno.ENOTCONN:
                    raise
                self.answers["cut off"] += 1
            del self._acting[client]
            self.done[nuisance.__name__] += 1
            self._held.append(client)
            if not client.is_held or len(self._held) > MOST_HELD:
                (self._held.popleft() if client.is_held else self._held.pop()).stream.close()
        if self.is_over:
            while self._held:
                self._held.pop().stream.close()

    def _begin(self) -> None:
        chance, number = self._chance, self._begun
        self._begun += 1
        stream = self._connect(FIRST_UID + number // OF_ONE_USER % USERS)
        nuisance = self._kinds[number] if number < len(self._kinds) else chance.choice(self._kinds)
        client = Client(stream, chance, self.answers)
        self._acting[client] = nuisance, nuisance(client)

    @property
    def is_over(self) -> bool:
        return self._begun == self._count and not self._acting

    def check(self) -> None:
        """They were of all kinds."""
        print(self.done, self.answers)
        assert sum(self.done.values()) == self._count
        assert all(self.done[nuisance.__name__] for nuisance in self._kinds)
