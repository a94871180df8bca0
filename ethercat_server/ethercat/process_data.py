"""The exchange of process data: frames of our own, several at a time, each matched by its index."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from ethercat_server.errors import SetUpError
from ethercat_server.ethercat.backend import Backend
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import (
    COUNTER_SIZE,
    DATAGRAM_HEADER,
    DATAGRAM_INDEX,
    FIRST_DATA,
    FRAME_HEADER,
    SHORTEST_FRAME,
    Command,
    build,
)

FIRST_INDEX: Final = 0x90
"""Single datagrams and SOEM use the indices below."""
_INDICES: Final = 0x100 - FIRST_INDEX
MOST_IN_FLIGHT = 100
"""Frames on the wire; a limit for a bus that does not answer."""
_LOST_NS: Final = 100_000_000
"""A frame that is not back after this time counts as lost: its index is used again."""
_TAG: Final = struct.Struct("<I")
"""Each frame carries its number in a second datagram (NOP), which comes back as it was sent: by the index
alone one that comes back very late would be taken for a later one."""
_BEFORE_TAG: Final = COUNTER_SIZE + DATAGRAM_HEADER
_LONGEST_LRW: Final = 1486 - _BEFORE_TAG - _TAG.size
_LONGEST_LRD: Final = (_LONGEST_LRW - _BEFORE_TAG) // 2
"""Bytes of process data that fit one frame with these datagrams."""
_NEVER: Final = b"\xff"
"""What is sent where the inputs will be; no sensor says it, for its numbers would be NaN throughout."""

_NOTHING: Final = (0, 0, 0)


class Area(NamedTuple):
    """Process data of one slave in the logical address space."""

    start: int
    end: int
    kind: int


class Inputs(NamedTuple):
    """Where the inputs of a sensor are in the frame that carries them."""

    number: int
    """Of the sensor."""
    start: int
    end: int
    untouched: bytes
    """What is there after an exchange in which the sensor did not take part."""


class ProcessData:
    """The frames of an exchange, and those that are on the wire."""

    def __init__(self, areas: Sequence[Sequence[Area]], backend: Backend, *, lrw: bool = True) -> None:
        """`areas` are those of each sensor by number; SetUpError if they cannot be read frame by frame.

        Without `lrw` each frame reads (LRD) and writes (LWR) with datagrams of their own.
        """
        self._send, self._monotonic_ns = backend.send, backend.clock.monotonic_ns
        spans = _spans((area for each in areas for area in each), _longest(lrw))
        self._lrw, self._command = lrw, int(Command.LRW if lrw else Command.LRD)
        self.counters = [tuple(_working_counter(each, span) for span in spans) for each in areas]
        """What a sensor adds to the working counter of each frame: 2 for its outputs, 1 for its inputs."""
        self._frames = [_frame(span, lrw) for span in spans]
        self.inputs: list[list[Inputs]] = [[] for _ in spans]
        """By frame: the sensors whose inputs it carries."""
        for number, each in enumerate(areas):
            self._lay_out(number, each, spans)
        self._ends = [FIRST_DATA + end - start for start, end in spans]
        """Where the process data (at least the inputs) ends in each."""
        self._written = [0 if lrw else end + _BEFORE_TAG + end - FIRST_DATA for end in self._ends]
        """Where the outputs end in each, if separate."""
        self._tags = [
            (each or end) + _BEFORE_TAG for each, end in zip(self._written, self._ends, strict=True)
        ]
        self._index = self._number = 0
        self._sent = [_NOTHING] * _INDICES
        """By index less the first: when a frame was sent that is not back, else 0; which it was; its tag."""
        self.in_flight = 0
        """Frames in flight: not back, and not known to be lost."""
        self._lost = 0
        self.blocked_until_ns = 0
        """Nothing can be sent before, as long as nothing comes back."""
        self.frame = b""
        """The answer that `take` took last."""
        self.wkc = 0
        """Its working counter."""
        self.which = 0
        """Which frame of the exchange it is."""

    def _lay_out(self, number: int, areas: Sequence[Area], spans: list[tuple[int, int]]) -> None:
        inputs = [area for area in areas if area.kind == reg.FMMU_READ]
        first, last = min(area.start for area in inputs), max(area.end for area in inputs)
        which = next((n for n, (start, end) in enumerate(spans) if start <= first and last <= end), -1)
        if which < 0:
            raise SetUpError(f"the process data of sensor {number} lies among that of others: start again")
        frame, offset = self._frames[which], FIRST_DATA - spans[which][0]
        for area in inputs:
            frame[area.start + offset : area.end + offset] = _NEVER * (area.end - area.start)
        start, end = first + offset, last + offset
        self.inputs[which].append(Inputs(number, start, end, bytes(frame[start:end])))

    def send(self) -> int:
        """Send an exchange, unless too many are on the wire. Returns when."""
        now_ns = 0
        for which, frame in enumerate(self._frames):
            index = self._index
            if self.in_flight >= MOST_IN_FLIGHT or self._sent[index][0]:
                now_ns = self._monotonic_ns()
                self._forget(now_ns)
                if self.in_flight >= MOST_IN_FLIGHT:
                    self.blocked_until_ns = min(sent[0] for sent in self._sent if sent[0]) + _LOST_NS
                    return now_ns
                while self._sent[index][0]:
                    index = (index + 1) % _INDICES
            self._index = (index + 1) % _INDICES
            self._number = number = (self._number + 1) & 0xFFFFFFFF
            frame[DATAGRAM_INDEX] = index + FIRST_INDEX
            _TAG.pack_into(frame, self._tags[which], number)
            self.in_flight += 1
            now_ns = self._monotonic_ns()
            self._send(frame)
            self._sent[index] = now_ns, which, number
        return now_ns

    def take(self, frame: bytes) -> int:
        """Take a frame that has arrived: returns when it was sent; 0 if it is no answer that is awaited."""
        if (
            len(frame) <= DATAGRAM_INDEX
            or frame[DATAGRAM_INDEX] < FIRST_INDEX
            or frame[FRAME_HEADER] != self._command
        ):
            return 0
        index = frame[DATAGRAM_INDEX] - FIRST_INDEX
        sent_ns, which, number = self._sent[index]
        if not sent_ns:
            return 0
        at = self._tags[which]
        if len(frame) < at + _TAG.size or _TAG.unpack_from(frame, at)[0] != number:  # an older one
            return 0
        self._sent[index] = _NOTHING
        self.blocked_until_ns = 0
        self.in_flight -= 1
        self.frame, self.which = frame, which
        end = self._ends[which]
        self.wkc = frame[end] | frame[end + 1] << 8
        if not self._lrw:  # an LRW would have counted 2
            end = self._written[which]
            self.wkc += 2 * (frame[end] | frame[end + 1] << 8)
        return sent_ns

    @property
    def lost(self) -> int:
        """Frames that did not come back."""
        self._forget(self._monotonic_ns())
        return self._lost

    def _forget(self, now_ns: int) -> None:
        """Give up the frames that have been away for too long."""
        for index, (sent_ns, _, _) in enumerate(self._sent):
            if sent_ns and now_ns - sent_ns >= _LOST_NS:
                self._sent[index] = _NOTHING
                self.in_flight -= 1
                self._lost += 1


def _longest(lrw: bool) -> int:
    return _LONGEST_LRW if lrw else _LONGEST_LRD


def _spans(areas: Iterable[Area], longest: int) -> list[tuple[int, int]]:
    """Logical addresses of each frame: as many areas as fit one."""
    spans: list[tuple[int, int]] = []
    for area in sorted(areas):
        if not spans or area.end - spans[-1][0] > longest:
            spans.append((area.start, area.end))
        spans[-1] = spans[-1][0], max(spans[-1][1], area.end)
    return spans


def _frame(span: tuple[int, int], lrw: bool) -> bytearray:
    start, end = span
    rest = start & 0xFFFF, start >> 16, bytes(end - start)
    exchange = [(command, *rest) for command in ((Command.LRW,) if lrw else (Command.LRD, Command.LWR))]
    return build(*exchange, (Command.NOP, 0, 0, bytes(_TAG.size))).ljust(SHORTEST_FRAME, b"\0")


def _working_counter(areas: Sequence[Area], span: tuple[int, int]) -> int:
    kinds = {area.kind for area in areas if span[0] <= area.start < span[1]}
    return 2 * (reg.FMMU_WRITE in kinds) + (reg.FMMU_READ in kinds)


def fit_a_frame(areas: Sequence[Area], *, lrw: bool) -> bool:
    """Whether one frame can carry all the process data of a sensor."""
    return max(area.end for area in areas) - min(area.start for area in areas) <= _longest(lrw)
