"""What a replay counts and measures, under the names that the server's `status` has for it."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from clients.replay.sensors import ReplayedSensors
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import is_finite

_MISSED_NS: Final = 10_000_000
_RECENT_NS: Final = 10_000_000_000
_WINDOW: Final = 100_000
"""Number of frames that the distributions cover."""
_REPEATED, _INVALID = int(DataFlag.REPEATED), int(DataFlag.INVALID)
_NO_BUS: Final = {"p50": 0.0, "p99": 0.0, "p999": 0.0, "max": 0.0}


class Meter:
    """Counts frames by sensor, and how late they were sent.

    Attributes:
        sent: number of frames handed to the hub.
    """

    def __init__(self, sensors: ReplayedSensors) -> None:
        self.sent = 0
        self._sensors = sensors
        self._late: deque[tuple[int, int]] = deque(maxlen=_WINDOW)
        """When a frame was sent and how late that was, ns."""
        self._missed = 0
        self._counts: defaultdict[tuple[int, int], int] = defaultdict(int)
        self._not_finite: defaultdict[int, int] = defaultdict(int)
        self._started = time.monotonic()

    def count(self, frame: DataMessage, due_ns: int, now_ns: int) -> None:
        """A frame was sent; `due_ns` is when it was due, 0 if it had no time."""
        self.sent += 1
        old = frame.flags & (_REPEATED | _INVALID)
        self._counts[frame.sensor, old] += 1
        self._not_finite[frame.sensor] += not old and not is_finite(frame.process_data)
        if due_ns:
            self._late.append((now_ns, now_ns - due_ns))
            self._missed += now_ns - due_ns > _MISSED_NS

    def status(self) -> dict[str, Any]:
        """The `status` reply, except for the clients."""
        since_ns = time.monotonic_ns() - _RECENT_NS
        late = _summary_us(late for _, late in self._late)
        recent = _summary_us(late for at_ns, late in self._late if at_ns >= since_ns)
        positions = range(len(self._sensors.sensors))
        return {
            "cycles": self.sent,
            "round_trip": {"least_us": None, "usual_us": None},
            "missed_deadlines": self._missed,
            "lost_frames": 0,
            "duplicate_frames": 0,
            "wake_us": late,
            "exchange_us": _NO_BUS,
            "last_10s": {"wake_us": recent, "exchange_us": _NO_BUS, "age_us": [recent for _ in positions]},
            "sensors": [{**self._of_sensor(position), "age_us": late} for position in positions],
            "uptime_s": round(time.monotonic() - self._started, 3),
        }

    def _of_sensor(self, position: int) -> dict[str, Any]:
        sensor = self._sensors.sensors[position]
        rate_hz = sensor.row.get("rate_hz")
        period_us = 1e6 / rate_hz if isinstance(rate_hz, int | float) and rate_hz > 0 else None
        return {
            "sensor": position,
            "fresh": self._counts[position, 0],
            "repeated": self._counts[position, _REPEATED],
            "invalid": self._counts[position, _INVALID] + self._counts[position, _INVALID | _REPEATED],
            "lost_samples": 0,
            "not_finite": self._not_finite[position],
            "recoveries": 0,
            **sensor.emergencies(),
            "settling": False,
            "clock": {
                "mode": "locked",
                "stamps": "polling",
                "period_us": period_us,
                "offset_ppm": 0.0,
                "uncertainty_us": 0.0,
            },
        }


def _summary_us(late_ns: Iterable[int]) -> dict[str, float]:
    """p50, p99, p999 and max in µs, as `status` gives them."""
    values = np.fromiter(late_ns, np.float64) / 1000
    if not len(values):
        return _NO_BUS
    found = np.percentile(np.maximum(values, 0.0), (50, 99, 99.9, 100)).round(3)
    return dict(zip(_NO_BUS, map(float, found), strict=True))
