"""Single datagrams on a veth pair, with this test in the slave's place."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from ethercat_server.raw_socket import FPRD, FPWR, SOEM_INDICES, RawSocket, packet_sockets
from tests.server.running import Veth, needs_bus, wait_until

pytestmark = [pytest.mark.bus, needs_bus]

ETHERCAT = 0x88A4
INDEX, DATA = 17, 26
STATION = 0x1001


class Pair:
    """The master's raw socket and, on the other end of the cable, a plain one."""

    def __init__(self, near: socket.socket, far: socket.socket) -> None:
        self.near, self.far = near, far
        self.raw = RawSocket(near.fileno())
        self.raw.set_blocking(False)

    def answer(self, wkc: int, data: bytes = b"", *, before: bytes = b"") -> threading.Thread:
        """Answer the next frame, `before` sent ahead of it."""

        def run() -> None:
            frame = bytearray(self.far.recv(2048))
            if before:
                self.far.send(before)
            size = int.from_bytes(frame[22:24], "little") & 0x07FF
            frame[DATA : DATA + len(data)] = data
            frame[DATA + size : DATA + size + 2] = wkc.to_bytes(2, "little")
            self.far.send(frame)

        thread = threading.Thread(target=run)
        thread.start()
        return thread


def open_packet(ifname: str) -> socket.socket:
    sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    sock.bind((ifname, ETHERCAT))
    sock.settimeout(10)
    return sock


@pytest.fixture
def pair() -> Iterator[Pair]:
    with Veth() as veth, open_packet(veth.near) as near, open_packet(veth.far) as far:
        made = Pair(near, far)
        with contextlib.closing(made.raw):
            yield made


def frame_of_soem(index: int) -> bytes:
    head = b"\xff" * 6 + b"\x01" * 6 + b"\x88\xa4" + b"\x0e\x10"
    return (head + bytes((12, index)) + bytes(12)).ljust(60, b"\0")


def test_a_datagram_brings_back_data_and_working_counter(pair: Pair) -> None:
    thread = pair.answer(1, b"\x08\x00")
    assert pair.raw.datagram(FPRD, STATION, 0x0130, bytes(2), 5) == (1, b"\x08\x00")
    thread.join()


def test_what_is_on_the_wire_is_a_datagram_of_the_standard(pair: Pair) -> None:
    assert pair.raw.datagram(FPWR, STATION, 0x0120, b"\x02\x00", 0.01) is None
    frame = pair.far.recv(2048)
    assert frame[12:14] == b"\x88\xa4"
    assert len(frame) == 60
    assert int.from_bytes(frame[14:16], "little") == 0x1000 | 14
    assert frame[16] == FPWR
    assert frame[18:24] == STATION.to_bytes(2, "little") + b"\x20\x01" + b"\x02\x00"
    assert frame[26:30] == b"\x02\x00\x00\x00", "data, then the working counter"


def test_a_slave_that_does_not_do_it_is_told_from_a_frame_that_is_lost(pair: Pair) -> None:
    thread = pair.answer(0)
    answer = pair.raw.datagram(FPWR, STATION, 0x1000, b"\1", 5)
    assert answer is not None
    assert answer[0] == 0
    thread.join()
    assert pair.raw.datagram(FPRD, STATION, 0x0130, bytes(2), 0.01) is None


def test_neither_late_nor_foreign_frames_are_taken_for_the_answer(pair: Pair) -> None:
    assert pair.raw.datagram(FPRD, STATION, 0x0130, bytes(2), 0.01) is None
    late = pair.far.recv(2048)
    thread = pair.answer(1, b"\x02\x00", before=late)
    assert pair.raw.datagram(FPRD, STATION, 0x0130, bytes(2), 5) == (1, b"\x02\x00")
    thread.join()
    for foreign in (frame_of_soem(3), b"\xff" * 6 + b"\x01" * 6 + b"\x88\xa4"):
        thread = pair.answer(1, b"\x04\x00", before=foreign)
        assert pair.raw.datagram(FPRD, STATION, 0x0130, bytes(2), 5) == (1, b"\x04\x00")
        thread.join()


def test_its_numbers_are_none_of_soems(pair: Pair) -> None:
    for _ in range(300):
        pair.raw.datagram(FPRD, STATION, 0x0130, bytes(2), 0)
        assert pair.far.recv(2048)[INDEX] >= SOEM_INDICES


def test_waiting_leaves_the_processor_to_others(pair: Pair) -> None:
    before = time.thread_time()
    assert pair.raw.datagram(FPRD, STATION, 0x0130, bytes(2), 0.3) is None
    assert time.thread_time() - before < 0.15


def test_find_drops_what_came_too_late(pair: Pair) -> None:
    for index in (3, 4, 0x85, 5):
        pair.far.send(frame_of_soem(index))
    assert pair.raw.find(5, 1) == 5
    assert pair.near.recv(2048)[INDEX] == 5, "it is left to be received"
    assert pair.raw.find(6, 0.01) is None


def test_find_takes_any_frame_of_soems_when_the_number_is_unknown(pair: Pair) -> None:
    for index in (0x85, 7):
        pair.far.send(frame_of_soem(index))
    assert pair.raw.find(None, 1) == 7


def test_drop_ends_when_nothing_comes_any_more(pair: Pair) -> None:
    for _ in range(5):
        pair.far.send(frame_of_soem(1))
    wait_until(lambda: pair.raw.wait(0), "the frames")
    pair.raw.drop(0.01)
    assert not pair.raw.wait(0)


def test_packet_sockets_are_found_among_the_descriptors(pair: Pair) -> None:
    assert pair.near.fileno() in packet_sockets()
    with socket.socket() as other:
        assert other.fileno() not in packet_sockets()
