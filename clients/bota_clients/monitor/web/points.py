"""Frames as points of the page's traces: the extremes of every 10 ms, so that no peak is lost.

A message to the page, little-endian: u8 kind (1), u8 position of the sensor, u16 number of points n,
u32 1 if the page was not sent the points before because it was slow, else 0, f64 time t0; then f32: 13 values
of the newest sample, n times after t0, and n values of each of the 13 channels. Times are the server's
CLOCK_MONOTONIC in seconds, values in SI units or counts; NaN: not a finite number.
"""

from __future__ import annotations

import math
import struct
import threading
from array import array
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Final

from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.observer import COMMON
from bota_ethercat.pdo import STANDARD_GRAVITY, ImuUnits, PdoType

STEP_NS: Final = 10_000_000
KIND: Final = 1
HEADER: Final = struct.Struct("<BBHId")
MOST_POINTS: Final = 4096  # that wait to be taken: 20 s

# Six axes of the wrench, acceleration, angular rate, temperature.
CHANNELS: Final = tuple(field.name for field in COMMON.fields if field.type is PdoType.REAL)

Values = tuple[float, ...]


def start_s(batch: bytes) -> float:
    """The time of its first point."""
    return float(HEADER.unpack_from(batch)[4])


def after_skipped(batch: bytes) -> bytes:
    """The same for a page that was not sent the points before."""
    kind, position, count, _, start = HEADER.unpack_from(batch)
    return HEADER.pack(kind, position, count, 1, start) + batch[HEADER.size :]


def _scales(imu_units: ImuUnits) -> Values:
    """The factor of each channel from the process data's units to SI."""
    of_imu = {"acceleration": STANDARD_GRAVITY, "angular_rate": math.pi / 180.0}
    factors = {} if imu_units is ImuUnits.SI else of_imu
    return tuple(factors.get(name.split(".")[0], 1.0) for name in CHANNELS)


class _Points:
    """One sensor's. A step with one sample is one point, others are two: the extremes of each channel."""

    def __init__(self, scale: Values) -> None:
        self._scale = scale
        self._times: list[int] = []
        self._rows: list[Values] = []
        self._points: deque[tuple[int, Values]] = deque(maxlen=MOST_POINTS)
        self._newest: Values = ()
        self.last = (-1, -1)  # number and time of the newest frame

    def take(self, frames: Iterable[DataMessage]) -> None:
        """Frames of this sensor as they came; REPEATED, INVALID and old ones bring nothing."""
        unpack_from = COMMON.reals.unpack_from
        for sequence, _, time_ns, _, flags, _, process_data in frames:
            if flags & NOT_NEW or (sequence <= self.last[0] and time_ns <= self.last[1]):
                continue
            if self._times and time_ns // STEP_NS != self._times[0] // STEP_NS:
                self._end_step()
            self.last = sequence, time_ns
            self._times.append(time_ns)
            self._newest = unpack_from(process_data)
            self._rows.append(self._newest)

    def batch(self, position: int, *, silent: bool = False) -> bytes | None:
        """The points since the last one, as a message; None without any. `silent`: end the step now."""
        if silent and self._times:
            self._end_step()
        points = list(self._points)
        if not points:
            return None
        self._points.clear()
        start_ns = points[0][0]
        newest = [value * scale for value, scale in zip(self._newest, self._scale, strict=True)]
        body = array("f", newest)
        body.extend((time_ns - start_ns) * 1e-9 for time_ns, _ in points)
        columns = zip(*(values for _, values in points), strict=True)
        for column, scale in zip(columns, self._scale, strict=True):
            body.extend(column if scale == 1.0 else [value * scale for value in column])
        header = HEADER.pack(KIND, position, len(points), 0, start_ns * 1e-9)
        return header + body.tobytes()

    def _end_step(self) -> None:
        first, second = zip(*map(_extremes, zip(*self._rows, strict=True)), strict=True)
        self._points.append((self._times[0], first))
        if len(self._rows) > 1:
            self._points.append((self._times[-1], second))
        self._times.clear()
        self._rows.clear()


def _extremes(column: Values) -> tuple[float, float]:
    """Minimum and maximum in the order in which they came."""
    if not math.isfinite(sum(column)):
        column = tuple(value for value in column if math.isfinite(value)) or (math.nan,)
    low, high = min(column), max(column)
    return (low, high) if column.index(low) < column.index(high) else (high, low)


class Feed:
    """The points of all sensors. One thread feeds it, another takes the batches."""

    def __init__(self, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        self._lock = threading.Lock()
        self._scale = _scales(imu_units)
        self._points: dict[int, _Points] = {}

    def restart(self) -> None:
        """A new connection to the server."""
        with self._lock:
            for points in self._points.values():
                points.last = (-1, -1)  # the server may count from the beginning again

    def take(self, frames: Sequence[DataMessage]) -> None:
        """Frames of any sensors in order of arrival."""
        with self._lock:
            for position in {frame.sensor for frame in frames}:
                points = self._points.setdefault(position, _Points(self._scale))
                points.take(frame for frame in frames if frame.sensor == position)

    def batches(self, *, silent: bool = False) -> dict[int, bytes]:
        """The messages that are due, by position."""
        with self._lock:
            made = {p: points.batch(p, silent=silent) for p, points in self._points.items()}
        return {position: batch for position, batch in made.items() if batch is not None}
