"""Both transports behave alike, and what only real sockets can show: addresses, ports, the kernel's buffers.

The rest of the hub is tested in memory (test_hub.py), which is worth what the first half of this file finds.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import pytest

from bota_ethercat.control import parse_request, reply
from bota_ethercat.framing import DataMessage, FrameDecoder, encode_data, encode_json
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.serving.connection import Connection, Subscription
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.in_memory import InMemoryTransport, ManualClock
from ethercat_server.serving.permissions import controlling_uids
from ethercat_server.serving.transport import SocketTransport, Stream, Transport
from tests.server.running import free_port

PATIENCE_S = 20.0


class ClientEnd(Protocol):
    """What both kinds of client's end can do."""

    def send(self, data: bytes, /) -> int: ...
    def recv(self, size: int, /) -> bytes: ...
    def end_sending(self) -> None: ...
    def close(self) -> None: ...


class SocketClient:
    """A real socket with the in-memory end's interface."""

    def __init__(self, port: int) -> None:
        self._sock = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self.send = self._sock.send
        self.recv = self._sock.recv
        self.close = self._sock.close

    def end_sending(self) -> None:
        self._sock.shutdown(socket.SHUT_WR)


class Pair:
    """A connection on one of the transports: the server's end and the client's."""

    def __init__(self, transport: Transport, connect: Callable[[], ClientEnd]) -> None:
        self.transport = transport
        (self.listener,) = transport.listening()
        assert transport.accept(self.listener) is None
        self.connect = connect
        self.client = connect()
        assert transport.wait([self.listener], [], PATIENCE_S) == ([self.listener], [])
        stream = transport.accept(self.listener)
        assert stream is not None
        self.stream: Stream = stream

    def readable(self, seconds: float = PATIENCE_S) -> bool:
        readable, writable = self.transport.wait([self.listener, self.stream.fileno()], [], seconds)
        assert not writable
        return self.stream.fileno() in readable

    def writable(self) -> bool:
        readable, writable = self.transport.wait([], [self.stream.fileno()], 0)
        assert not readable
        return bool(writable)


@pytest.fixture(params=["memory", "sockets"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    if request.param == "memory":
        in_memory = InMemoryTransport(ManualClock())
        made = Pair(in_memory, lambda: in_memory.connect(os.geteuid()))
    else:
        sockets = SocketTransport(("127.0.0.1",), free_port())
        made = Pair(sockets, lambda: SocketClient(sockets.port))
    yield made
    made.stream.close()
    made.client.close()
    made.transport.close()


def test_bytes_go_both_ways(pair: Pair) -> None:
    assert not pair.readable(0)
    with pytest.raises(BlockingIOError):
        pair.stream.recv(10)
    assert pair.client.send(b"question") == 8
    assert pair.readable()
    assert pair.stream.recv(5) == b"quest"
    assert pair.stream.recv(5) == b"ion"
    assert pair.writable()
    assert pair.stream.send(memoryview(b"answer")) == 6
    assert pair.client.recv(100) == b"answer"


def test_a_client_may_close_its_side_and_still_receive(pair: Pair) -> None:
    pair.client.send(b"last")
    pair.client.end_sending()
    assert pair.readable()
    assert [pair.stream.recv(10), pair.stream.recv(10), pair.stream.recv(10)] == [b"last", b"", b""]
    pair.stream.send(b"reply")
    pair.stream.end_sending()
    assert [pair.client.recv(10), pair.client.recv(10)] == [b"reply", b""]
    with pytest.raises(BrokenPipeError):
        pair.stream.send(b"more")


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


def test_sending_to_a_client_that_has_closed_fails_in_the_end(pair: Pair) -> None:
    pair.client.close()
    assert pair.readable()
    assert pair.stream.recv(10) == b""
    deadline = time.monotonic() + PATIENCE_S
    with contextlib.suppress(ConnectionError):  # what is sent first may still seem to arrive
        while time.monotonic() < deadline:
            pair.stream.send(b"x")
    with pytest.raises(ConnectionError):
        pair.stream.send(b"x")
    assert pair.writable()


def test_closing_with_unread_bytes_resets_the_connection(pair: Pair) -> None:
    pair.client.send(b"unread")
    assert pair.readable()
    pair.stream.send(b"reply")
    pair.stream.close()
    with contextlib.suppress(ConnectionResetError):
        while pair.client.recv(100):
            pass
        pytest.fail("the connection ended without a reset")


def test_the_user_of_the_other_end_is_known_while_it_is_open(pair: Pair) -> None:
    assert pair.stream.peer_uid() == os.geteuid()
    assert pair.stream.peer
    pair.client.close()
    assert pair.readable()
    assert pair.stream.peer_uid() is None


def test_nobody_connects_once_it_has_stopped_listening(pair: Pair) -> None:
    pair.transport.stop_listening()
    assert not pair.transport.listening()
    with pytest.raises(ConnectionRefusedError):
        pair.connect()


# -- only real sockets


def test_an_address_that_this_machine_does_not_have_is_reported() -> None:
    with pytest.raises(ServerError, match=r"192\.0\.2\.1 cannot be used: no interface of this machine has"):
        SocketTransport(["192.0.2.1"], free_port())


def test_a_port_in_use_is_reported_at_once() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ServerError, match=f"port {port} on 127.0.0.1 is in use by another program"):
            SocketTransport(("127.0.0.1",), port)


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


class ServedOverTcp:
    """A hub with real sockets and the means to talk to it from the same thread."""

    def __init__(self) -> None:
        self.transport = SocketTransport(("127.0.0.1",), free_port())
        self.hub = Hub(self.transport)
        self.hub.permissions.control_uids = controlling_uids((), ())
        self.hub.start(self.handle)

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject:
        request = parse_request(message)
        if request.action == "subscribe":
            connection.subscription = Subscription(1, None, 1, fresh_only=True)
            self.hub.subscriptions_changed()
        return reply(request)

    def serve_until(self, done: Callable[[], Any]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline
            self.hub.serve(time.monotonic_ns() + 2_000_000)


@pytest.fixture
def over_tcp() -> Iterator[ServedOverTcp]:
    served = ServedOverTcp()
    yield served
    served.hub.close()


def connect(served: ServedOverTcp) -> socket.socket:
    sock = socket.create_connection(("127.0.0.1", served.transport.port), timeout=PATIENCE_S)
    sock.setblocking(False)
    return sock


def receive(sock: socket.socket, into: bytearray) -> bool:
    """Whether the server has closed the connection."""
    with contextlib.suppress(BlockingIOError):
        while data := sock.recv(65536):
            into += data
        return True
    return False


def test_a_bare_request_over_tcp_is_answered_and_the_connection_closed(over_tcp: ServedOverTcp) -> None:
    with connect(over_tcp) as sock:
        sock.send(b'{"action":"describe"}')
        sock.shutdown(socket.SHUT_WR)
        received = bytearray()
        over_tcp.serve_until(lambda: receive(sock, received))
        assert received == b'{"reply":"describe","ok":true}\n'
        assert not over_tcp.hub.connections


def test_a_refusal_over_tcp_is_not_lost_in_a_reset(over_tcp: ServedOverTcp) -> None:
    with connect(over_tcp) as sock:
        sock.send(b"\0\0\0\0\2" + bytes(20_000))
        received = bytearray()
        over_tcp.serve_until(lambda: receive(sock, received))
        assert b'"bad_request"' in received


def test_a_slow_subscriber_over_tcp_gets_whole_frames_and_the_newest(over_tcp: ServedOverTcp) -> None:
    with connect(over_tcp) as sock:
        sock.send(encode_json({"action": "subscribe"}))
        over_tcp.serve_until(lambda: over_tcp.hub._subscribers)
        (connection,) = over_tcp.hub.connections.values()
        total = 0
        while connection.outbox.withheld < 500:
            over_tcp.hub.publish([(encode_data(total, 1, 2, 0, 0, 3, bytes(61)), 0, 0)], time.monotonic_ns())
            total += 1
        received = bytearray()
        over_tcp.serve_until(lambda: receive(sock, received) or not connection.outbox.waiting)
        receive(sock, received)
        decoder = FrameDecoder()
        decoder.feed(received)
        frames = [message for message in decoder if isinstance(message, DataMessage)]
        assert len(frames) == total - connection.outbox.withheld
        assert frames[-1].sequence == total - 1
