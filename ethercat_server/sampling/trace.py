"""What the exchanges of the last minute said, and the sampling clocks' state before: enough to replay them.

The ring holds a record an exchange and sensor, of 24 bytes, little-endian:

    u64 sent_ns | u32 duration ns | u32 a | u32 b | u8 sensor | u8 kind | u16 working counter

- READ, FRESH (kinds 0, 1): the sensor's process data was that of before, or new; it took `duration` until
  this program had the answer. a and b are the DC system time and the time of the event that came with it, if
  their working counters were 1 (0x80 is added to the kind then), else 0.
- INVALID (2): the exchange brought nothing of this sensor.
- LEARNED (3): the clocks learned from the exchange of the records before: a is how long it took until its
  answer began to arrive, b by how much the loop had woken late in ns and 1 (0: it had not slept). SHORT (4):
  only the local clocks of slave controllers did.

A snapshot is the state of all clocks between two records. A trace file is a line of JSON (`format`,
`version`, who wrote it, `snapshots` with the record each stands before), then the records.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Sequence
from enum import Enum, IntEnum
from itertools import count
from typing import Any, Final, NamedTuple

from ethercat_server.sampling.observation import DistributedClock, Latched
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock, learn, learn_short_exchange
from ethercat_server.sampling.slave_clock import EventTimes
from ethercat_server.sampling.trust import TrustState

FORMAT: Final = "bota-ethercat sampling trace"
VERSION: Final = 1
_RECORD: Final = struct.Struct("<QIIIBBH")
_MOST: Final = 0xFFFFFFFF  # longest duration, ns
_LATCHED: Final = 0x80
_LARGEST: Final = 8 << 20  # of the ring, bytes
_SECONDS: Final = 60.0  # that the ring has at least, if it is not larger for it
_RECORDS: Final = 2.5  # a sample, at most, as a rule
_LONGEST_HEADER: Final = 4 << 20


_PLAIN: Final = int | float | str


class RecordKind(IntEnum):
    """What a record says; see the module."""

    READ = 0
    FRESH = 1
    INVALID = 2
    LEARNED = 3
    SHORT = 4


class Record(NamedTuple):
    """One record of a trace; `a` and `b` depend on its kind."""

    sent_ns: int
    duration_ns: int
    a: int
    b: int
    sensor: int
    kind: RecordKind
    latched: bool
    wkc: int


# (sent_ns, back_ns, frame, working counter, which frame), as the server's `Exchange`.
Exchanged = tuple[int, int, bytes, int, int]
# An exchange, what is latched, the sensor, the kind.
Note = tuple[Exchanged, Latched, int, int]
NOTHING: Final[Latched] = (0, 0, 0, 0)


def learn_note(
    exchange: Exchanged, arrived_ns: int, kind: RecordKind = RecordKind.SHORT, late_ns: float | None = None
) -> Note:
    """That the clocks learn from an exchange; see `RoundTrip.learn`."""
    late = 0 if late_ns is None else 1 + min(max(0, round(late_ns)), _MOST - 1)
    return exchange, (min(arrived_ns - exchange[0], _MOST), 0, late, 0), 0, kind


class TraceError(Exception):
    """A file is no trace, or one of another version: the text says which."""


def state_of(value: Any, seen: set[int] | None = None) -> Any:
    """All numbers of an object of this package, for `set_state`; what was seen already is left out."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Enum):
        return value.name
    seen = set() if seen is None else seen
    seen.add(id(value))
    parts = {name: getattr(value, name) for name in _attributes(value)}
    return {name: state_of(part, seen) for name, part in parts.items() if id(part) not in seen}


def set_state(value: Any, state: Any) -> None:
    """Have an object be as `state_of` said; TraceError if it cannot."""
    names = set(_attributes(value))
    for name, part in state.items() if isinstance(state, dict) else ():
        now = getattr(value, name) if name in names else _PLAIN
        if isinstance(part, dict) and now is not None and not isinstance(now, _PLAIN):
            set_state(now, part)
        elif isinstance(now, TrustState) and part in TrustState.__members__:
            setattr(value, name, TrustState[part])
        elif isinstance(now, str) is isinstance(part, str) and all(
            isinstance(each, _PLAIN | None) for each in (now, part)
        ):
            setattr(value, name, part)
        else:
            raise TraceError("its snapshots are damaged, or of another version")


def _attributes(value: Any) -> Iterator[str]:
    for kind in type(value).__mro__:
        yield from getattr(kind, "__slots__", ())
    yield from getattr(value, "__dict__", ())


class Clocks(NamedTuple):
    """The sampling clocks of all sensors of a bus, and its round trips."""

    round_trip: RoundTrip
    sensors: Sequence[SampleClock]

    def state(self) -> dict[str, Any]:
        """For `clocks_of`."""
        seen = {id(self.round_trip)}
        return {
            "round_trip": state_of(self.round_trip),
            "sensors": [state_of(each, seen) for each in self.sensors],
        }


def clocks_of(state: Any) -> Clocks:
    """Clocks with this state; TraceError if there can be none."""
    try:
        round_trip = RoundTrip()
        set_state(round_trip, state["round_trip"])
        sensors = []
        for each in state["sensors"]:
            events = None
            if each["events"] is not None:
                events = EventTimes(DistributedClock(0, 0, 0), round_trip, 0)
            sensors.append(clock := SampleClock(1.0, round_trip, events))
            set_state(clock, each)
    except (KeyError, TypeError) as error:
        raise TraceError("its snapshots are damaged, or of another version") from error
    return Clocks(round_trip, sensors)


class Ring:
    """The records of the last minute, and the snapshots among them."""

    def __init__(self, samples_per_second: float) -> None:
        """`samples_per_second` of all sensors."""
        size = round(_SECONDS * _RECORDS * samples_per_second) * _RECORD.size
        self._ring = bytearray(max(1, min(size, _LARGEST) // _RECORD.size) * _RECORD.size)
        self._end = 0  # bytes of records so far; the ring has the last of them
        self._snapshots: list[tuple[int, dict[str, Any]]] = []  # with the records before each, in bytes

    def add(self, notes: Sequence[Note]) -> None:
        """Make records of the notes."""
        ring, size, at = self._ring, len(self._ring), count(self._end, _RECORD.size)
        for (sent, back, _, wkc, _), (a, counted, b, too), sensor, kind in notes:
            kind |= (counted == too == 1) * _LATCHED  # noqa: PLW2901 - a line less for each sample
            _RECORD.pack_into(ring, next(at) % size, sent, min(back - sent, _MOST), a, b, sensor, kind, wkc)
        self._end = next(at)

    def snapshot(self, clocks: Clocks) -> None:
        """Keep the state before the next record."""
        oldest = self._end - len(self._ring)
        self._snapshots = [row for row in self._snapshots if row[0] >= oldest]
        self._snapshots.append((self._end, clocks.state()))

    def freeze(self, about: dict[str, Any]) -> FrozenTrace:
        """What there is now, as a file. `about` says of which sensors."""
        oldest = self._end - len(self._ring)
        rows = [row for row in self._snapshots if row[0] >= oldest]
        begin = rows[0][0] if rows else self._end
        snapshots = [{"before": (at - begin) // _RECORD.size, **state} for at, state in rows]
        header = {"format": FORMAT, "version": VERSION, **about, "snapshots": snapshots}
        return FrozenTrace(self, json.dumps(header).encode() + b"\n", begin, self._end)

    def read(self, at: int, length: int) -> bytes:
        """Records from the byte `at` on; zeros for those that the ring has lost."""
        data = b""
        while length:
            start = at % len(self._ring)
            part = min(length, len(self._ring) - start)
            is_there = at >= self._end - len(self._ring)
            data += self._ring[start : start + part] if is_there else bytes(part)
            at, length = at + part, length - part
        return data


class FrozenTrace(NamedTuple):
    """A trace file, of which the records are still in the ring: to be read faster than others come."""

    ring: Ring
    header: bytes
    begin: int  # of the records in the ring, and where they end
    end: int

    @property
    def size(self) -> int:
        """Bytes of the whole file."""
        return len(self.header) + self.end - self.begin

    def read(self, offset: int, length: int) -> bytes:
        """Bytes of the file; fewer than `length` at its end."""
        data = self.header[offset : offset + length]
        at = self.begin + max(0, offset - len(self.header))
        return data + self.ring.read(at, max(0, min(length - len(data), self.end - at)))


class Decision(NamedTuple):
    """What a sampling clock decided about a record."""

    record: Record
    instant_ns: float  # of a new sample, by CLOCK_MONOTONIC
    steps: int  # samples since the one before
    uncertain: bool
    locked: bool
    by_events: bool


class Trace:
    """A trace file; TraceError if it is none.

    Attributes:
        about: what the header says, without the snapshots.
    """

    def __init__(self, data: bytes) -> None:
        line, _, records = data.partition(b"\n")
        try:
            header = json.loads(line) if len(line) <= _LONGEST_HEADER else None
            if not isinstance(header, dict) or header.get("format") != FORMAT:
                raise TraceError("it is no trace of the sampling clocks")
            if header.get("version") != VERSION:
                raise TraceError(
                    f"it has version {header.get('version')!r}, and this program reads {VERSION}"
                )
            self._snapshots = [(int(row["before"]), row) for row in header.pop("snapshots")]
            whole = records[: len(records) // _RECORD.size * _RECORD.size]
            self.records = [
                Record(sent_ns, took_ns, a, b, sensor, RecordKind(kind & ~_LATCHED), kind >= _LATCHED, wkc)
                for sent_ns, took_ns, a, b, sensor, kind, wkc in _RECORD.iter_unpack(whole)
            ]
        except (ValueError, TypeError, KeyError, struct.error, RecursionError) as error:
            raise TraceError("it is damaged") from error
        self.about: dict[str, Any] = header

    def replay(self, *, anew: bool = False) -> Iterator[Decision]:
        """What the clocks make of each record of a sensor; TraceError where a record cannot be.

        `anew`: not from the state of the snapshots, but from the beginning, as a server that starts there:
        for a trace of another version of the clocks.
        """
        try:
            yield from self._replay(anew)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise TraceError("its snapshots are damaged, or of another version") from error

    def _begin_anew(self, state: Any, before: Clocks | None) -> Clocks:
        """Clocks that know nothing; of those `before` the ones that did not begin anew here."""
        round_trip = before.round_trip if before else RoundTrip(state["round_trip"]["_wire_ns"])
        clocks = list(before.sensors) if before else []
        for number, each in enumerate(state["sensors"]):
            if number < len(clocks) and each["_begun"]:
                continue
            events, offset_ns = each["events"], each["_data_offset_ns"]
            if events is not None:
                loop_ns = round(2 * events["_half_loop_ns"])
                slave = DistributedClock(events["_offset"], loop_ns, events["_reading_ns"])
                events = EventTimes(slave, round_trip, offset_ns)
            period_ns = 1e9 / self.about["sensors"][number]["nominal_hz"]
            clocks[number : number + 1] = [SampleClock(period_ns, round_trip, events, offset_ns)]
        return Clocks(round_trip, clocks)

    def _replay(self, anew: bool) -> Iterator[Decision]:
        waiting = list(self._snapshots)
        clocks: Clocks | None = None
        pending: list[SampleClock] = []
        pending_ns = 0
        for number, record in enumerate(self.records):
            while waiting and waiting[0][0] <= number:
                state = waiting.pop(0)[1]
                clocks = self._begin_anew(state, clocks) if anew else clocks_of(state)
            if clocks is None:
                continue
            sent_ns, back_ns = record.sent_ns, record.sent_ns + record.duration_ns
            if record.kind is RecordKind.LEARNED:
                late_ns = record.b - 1.0 if record.b else None
                learners = [clock for clock in pending if clock.learns]
                learn(clocks.round_trip, learners, sent_ns, sent_ns + record.a, back_ns, late_ns)
                pending = []
                continue
            if record.kind is RecordKind.SHORT:
                learn_short_exchange(clocks.round_trip, pending, sent_ns, sent_ns + record.a)
                pending = []
                continue
            if record.sensor >= len(clocks.sensors):
                raise TraceError(f"it has a record of sensor {record.sensor}, which it does not describe")
            clock = clocks.sensors[record.sensor]
            if record.kind is not RecordKind.INVALID:
                if pending and record.sent_ns != pending_ns:
                    pending = []
                pending_ns = record.sent_ns
                pending.append(clock)
                latched = (record.a, 1, record.b, 1) if record.latched else None
                if latched is None and clock.events is not None:
                    latched = (0, 0, 0, 0)
                clock.observe(sent_ns, back_ns, latched, fresh=record.kind is RecordKind.FRESH)
            yield Decision(
                record, clock.instant_ns if record.kind is RecordKind.FRESH else math.nan, clock.steps,
                clock.uncertain, clock.locked, clock.by_events,
            )  # fmt: skip
