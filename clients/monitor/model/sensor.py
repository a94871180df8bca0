"""One sensor: identity, newest sample, peaks and traces.

Every sample counts for peaks and traces: the values of a batch are unpacked at once and compared by column.
Only the newest sample is decoded in full.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from clients.monitor.model.judgement import Judgement
from clients.monitor.model.state import (
    AXES,
    SILENT_S,
    WRENCH_FIELDS,
    Clock,
    Range,
    SensorState,
    Spread,
)
from clients.monitor.model.stream_meter import StreamMeter
from protocol.framing import DataMessage
from protocol.pdo import LAYOUTS, ImuUnits, SampleDecoder
from protocol.settings import SETTINGS
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import number, text, whole

TRACE_STEP_S: Final = 0.25
TRACE_STEPS: Final = 80

_COMMON: Final = LAYOUTS[min(LAYOUTS)]
"""The fields common to all sizes of process data."""
_WRENCH: Final = tuple(_COMMON.index(name) for name in WRENCH_FIELDS)


class SensorModel:
    """Takes frames and replies to `describe` and `status`; provides the state."""

    def __init__(self, position: int, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        self.position = position
        self.meter = StreamMeter()
        self.judgement = Judgement()
        self._imu_units = imu_units
        self._description: JsonObject = {}
        self._status: JsonObject = {}
        self._last_10s: Any = None
        self._lost: str | None = None
        self._newest: bytes | None = None
        self._trace: dict[int, tuple[Range, ...]] = {}
        self._peaks: tuple[Range, ...] | None = None

    def reset(self) -> None:
        """Reset peaks and past warnings."""
        self.reset_peaks()
        self.judgement.reset()

    def reset_peaks(self) -> None:
        """Reset the peaks only: the zero has moved."""
        self._peaks = None

    def describe(self, row: JsonObject, now_s: float) -> None:
        """Take the sensor's row of `describe`."""
        if self._description and row.get("serial") != self._description.get("serial"):
            self.reset()
            self._newest, self._trace = None, {}
        self._description = row
        self.judgement.describe(row, now_s)

    def restart(self, now_s: float, *, again: bool) -> None:
        """The monitor has connected; `again`: not for the first time."""
        self.meter.restart()
        self._lost = None
        self.judgement.restart(now_s, again=again)

    def lost(self, message: str | None) -> None:
        """The server has lost the sensor, for this reason; None: it is back."""
        self._lost = message

    def take_status(self, row: JsonObject, last_10s: Any, now_s: float) -> None:
        """The sensor's row of `status`, and its distribution of ages of the last ten seconds."""
        self.judgement.take_status(row, now_s)
        self._status, self._last_10s = row, last_10s

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """Frames of this sensor as they came, oldest first."""
        fresh = self.meter.take(frames, now_s)
        self.judgement.take(frames, now_s, lost=self._lost)
        if not fresh:
            return
        self._newest = fresh[-1]
        columns = list(zip(*map(_COMMON.struct.unpack_from, fresh), strict=True))
        ranges: list[Range] = []
        for index in _WRENCH:
            column: Sequence[float] = columns[index]
            if not math.isfinite(sum(column)):
                column = [value for value in column if math.isfinite(value)] or (0.0,)
            ranges.append(Range(min(column), max(column)))
        found = tuple(ranges)
        self._peaks = found if self._peaks is None else _widest(self._peaks, found)
        step = int(now_s / TRACE_STEP_S)
        if step in self._trace:
            found = _widest(self._trace[step], found)
        elif len(self._trace) > 2 * TRACE_STEPS:
            self._trace = {at: kept for at, kept in self._trace.items() if at > step - TRACE_STEPS}
        self._trace[step] = found

    def state(self, now_s: float, *, server_speaks: bool = True) -> SensorState:
        """The current state. Silence is the sensor's fault only if the server is not silent."""
        row = self._description
        given = row.get("settings")
        settings = given if isinstance(given, dict) else {}
        clock = self._status.get("clock")
        sample = None
        if self._newest is not None:
            sample = SampleDecoder(len(self._newest), self._imu_units).decode(self._newest)
        stream = self.meter.state(now_s)
        silent_s = 0.0 if stream.silent_s is None else stream.silent_s
        if server_speaks:
            self.judgement.judge(now_s, lost=self._lost)
        return SensorState(
            position=self.position,
            name=text(row.get("name")),
            serial=whole(row.get("serial")),
            firmware=text(row.get("firmware")),
            al_state="LOST" if self._lost is not None else text(row.get("state")),
            nominal_hz=number(row.get("rate_hz")),
            raw_counts=settings.get("calibration_matrix") is False,
            imu_off=settings.get("imu_active") == 0,
            sample=sample,
            old_s=silent_s if silent_s >= SILENT_S else None,
            peaks=self._peaks,
            traces=self._traces(now_s),
            saturated=frozenset(self.judgement.saturated),
            verdict=self.judgement.verdict,
            alerts=tuple(self.judgement.alerts(now_s, present=server_speaks)),
            stream=stream,
            clock=_clock(clock) if isinstance(clock, dict) else None,
            bus_lost=whole(self._status.get("lost_samples")),
            recoveries=whole(self._status.get("recoveries")),
            hand_out_us=spread(self._last_10s),
            settings={name: settings[name] for name in SETTINGS if isinstance(settings.get(name), int)},
        )

    def _traces(self, now_s: float) -> tuple[tuple[Range | None, ...], ...]:
        last = int(now_s / TRACE_STEP_S)
        rows = [self._trace.get(step) for step in range(last - TRACE_STEPS + 1, last + 1)]
        return tuple(tuple(None if row is None else row[axis] for row in rows) for axis in range(len(AXES)))


def spread(values: Any) -> Spread | None:
    """The distribution in a reply to `status`; None if there is none."""
    if not isinstance(values, dict):
        return None
    middle, end = number(values.get("p50")), number(values.get("p99"))
    return None if middle is None or end is None else Spread(middle, end)


def _clock(row: JsonObject) -> Clock:
    return Clock(text(row.get("mode")), number(row.get("offset_ppm")), number(row.get("uncertainty_us")))


def _widest(one: tuple[Range, ...], other: tuple[Range, ...]) -> tuple[Range, ...]:
    return tuple(
        Range(min(a.low, b.low), max(a.high, b.high)) for a, b in zip(one, other, strict=True)
    )  # fmt: skip
