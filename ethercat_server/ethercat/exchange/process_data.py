"""The exchange of process data: frames of our own, several at a time, each matched by its index."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from ethercat_server.ethercat.backend import Backend
from ethercat_server.ethercat.exchange.distributed_clock import switch_latched
from ethercat_server.ethercat.exchange.frames import Area, make_frames
from ethercat_server.ethercat.wire import BYTE_NS, DATAGRAM_INDEX, FRAME_HEADER, Command

# Single datagrams and SOEM use the indices below.
FIRST_INDEX: Final = 0x90
_INDICES: Final = 0x100
# Frames on the wire; a limit for a bus that does not answer.
MOST_IN_FLIGHT = 100
# A frame that is not back after this time counts as lost: its index is used again.
_LOST_NS: Final = 100_000_000
_TAG: Final = struct.Struct("<I")
_NOTHING: Final = (0, 0, -1)
_IMPOSSIBLE: Final = 0xFFFF


class Exchange(NamedTuple):
    """One that is back. Times are CLOCK_MONOTONIC ns."""

    sent_ns: int
    back_ns: int
    frame: bytes
    wkc: int
    """Working counter; 0xFFFF if it cannot be."""
    which: int
    """Number of the frame, of those that make up an exchange."""


# An answer that was taken before.
DUPLICATE: Final = Exchange(0, 0, b"", 0, 0)


class ProcessData:
    """The frames of an exchange, and those that are on the wire."""

    def __init__(
        self,
        areas: Sequence[Sequence[Area]],
        backend: Backend,
        *,
        lrw: bool = True,
        stations: Sequence[int | None] = (),
    ) -> None:
        """See `make_frames`."""
        self._send, self._monotonic_ns = backend.send, backend.clock.monotonic_ns
        frames = make_frames(areas, stations or [None] * len(areas), lrw=lrw)
        self._lrw, self._command = lrw, int(Command.LRW if lrw else Command.LRD)
        self._frames = [frame.content for frame in frames]
        self.wire_ns = [len(frame.content) * BYTE_NS for frame in frames]
        """By frame: what its bytes take on the wire."""
        self._ends = [frame.end for frame in frames]
        self._written = [frame.written for frame in frames]
        self._tags = [frame.tag for frame in frames] or [0]
        self.inputs = [frame.inputs for frame in frames]
        """By frame: the sensors whose inputs it carries."""
        self.counters = [tuple(frame.counters[number] for frame in frames) for number in range(len(areas))]
        """What each sensor adds to the working counter of each frame."""
        self.most_wkc = [sum(frame.counters) for frame in frames]
        """The highest working counter of each frame that there can be."""
        self._most = [
            (sum(each & 1 for each in frame.counters), sum(each >> 1 for each in frame.counters))
            for frame in frames
        ]
        """By frame: the highest counters of LRD and LWR."""
        self._index, self._number = FIRST_INDEX, 0
        # By index: when a frame was sent that is not back, else 0; which it was; its tag, -1 once it is lost.
        self._sent = [_NOTHING] * _INDICES
        self.in_flight = 0
        """Frames in flight: not back, and not known to be lost."""
        self._lost = 0
        self.duplicates = 0
        """Answers that came once more."""
        self.blocked_until_ns = 0
        """Nothing can be sent before, as long as nothing comes back."""

    def read_latched(self, number: int, *, reads: bool) -> int | None:
        """Read what a sensor's controller latches, or no longer; where, or None if it latches nothing."""
        for content, inputs in zip(self._frames, self.inputs, strict=True):
            for each in inputs:
                if each.number == number and each.latched:
                    switch_latched(content, each.latched, reads=reads)
                    return each.latched
        return None

    def send(self) -> int:
        """Send an exchange, unless too many are on the wire. Returns when."""
        for which, frame in enumerate(self._frames):
            index = self._index
            if self.in_flight >= MOST_IN_FLIGHT or self._sent[index][0]:
                now_ns = self._monotonic_ns()
                self._forget(now_ns)
                if self.in_flight >= MOST_IN_FLIGHT:
                    self.blocked_until_ns = min(sent[0] for sent in self._sent if sent[0]) + _LOST_NS
                    return now_ns
                while self._sent[index][0]:
                    index = max(FIRST_INDEX, (index + 1) % _INDICES)
            self._index = max(FIRST_INDEX, (index + 1) % _INDICES)
            self._number = number = (self._number + 1) & 0xFFFFFFFF
            frame[DATAGRAM_INDEX] = index
            _TAG.pack_into(frame, self._tags[which], number)
            self.in_flight += 1
            now_ns = self._monotonic_ns()
            self._send(frame)
            self._sent[index] = now_ns, which, number
        return now_ns

    def take(self, frame: bytes, back_ns: int) -> Exchange | None:
        """Take a frame that has arrived; None if it is no answer that is awaited."""
        if len(frame) <= DATAGRAM_INDEX or frame[FRAME_HEADER] != self._command:
            return None
        index = frame[DATAGRAM_INDEX]
        sent_ns, which, number = self._sent[index]
        at = self._tags[which]
        if len(frame) < at + _TAG.size or _TAG.unpack_from(frame, at)[0] != number:  # an older one
            return None
        if not sent_ns:
            self.duplicates += 1
            return DUPLICATE
        self._sent[index], self.blocked_until_ns = (0, which, number), 0
        self.in_flight -= 1
        end = self._ends[which]
        wkc = frame[end] | frame[end + 1] << 8
        if not self._lrw:  # an LRW would have counted 2
            end = self._written[which]
            written = frame[end] | frame[end + 1] << 8
            reads, writes = self._most[which]
            wkc = wkc + 2 * written if wkc <= reads and written <= writes else _IMPOSSIBLE
        return Exchange(sent_ns, back_ns, frame, wkc, which)

    @property
    def sent(self) -> int:
        """Exchanges that were sent."""
        return self._number // max(1, len(self._frames))

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
