"""SDO transfers by single datagrams, with a mailbox whose answers are given; AL status codes in words."""

from __future__ import annotations

import itertools
import struct
from typing import cast

import pytest

from ethercat_server.errors import SdoAbortError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.slave.al import AlStatus
from ethercat_server.ethercat.slave.coe import MailboxSdo, Steps, T, finish
from ethercat_server.ethercat.slave.registers import MAILBOX_IN_STATUS

MAILBOXES = ((0x1000, 128), (0x1080, 128))
READ, WRITTEN, ABORTED = 0x43, 0x60, 0x80


class GivenBus:
    """A sensor that puts these answers into its mailbox once it is asked: command, index, data."""

    clock = SYSTEM_CLOCK

    def __init__(self, *answers: tuple[int, int, bytes]) -> None:
        self.answers = list(answers)
        self.asked = 0
        self.counters: list[int] = []

    def read_register(self, slave: int, address: int, size: int) -> bytes:
        if address == MAILBOX_IN_STATUS:
            return bytes([0x08 if self.asked and self.answers else 0])
        command, index, data = self.answers.pop(0)
        service = 2 if command == ABORTED else 3
        body = struct.pack("<HBHB", service << 12, command, index, 1) + data
        return (struct.pack("<HHBB", len(body), 0, 0, 3) + body).ljust(size, b"\0")

    def write_register(self, slave: int, address: int, data: bytes) -> bool:
        self.asked += 1
        self.counters.append(data[5] >> 4)
        return True


def run(bus: GivenBus, steps: Steps[T]) -> T:
    done = finish(steps)
    assert bus.asked == 1
    assert not bus.answers
    return done


def mailbox(bus: GivenBus) -> MailboxSdo:
    return MailboxSdo(cast(Bus, bus), 0, MAILBOXES)


def test_a_read_leaves_the_late_answer_to_a_repeated_write_alone() -> None:
    bus = GivenBus((WRITTEN, 0x8001, bytes(4)), (READ, 0x8001, b"abcd"))
    assert run(bus, mailbox(bus).read(0x8001, 1)) == b"abcd"


def test_a_write_leaves_the_late_answer_to_a_repeated_read_alone() -> None:
    bus = GivenBus((READ, 0x8001, b"abcd"), (WRITTEN, 0x8001, bytes(4)))
    run(bus, mailbox(bus).write(0x8001, 1, b"efgh"))


def test_no_message_has_the_counter_of_the_one_before_or_that_soems_mapping_begins_with() -> None:
    bus = GivenBus(*[(READ, 0x8001, b"abcd")] * 20)
    sdo = mailbox(bus)
    for _ in range(20):
        bus.asked = 0
        finish(sdo.read(0x8001, 1))
    assert all(one != other for one, other in itertools.pairwise([1, *bus.counters, 1]))
    assert set(bus.counters) == set(range(2, 8))


def test_an_answer_about_another_object_is_left_alone_and_a_refusal_is_not() -> None:
    bus = GivenBus((READ, 0x8000, b"abcd"), (ABORTED, 0x8001, struct.pack("<I", 0x06090030)))
    with pytest.raises(SdoAbortError, match="refused reading object 0x8001:1: the value is out of range "):
        finish(mailbox(bus).read(0x8001, 1))


@pytest.mark.parametrize(("code", "words"), [(0x06020000, "does not exist"), (0x12345678, "does not define")])
def test_a_refusal_says_why_in_words_and_as_a_number(code: int, words: str) -> None:
    bus = GivenBus((ABORTED, 0x8001, struct.pack("<I", code)))
    with pytest.raises(SdoAbortError, match=rf"sensor 0 refused writing .*{words} \(abort 0x{code:08X}\)"):
        finish(mailbox(bus).write(0x8001, 1, b"efgh"))


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x001B, "sync manager watchdog"),
        (0x0035, "distributed clock: invalid sync cycle time"),
        (0x8001, "the vendor's own code"),
        (0x0FFF, "reserved"),
    ],
)
def test_an_al_error_is_said_in_words(code: int, words: str) -> None:
    assert str(AlStatus.of(0x14, code)).startswith(f"SAFEOP with AL status 0x{code:04X} ({words}")
