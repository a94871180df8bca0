"""The exchange of process data: the layout of its frames, which process data and latched times each carries,
and the frames in flight, matched with their answers by index and tag.

Distributed clocks, by ETG.1000.4 and the data sheets of slave controllers: the local time counts ns from
power-on; the DC system time is the local time plus the system time offset less the propagation delay, both
written by masters that synchronize slaves. Events are latched in local time, for the sync managers that are
asked to; nothing else is written here, and only to sensors.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from ethercat_server.errors import BusError, SetUpError
from ethercat_server.ethercat.backend import Backend
from ethercat_server.ethercat.datagrams import Datagrams, Steps, repeat
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import (
    BYTE_NS,
    COUNTER_SIZE,
    DATAGRAM_HEADER,
    DATAGRAM_INDEX,
    FIRST_DATA,
    FRAME_HEADER,
    SHORTEST_FRAME,
    Command,
    build,
)
from ethercat_server.sampling.observation import DistributedClock

_U64_U32: Final = struct.Struct("<QI")
_PORTS: Final = struct.Struct("<4I")
# Bit of the DL status that says whether port 0 has a link.
_LINKS: Final = 4
_MOST_LOOP_DELAY_NS: Final = 1_000_000
_WRAP: Final = 1 << 32
_TIME_SIZE: Final = 4
_SLACK_NS: Final = 10_000
# A single lost frame must not disable event times; more attempts would delay the loop.
_ATTEMPTS: Final = 3

# As `Latched`.
LATCHED: Final = struct.Struct(f"<IH{DATAGRAM_HEADER}xIH")
# Bytes in a frame, of two datagrams.
LATCHED_SIZE: Final = DATAGRAM_HEADER + LATCHED.size


def latched_datagrams(station: int) -> tuple[tuple[int, int, int, bytes], ...]:
    """The datagrams that read `Latched`, for `wire.build`."""
    return (
        (Command.FPRD, station, reg.DC_SYSTEM_TIME, bytes(_TIME_SIZE)),
        (Command.FPRD, station, reg.DC_PDI_CHANGE_EVENT, bytes(_TIME_SIZE)),
    )


def switch_latched(frame: bytearray, at: int, *, reads: bool) -> None:
    """Have a frame read (FPRD) the latched times, which are at `at`, or not (NOP)."""
    for data in (at, at + LATCHED.size - COUNTER_SIZE - _TIME_SIZE):
        frame[data - DATAGRAM_HEADER] = Command.FPRD if reads else Command.NOP


def read_clock(bus: Datagrams, number: int, at: int) -> Steps[DistributedClock | None]:
    """The clock of a sensor's controller as another master has set it; None if it does not answer.

    `at` is where frames read what is latched.
    """
    if not (data := (yield from repeat(_ATTEMPTS, bus.read_register, number, reg.DC_OFFSET, _U64_U32.size))):
        return None
    offset, delay = _U64_U32.unpack(data)
    loop_ns = yield from _loop_delay_ns(bus, number)
    return DistributedClock((offset - delay) % _WRAP, loop_ns, at * BYTE_NS + _SLACK_NS)


def _loop_delay_ns(bus: Datagrams, number: int) -> Steps[int]:
    """Have the controller latch when a frame arrives at each port: the last less port 0; 0 if unknown."""
    if not (yield from bus.write_register(number, reg.DC_RECEIVE_TIMES, bytes(4))):
        return 0
    data = yield from bus.read_register(number, reg.DC_RECEIVE_TIMES, _PORTS.size)
    links = yield from bus.read_register(number, reg.DL_STATUS, 2)
    if not data or not links:
        return 0
    status = int.from_bytes(links, "little")
    out, *back = _PORTS.unpack(data)
    times = [(time - out) % _WRAP for port, time in enumerate(back, 1) if status >> _LINKS + port & 1]
    return max((time for time in times if time < _MOST_LOOP_DELAY_NS), default=0)


# The last datagram of each frame (NOP) carries its number as a tag, which slaves do not change: by the index
# alone a very late answer would be mistaken for that to a later frame.
TAG_SIZE: Final = 4
_AROUND_DATA: Final = DATAGRAM_HEADER + COUNTER_SIZE
# Bytes of datagrams that fit one frame.
_LONGEST: Final = 1498
# Sent where inputs are to be filled in. No sensor sends this: all its values would be NaN.
_NEVER: Final = b"\xff"


class Area(NamedTuple):
    """Process data of one slave in the logical address space."""

    start: int
    end: int
    kind: int


class Inputs(NamedTuple):
    """Where the inputs of a sensor are in the frame that carries them."""

    number: int  # of the sensor
    start: int
    end: int
    unfilled: bytes  # what is there after an exchange in which the sensor did not take part
    # Where the times are that its controller latched (`LATCHED`); 0 if the frame does not read them.
    latched: int


class Frame(NamedTuple):
    """One frame of an exchange, as sent except for index and tag."""

    content: bytearray
    inputs: list[Inputs]
    end: int  # of the process data (at least the inputs): there is the working counter
    written: int  # end of the outputs if they have a datagram of their own, else 0
    tag: int
    counters: list[int]  # what each sensor adds to the working counter: 2 for its outputs, 1 for its inputs
    # Of each terminal that has a datagram in it: number, start and end of the data, before its counter.
    terminals: list[tuple[int, int, int]]


def make_frames(
    areas: Sequence[Sequence[Area]], stations: Sequence[int | None], *, lrw: bool,
    terminals: Sequence[Area] = (),
) -> list[Frame]:  # fmt: skip
    """The frames that exchange the `areas` of each sensor, by number.

    Without `lrw` each reads (LRD) and writes (LWR) with datagrams of their own. `stations` are the addresses
    of the sensors whose latched times are read, None for others. The last frame reads each of the `terminals`
    with a datagram of its own (LRD). SetUpError if the inputs of a sensor are not in one frame, BusError if
    those of the terminals do not fit.
    """
    spans = _spans(areas, stations, lrw=lrw)
    frames = [
        _frame(*span, areas, stations, terminals if span == spans[-1] else (), lrw=lrw) for span in spans
    ]
    if terminals and len(frames[-1].content) > FRAME_HEADER + _LONGEST:
        raise BusError("the inputs of all terminals do not fit the frame with the sensors': name fewer")
    carried = [each.number for frame in frames for each in frame.inputs]
    for number in range(len(areas)):
        if carried.count(number) != 1:
            raise SetUpError(f"the process data of sensor {number} lies among that of others: start again")
    return frames


def fit_a_frame(areas: Sequence[Area], *, lrw: bool) -> bool:
    """Whether one frame can carry all the process data of a sensor."""
    return _size(max(area.end for area in areas) - min(area.start for area in areas), 1, lrw=lrw) <= _LONGEST


def _size(length: int, latching: int, *, lrw: bool) -> int:
    """Bytes of the datagrams for `length` bytes of process data and `latching` sensors' latched times."""
    exchanged = (1 if lrw else 2) * (_AROUND_DATA + length)
    return exchanged + latching * LATCHED_SIZE + _AROUND_DATA + TAG_SIZE


def _spans(
    areas: Sequence[Sequence[Area]], stations: Sequence[int | None], *, lrw: bool
) -> list[tuple[int, int]]:
    """Logical addresses of each frame: as many areas as fit one."""
    spans: list[tuple[int, int]] = []
    latching = 0
    for area, number in sorted((area, number) for number, each in enumerate(areas) for area in each):
        adds = area.kind == reg.FMMU_READ and stations[number] is not None
        if not spans or _size(area.end - spans[-1][0], latching + adds, lrw=lrw) > _LONGEST:
            spans.append((area.start, area.end))
            latching = 0
        spans[-1] = spans[-1][0], max(spans[-1][1], area.end)
        latching += adds
    return spans


def _frame(
    start: int, end: int, areas: Sequence[Sequence[Area]], stations: Sequence[int | None],
    terminals: Sequence[Area], *, lrw: bool,
) -> Frame:  # fmt: skip
    """The frame for the logical addresses from `start` to `end`, with the inputs that lie in them."""
    length, commands = end - start, (Command.LRW,) if lrw else (Command.LRD, Command.LWR)
    datagrams = [(int(command), start & 0xFFFF, start >> 16, bytes(length)) for command in commands]
    read = FIRST_DATA + length
    written = 0 if lrw else read + _AROUND_DATA + length
    at = (written or read) + COUNTER_SIZE + DATAGRAM_HEADER
    data, inputs, counters = bytearray(length), [], []
    for number, each in enumerate(areas):
        kinds = {area.kind for area in each if start <= area.start < end}
        counters.append(2 * (reg.FMMU_WRITE in kinds) + (reg.FMMU_READ in kinds))
        read_areas = [area for area in each if area.kind == reg.FMMU_READ]
        first, last = (
            min(area.start for area in read_areas) - start,
            max(area.end for area in read_areas) - start,
        )
        if first < 0 or last > length:
            continue
        for area in read_areas:
            data[area.start - start : area.end - start] = _NEVER * (area.end - area.start)
        station, latched = stations[number], 0
        if station is not None:
            latched, at = at, at + LATCHED_SIZE
            datagrams += latched_datagrams(station)
        inputs.append(Inputs(number, FIRST_DATA + first, FIRST_DATA + last, bytes(data[first:last]), latched))
    alone = []
    for number, (first, last, _) in enumerate(terminals):
        datagrams.append((Command.LRD, first & 0xFFFF, first >> 16, bytes(last - first)))
        alone.append((number, at, at + last - first))
        at += last - first + _AROUND_DATA
    content = build(*datagrams, (Command.NOP, 0, 0, bytes(TAG_SIZE))).ljust(SHORTEST_FRAME, b"\0")
    content[FIRST_DATA:read] = data
    return Frame(content, inputs, read, written, at, counters, alone)


# Single datagrams and SOEM use the indices below.
FIRST_INDEX: Final = 0x90
_INDICES: Final = 0x100
_OWN_INDICES: Final = _INDICES - FIRST_INDEX
# Limit of frames in flight on a bus that does not answer.
MOST_IN_FLIGHT = 100
# A frame counts as lost after this time, and its index is used again.
_LOST_NS: Final = 100_000_000
_pack_tag_into, _unpack_tag_from = struct.Struct("<I").pack_into, struct.Struct("<I").unpack_from
# Of a frame that was sent, by index: when (0: it is not in flight), its tag (-1: none), its number in the
# exchange, where its tag, the working counter of the process data and that of separate outputs are.
_NOT_SENT: Final = (0, -1, 0, 0, 0, 0)
_IMPOSSIBLE: Final = 0xFFFF


class Exchange(NamedTuple):
    """An exchange whose answer has arrived. Times are CLOCK_MONOTONIC_RAW ns."""

    sent_ns: int
    back_ns: int
    frame: bytes
    wkc: int  # working counter; 0xFFFF if it is impossible
    which: int  # number of the frame, of those that make up an exchange


# What `match` gives for an answer that arrived before.
DUPLICATE: Final = Exchange(0, 0, b"", 0, 0)


class ProcessData:
    """The frames of an exchange, and those in flight.

    Attributes:
        inputs: by frame, the sensors whose inputs it carries.
        terminals: by frame, the terminals' (`Frame.terminals`).
        wire_ns: by frame, what its bytes take on the wire.
        counters: by sensor, what it adds to the working counter of each frame.
        most_wkc: by frame, the highest working counter that there can be.
        in_flight: frames that are not back, and not known to be lost.
        duplicates: answers that arrived more than once.
        blocked_until_ns: until then nothing can be sent unless an answer arrives.
    """

    def __init__(
        self,
        areas: Sequence[Sequence[Area]],
        backend: Backend,
        *,
        lrw: bool = True,
        stations: Sequence[int | None] = (),
        terminals: Sequence[Area] = (),
    ) -> None:
        """See `make_frames`."""
        self._send, self._raw_ns = backend.send, backend.clock.raw_ns
        stations = stations or [None] * len(areas)
        self._frames = frames = make_frames(areas, stations, lrw=lrw, terminals=terminals)
        self._command = int(Command.LRW if lrw else Command.LRD) if frames else -1  # no frame has that
        self.inputs = [frame.inputs for frame in frames]
        self.terminals = [frame.terminals for frame in frames]
        self.wire_ns = [len(frame.content) * BYTE_NS for frame in frames]
        self.counters = [tuple(frame.counters[number] for frame in frames) for number in range(len(areas))]
        self.most_wkc = [sum(frame.counters) for frame in frames]
        # The highest counters of LRD and LWR.
        self._most = [
            (sum(each & 1 for each in frame.counters), sum(each >> 1 for each in frame.counters))
            for frame in frames
        ]
        self._rows = [
            (frame.content, which, frame.tag, frame.end, frame.written) for which, frame in enumerate(frames)
        ]
        self._tag = 0
        self._unused = 0  # tags that no frame has, for their index is another's
        self._sent = [_NOT_SENT] * _INDICES
        self.in_flight = 0
        self._lost = 0
        self.duplicates = 0
        self.blocked_until_ns = 0

    def read_latched(self, number: int, *, reads: bool) -> int | None:
        """Switch the reading of the times that a sensor's controller latches on or off.

        Returns where they are in the frame; None if no frame reads them.
        """
        for frame in self._frames:
            for each in frame.inputs:
                if each.number == number and each.latched:
                    switch_latched(frame.content, each.latched, reads=reads)
                    return each.latched
        return None

    def send(self) -> int:
        """Send an exchange unless too many frames are in flight. Returns the time."""
        sent = self._sent
        for content, which, tag_at, end, written in self._rows:
            self._tag = tag = self._tag + 1 & 0xFFFFFFFF
            content[DATAGRAM_INDEX] = index = FIRST_INDEX + tag % _OWN_INDICES
            if self.in_flight >= MOST_IN_FLIGHT or sent[index][0]:
                now_ns = self._raw_ns()
                self._expire(now_ns)
                if self.in_flight >= MOST_IN_FLIGHT:
                    self._tag -= 1
                    self.blocked_until_ns = min(row[0] for row in sent if row[0]) + _LOST_NS
                    return now_ns
                while sent[index][0]:
                    self._unused += 1
                    self._tag = tag = self._tag + 1 & 0xFFFFFFFF
                    content[DATAGRAM_INDEX] = index = FIRST_INDEX + tag % _OWN_INDICES
            _pack_tag_into(content, tag_at, tag)
            self.in_flight += 1
            now_ns = self._raw_ns()
            self._send(content)
            sent[index] = now_ns, tag, which, tag_at, end, written
        return now_ns

    def match(self, frame: bytes, back_ns: int) -> Exchange | None:
        """The exchange that a frame answers; None if none is awaited, DUPLICATE if it was answered before."""
        if len(frame) <= DATAGRAM_INDEX or frame[FRAME_HEADER] != self._command:
            return None
        index = frame[DATAGRAM_INDEX]
        sent_ns, tag, which, tag_at, end, written = self._sent[index]
        if len(frame) < tag_at + TAG_SIZE or _unpack_tag_from(frame, tag_at)[0] != tag:  # an older one
            return None
        if not sent_ns:
            self.duplicates += 1
            return DUPLICATE
        self._sent[index], self.blocked_until_ns = (0, tag, which, tag_at, end, written), 0
        self.in_flight -= 1
        wkc = frame[end] | frame[end + 1] << 8
        if written:  # an LRW would have counted 2
            writes = frame[written] | frame[written + 1] << 8
            most_reads, most_writes = self._most[which]
            wkc = wkc + 2 * writes if wkc <= most_reads and writes <= most_writes else _IMPOSSIBLE
        return Exchange(sent_ns, back_ns, frame, wkc, which)

    @property
    def sent(self) -> int:
        return (self._tag - self._unused) // max(1, len(self._frames))

    @property
    def answered(self) -> int:
        """Number of frames that were answered; it grows with each."""
        return self._tag - self._unused - self.in_flight - self._lost

    @property
    def lost(self) -> int:
        self._expire(self._raw_ns())
        return self._lost

    def _expire(self, now_ns: int) -> None:
        """Count frames as lost that are not back after `_LOST_NS`."""
        for index, (sent_ns, *_) in enumerate(self._sent):
            if sent_ns and now_ns - sent_ns >= _LOST_NS:
                self._sent[index] = _NOT_SENT
                self.in_flight -= 1
                self._lost += 1
