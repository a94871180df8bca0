"""Both transports behave alike, and what only real sockets can show: addresses, ports, the kernel's buffers.

The hub is tested in memory (test_hub.py), which is worth what the first parts of this file find: what ends a
connection, and in which order, in the calls at random.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import random
import select
import socket
import struct
import sys
import termios
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

import pytest

from bota_ethercat.control import parse_request, reply
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.serving.connection import Connection
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.permissions import MAX_CLIENTS_PER_USER
from ethercat_server.serving.transport import SocketStream, SocketTransport, Stream, Transport
from ethercat_server.simulation.transport import InMemoryStream, InMemoryTransport
from tests.ended import completed
from tests.rights import NO_OTHER_USER, socket_of
from tests.server.running import free_port, needs_bus, wait_until
from tests.simulation import ManualClock, more_if_long

PATIENCE_S = 20.0
HOSTS = ("127.0.0.1", "127.0.0.2")
RESET = struct.pack("ii", 1, 0)  # SO_LINGER with which a close resets the connection


def socket_client(sock: socket.socket) -> Any:
    """A real socket with the in-memory end's interface; it waits for what it receives."""
    end = partial(sock.shutdown, socket.SHUT_WR)
    return SimpleNamespace(send=sock.send, recv=sock.recv, close=sock.close, end_sending=end)


class InMemory:
    """A transport, and clients of it."""

    def __init__(self) -> None:
        self.transport: Transport = InMemoryTransport(ManualClock())

    def connect(self, to: int = 0, uid: int | None = None) -> Any:
        """A client of the listener with this number, of the user `uid` or of who the tests are."""
        assert isinstance(self.transport, InMemoryTransport)
        return self.transport.connect(os.geteuid() if uid is None else uid, to=to)


class Sockets:
    """See `InMemory`."""

    def __init__(self) -> None:
        self.port = free_port()
        self.transport: Transport = SocketTransport(HOSTS, self.port)

    def socket(self, to: int = 0, uid: int | None = None) -> socket.socket:
        made = socket_of(uid)
        made.settimeout(PATIENCE_S)
        try:
            made.connect((HOSTS[to], self.port))
        except OSError:
            made.close()
            raise
        return made

    def connect(self, to: int = 0, uid: int | None = None) -> Any:
        return socket_client(self.socket(to, uid))


class Pair:
    """A connection on one of the transports: the server's end and the client's."""

    def __init__(self, network: Network) -> None:
        self.transport, self.connect = network.transport, network.connect
        self.listener, _ = self.transport.listening()
        assert self.transport.accept(self.listener) is None
        self.client = self.connect()
        self.stream = self.accept()

    def accept(self) -> Stream:
        assert self.transport.wait([self.listener], [], PATIENCE_S) == ([self.listener], [])
        stream = self.transport.accept(self.listener)
        assert stream is not None
        return stream

    def readable(self, seconds: float = PATIENCE_S) -> bool:
        readable, writable = self.transport.wait([self.listener, self.stream.fileno()], [], seconds)
        assert not writable
        return self.stream.fileno() in readable

    def writable(self) -> bool:
        readable, writable = self.transport.wait([], [self.stream.fileno()], 0)
        assert not readable
        return bool(writable)


Network = InMemory | Sockets
NETWORKS: dict[str, Callable[[], Network]] = {"memory": InMemory, "sockets": Sockets}


@pytest.fixture(params=NETWORKS)
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    made = NETWORKS[request.param]()
    yield made
    made.transport.close()


@pytest.fixture
def pair(network: Network) -> Iterator[Pair]:
    made = Pair(network)
    yield made
    made.stream.close()
    made.client.close()


def test_a_full_buffer_takes_part_then_nothing_then_goes_on(pair: Pair) -> None:
    sent = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            sent += pair.stream.send(bytes(100_000))
    assert not pair.writable()
    received = 0
    while received < sent:
        received += len(pair.client.recv(100_000))
    assert received == sent
    assert pair.transport.wait([], [pair.stream.fileno()], PATIENCE_S)[1]
    assert pair.stream.send(b"more") == 4


def test_nobody_connects_once_it_has_stopped_listening(pair: Pair) -> None:
    waiting = pair.connect()
    assert pair.transport.wait([pair.listener], [], PATIENCE_S)[0]
    pair.transport.stop_listening()
    assert not pair.transport.listening()
    with pytest.raises(ConnectionRefusedError):
        pair.connect()
    with pytest.raises(ConnectionResetError):
        waiting.recv(1)
    waiting.close()


def test_what_is_ready_comes_in_the_order_in_which_it_was_asked_for(pair: Pair) -> None:
    other, listeners = pair.connect(), pair.transport.listening()
    stream = pair.accept()
    arriving = [pair.connect(to) for to in range(2)]
    for client in (pair.client, other):
        client.send(b"x")
    everything = (*listeners, pair.stream.fileno(), stream.fileno())
    wait_until(lambda: len(pair.transport.wait(everything, [], 1)[0]) == 4, "all to be ready")
    streams = everything[2:]
    for order in itertools.permutations(everything):
        writers = [fd for fd in order if fd in streams]
        assert pair.transport.wait(order, writers, 0) == (list(order), writers)
        assert list(pair.transport.wait(set(order), (), 0)[0]) == list(set(order)), "a set, as the hub has it"
    for each in (*arriving, other, stream):
        each.close()


def test_only_listeners_accept(pair: Pair) -> None:
    """What is closed, and what is a client's, is no listener."""
    for fd in (pair.stream.fileno(), 1_000):
        with pytest.raises(KeyError):
            pair.transport.accept(fd)


def test_a_closed_descriptor_cannot_be_waited_for(pair: Pair) -> None:
    fd = pair.stream.fileno()
    pair.stream.close()
    assert pair.stream.fileno() == -1
    for readers, writers in (([fd], []), ([], [fd])):
        with pytest.raises(OSError, match="Bad file descriptor"):
            pair.transport.wait(readers, writers, 0)
    for call in (partial(pair.stream.recv, 1), partial(pair.stream.send, b"x")):
        with pytest.raises(OSError, match="Bad file descriptor"):
            call()
    pair.stream.end_sending()
    pair.stream.close()
    assert pair.stream.peer_uid() is None


# -- call by call


class RealEnds:
    """Both ends of a connection over sockets."""

    def __init__(self, network: Sockets) -> None:
        self._network = network
        self._client = network.socket()
        self.ends: dict[str, Any] = {"client": SocketStream(self._client, None)}

    def accept(self) -> None:
        listener = self._network.transport.listening()[0]
        assert self._network.transport.wait([listener], [], PATIENCE_S)[0]
        self.ends["server"] = self._network.transport.accept(listener)

    def reset(self) -> None:
        if self._client.fileno() < 0:
            return
        self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        self._client.close()

    def state(self, end: str) -> tuple[object, ...]:
        """Whether it can be read and written, whether all is over, how many bytes have arrived, from whom."""
        fd, poll = self.ends[end].fileno(), select.poll()
        if fd < 0:
            return ("closed",)
        poll.register(fd)
        ((_, events),) = poll.poll(0) or [(fd, 0)]
        readable, writable, _ = select.select([fd], [fd], [], 0)
        (count,) = struct.unpack("i", fcntl.ioctl(fd, termios.FIONREAD, bytes(4)))
        uid = self.ends[end].peer_uid() if end == "server" else None
        return bool(readable), bool(writable), bool(events & select.POLLHUP), count, uid


class DoublesEnds:
    """Both ends of a connection in memory."""

    def __init__(self, network: InMemory) -> None:
        self._network = network
        self._client: InMemoryStream = network.connect()
        self._client.number = 1_000
        self.ends: dict[str, Any] = {"client": self._client}
        self.reset = self._client.reset

    def accept(self) -> None:
        self.ends["server"] = self._network.transport.accept(0)

    def state(self, end: str) -> tuple[object, ...]:
        """See `RealEnds`."""
        stream = self.ends[end]
        if stream.fileno() < 0:
            return ("closed",)
        if end == "server":
            fd = stream.fileno()
            ready = self._network.transport.wait([fd], [fd], 0)
            assert (bool(ready[0]), bool(ready[1])) == (stream.readable, stream.writable)
        over = stream._gone or (stream._ended and stream._end_sent)
        uid = stream.peer_uid() if end == "server" else None
        return stream.readable, stream.writable, over, len(stream._received), uid


def outcome(call: Callable[[], object]) -> object:
    try:
        return call()
    except OSError as error:
        return type(error)


def any_call(chance: random.Random) -> tuple[str, str, tuple[object, ...]]:
    end = chance.choice(("client", "server"))
    call = chance.choice(("send", "send", "recv", "recv", "end_sending", "close"))
    arguments: tuple[object, ...] = ()
    if call == "send":
        arguments = (chance.randbytes(chance.randint(1, 5)),)
    elif call == "recv":
        arguments = (chance.randint(1, 8),)
    elif call == "close" and end == "client" and chance.random() < 0.5:
        call = "reset"
    return end, call, arguments


@pytest.mark.parametrize("seed", more_if_long(range(4), range(60)))
def test_every_call_has_the_same_outcome_in_memory(seed: int) -> None:
    """Calls at random, at both ends: what they return and raise, and what is ready after each."""
    chance = random.Random(seed)
    with contextlib.closing(SocketTransport(HOSTS, free_port())) as transport:
        sockets, memory = Sockets.__new__(Sockets), InMemory()
        sockets.port, sockets.transport = transport.port, transport
        for _ in range(100):
            real, double, history = RealEnds(sockets), DoublesEnds(memory), list[object]()
            accepted_at = chance.choice((0, 0, 0, 1, 2, 3))
            for step in range(14):
                if step == accepted_at:
                    real.accept()
                    double.accept()
                end, name, arguments = any_call(chance)
                if step < accepted_at:
                    end = "client"
                history.append((end, name, arguments))
                results = [
                    outcome(
                        each.reset if name == "reset" else partial(getattr(each.ends[end], name), *arguments)
                    )
                    for each in (real, double)
                ]
                assert results[0] == results[1], history

                def states() -> list[list[tuple[object, ...]]]:
                    return [[each.state(end) for end in each.ends] for each in (real, double)]  # noqa: B023

                with contextlib.suppress(AssertionError):  # the kernel may take a moment
                    wait_until(lambda: states()[0] == states()[1], "the kernel", 2.0, 0.001)
                assert states()[0] == states()[1], history
            for each in real.ends.values():
                each.close()


# -- the hub on either


class Shuffled(InMemoryTransport):
    """What is ready comes in any order."""

    def __init__(self, seed: int) -> None:
        super().__init__(ManualClock())
        self._chance = random.Random(seed)

    def wait(
        self, readers: Collection[int], writers: Collection[int], seconds: float
    ) -> tuple[Sequence[int], Sequence[int]]:
        readable, writable = map(list, super().wait(readers, writers, seconds))
        self._chance.shuffle(readable)
        self._chance.shuffle(writable)
        return readable, writable


STATUS = b'{"action":"status"}\n'
USERS = (4711, 4712, 4713)


@pytest.mark.parametrize("kind", [*NETWORKS, *range(8)])
def test_who_is_closed_to_make_room_may_be_ready_too(kind: str | int) -> None:
    """Two users hold all that they can get and ask; a third connects again and again, all in one pass."""
    if kind == "sockets" and NO_OTHER_USER is not None:
        pytest.skip(NO_OTHER_USER)
    network = NETWORKS[kind]() if isinstance(kind, str) else InMemory()
    if isinstance(kind, int):
        network.transport = Shuffled(kind)
    hub, asked = Hub(network.transport, time.monotonic_ns), list[Connection]()

    def grant(connection: Connection, message: JsonObject) -> JsonObject:
        asked.append(connection)
        return reply(parse_request(message))

    hub.start(grant)
    holders = [network.connect(uid=uid) for uid in USERS[:2] for _ in range(MAX_CLIENTS_PER_USER)]
    third = [network.connect(uid=USERS[2])]

    def serve(until: Callable[[], object], what: str) -> None:
        def served() -> object:
            hub.serve(time.monotonic_ns())
            return until()

        wait_until(served, what, step_s=0)

    serve(lambda: len(hub.connections) == len(holders) + 1, "all to be accepted")
    for _ in range(5):
        asked.clear()
        for client in holders:
            client.send(STATUS)
        third.append(network.connect(len(third) % 2, uid=USERS[2]))
        serve(lambda: len(asked) == len(holders), "all to be answered")
        assert {each.uid for each in hub.connections.values()} == set(USERS)
        assert len(hub.connections) == len(holders) + 1, "who asks is not idle, so there is no more room"
        serve(lambda: all(each.is_idle for each in hub.connections.values()), "all to be idle")
        watched = hub._watched
        assert watched.readers == {*hub.connections, *network.transport.listening()}
        assert not watched.writers
    for client in (*holders, *third):
        client.close()
    hub.close()


# -- only real sockets


def test_an_address_that_this_machine_does_not_have_is_reported() -> None:
    with pytest.raises(ServerError, match=r"192\.0\.2\.1 cannot be used: no interface of this machine has"):
        SocketTransport(["192.0.2.1"], free_port())


def test_an_address_that_is_given_twice_is_listened_on_once() -> None:
    port = free_port()
    transport = SocketTransport(("127.0.0.1", "::1", "127.0.0.1", "0:0:0:0:0:0:0:1"), port)
    try:
        with socket.create_connection(("127.0.0.1", port)):
            pass
    finally:
        transport.close()


@pytest.mark.parametrize(("wildcard", "one"), [("0.0.0.0", "127.0.0.1"), ("::", "::1")])
def test_overlapping_addresses_are_not_reported_as_a_port_in_use(wildcard: str, one: str) -> None:
    for hosts in ((wildcard, one), (one, wildcard)):
        with pytest.raises(UsageError, match=f"overlap: {wildcard} includes {one}; remove one"):
            SocketTransport(hosts, free_port())


LOOPBACK: Final = """
import asyncio
from unittest.mock import Mock
from bota_clients.monitor.web.server import serving
from ethercat_server.errors import ServerError
from ethercat_server.serving.transport import listen
async def show_page():
    async with serving(Mock(), "localhost", 0):
        print("page")
for hosts in ("127.0.0.1", "::1"), ("::1", "127.0.0.1"), ("127.0.0.1",):
    try:
        print(*(listener.getsockname()[0] for listener in listen(hosts, 0)))
    except ServerError as error:
        print(error)
try:
    asyncio.run(show_page())
except OSError:
    print("no page")
"""
NOT_HERE: Final = "port 0 on 127.0.0.1 cannot be used: no interface of this machine has this address"


@needs_bus
@pytest.mark.parametrize(
    ("lacks", "said"),
    [
        ("::1", ["127.0.0.1", "127.0.0.1", "127.0.0.1", "page"]),
        ("127.0.0.1", ["::1", "::1", NOT_HERE, "page"]),
        ("::1 127.0.0.1", [NOT_HERE, "port 0 on ::1 cannot", NOT_HERE, "no page"]),
    ],
)
def test_a_machine_lacks_a_loopback_address(lacks: str, said: list[str]) -> None:
    away = "; ".join(f"ip address del {one}/{128 if ':' in one else 8} dev lo" for one in lacks.split())
    script = f"set -e; ip link set lo up; {away}; exec {sys.executable} -W ignore -c '{LOOPBACK}'"
    found = completed("unshare", "--net", "bash", "-c", script)
    assert all(map(str.startswith, found.stdout.splitlines(), said)), found
    assert found.stdout.count("\n") == len(said)
