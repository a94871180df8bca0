"""Both transports behave alike, and what only real sockets can show: addresses, ports, the kernel's buffers.

The hub is tested in memory (test_hub.py), which is worth what the first half of this file finds.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from ethercat_server.errors import ServerError, UsageError
from ethercat_server.serving.transport import SocketTransport, Stream, Transport
from ethercat_server.simulation.transport import InMemoryTransport
from tests.server.running import free_port
from tests.simulation import ManualClock

PATIENCE_S = 20.0


def socket_client(port: int) -> Any:
    """A real socket with the in-memory end's interface."""
    sock = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
    end = partial(sock.shutdown, socket.SHUT_WR)
    return SimpleNamespace(send=sock.send, recv=sock.recv, close=sock.close, end_sending=end)


class Pair:
    """A connection on one of the transports: the server's end and the client's."""

    def __init__(self, transport: Transport, connect: Callable[[], Any]) -> None:
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
        made = Pair(sockets, lambda: socket_client(sockets.port))
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
