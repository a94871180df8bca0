"""The EtherCAT bus: exchanges of process data, and single datagrams between them.

Each is a frame of our own over the backend, matched with its answer by its index: a frame that comes too late
is never taken for another one's answer.
"""

from __future__ import annotations

import contextlib
import functools
import struct
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import Backend, CheckInterrupt, SlaveIdentity
from ethercat_server.ethercat.late_answers import LateAnswers
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import (
    COUNTER_SIZE,
    DATAGRAM_INDEX,
    FIRST_DATA,
    Command,
    build,
    is_answer,
)

_DATAGRAM_TIMEOUT_S: Final = 0.002
_PATIENT_TIMEOUT_S: Final = 0.02
_LEAST_TIMEOUT_S: Final = 0.0003
_ANSWER_ATTEMPTS: Final = 3
_REGISTER_ATTEMPTS: Final = 20
_FIRST_INDEX: Final = 0x80
"""SOEM uses the indices below."""
_LONGEST_DATA: Final = 1486
"""Bytes of process data that fit one frame with one datagram."""
_SHORTEST_FRAME: Final = 60
_U16: Final = struct.Struct("<H")
_FMMU: Final = struct.Struct("<IHBBHBBB3x")
_FMMU_READ, _FMMU_WRITE = 1, 2
_SYNC_MANAGER: Final = struct.Struct("<2xHBxBx")
"""Length, control, activation."""
_SM_WRITE, _SM_MAILBOX = 0x04, 0x02


class _Area(NamedTuple):
    """Process data of one slave in the logical address space."""

    start: int
    end: int
    kind: int


class Bus:
    """An EtherCAT bus through `backend`. Slaves are numbered from 0 by their position. Used by one thread."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.clock = backend.clock
        self.ifname = backend.ifname
        self._send, self._receive = backend.send, backend.receive
        self._monotonic_ns = backend.clock.monotonic_ns
        self._index = 0
        self._datagram_timeout_s = _PATIENT_TIMEOUT_S
        self._late = LateAnswers(backend.clock, _FIRST_INDEX)
        self._pending_ns = self._late.pending_ns
        self.stations: list[int] = []
        """Configured station addresses, by position."""
        self.fmmus: list[bytes] = []
        """FMMU registers as they must be in OP, by position."""
        self._counters: list[int] = []
        self._frames: list[bytearray] = []
        """The exchange's frames; more than one only for process data that does not fit one."""
        self._ends: list[int] = []
        """Where the data ends in each."""
        self._answers: list[bytes] = []
        self._inputs: list[tuple[int, int, int]] = []
        """By position: which frame, where the inputs begin in it, where they end."""
        self._sent: dict[int, int] = {}
        """Which frame went out under which index."""

    # -- until OP

    def scan(self, check_interrupt: CheckInterrupt) -> list[SlaveIdentity]:
        """Find the slaves and take them to PREOP; BusError if none answers."""
        slaves = self.backend.scan(check_interrupt)
        self.stations = []
        for position in range(len(slaves)):
            data = self.read_surely_at(position, reg.STATION_ADDRESS, 2)
            self.stations.append(_U16.unpack(data)[0])
        return slaves

    def go_operational(self, check_interrupt: CheckInterrupt) -> None:
        """Take every slave from SAFEOP to OP; BusError names one that refuses."""
        self.backend.go_operational(check_interrupt)
        self._lay_out_exchange()

    def _lay_out_exchange(self) -> None:
        """Read from the FMMUs which logical addresses are whose process data."""
        areas: list[list[_Area]] = []
        self.fmmus = []
        for position in range(len(self.stations)):
            count = self.read_surely(position, reg.FMMU_AND_SM_COUNT, 2)[0]
            self.fmmus.append(self.read_surely(position, reg.FMMU, count * reg.FMMU_SIZE))
            rows = (_FMMU.unpack_from(self.fmmus[-1], at * reg.FMMU_SIZE) for at in range(count))
            areas.append([_Area(row[0], row[0] + row[1], row[6]) for row in rows if row[7] & 1])
            if {area.kind for area in areas[-1]} != self._kinds(position):
                # SOEM writes them once, and does not look whether that worked.
                raise BusError(f"sensor {position} did not answer when it was mapped: check cable and power")
        self._counters = [_working_counter(each) for each in areas]
        self._lay_out_frames(areas)

    def _kinds(self, position: int) -> set[int]:
        """What a slave has according to its sync managers: inputs, outputs, or both."""
        count = self.read_surely(position, reg.FMMU_AND_SM_COUNT, 2)[1]
        data = self.read_surely(position, reg.SYNC_MANAGER, count * reg.SYNC_MANAGER_SIZE)
        rows = [_SYNC_MANAGER.unpack_from(data, at * reg.SYNC_MANAGER_SIZE) for at in range(count)]
        return {
            _FMMU_WRITE if control & _SM_WRITE else _FMMU_READ
            for length, control, active in rows
            if length and active & 1 and not control & _SM_MAILBOX
        }

    def _lay_out_frames(self, areas: list[list[_Area]]) -> None:
        spans: list[list[int]] = []
        for area in sorted(area for each in areas for area in each):
            if not spans or area.end - spans[-1][0] > _LONGEST_DATA:
                spans.append([area.start, area.end])
            spans[-1][1] = max(spans[-1][1], area.end)
        self._frames = []
        for start, end in spans:
            frame = build((Command.LRW, start & 0xFFFF, start >> 16, bytes(end - start)))
            self._frames.append(frame.ljust(_SHORTEST_FRAME, b"\0"))
        self._answers = [bytes(frame) for frame in self._frames]
        self._ends = [FIRST_DATA + end - start for start, end in spans]
        self._inputs = []
        for each in areas:
            inputs = [area for area in each if area.kind == _FMMU_READ]
            first, last = min(area.start for area in inputs), max(area.end for area in inputs)
            n = next(n for n, (start, end) in enumerate(spans) if start <= first and last <= end)
            self._inputs.append((n, FIRST_DATA + first - spans[n][0], FIRST_DATA + last - spans[n][0]))

    # -- the exchange

    def send(self, now_ns: int) -> None:
        """Send the process data; `receive` must follow. Only after `go_operational`."""
        sent = self._sent
        sent.clear()
        for n, frame in enumerate(self._frames):
            self._index = index = (self._index + 1) % len(self._pending_ns)
            self._pending_ns[index] = now_ns
            frame[DATAGRAM_INDEX] = index = index + _FIRST_INDEX
            sent[index] = n
            self._send(frame)

    def receive(self, timeout_s: float) -> int:
        """Wait for the process data to come back; returns the working counter, -1 if it does not.

        At most `timeout_s`, or longer where answers come late.
        """
        timeout_s = max(timeout_s, self._late.timeout_s)
        answer, sent, wkc = self._receive(timeout_s), self._sent, 0
        while answer is not None:
            n = sent.pop(answer[DATAGRAM_INDEX], -1) if len(answer) > DATAGRAM_INDEX else -1
            if n >= 0 and len(answer) >= (end := self._ends[n]) + COUNTER_SIZE:
                self._answers[n] = answer
                wkc += answer[end] | answer[end + 1] << 8
                if not sent:
                    if self._late.timeout_s:
                        self._late.in_time(self._index)
                    self._pending_ns[self._index] = 0
                    return wkc
            else:
                self._late.note(answer)
            until_ns = self._pending_ns[self._index] + int(timeout_s * 1e9)
            left_ns = until_ns - self._monotonic_ns()
            answer = self._receive(left_ns * 1e-9) if left_ns > 0 else None
        return -1

    def working_counter(self, position: int) -> int:
        """What a slave adds to the working counter of an exchange: 2 for its outputs, 1 for its inputs."""
        return self._counters[position]

    def process_data(self, position: int) -> bytes:
        """The inputs of a slave as of the last exchange, byte for byte."""
        n, start, end = self._inputs[position]
        return self._answers[n][start:end]

    # -- single datagrams

    def be_patient(self, patient: bool) -> None:
        """Whether single datagrams may take long: no sensor is left that would have to wait for them."""
        self._datagram_timeout_s = _PATIENT_TIMEOUT_S if patient else _DATAGRAM_TIMEOUT_S

    @contextlib.contextmanager
    def in_time(self, until_ns: int) -> Iterator[None]:
        """Within it, single datagrams wait no longer than until then: an exchange is due."""
        usual, left_s = self._datagram_timeout_s, (until_ns - self._monotonic_ns()) * 1e-9
        self._datagram_timeout_s = min(usual, max(_LEAST_TIMEOUT_S, left_s))
        try:
            yield
        finally:
            self._datagram_timeout_s = usual

    def read_register(self, position: int, address: int, size: int) -> bytes | None:
        """Read ESC registers or a mailbox of a scanned slave with one datagram; None if it did not do it."""
        return self._read(Command.FPRD, self.stations[position], address, size, self._datagram_timeout_s)

    def write_register(self, position: int, address: int, data: bytes) -> bool:
        """Write ESC registers or a mailbox of a scanned slave with one datagram; False if it did not."""
        return self._write(Command.FPWR, self.stations[position], address, data, self._datagram_timeout_s)

    def read_at(self, position: int, address: int, size: int) -> bytes | None:
        """Read ESC registers of the slave at a position, scanned or not; None if it did not do it."""
        return self._read(Command.APRD, -position, address, size, self._datagram_timeout_s)

    def write_at(self, position: int, address: int, data: bytes) -> bool:
        """Write ESC registers of the slave at a position, scanned or not; False if it did not do it."""
        return self._write(Command.APWR, -position, address, data, self._datagram_timeout_s)

    def count_slaves(self, size: int, timeout_s: float) -> int:
        """How many slaves answer a broadcast read of `size` bytes from register 0 on; -1 if it is lost.

        Needs no scan and changes nothing, so it also serves to measure the round trip of such a frame.
        """
        answer = self.read_all(0, size, timeout_s)
        return -1 if answer is None else answer[0]

    def read_all(self, address: int, size: int, timeout_s: float) -> tuple[int, bytes] | None:
        """How many slaves answer a broadcast read, and what they have there, ORed; None if it is lost."""
        return self._datagram(Command.BRD, 0, address, bytes(size), timeout_s)

    def listen(self, seconds: float) -> int:
        """The number of frames that arrive from others in this time; nothing is sent."""
        until_ns, count = self._monotonic_ns() + int(seconds * 1e9), 0
        while (left_ns := until_ns - self._monotonic_ns()) > 0:
            count += self._receive(left_ns * 1e-9) is not None
        return count

    def read_surely(self, position: int, address: int, size: int) -> bytes:
        """Read ESC registers of a scanned slave; BusError if it does not answer."""
        data = self._attempt(functools.partial(self.read_register, position, address, size))
        if data is None:
            raise BusError(f"sensor {position} does not answer: check cable and power")
        return data

    def read_surely_at(self, position: int, address: int, size: int) -> bytes:
        """Read ESC registers of the slave at a position, scanned or not; BusError if it does not answer."""
        data = self._attempt(functools.partial(self.read_at, position, address, size))
        if data is None:
            raise BusError(
                f"a slave on {self.ifname} stopped answering during the scan: check cable and power"
            )
        return data

    def check_answers(self, position: int) -> None:
        """BusError if a slave does not answer any more."""
        if all(self.read_register(position, 0, 1) is None for _ in range(_ANSWER_ATTEMPTS)):
            raise BusError(f"sensor {position} stopped answering while it was set up: check cable and power")

    def _attempt(self, read: Callable[[], bytes | None]) -> bytes | None:
        """Read again while datagrams are lost, a bounded number of times."""
        for _ in range(_REGISTER_ATTEMPTS):
            if (data := read()) is not None:
                return data
        return None

    def _read(self, command: Command, adp: int, address: int, size: int, timeout_s: float) -> bytes | None:
        answer = self._datagram(command, adp, address, bytes(size), timeout_s)
        return answer[1] if answer is not None and answer[0] == 1 else None

    def _write(self, command: Command, adp: int, address: int, data: bytes, timeout_s: float) -> bool:
        answer = self._datagram(command, adp, address, data, timeout_s)
        return answer is not None and answer[0] == 1

    def _datagram(
        self, command: Command, adp: int, ado: int, data: bytes, timeout_s: float
    ) -> tuple[int, bytes] | None:
        """Send one datagram and wait for it: its working counter and data; None if it does not come back."""
        self._index = (self._index + 1) % len(self._pending_ns)
        index = self._index + _FIRST_INDEX
        frame = build((command, adp, ado, data), first_index=index)
        self._pending_ns[self._index] = now_ns = self._monotonic_ns()
        until_ns = now_ns + int(max(timeout_s, self._late.timeout_s) * 1e9)
        self._send(frame.ljust(_SHORTEST_FRAME, b"\0"))
        end = FIRST_DATA + len(data)
        while (left_ns := until_ns - self._monotonic_ns()) > 0:
            answer = self._receive(left_ns * 1e-9)
            if answer is None:
                return None
            if is_answer(answer, command, index, len(data)):
                self._pending_ns[self._index] = 0
                return _U16.unpack_from(answer, end)[0], answer[FIRST_DATA:end]
            self._late.note(answer)
        return None


def _working_counter(areas: list[_Area]) -> int:
    kinds = {area.kind for area in areas}
    return 2 * (_FMMU_WRITE in kinds) + (_FMMU_READ in kinds)
