"""Statistics of a block of samples of one sensor: mean, standard deviation, rate, warnings, losses."""

from __future__ import annotations

import math
from typing import Any, Final

from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import Sample, SampleDecoder
from bota_ethercat.sensor.warnings_register import explain

_VECTORS: Final = ("force", "torque", "acceleration", "angular_rate")
_LEAST_INTERVALS: Final = 10
"""Minimum number of intervals for a rate."""


class Block:
    """Collects frames; `finish` returns their statistics and starts the next block."""

    def __init__(self) -> None:
        self._decoders: dict[int, SampleDecoder] = {}
        self._last_ns: int | None = None
        self._begin()

    def _begin(self) -> None:
        self._count = self._invalid = self._repeated = self._gaps = self._warnings = 0
        self._first_ns: int | None = self._last_ns
        self._begin_count = 0 if self._last_ns is not None else 1
        self._first: list[float] = []
        self._sums, self._squares = [0.0] * 12, [0.0] * 12
        self._newest: Sample | None = None

    def __bool__(self) -> bool:
        """Whether it has any frames."""
        return bool(self._count or self._invalid or self._repeated)

    def take(self, frame: DataMessage) -> bool:
        """Add a frame; returns whether it is a new sample."""
        self._gaps += bool(frame.flags & DataFlag.GAP)
        if frame.flags & (DataFlag.INVALID | DataFlag.REPEATED):
            invalid = bool(frame.flags & DataFlag.INVALID)
            self._invalid += invalid
            self._repeated += not invalid
            if not invalid and self._newest is None:
                self._newest = self._decode(frame)  # a stuck sensor has nothing newer
            return False
        sample = self._newest = self._decode(frame)
        self._warnings |= sample.warnings
        row = sample.array
        self._first = self._first or row
        for n, (value, start) in enumerate(zip(row, self._first, strict=True)):
            self._sums[n] += value - start
            self._squares[n] += (value - start) ** 2
        if self._first_ns is None:
            self._first_ns = frame.monotonic_ns
        self._last_ns = frame.monotonic_ns
        self._count += 1
        return True

    def _decode(self, frame: DataMessage) -> Sample:
        size = len(frame.process_data)
        return self._decoders.setdefault(size, SampleDecoder(size)).decode(frame.process_data)

    def finish(self) -> dict[str, Any]:
        """The statistics in SI units, ready for JSON."""
        found: dict[str, Any] = {
            "samples": self._count,
            "rate_hz": self._rate_hz(),
            "invalid": self._invalid,
            "repeated": self._repeated,
            "gaps": self._gaps,
        }
        if self._newest is not None:
            count, first = max(1, self._count), self._first or self._newest.array
            means = [s / count for s in self._sums]
            deviations = [
                math.sqrt(max(0.0, q / count - m * m)) for q, m in zip(self._squares, means, strict=True)
            ]
            means = [m + f for m, f in zip(means, first, strict=True)]
            found |= {name: means[3 * n : 3 * n + 3] for n, name in enumerate(_VECTORS)}
            found["deviation"] = {name: deviations[3 * n : 3 * n + 3] for n, name in enumerate(_VECTORS)}
            found["temperature"] = self._newest.temperature
            found["orientation"] = self._newest.orientation
        found["warnings"] = [
            {"severity": row.severity.value, "meaning": row.meaning, "remedy": row.remedy}
            for row in explain(self._warnings)
        ]
        self._begin()
        return found

    def _rate_hz(self) -> float | None:
        intervals = self._count - self._begin_count
        if self._first_ns is None or self._last_ns is None or intervals < _LEAST_INTERVALS:
            return None
        return intervals * 1e9 / (self._last_ns - self._first_ns)
