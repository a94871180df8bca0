"""The raw socket on a veth pair, with this test at the other end: what only the kernel can show."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator

import pytest

from ethercat_server.ethercat.raw_socket import RawSocket, packet_sockets
from tests.server.running import Veth, needs_bus

pytestmark = [pytest.mark.bus, needs_bus]

ETHERCAT = 0x88A4
FRAME = (b"\xff" * 6 + b"\x01" * 6 + b"\x88\xa4" + b"\x0e\x10").ljust(60, b"\0")
LONG_S = 20.0


def open_packet(ifname: str) -> socket.socket:
    sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    sock.bind((ifname, ETHERCAT))
    sock.settimeout(LONG_S)
    return sock


@pytest.fixture(scope="module")
def ends() -> Iterator[tuple[socket.socket, socket.socket, Veth]]:
    with Veth() as veth, open_packet(veth.near) as near, open_packet(veth.far) as far:
        yield near, far, veth


def test_frames_go_both_ways_and_none_is_none(ends: tuple[socket.socket, socket.socket, Veth]) -> None:
    near, far, _ = ends
    with contextlib.closing(RawSocket(near.fileno())) as raw:
        assert raw.receive(0) is None
        raw.send(FRAME)
        assert far.recv(2048) == FRAME
        far.send(FRAME)
        assert raw.receive(LONG_S) == FRAME
        far.send(FRAME)
        far.send(FRAME)
        assert raw.receive(LONG_S) == FRAME
        raw.discard()
        assert raw.receive(0) is None


def test_the_kernel_says_when_a_frame_had_arrived(ends: tuple[socket.socket, socket.socket, Veth]) -> None:
    near, far, _ = ends
    with contextlib.closing(RawSocket(near.fileno())) as raw:
        raw.arrived_ns()  # from now on
        right = False
        for _ in range(50):  # it is late if this process stops while it reads two clocks
            before = time.monotonic_ns()
            far.send(FRAME)
            after = time.monotonic_ns()
            time.sleep(0.002)  # in which it lies there
            assert raw.receive(LONG_S) == FRAME
            assert raw.arrived_ns() > before
            right |= raw.arrived_ns() < after
        assert right


def test_waiting_leaves_the_processor_to_others(ends: tuple[socket.socket, socket.socket, Veth]) -> None:
    near, _, _ = ends
    with contextlib.closing(RawSocket(near.fileno())) as raw:
        before = time.thread_time()
        assert raw.receive(0.3) is None
        assert time.thread_time() - before < 0.15


def test_packet_sockets_are_found_among_the_descriptors(
    ends: tuple[socket.socket, socket.socket, Veth],
) -> None:
    near, _, _ = ends
    assert near.fileno() in packet_sockets()
    with socket.socket() as other:
        assert other.fileno() not in packet_sockets()


def test_a_link_that_is_down_loses_frames(
    ends: tuple[socket.socket, socket.socket, Veth],
) -> None:
    near, _, veth = ends
    veth.ip("link", "set", veth.near, "down")
    with contextlib.closing(RawSocket(near.fileno())) as raw:
        raw.send(FRAME)
        assert raw.receive(0.01) is None
