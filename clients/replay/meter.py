"""What a replay counts and measures, under the names that the server's `status` has for it."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any, Final

from clients.replay.sensors import ReplayedSensors
from ethercat_server.distribution import SLOT_NS, RecentDistribution
from protocol.framing import DataFlag, DataMessage

_MISSED_NS: Final = 10_000_000
_REPEATED, _INVALID = int(DataFlag.REPEATED), int(DataFlag.INVALID)


class Meter:
    """Counts frames by sensor, and how late they went out.

    Attributes:
        sent: frames handed out.
    """

    def __init__(self, sensors: ReplayedSensors) -> None:
        self.sent = 0
        self._sensors = sensors
        self._late = RecentDistribution()
        self._exchange = RecentDistribution()
        """Stays empty: there is no bus."""
        self._missed = 0
        self._counts: defaultdict[tuple[int, int], int] = defaultdict(int)
        self._started = time.monotonic()
        self._roll_at_ns = 0

    def count(self, frame: DataMessage, due_ns: int, now_ns: int) -> None:
        """A frame went out; `due_ns` is when it was to, 0 if at no certain time."""
        self.sent += 1
        self._counts[frame.sensor, frame.flags & (_REPEATED | _INVALID)] += 1
        if due_ns:
            self._late.record(now_ns - due_ns)
            self._missed += now_ns - due_ns > _MISSED_NS
        if now_ns >= self._roll_at_ns:
            self._roll_at_ns = now_ns + SLOT_NS
            self._late.roll()

    def status(self) -> dict[str, Any]:
        """The `status` reply, but for the clients."""
        late, recent_late = self._late.summaries_us()
        exchange, recent_exchange = self._exchange.summaries_us()
        places = range(len(self._sensors.sensors))
        return {
            "cycles": self.sent,
            "missed_deadlines": self._missed,
            "lost_frames": 0,
            "wake_us": late,
            "exchange_us": exchange,
            "last_10s": {
                "wake_us": recent_late,
                "exchange_us": recent_exchange,
                "age_us": [recent_late for _ in places],
            },
            "sensors": [{**self._of_sensor(place), "age_us": late} for place in places],
            "uptime_s": round(time.monotonic() - self._started, 3),
        }

    def _of_sensor(self, place: int) -> dict[str, Any]:
        rate_hz = self._sensors.sensors[place].row.get("rate_hz")
        period_us = 1e6 / rate_hz if isinstance(rate_hz, int | float) and rate_hz > 0 else None
        return {
            "sensor": place,
            "fresh": self._counts[place, 0],
            "repeated": self._counts[place, _REPEATED],
            "invalid": self._counts[place, _INVALID] + self._counts[place, _INVALID | _REPEATED],
            "lost_samples": 0,
            "recoveries": 0,
            "clock": {"mode": "locked", "period_us": period_us, "offset_ppm": 0.0, "uncertainty_us": 0.0},
        }
