"""What a replay says of its sensors: identities and settings over time, and the counters of `status`."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from typing import Any, Final, NoReturn

import numpy as np

from bota_clients.recording.reader import Description, Event, RecordedSensor
from bota_ethercat.control import ErrorCode, Request
from bota_ethercat.control import Event as ServerEvent
from bota_ethercat.errors import RequestError
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import is_finite
from ethercat_server.serving.connection import Connection

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


_STATES: Final[Mapping[str, str]] = {ServerEvent.SENSOR_LOST: "lost", ServerEvent.SENSOR_BACK: "OP"}


class ReplayedSensor:
    """One sensor as the recording last described it."""

    def __init__(self, row: dict[str, Any]) -> None:
        self.row = row
        self._emergencies: int = 0
        self._emergency: dict[str, Any] | None = None
        self._emergency_at = 0.0

    def take_emergency(self, event: Mapping[str, Any]) -> None:
        """An emergency was recorded."""
        self._emergencies += 1
        self._emergency = {key: event.get(key) for key in ("code", "text", "register", "data")}
        self._emergency_at = time.monotonic()

    def emergencies(self) -> dict[str, Any]:
        """Its part of the `status` reply."""
        last = self._emergency and {
            **self._emergency, "ago_s": round(time.monotonic() - self._emergency_at, 3)
        }  # fmt: skip
        return {"emergencies": self._emergencies, "emergency": last}

    def describe(self) -> dict[str, Any]:
        """Its part of the `describe` reply."""
        return self.row


class ReplayedSensors:
    """All sensors, by position; also those without frames, so that positions are kept."""

    handlers: Final = frozenset({"sdo_read", "sdo_write", "configure", "tare"})

    def __init__(self, recorded: Iterable[RecordedSensor]) -> None:
        found = {sensor.sensor: sensor for sensor in recorded}
        self.sensors = [
            ReplayedSensor(_row(position, found.get(position)))
            for position in range(max(found, default=-1) + 1)
        ]

    def describe(self, description: Description) -> None:
        """Take a later description of the recording."""
        rows = description.reply.get("sensors")
        for row in rows if isinstance(rows, list) else ():
            if isinstance(row, dict) and (sensor := self._at(row.get("sensor"))) is not None:
                sensor.row = {**row, "settling": False}  # it was, when it was described

    def take(self, event: Event) -> None:
        """Apply an event of the recording to the descriptions."""
        sensor = self._at(event.event.get("sensor"))
        if sensor is None:
            return
        if event.name == ServerEvent.EMERGENCY:
            sensor.take_emergency(event.event)
        settings = event.event.get("settings")
        if isinstance(settings, dict):
            sensor.row = {**sensor.row, "settings": settings}
            if "rate_hz" in event.event:
                sensor.row["rate_hz"] = event.event["rate_hz"]
        state = _STATES.get(event.name)
        if state is not None:
            sensor.row = {**sensor.row, "state": state}

    def handle(self, connection: Connection, request: Request) -> NoReturn:  # noqa: ARG002
        """Refuse what needs a real sensor."""
        raise RequestError(
            ErrorCode.NOT_READY,
            f"{request.action} needs a sensor, but this is a replay of a recording: connect to the server",
        )

    def _at(self, position: object) -> ReplayedSensor | None:
        known = (
            isinstance(position, int) and not isinstance(position, bool) and 0 <= position < len(self.sensors)
        )
        return self.sensors[position] if known and isinstance(position, int) else None


def _row(position: int, sensor: RecordedSensor | None) -> dict[str, Any]:
    if sensor is None:
        sensor = RecordedSensor(position, "?", 0, "?", "?", 0, 0.0, {}, (), 0)
    return {
        "sensor": position,
        "name": sensor.name,
        "serial": sensor.serial,
        "hardware": sensor.hardware,
        "firmware": sensor.firmware,
        "pdo_size": sensor.pdo_size,
        "rate_hz": int(sensor.rate_hz) if sensor.rate_hz.is_integer() else sensor.rate_hz,
        "state": "OP",
        "settings": dict(sensor.settings),
    }
