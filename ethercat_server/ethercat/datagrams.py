"""Single datagrams on the bus: registers of the slaves, by station address or position, and broadcast reads.

Each is a frame, matched with its answer by index, command and address: a late answer is not mistaken for that
to another datagram.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, ParamSpec, Protocol, TypeVar

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import Backend
from ethercat_server.ethercat.clock import Clock
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
_REGISTER_ATTEMPTS: Final = 20
_U16: Final = struct.Struct("<H")
_LONGEST_TIMEOUT_S: Final = 0.25
# On a bus whose answers come late the timeout is this many times the longest recent round trip.
_LATE_FACTOR: Final = 2.0
# Below it, frames are in time.
_SHORTEST_TIMEOUT_S: Final = 0.0003


P = ParamSpec("P")
T = TypeVar("T")


def repeat(attempts: int, do: Callable[P, T | None], *args: P.args, **kwargs: P.kwargs) -> T | None:
    """What `do` returns, called again while its datagram is lost: while it returns nothing, or False."""
    return next(filter(None, (do(*args, **kwargs) for _ in range(attempts))), None)


class Registers(Protocol):
    """Access to registers and mailboxes of slaves: by sensor number, as on a `Bus`, or `ByPosition`."""

    @property
    def clock(self) -> Clock:
        """The clock of the bus."""

    def read_register(self, number: int, address: int, size: int, /) -> bytes | None:
        """None if the slave did not execute it."""

    def write_register(self, number: int, address: int, data: bytes, /) -> bool:
        """False if the slave did not execute it."""


class LateAnswers:
    """The timeout of datagrams.

    It grows while answers are late, so that a slow machine reads its sensors slowly rather than not at all:
    an answer that arrives after its timeout shows the present round trip.
    """

    def __init__(self, clock: Clock) -> None:
        self.timeout_s = 0.0  # the timeout at least; 0 on a bus that is in time
        self._monotonic_ns = clock.monotonic_ns
        # By index less the first: when a frame was sent that is not back; else 0.
        self.pending_ns = [0] * _INDICES

    def note(self, answer: bytes) -> None:
        """Take an answer that is not the one awaited."""
        index = answer[DATAGRAM_INDEX] - FIRST_INDEX if len(answer) > DATAGRAM_INDEX else -1
        if 0 <= index < _INDICES and self.pending_ns[index]:
            self.timeout_s = min(max(self.timeout_s, self._least_s(index)), _LONGEST_TIMEOUT_S)
            self.pending_ns[index] = 0

    def in_time(self, index: int) -> None:
        """Take the awaited answer: the timeout falls if it was early."""
        timeout_s = min(max(self.timeout_s / 2, self._least_s(index)), _LONGEST_TIMEOUT_S)
        self.timeout_s = timeout_s if timeout_s > _SHORTEST_TIMEOUT_S else 0.0

    def _least_s(self, index: int) -> float:
        return _LATE_FACTOR * (self._monotonic_ns() - self.pending_ns[index]) * 1e-9


class Datagrams:
    """Single datagrams through `backend`. Used by one thread."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.clock = backend.clock
        self._send, self._receive = backend.send, backend.receive
        self._monotonic_ns = backend.clock.monotonic_ns
        self._index = 0
        self._late = LateAnswers(backend.clock)
        self._pending_ns = self._late.pending_ns
        # Returns the next frame before an instant in ns, None if there is none. The acquisition loop replaces
        # it by one that continues to exchange process data.
        self.next_frame = self.next_on_wire
        self.stations: list[int] = []  # configured station addresses of the sensors, by number

    @property
    def ifname(self) -> str:
        """Name of the interface, for people."""
        return self.backend.ifname

    def next_on_wire(self, until_ns: int) -> bytes | None:
        """The next frame that arrives before `until_ns`; None if none does."""
        left_ns = until_ns - self._monotonic_ns()
        return self._receive(left_ns * 1e-9) if left_ns > 0 else None

    def read_register(self, number: int, address: int, size: int) -> bytes | None:
        """Read ESC registers or a mailbox of a sensor with one datagram; None if it did not do it."""
        return self._read(Command.FPRD, self.stations[number], address, size)

    def write_register(self, number: int, address: int, data: bytes) -> bool:
        """Write ESC registers or a mailbox of a sensor with one datagram; False if it did not."""
        return self._write(Command.FPWR, self.stations[number], address, data)

    def read_at(self, position: int, address: int, size: int) -> bytes | None:
        """Read ESC registers of the slave at a position, scanned or not; None if it did not do it."""
        return self._read(Command.APRD, -position, address, size)

    def write_at(self, position: int, address: int, data: bytes) -> bool:
        """Write ESC registers of the slave at a position, scanned or not; False if it did not do it."""
        return self._write(Command.APWR, -position, address, data)

    def count_slaves(self, size: int, timeout_s: float) -> int:
        """How many slaves answer a broadcast read of `size` bytes from register 0 on; -1 if it is lost.

        Needs no scan and changes nothing, so it also serves to measure the round trip of such a frame.
        """
        answer = self._datagram(Command.BRD, 0, 0, bytes(size), timeout_s)
        return -1 if answer is None else answer[0]

    def listen(self, seconds: float) -> int:
        """The number of frames that arrive from others in this time; nothing is sent."""
        until_ns, count = self._monotonic_ns() + int(seconds * 1e9), 0
        while (left_ns := until_ns - self._monotonic_ns()) > 0:
            count += self._receive(left_ns * 1e-9) is not None
        return count

    def read_surely_at(self, position: int, address: int, size: int) -> bytes:
        """Read ESC registers of the slave at a position, scanned or not; BusError if it does not answer."""
        if data := repeat(_REGISTER_ATTEMPTS, self.read_at, position, address, size):
            return data
        raise self._unanswered(position)

    def write_surely_at(self, position: int, address: int, data: bytes) -> None:
        """Write ESC registers of the slave at a position, scanned or not; BusError if it does not answer."""
        if not repeat(_REGISTER_ATTEMPTS, self.write_at, position, address, data):
            raise self._unanswered(position)

    def _unanswered(self, position: int) -> BusError:
        return BusError(f"slave {position} on {self.ifname} does not answer: check cable and power")

    def _read(self, command: Command, adp: int, address: int, size: int) -> bytes | None:
        answer = self._datagram(command, adp, address, bytes(size), _TIMEOUT_S)
        return answer[1] if answer is not None and answer[0] == 1 else None

    def _write(self, command: Command, adp: int, address: int, data: bytes) -> bool:
        answer = self._datagram(command, adp, address, data, _TIMEOUT_S)
        return answer is not None and answer[0] == 1

    def _datagram(
        self, command: Command, adp: int, ado: int, data: bytes, timeout_s: float
    ) -> tuple[int, bytes] | None:
        """Send one datagram and wait for it: its working counter and data; None if it does not come back."""
        self._index = (self._index + 1) % len(self._pending_ns)
        frame = build((command, adp, ado, data), first_index=self._index + FIRST_INDEX)
        self._pending_ns[self._index] = now_ns = self._monotonic_ns()
        until_ns = now_ns + int(max(timeout_s, self._late.timeout_s) * 1e9)
        self._send(frame.ljust(SHORTEST_FRAME, b"\0"))
        end = FIRST_DATA + len(data)
        while (answer := self.next_frame(until_ns)) is not None:
            if is_answer(answer, frame, len(data)):
                if self._late.timeout_s:
                    self._late.in_time(self._index)
                self._pending_ns[self._index] = 0
                return _U16.unpack_from(answer, end)[0], answer[FIRST_DATA:end]
            self._late.note(answer)
        return None


class ByPosition:
    """Registers of slaves by position, for those without a station address."""

    def __init__(self, bus: Datagrams) -> None:
        self.clock = bus.clock
        self.read_register, self.write_register = bus.read_at, bus.write_at
