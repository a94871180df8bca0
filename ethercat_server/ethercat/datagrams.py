"""Single datagrams on the bus: registers of the slaves, by station address or position, and broadcast reads.

Each is a frame, matched with its answer by index, command and address: a late answer is not mistaken for that
to another datagram. What takes several is a generator, `Steps`: between two exchanges the acquisition loop
sends what it asks for (`acquisition.acyclic`); where nothing streams `finish` waits for the answers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator
from typing import Any, Final, NamedTuple, ParamSpec, TypeVar

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import Backend, CheckInterrupt
from ethercat_server.ethercat.clock import SYSTEM_CLOCK, Clock
from ethercat_server.ethercat.wire import (
    DATAGRAM_INDEX,
    FIRST_DATA,
    SHORTEST_FRAME,
    Command,
    build,
    is_answer,
)

# SOEM uses the indices below, and the exchange of process data those from `exchange.FIRST_INDEX` on.
FIRST_INDEX: Final = 0x80
_INDICES: Final = 0x10
_TIMEOUT_S: Final = 0.02
_PAUSE_S: Final = 0.001
_REGISTER_ATTEMPTS: Final = 20
_COUNT_ATTEMPTS: Final = 5
_U16: Final = struct.Struct("<H")
_LONGEST_TIMEOUT_S: Final = 0.25
# On a bus whose answers come late the timeout is this many times the longest recent round trip.
_LATE_FACTOR: Final = 2.0
# Below it, frames are in time.
_SHORTEST_TIMEOUT_S: Final = 0.0003


P = ParamSpec("P")
T = TypeVar("T")


class RegisterAccess(NamedTuple):
    """One datagram: registers or a mailbox of a slave, read or written."""

    command: Command
    adp: int
    ado: int
    data: bytes


class Answer(NamedTuple):
    """What came back."""

    wkc: int  # working counter
    data: bytes


# An operation in steps, which never waits itself: it yields a datagram and is resumed with the answer, None
# if it is lost; or it yields how long to wait, in s (None: a moment). It returns the result.
Steps = Generator[RegisterAccess | float | None, Answer | None, T]


def repeat(
    attempts: int, do: Callable[P, Steps[T | None]], *args: P.args, **kwargs: P.kwargs
) -> Steps[T | None]:
    """What `do` returns, done again while its datagram is lost: while it returns nothing, or False."""
    for _ in range(attempts):
        if found := (yield from do(*args, **kwargs)):
            return found
    return None


def finish(
    steps: Steps[T],
    clock: Clock = SYSTEM_CLOCK,
    check_interrupt: CheckInterrupt = lambda: None,
    ask: Callable[[RegisterAccess], Answer | None] | None = None,
) -> T:
    """Run `steps` to their end where nothing else is to be done meanwhile; returns their result.

    What interrupts them is raised in them: they clean up on the bus.
    """
    try:
        wanted = next(steps)
        while True:
            try:
                check_interrupt()
                value: Any = None
                if isinstance(wanted, RegisterAccess):
                    assert ask is not None, "on a bus only"
                    value = ask(wanted)
                else:
                    clock.sleep(_PAUSE_S if wanted is None else wanted)
            except BaseException as error:  # noqa: BLE001 - the steps raise it again
                check_interrupt = lambda: None  # noqa: E731
                wanted = steps.throw(error)
            else:
                wanted = steps.send(value)
    except StopIteration as stop:
        result: T = stop.value
        return result


class Datagrams:
    """Single datagrams through `backend`. Used by one thread.

    Their timeout grows while answers are late, so that a slow machine reads its sensors slowly rather than
    not at all: an answer that arrives after its timeout shows the present round trip.
    """

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.clock = backend.clock
        self._send, self._receive = backend.send, backend.receive
        self._raw_ns = backend.clock.raw_ns
        self._index = 0
        self._timeout_s = 0.0  # the timeout at least; 0 on a bus that is in time
        # By index less the first: when a frame was sent that is not back; else 0.
        self._pending_ns = [0] * _INDICES
        self._awaited: tuple[bytearray, int] | None = None  # the frame sent last, bytes of data in it
        self.stations: list[int] = []  # configured station addresses of the sensors, by number

    @property
    def ifname(self) -> str:
        """Name of the interface, for people."""
        return self.backend.ifname

    def send(self, access: RegisterAccess) -> int:
        """Send a datagram; returns until when, in ns, its answer is to be awaited."""
        command, adp, ado, data = access
        self._index = (self._index + 1) % len(self._pending_ns)
        frame = build((command, adp, ado, data), first_index=self._index + FIRST_INDEX)
        self._awaited = frame, len(data)
        self._pending_ns[self._index] = now_ns = self._raw_ns()
        self._send(frame.ljust(SHORTEST_FRAME, b"\0"))
        return now_ns + int(max(_TIMEOUT_S, self._timeout_s) * 1e9)

    def match(self, frame: bytes) -> Answer | None:
        """The answer to the datagram that was sent last, if this frame is that."""
        if self._awaited is None or not is_answer(frame, *self._awaited):
            index = frame[DATAGRAM_INDEX] - FIRST_INDEX if len(frame) > DATAGRAM_INDEX else -1
            if 0 <= index < _INDICES and self._pending_ns[index]:  # it is late
                self._set_timeout(self._timeout_s, index)
                self._pending_ns[index] = 0
            return None
        if self._timeout_s:  # it falls if the answer was early
            self._set_timeout(self._timeout_s / 2, self._index)
            if self._timeout_s <= _SHORTEST_TIMEOUT_S:
                self._timeout_s = 0.0
        end = FIRST_DATA + self._awaited[1]
        self._pending_ns[self._index], self._awaited = 0, None
        return Answer(_U16.unpack_from(frame, end)[0], frame[FIRST_DATA:end])

    def _set_timeout(self, least_s: float, index: int) -> None:
        """What the answer to the frame with this index, which has just come, suggests."""
        round_trip_s = (self._raw_ns() - self._pending_ns[index]) * 1e-9
        self._timeout_s = min(max(least_s, _LATE_FACTOR * round_trip_s), _LONGEST_TIMEOUT_S)

    def give_up(self) -> None:
        """The answer that was awaited is lost, or late."""
        self._awaited = None

    def finish(self, steps: Steps[T], check_interrupt: CheckInterrupt = lambda: None) -> T:
        """Run `steps` to their end, while nothing streams; see `finish`."""
        return finish(steps, self.clock, check_interrupt, self._ask)

    def read_register(self, number: int, address: int, size: int) -> Steps[bytes | None]:
        """Read ESC registers or a mailbox of a sensor; empty if it did not execute it, None if it is lost."""
        return _read(Command.FPRD, self.stations[number], address, size)

    def write_register(self, number: int, address: int, data: bytes) -> Steps[bool]:
        """Write ESC registers or a mailbox of a sensor; False if it did not execute it, or that is lost."""
        return _write(Command.FPWR, self.stations[number], address, data)

    def read_at(self, position: int, address: int, size: int) -> Steps[bytes | None]:
        """Read ESC registers of the slave at a position, scanned or not."""
        return _read(Command.APRD, -position, address, size)

    def write_at(self, position: int, address: int, data: bytes) -> Steps[bool]:
        """Write ESC registers of the slave at a position, scanned or not."""
        return _write(Command.APWR, -position, address, data)

    def count_slaves(self) -> int:
        """How many slaves answer a broadcast read, the most of some; needs no scan and changes nothing."""
        answers = [self._ask(RegisterAccess(Command.BRD, 0, 0, b"\0")) for _ in range(_COUNT_ATTEMPTS)]
        return max(answer.wkc if answer else 0 for answer in answers)

    def listen(self, seconds: float) -> int:
        """The number of frames that arrive from others in this time; nothing is sent."""
        until_ns, count = self._raw_ns() + int(seconds * 1e9), 0
        while (left_ns := until_ns - self._raw_ns()) > 0:
            count += self._receive(left_ns * 1e-9) is not None
        return count

    def read_surely_at(self, position: int, address: int, size: int) -> bytes:
        """Read ESC registers of the slave at a position, scanned or not; BusError if it does not answer."""
        if data := self.finish(repeat(_REGISTER_ATTEMPTS, self.read_at, position, address, size)):
            return data
        raise self._unanswered(position)

    def write_surely_at(self, position: int, address: int, data: bytes) -> None:
        """Write ESC registers of the slave at a position, scanned or not; BusError if it does not answer."""
        if not self.finish(repeat(_REGISTER_ATTEMPTS, self.write_at, position, address, data)):
            raise self._unanswered(position)

    def _unanswered(self, position: int) -> BusError:
        return BusError(f"slave {position} on {self.ifname} does not answer: check cable and power")

    def _ask(self, access: RegisterAccess) -> Answer | None:
        """Send a datagram and wait for its answer."""
        until_ns = self.send(access)
        while (left_ns := until_ns - self._raw_ns()) > 0:
            if (frame := self._receive(left_ns * 1e-9)) is None:
                break
            if (answer := self.match(frame)) is not None:
                return answer
        self.give_up()
        return None


def _read(command: Command, adp: int, address: int, size: int) -> Steps[bytes | None]:
    answer = yield RegisterAccess(command, adp, address, bytes(size))
    return answer and (answer.data if answer.wkc == 1 else b"")


def _write(command: Command, adp: int, address: int, data: bytes) -> Steps[bool]:
    answer = yield RegisterAccess(command, adp, address, data)
    return answer is not None and answer.wkc == 1


class ByPosition:
    """Registers of slaves by position, for those without a station address."""

    def __init__(self, bus: Datagrams) -> None:
        self.clock = bus.clock
        self.read_register, self.write_register = bus.read_at, bus.write_at


Registers = Datagrams | ByPosition
