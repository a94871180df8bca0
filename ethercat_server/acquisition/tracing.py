"""Keeps what the exchanges of the last minute said, for a trace (`sampling.trace`).

The loop only notes what it has at hand; the notes become records in a chore.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.program.version import VERSION
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.trace import Clocks, FrozenTrace, Note, Ring

_SNAPSHOT_EVERY_S: Final = 20
_PART: Final = 24 << 10  # bytes of a trace in one reply


class Tracing:
    """The trace of all sensors of a bus; the loop appends to `notes`."""

    def __init__(self, round_trip: RoundTrip, streams: Sequence[SensorStream]) -> None:
        self._round_trip, self._streams = round_trip, streams
        self._ring = Ring(sum(1e9 / stream.clock.period_ns for stream in streams))
        self.notes: list[Note] = []
        for stream in streams:
            stream.notes, stream.on_change = self.notes, self.snapshot
        self._snapshot_in_s = 0
        self.snapshot()
        self._frozen = self.freeze()  # what clients read

    def pack(self) -> None:
        """Make records of the notes."""
        self._ring.add(self.notes)
        self.notes.clear()

    def snapshot(self) -> None:
        """Keep the state of the clocks: now and then, and where it changed otherwise than by records."""
        self.pack()
        self._ring.snapshot(Clocks(self._round_trip, [stream.clock for stream in self._streams]))
        self._snapshot_in_s = _SNAPSHOT_EVERY_S

    def each_second(self) -> None:
        self._snapshot_in_s -= 1
        if self._snapshot_in_s <= 0:
            self.snapshot()

    def freeze(self) -> FrozenTrace:
        """A trace file of the last minute."""
        self.pack()
        sensors = [{"model": stream.model, "nominal_hz": stream.nominal_hz} for stream in self._streams]
        return self._ring.freeze({"program": f"ethercat-server {VERSION}", "sensors": sensors})

    def part(self, offset: int) -> dict[str, Any]:
        """A part of a trace file, from `offset` on; that from 0 on begins a new one."""
        if not offset:
            self._frozen = self.freeze()
        data = self._frozen.read(offset, _PART)
        return {"size": self._frozen.size, "data": base64.b64encode(data).decode()}
