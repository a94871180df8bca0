"""The EtherCAT bus: exchanges of process data in frames of our own, each matched by its index.

Single datagrams go between them (`Datagrams`).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from ethercat_server.errors import SetUpError
from ethercat_server.ethercat.backend import Backend, CheckInterrupt, Master
from ethercat_server.ethercat.datagrams import FIRST_INDEX, SHORTEST_FRAME, Datagrams
from ethercat_server.ethercat.mailbox.emergencies import Emergencies
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import COUNTER_SIZE, DATAGRAM_INDEX, FIRST_DATA, Command, build

_LONGEST_DATA: Final = 1486
"""Bytes of process data that fit one frame with one datagram."""
_U16: Final = struct.Struct("<H")
_SYNC_MANAGER: Final = struct.Struct("<2xHBxBx")
"""Length, control, activation."""
_SM_WRITE, _SM_MAILBOX = 0x04, 0x02
_NEVER: Final = b"\xff"
"""What is sent where the inputs will be; no sensor says it, for its numbers would be NaN throughout."""


class _Area(NamedTuple):
    """Process data of one slave in the logical address space."""

    start: int
    end: int
    kind: int


class Bus(Datagrams):
    """An EtherCAT bus through `backend`. Its sensors are numbered from 0. Used by one thread."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.master: Master
        """Whoever scanned it."""
        self.spare: Master
        """Who scans it again if that went wrong: one that repeats what lost frames spoil."""
        self._is_scanned = False
        self.emergencies = Emergencies(backend.clock)
        """What the sensors report unasked."""
        self.positions: list[int] = []
        """Where the sensors are on the wire: by number, as everything below."""
        self.fmmus: list[bytes] = []
        """FMMU registers as they must be in OP."""
        self._counters: list[int] = []
        self._frames: list[bytearray] = []
        """The exchange's frames; more than one only for process data that does not fit one."""
        self._ends: list[int] = []
        """Where the data ends in each."""
        self._answers: list[bytes] = []
        self._inputs: list[tuple[int, int, int]] = []
        """Which frame, where the inputs begin in it, where they end."""
        self.untouched: list[bytes] = []
        """By number: what `process_data` is after an exchange in which the sensor did not take part."""
        self._sent: dict[int, int] = {}
        """Which frame went out under which index."""

    # -- until OP

    def scan(self, master: Master, positions: Sequence[int], check_interrupt: CheckInterrupt) -> None:
        """Number the sensors at these positions and have `master` take them to PREOP."""
        self.master, self._is_scanned = master, True
        master.scan(positions, check_interrupt)
        self.positions = list(positions)
        self.stations = [
            _U16.unpack(self.read_surely_at(position, reg.STATION_ADDRESS, 2))[0] for position in positions
        ]
        master.enter_preop(check_interrupt)

    def go_operational(self, check_interrupt: CheckInterrupt) -> None:
        """Take every sensor from SAFEOP to OP; BusError names one that refuses."""
        self._lay_out_exchange()
        self.master.go_operational(check_interrupt)

    def close(self) -> None:
        """Take the sensors to INIT if they were scanned, and close the wire."""
        if self._is_scanned:
            self._is_scanned = False
            self.master.release()
        self.backend.close()

    def _lay_out_exchange(self) -> None:
        """Read from the FMMUs which logical addresses are whose process data."""
        areas: list[list[_Area]] = []
        self.fmmus = []
        for number in range(len(self.stations)):
            count = min(self.read_surely(number, reg.FMMU_AND_SM_COUNT, 2)[0], reg.MOST_FMMUS)
            self.fmmus.append(self.read_surely(number, reg.FMMU, count * reg.FMMU_SIZE))
            rows = (reg.FMMU_LAYOUT.unpack_from(self.fmmus[-1], at * reg.FMMU_SIZE) for at in range(count))
            areas.append([_Area(row[0], row[0] + row[1], row[6]) for row in rows if row[7] & 1])
            kinds = {area.kind for area in areas[-1]}
            if kinds != self._kinds(number) or reg.FMMU_READ not in kinds or _is_too_long(areas[-1]):
                # SOEM writes them once, and does not look whether that worked.
                raise SetUpError(f"sensor {number} did not answer when it was mapped: check cable and power")
        self._counters = [_working_counter(each) for each in areas]
        self._lay_out_frames(areas)

    def _kinds(self, number: int) -> set[int]:
        """What a sensor has according to its sync managers: inputs, outputs, or both."""
        count = min(self.read_surely(number, reg.FMMU_AND_SM_COUNT, 2)[1], reg.MOST_SYNC_MANAGERS)
        data = self.read_surely(number, reg.SYNC_MANAGER, count * reg.SYNC_MANAGER_SIZE)
        rows = [_SYNC_MANAGER.unpack_from(data, at * reg.SYNC_MANAGER_SIZE) for at in range(count)]
        return {
            reg.FMMU_WRITE if control & _SM_WRITE else reg.FMMU_READ
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
            self._frames.append(frame.ljust(SHORTEST_FRAME, b"\0"))
        self._answers = [bytes(frame) for frame in self._frames]
        self._ends = [FIRST_DATA + end - start for start, end in spans]
        self._inputs = []
        for number, each in enumerate(areas):
            inputs = [area for area in each if area.kind == reg.FMMU_READ]
            first, last = min(area.start for area in inputs), max(area.end for area in inputs)
            n = next((n for n, (start, end) in enumerate(spans) if start <= first and last <= end), -1)
            if n < 0:
                raise SetUpError(
                    f"the process data of sensor {number} lies among that of others: start again"
                )
            at, end = (FIRST_DATA + address - spans[n][0] for address in (first, last))
            self._inputs.append((n, at, end))
            for area in inputs:
                here = at + area.start - first
                self._frames[n][here : here + area.end - area.start] = _NEVER * (area.end - area.start)
        self.untouched = [bytes(self._frames[n][at:end]) for n, at, end in self._inputs]

    # -- the exchange

    def send(self, now_ns: int) -> None:
        """Send the process data; `receive` must follow. Only after `go_operational`."""
        sent = self._sent
        sent.clear()
        for n, frame in enumerate(self._frames):
            self._index = index = (self._index + 1) % len(self._pending_ns)
            self._pending_ns[index] = now_ns
            frame[DATAGRAM_INDEX] = index = index + FIRST_INDEX
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

    def working_counter(self, number: int) -> int:
        """What a sensor adds to the working counter of an exchange: 2 for its outputs, 1 for its inputs."""
        return self._counters[number]

    def process_data(self, number: int) -> bytes:
        """The inputs of a sensor as of the last exchange, byte for byte."""
        n, start, end = self._inputs[number]
        return self._answers[n][start:end]


def _working_counter(areas: list[_Area]) -> int:
    kinds = {area.kind for area in areas}
    return 2 * (reg.FMMU_WRITE in kinds) + (reg.FMMU_READ in kinds)


def _is_too_long(areas: list[_Area]) -> bool:
    return max(area.end for area in areas) - min(area.start for area in areas) > _LONGEST_DATA
