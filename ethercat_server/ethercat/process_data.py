"""The exchange of process data: frames of our own, several at a time, each matched by its index."""

from __future__ import annotations

from collections import deque
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
_TAG_SIZE: Final = 4
"""Each frame carries its number in a second datagram (NOP), which comes back as it was sent: by the index
alone one that comes back very late would be taken for a later one."""
_BEFORE_TAG: Final = COUNTER_SIZE + DATAGRAM_HEADER
_LONGEST_DATA: Final = 1486 - _BEFORE_TAG - _TAG_SIZE
"""Bytes of process data that fit one frame with these two datagrams."""
_NEVER: Final = b"\xff"
"""What is sent where the inputs will be; no sensor says it, for its numbers would be NaN throughout."""


_NOTHING: Final = (0, 0, b"")


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

    def __init__(self, areas: Sequence[Sequence[Area]], backend: Backend) -> None:
        """`areas` are those of each sensor by number; SetUpError if they cannot be read frame by frame."""
        self._send, self._monotonic_ns = backend.send, backend.clock.monotonic_ns
        spans = _spans(area for each in areas for area in each)
        self.counters = [tuple(_working_counter(each, span) for span in spans) for each in areas]
        """What a sensor adds to the working counter of each frame: 2 for its outputs, 1 for its inputs."""
        self._frames = [_frame(span) for span in spans]
        self.inputs: list[list[Inputs]] = [[] for _ in spans]
        """By frame: the sensors whose inputs it carries."""
        for number, each in enumerate(areas):
            self._lay_out(number, each, spans)
        self._ends = [FIRST_DATA + end - start for start, end in spans]
        """Where the process data ends in each."""
        self._index = self._number = 0
        self._sent = [_NOTHING] * _INDICES
        """By index less the first: when a frame was sent that is not back, else 0; which it was; its tag."""
        self._flying: deque[tuple[int, int]] = deque()
        """When frames were sent, and under which index: the oldest first; some are back."""
        self.in_flight = 0
        """Frames that are not back, and not lost."""
        self.lost = 0
        """Frames that did not come back."""
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
        if not self.in_flight:
            self._flying.clear()
        elif self._flying:
            self._forget(self._monotonic_ns())
        now_ns = 0
        for which, frame in enumerate(self._frames):
            if self.in_flight >= MOST_IN_FLIGHT:
                self.blocked_until_ns = self._flying[0][0] + _LOST_NS
                return self._monotonic_ns()
            index = self._index
            while self._sent[index][0]:
                index = (index + 1) % _INDICES
            self._index = (index + 1) % _INDICES
            self._number = (self._number + 1) & 0xFFFFFFFF
            tag, at = self._number.to_bytes(_TAG_SIZE, "little"), self._ends[which] + _BEFORE_TAG
            frame[at : at + _TAG_SIZE] = tag
            frame[DATAGRAM_INDEX] = index + FIRST_INDEX
            self.in_flight += 1
            now_ns = self._monotonic_ns()
            self._send(frame)
            self._sent[index] = now_ns, which, tag
            self._flying.append((now_ns, index))
        return now_ns

    def take(self, frame: bytes) -> int:
        """Take a frame that has arrived: returns when it was sent; 0 if it is no answer that is awaited."""
        if (
            len(frame) <= DATAGRAM_INDEX
            or frame[DATAGRAM_INDEX] < FIRST_INDEX
            or frame[FRAME_HEADER] != Command.LRW
        ):
            return 0
        index = frame[DATAGRAM_INDEX] - FIRST_INDEX
        sent_ns, which, tag = self._sent[index]
        end = self._ends[which]
        at = end + _BEFORE_TAG
        if not sent_ns or frame[at : at + _TAG_SIZE] != tag:  # shorter, or an older one
            return 0
        self._sent[index] = _NOTHING
        self.blocked_until_ns = 0
        self.in_flight -= 1
        self.frame, self.which = frame, which
        self.wkc = frame[end] | frame[end + 1] << 8
        return sent_ns

    def _forget(self, now_ns: int) -> None:
        """Give up the frames that have been away for too long."""
        flying = self._flying
        while flying:
            sent_ns, index = flying[0]
            if self._sent[index][0] == sent_ns:
                if now_ns - sent_ns < _LOST_NS:
                    return
                self._sent[index] = _NOTHING
                self.in_flight -= 1
                self.lost += 1
            flying.popleft()


def _spans(areas: Iterable[Area]) -> list[tuple[int, int]]:
    """Logical addresses of each frame: as many areas as fit one."""
    spans: list[tuple[int, int]] = []
    for area in sorted(areas):
        if not spans or area.end - spans[-1][0] > _LONGEST_DATA:
            spans.append((area.start, area.end))
        spans[-1] = spans[-1][0], max(spans[-1][1], area.end)
    return spans


def _frame(span: tuple[int, int]) -> bytearray:
    start, end = span
    exchange = Command.LRW, start & 0xFFFF, start >> 16, bytes(end - start)
    return build(exchange, (Command.NOP, 0, 0, bytes(_TAG_SIZE))).ljust(SHORTEST_FRAME, b"\0")


def _working_counter(areas: Sequence[Area], span: tuple[int, int]) -> int:
    kinds = {area.kind for area in areas if span[0] <= area.start < span[1]}
    return 2 * (reg.FMMU_WRITE in kinds) + (reg.FMMU_READ in kinds)


def fit_a_frame(areas: Sequence[Area]) -> bool:
    """Whether one frame can carry all the process data of a sensor."""
    return max(area.end for area in areas) - min(area.start for area in areas) <= _LONGEST_DATA
