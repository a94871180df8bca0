"""What the exchanges of the last minute said, and the sampling clocks' state before: enough for `replay`.

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
import struct
from collections.abc import Iterator, Sequence
from enum import Enum, IntEnum
from itertools import count
from typing import Any, Final, NamedTuple

from ethercat_server.sampling.observation import Latched
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock

FORMAT: Final = "bota-ethercat sampling trace"
VERSION: Final = 1
RECORD: Final = struct.Struct("<QIIIBBH")
_MOST: Final = 0xFFFFFFFF  # longest duration, ns
LATCHED: Final = 0x80
MAX_TRACE_BYTES: Final = 8 << 20  # of records
_SECONDS: Final = 60.0  # that the ring has at least, if it is not larger for it
RECORDS: Final = 2.5  # a sample, at most, as a rule


class RecordKind(IntEnum):
    """What a record says; see the module."""

    READ = 0
    FRESH = 1
    INVALID = 2
    LEARNED = 3
    SHORT = 4


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


def state_of(value: Any, seen: set[int] | None = None) -> Any:
    """All numbers of an object of this package, for `set_state`; what was seen already is left out.

    Its attributes are keys in trace files: who renames one has to count up `VERSION`.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Enum):
        return value.name
    seen = set() if seen is None else seen
    seen.add(id(value))
    parts = {name: getattr(value, name) for name in attributes(value)}
    return {name: state_of(part, seen) for name, part in parts.items() if id(part) not in seen}


def attributes(value: Any) -> Iterator[str]:
    """Names of what an object of this package has."""
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


class Ring:
    """The records of the last minute, and the snapshots among them."""

    def __init__(self, samples_per_second: float) -> None:
        """`samples_per_second` of all sensors."""
        size = round(_SECONDS * RECORDS * samples_per_second) * RECORD.size
        self._ring = bytearray(max(1, min(size, MAX_TRACE_BYTES) // RECORD.size) * RECORD.size)
        self._end = 0  # bytes of records so far; the ring has the last of them
        self._snapshots: list[tuple[int, dict[str, Any]]] = []  # with the records before each, in bytes

    def add(self, notes: Sequence[Note]) -> None:
        """Make records of the notes."""
        ring, size, at = self._ring, len(self._ring), count(self._end, RECORD.size)
        for (sent, back, _, wkc, _), (a, counted, b, too), sensor, kind in notes:
            kind |= (counted == too == 1) * LATCHED  # noqa: PLW2901 - a line less for each sample
            RECORD.pack_into(ring, next(at) % size, sent, min(back - sent, _MOST), a, b, sensor, kind, wkc)
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
        snapshots = [{"before": (at - begin) // RECORD.size, **state} for at, state in rows]
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
