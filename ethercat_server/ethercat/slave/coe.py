"""SDO transfers over CoE by single datagrams: generators that yield after each and end with the result.

So the acquisition loop goes on in between. At start-up `finish` runs the same steps to their end.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Generator, Sequence
from typing import Final, Protocol, TypeVar

from ethercat_server.errors import BusError, SetUpError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock, Deadline
from ethercat_server.ethercat.datagrams import Registers
from ethercat_server.ethercat.slave.abort_codes import refused
from ethercat_server.ethercat.slave.emergencies import Emergencies, Emergency
from ethercat_server.ethercat.slave.registers import MAILBOX_FULL, MAILBOX_IN_STATUS

T = TypeVar("T")
# Work in steps: yields when the loop should have its turn, returns the result.
Steps = Generator[None, None, T]

_SHORTEST: Final = 16
_LONGEST: Final = 1486
_HEADER: Final = struct.Struct("<HHBB")
_TYPE_COE: Final = 3
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
_SIZE_BYTES: Final = 4  # the size goes before what is longer
_ANSWER_S: Final = 0.7  # until the request is sent again
_TRANSFER_S: Final = 2.1  # in all: frames lost for a moment are no refusal


class Sdo(Protocol):
    """Access to one slave's object dictionary."""

    @property
    def clock(self) -> Clock:
        """The time that passes meanwhile."""

    def read(self, index: int, subindex: int) -> Steps[bytes]:
        """Upload an object; SdoAbortError if the sensor refuses, BusError if it does not answer."""

    def write(self, index: int, subindex: int, data: bytes) -> Steps[None]:
        """Download an object; raises as `read`."""


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


class MessageLostError(Exception):
    """A message was taken from the mailbox and lost on its way."""


class MailboxSdo:
    """The mailboxes of slave `number`. A slave has one of these, whoever uses it: it drops a message that
    reuses the last counter.

    Emergencies come in among the answers: each is noted.
    """

    def __init__(
        self,
        bus: Registers,
        number: int,
        areas: Sequence[tuple[int, int]],
        emergencies: Emergencies | None = None,
    ) -> None:
        """`areas`: offset and size of the mailbox to the slave, and of the one from it."""
        self._bus, self._number, self._emergencies = bus, number, emergencies
        self.clock = bus.clock
        (self._out, self._out_size), (self._in, self._in_size) = areas
        if not all(_SHORTEST <= size <= _LONGEST for _, size in areas):
            raise BusError(
                f"sensor {number} has mailboxes of {self._out_size} and {self._in_size} bytes, which no "
                "frame can carry: power it off and on"
            )
        self._counter = 0
        self._in_use = False

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
        most = self._out_size - _HEADER.size - _SDO_HEADER.size - _SIZE_BYTES
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

    def look(self) -> None:
        """Read what the slave says unasked. Who waits for an answer does that too: it is left to them."""
        if not self._in_use:
            with contextlib.suppress(MessageLostError):
                self._take()

    def drain(self, most: int = _MOST_DRAINED) -> Steps[None]:
        """Read away what is there: `most` messages at most."""
        for _ in range(most):
            with contextlib.suppress(MessageLostError):
                if self._take() is None:
                    return
            yield

    def _transfer(self, index: int, subindex: int, command: int, data: bytes) -> Steps[tuple[int, bytes]]:
        self._in_use = True
        try:
            return (yield from self._ask(index, subindex, command, data))
        finally:
            self._in_use = False

    def _ask(self, index: int, subindex: int, command: int, data: bytes) -> Steps[tuple[int, bytes]]:
        doing, expected = ("reading", _UPLOAD) if command == _UPLOAD else ("writing", _DOWNLOADED)
        give_up = Deadline(self.clock, _TRANSFER_S)
        body = _SDO_HEADER.pack(_COE_SDO_REQUEST << 12, command, index, subindex) + data.ljust(4, b"\0")
        while not give_up.passed:
            yield from self.drain()
            if self._put(body):
                deadline = Deadline(self.clock, _ANSWER_S)
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

    def _answer(self, index: int, subindex: int, expected: int) -> tuple[int, bytes] | None:
        """Command and data of the answer if it is there; other messages are dropped.

        Such as the late answer to a request that was repeated: about the same object, but another command's.
        """
        body = self._take()
        if body is None or len(body) < _SDO_HEADER.size + 4:
            return None
        coe, command, its_index, its_subindex = _SDO_HEADER.unpack_from(body)
        is_sdo = coe >> 12 == _COE_SDO_RESPONSE or (coe >> 12 == _COE_SDO_REQUEST and command == _ABORT)
        if not is_sdo or (its_index, its_subindex) != (index, subindex):
            return None
        if command != _ABORT and command & _COMMAND_MASK != expected:
            return None
        return command, body[_SDO_HEADER.size :]

    def _put(self, body: bytes) -> bool:
        """Send a CoE message; False if that failed. It has another counter than the one before."""
        self._counter = max(2, self._counter + 1 & 7)  # 1 is left to SOEM, whose mapping begins with it
        header = _HEADER.pack(len(body), 0, 0, _TYPE_COE | self._counter << 4)
        return self._bus.write_register(self._number, self._out, (header + body).ljust(self._out_size, b"\0"))

    def _take(self) -> bytes | None:
        """The CoE message that is there; None if none is, empty if it is of another protocol.

        MessageLostError if the datagram that took it did not come back in time.
        """
        status = self._bus.read_register(self._number, MAILBOX_IN_STATUS, 1)
        if status is None or not status[0] & MAILBOX_FULL:
            return None
        message = self._bus.read_register(self._number, self._in, self._in_size)
        if message is None:
            raise MessageLostError
        length, _, _, kind = _HEADER.unpack_from(message)
        if kind & 0x0F != _TYPE_COE:
            return b""
        body = message[_HEADER.size : _HEADER.size + length]
        if self._emergencies is not None and (emergency := Emergency.parse(body)) is not None:
            self._emergencies.note(self._number, emergency)
        return body

    def _unanswered(self, doing: str, index: int, subindex: int, what: str) -> str:
        return f"sensor {self._number} did not answer {doing} object 0x{index:04X}:{subindex}: {what}"
