"""The recorded sensors, as the server's actions see them: they describe themselves and refuse all else."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any, Final, NoReturn

from clients.recording.reader import Description, Event, RecordedSensor
from ethercat_server.serving.connection import Connection
from protocol.control import ErrorCode, Request
from protocol.control import Event as ServerEvent
from protocol.errors import RequestError

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
