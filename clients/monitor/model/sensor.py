"""One sensor: identity, newest sample, peaks, traces and recent alerts.

Every sample counts for peaks, traces, warnings and saturation: the values of a batch are unpacked at once and
compared by column. Only the newest sample is decoded in full.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from typing import Any, Final

from clients.monitor.model.state import (
    AXES,
    SILENT_S,
    WRENCH_FIELDS,
    Alert,
    Clock,
    Range,
    SensorState,
    Spread,
)
from clients.monitor.model.stream_meter import StreamMeter
from protocol.framing import DataMessage
from protocol.pdo import LAYOUTS, ImuUnits, SampleDecoder
from protocol.sensor.warnings_register import WarningFlag, explain
from protocol.settings import SETTINGS
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import number, text, whole

TRACE_STEP_S: Final = 0.25
TRACE_STEPS: Final = 40
_PRESENT_S: Final = 1.0
"""How long a warning that was set for a single sample counts as present."""

_COMMON: Final = LAYOUTS[min(LAYOUTS)]
"""The fields common to all sizes of process data."""
_WRENCH: Final = tuple(_COMMON.index(name) for name in WRENCH_FIELDS)
_WARNINGS: Final = _COMMON.index("warnings")
_SATURATION: Final = (
    ("force_torque_saturated", AXES, WarningFlag.FORCE_TORQUE_SATURATED),
    ("acceleration_saturated", ("ax", "ay", "az"), WarningFlag.ACCELERATION_SATURATED),
    ("angular_rate_saturated", ("ωx", "ωy", "ωz"), WarningFlag.ANGULAR_RATE_SATURATED),
)
"""Field, the axes of its bits, and the corresponding warning."""
_SATURATION_COLUMNS: Final = tuple((_COMMON.index(field), names) for field, names, _ in _SATURATION)
_AXES_OF: Final = {int(flag): names for _, names, flag in _SATURATION}


class SensorModel:
    """Takes frames and replies to `describe` and `status`; provides the state."""

    def __init__(self, position: int, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        self.position = position
        self.meter = StreamMeter()
        self._imu_units = imu_units
        self._description: JsonObject = {}
        self._status: JsonObject = {}
        self._last_10s: Any = None
        self._lost: str | None = None
        self._newest: bytes | None = None
        self._trace: dict[int, tuple[Range, ...]] = {}
        self._started_s: float | None = None
        self._emergencies: int | None = 0
        """How many the sensor had sent when `_emergency` was the last one."""
        self.reset()

    def reset(self) -> None:
        """Reset peaks and past warnings."""
        self._peaks: tuple[Range, ...] | None = None
        self._warned_s: dict[int, float] = {}
        self._saturated_s: dict[str, float] = {}
        self._not_finite_s: float | None = None
        self._emergency: tuple[str, float] | None = None
        """The last one that is not over, in words, and when it came."""

    def describe(self, row: JsonObject, now_s: float) -> None:
        """Take the sensor's row of `describe`."""
        if self._description and row.get("serial") != self._description.get("serial"):
            self.reset()
            self._newest, self._trace = None, {}
        self._description = row
        self._started_s = now_s

    def restart(self) -> None:
        """The monitor has reconnected."""
        self.meter.restart()
        self._lost = None

    def lost(self, message: str | None) -> None:
        """The server has lost the sensor, for this reason; None: it is back."""
        self._lost = message

    def take_status(self, row: JsonObject, last_10s: Any, now_s: float) -> None:
        """The sensor's row of `status`, and its distribution of ages of the last ten seconds."""
        before, after = whole(self._status.get("not_finite")), whole(row.get("not_finite"))
        if before is not None and after is not None and after > before:
            self._not_finite_s = now_s
        count, last = whole(row.get("emergencies")), row.get("emergency")
        if count != self._emergencies and isinstance(last, dict):
            self._emergencies, self._emergency = count, _emergency(last, now_s)
        self._status, self._last_10s = row, last_10s

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """Frames of this sensor as they came, oldest first."""
        fresh = self.meter.take(frames, now_s)
        if not fresh:
            return
        self._newest = fresh[-1]
        columns = list(zip(*map(_COMMON.struct.unpack_from, fresh), strict=True))
        ranges: list[Range] = []
        for index in _WRENCH:
            column: Sequence[float] = columns[index]
            if not math.isfinite(sum(column)):
                self._not_finite_s = now_s
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
        register = functools.reduce(operator.or_, set(columns[_WARNINGS]))
        while register:
            bit = register & -register
            self._warned_s[bit] = now_s
            register ^= bit
        for index, names in _SATURATION_COLUMNS:
            bits = functools.reduce(operator.or_, set(columns[index]))
            if bits:
                for position, name in enumerate(names):
                    if bits >> position & 1:
                        self._saturated_s[name] = now_s

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
        present = (name for name, at_s in self._saturated_s.items() if now_s - at_s < _PRESENT_S)
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
            saturated=frozenset(present),
            alerts=tuple(self._alerts(now_s, server_speaks)),
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

    def _alerts(self, now_s: float, server_speaks: bool) -> list[Alert]:
        alerts: list[Alert] = []
        if self._lost is not None:
            alerts.append(Alert("error", self._lost, "Check its cable and power", None))
        elif server_speaks:
            alerts.extend(self._silence(now_s))
        if self._not_finite_s is not None:
            ago = _ago(self._not_finite_s, now_s)
            remedy = "Power-cycle the sensor; if it persists, contact support"
            alerts.append(Alert("error", "A measured value is not a finite number", remedy, ago))
        if self._emergency is not None:
            said, at_s = self._emergency
            alerts.append(Alert("warning", said, "If it comes again, contact support", _ago(at_s, now_s)))
        for bit in {**self._warned_s, **self._saturation_bits()}:
            (row,) = explain(bit)
            axes = [name for name in _AXES_OF.get(bit, ()) if name in self._saturated_s]
            at_s = max(
                self._warned_s.get(bit, -math.inf), *(self._saturated_s[name] for name in axes), -math.inf
            )
            meaning = f"{row.meaning}: {', '.join(axes)}" if axes else row.meaning
            alerts.append(Alert(row.severity.value, meaning, row.remedy, _ago(at_s, now_s)))
        rank = {"fatal": 0, "error": 1, "warning": 2}
        return sorted(alerts, key=lambda a: (-1.0 if a.ago_s is None else a.ago_s, rank.get(a.severity, 3)))

    def _silence(self, now_s: float) -> list[Alert]:
        stream = self.meter.state(now_s)
        since_s = stream.silent_s
        if since_s is None and self._started_s is not None:
            since_s = now_s - self._started_s
        if since_s is None or since_s < SILENT_S:
            return []
        return [Alert("error", f"No new sample for {since_s:.0f} s", "Check the sensor and its cable", None)]

    def _saturation_bits(self) -> dict[int, None]:
        """The warnings that saturated axes amount to, also where the sensor does not set them."""
        return {bit: None for bit, names in _AXES_OF.items() if self._saturated_s.keys() & set(names)}


def spread(values: Any) -> Spread | None:
    """The distribution in a reply to `status`; None if there is none."""
    if not isinstance(values, dict):
        return None
    middle, end = number(values.get("p50")), number(values.get("p99"))
    return None if middle is None or end is None else Spread(middle, end)


def _emergency(row: JsonObject, now_s: float) -> tuple[str, float] | None:
    """The one in a reply to `status`; None if it says that an error is over."""
    code = whole(row.get("code")) or 0
    said = f"Emergency 0x{code:04X}: {text(row.get('text'))}"
    return (said, now_s - (number(row.get("ago_s")) or 0.0)) if code & 0xFF00 else None


def _clock(row: JsonObject) -> Clock:
    return Clock(text(row.get("mode")), number(row.get("offset_ppm")), number(row.get("uncertainty_us")))


def _ago(at_s: float, now_s: float) -> float | None:
    return None if now_s - at_s < _PRESENT_S else now_s - at_s


def _widest(one: tuple[Range, ...], other: tuple[Range, ...]) -> tuple[Range, ...]:
    return tuple(
        Range(min(a.low, b.low), max(a.high, b.high)) for a, b in zip(one, other, strict=True)
    )  # fmt: skip
