"""SDO transfers over CoE, in two forms with one interface: generators that end with the result.

`BlockingSdo` goes through the bus's master and never yields; it is for start-up. `MailboxSdo` sends
single datagrams and yields after each, so that the acquisition loop goes on in between; it is for OP.
Code that configures a sensor is written once, with `yield from`, and `finish` runs it to its end at start-up.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Generator
from typing import Final, Protocol, TypeVar

from ethercat_server.errors import BusError, SetUpError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock, Deadline
from ethercat_server.ethercat.mailbox.mailbox import Mailbox, MessageLostError
from ethercat_server.ethercat.slave import times
from ethercat_server.ethercat.slave.abort_codes import refused

T = TypeVar("T")
Steps = Generator[None, None, T]
"""Work in steps: yields when the loop should have its turn, returns the result."""

_SDO_HEADER: Final = struct.Struct("<HBHB")
_COE_SDO_REQUEST: Final = 2
_COE_SDO_RESPONSE: Final = 3
_UPLOAD: Final = 0x40
_DOWNLOAD: Final = 0x20
_DOWNLOADED: Final = 0x60
_COMMAND_MASK: Final = 0xE0
_EXPEDITED: Final = 0x03
_SIZE_GIVEN: Final = 0x01
_ABORT: Final = 0x80
_LONGEST_EXPEDITED: Final = 4
_MOST_DRAINED: Final = 4
_SIZE_BYTES: Final = 4
"""The size goes before what is longer."""


class Sdo(Protocol):
    """Access to one slave's object dictionary."""

    @property
    def clock(self) -> Clock:
        """The time that passes meanwhile."""
        ...

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """Upload an object; SdoAbortError if the sensor refuses, BusError if it does not answer."""
        ...

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """Download an object; raises as `read`."""
        ...


def finish(
    steps: Steps[T],
    pause_s: float = 0.001,
    clock: Clock = SYSTEM_CLOCK,
    check_interrupt: CheckInterrupt = lambda: None,
) -> T:
    """Run `steps` to their end, `pause_s` apart; returns their result."""
    try:
        while True:
            check_interrupt()
            try:
                next(steps)
            except StopIteration as stop:
                result: T = stop.value
                return result
            clock.sleep(pause_s)
    finally:
        steps.close()  # given up between two steps, they undo what is half done while the bus is open


class BlockingSdo:
    """SDO before OP, through the bus's master: each call blocks until the answer is there.

    `check_interrupt` is called before each: with a slow slave many transfers take long.
    """

    def __init__(self, bus: Bus, number: int, check_interrupt: CheckInterrupt = lambda: None) -> None:
        self._bus, self._number, self._check_interrupt = bus, number, check_interrupt
        self.clock = bus.clock

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """See `Sdo`."""
        self._check_interrupt()
        yield from ()
        return self._bus.master.sdo_read(self._number, index, subindex)

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`."""
        self._check_interrupt()
        yield from ()
        self._bus.master.sdo_write(self._number, index, subindex, data)


class MailboxSdo:
    """SDO by single datagrams."""

    def __init__(self, mailbox: Mailbox) -> None:
        self._mailbox, self._number = mailbox, mailbox.number
        self.clock = mailbox.clock

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """See `Sdo`."""
        command, rest = yield from self._transfer(index, subindex, _UPLOAD, b"")
        if command & 0x02:  # expedited; bit 0: the size is given
            return rest[: 4 - (command >> 2 & 3)] if command & 0x01 else rest[:4]
        size = int.from_bytes(rest[:4], "little")
        if size > len(rest) - 4:
            raise BusError(
                self._unanswered("reading", index, subindex, f"its {size} bytes do not fit the mailbox")
            )
        return rest[4 : 4 + size]

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """See `Sdo`; at most what fits the mailbox in one piece."""
        most = self._mailbox.most - _SDO_HEADER.size - _SIZE_BYTES
        if not 0 < len(data) <= most:
            raise BusError(
                f"object 0x{index:04X}:{subindex} of sensor {self._number} cannot be written: 1 to {most} "
                f"bytes fit its mailbox, not {len(data)}"
            )
        if len(data) <= _LONGEST_EXPEDITED:
            command = _DOWNLOAD | _EXPEDITED | (_LONGEST_EXPEDITED - len(data)) << 2
        else:
            command, data = _DOWNLOAD | _SIZE_GIVEN, struct.pack("<I", len(data)) + data
        yield from self._transfer(index, subindex, command, data)

    def _transfer(self, index: int, subindex: int, command: int, data: bytes) -> Steps[tuple[int, bytes]]:
        self._mailbox.is_in_use = True
        try:
            return (yield from self._ask(index, subindex, command, data))
        finally:
            self._mailbox.is_in_use = False

    def _ask(self, index: int, subindex: int, command: int, data: bytes) -> Steps[tuple[int, bytes]]:
        doing, expected = ("reading", _UPLOAD) if command == _UPLOAD else ("writing", _DOWNLOADED)
        give_up = Deadline(self.clock, times.SDO_S)
        body = _SDO_HEADER.pack(_COE_SDO_REQUEST << 12, command, index, subindex) + data.ljust(4, b"\0")
        while not give_up.passed:
            yield from self._drain()
            if self._mailbox.put(body):
                deadline = Deadline(self.clock, times.SDO_ANSWER_S)
                while not deadline.passed:
                    yield
                    try:
                        answer = self._answer(index, subindex, expected)
                    except MessageLostError:
                        break  # ask again: reading and writing twice does no harm
                    if answer is None:
                        continue
                    if answer[0] == _ABORT:
                        code = int.from_bytes(answer[1][:4], "little")
                        raise refused(self._number, f"{doing} object 0x{index:04X}:{subindex}", code)
                    return answer
            yield
        raise SetUpError(self._unanswered(doing, index, subindex, "no answer"))

    def _drain(self) -> Steps[None]:
        """Read away what was left in the mailbox from before."""
        for _ in range(_MOST_DRAINED):
            with contextlib.suppress(MessageLostError):
                if self._mailbox.take() is None:
                    return
            yield

    def _answer(self, index: int, subindex: int, expected: int) -> tuple[int, bytes] | None:
        """Command and data of the answer if it is there; other messages are dropped.

        Such as the late answer to a request that was repeated: about the same object, but another command's.
        """
        body = self._mailbox.take()
        if body is None or len(body) < _SDO_HEADER.size + 4:
            return None
        coe, command, its_index, its_subindex = _SDO_HEADER.unpack_from(body)
        is_sdo = coe >> 12 == _COE_SDO_RESPONSE or (coe >> 12 == _COE_SDO_REQUEST and command == _ABORT)
        if not is_sdo or (its_index, its_subindex) != (index, subindex):
            return None
        if command != _ABORT and command & _COMMAND_MASK != expected:
            return None
        return command, body[_SDO_HEADER.size :]

    def _unanswered(self, doing: str, index: int, subindex: int, what: str) -> str:
        return f"sensor {self._number} did not answer {doing} object 0x{index:04X}:{subindex}: {what}"
