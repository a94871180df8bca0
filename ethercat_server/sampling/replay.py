"""Replays a trace file (`trace`) through the sampling clocks: the server's own decisions, or those of others.

Nothing here is loaded by the server.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from ethercat_server.sampling.observation import DistributedClock
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock, learn, learn_short_exchange
from ethercat_server.sampling.slave_clock import EventTimes
from ethercat_server.sampling.trace import FORMAT, LATCHED, RECORD, VERSION, Clocks, RecordKind, attributes
from ethercat_server.sampling.trust import TrustState

_LONGEST_HEADER: Final = 4 << 20
_PLAIN: Final = int | float | str


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


class TraceError(Exception):
    """A file is no trace, or one of another version: the text says which."""


def set_state(value: Any, state: Any) -> None:
    """Have an object be as `state_of` said; TraceError if it cannot."""
    names = set(attributes(value))
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


class Decision(NamedTuple):
    """What a sampling clock decided about a record."""

    record: Record
    instant_ns: float  # of a new sample, by CLOCK_MONOTONIC_RAW
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
            whole = records[: len(records) // RECORD.size * RECORD.size]
            self.records = [
                Record(sent_ns, duration_ns, a, b, sensor, RecordKind(kind & ~LATCHED), kind >= LATCHED, wkc)
                for sent_ns, duration_ns, a, b, sensor, kind, wkc in RECORD.iter_unpack(whole)
            ]
        except (ValueError, TypeError, KeyError, struct.error, RecursionError) as error:
            raise TraceError("it is damaged") from error
        self.about: dict[str, Any] = header

    def replay(self) -> Iterator[Decision]:
        """What the clocks make of each record of a sensor; TraceError where a record cannot be."""
        try:
            yield from self._replay()
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise TraceError("its snapshots are damaged, or of another version") from error

    def _replay(self) -> Iterator[Decision]:
        waiting = list(self._snapshots)
        clocks: Clocks | None = None
        pending: list[SampleClock] = []
        pending_ns = 0
        for number, record in enumerate(self.records):
            while waiting and waiting[0][0] <= number:
                clocks = clocks_of(waiting.pop(0)[1])
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
