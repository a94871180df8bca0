"""The recorded sensors as the server's actions see them: they describe themselves and can do nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final, NoReturn

from clients.recording.reader import Description, Event, RecordedSensor
from ethercat_server.connection import Connection
from protocol.control import ErrorCode, Request
from protocol.control import Event as ServerEvent
from protocol.errors import RequestError

_STATES: Final[Mapping[str, str]] = {ServerEvent.SENSOR_LOST: "lost", ServerEvent.SENSOR_BACK: "OP"}


class ReplayedSensor:
    """One sensor as the recording last described it."""

    def __init__(self, row: dict[str, Any]) -> None:
        self.row = row

    def describe(self) -> dict[str, Any]:
        """Its part of the `describe` reply."""
        return self.row


class ReplayedSensors:
    """All sensors, by place; also those that have no frames, so that places are as they were."""

    handlers: Final = frozenset({"sdo_read", "sdo_write", "configure", "tare"})

    def __init__(self, recorded: Iterable[RecordedSensor]) -> None:
        found = {sensor.sensor: sensor for sensor in recorded}
        self.sensors = [
            ReplayedSensor(_row(place, found.get(place))) for place in range(max(found, default=-1) + 1)
        ]

    def describe(self, description: Description) -> None:
        """The recording describes them anew."""
        rows = description.reply.get("sensors")
        for row in rows if isinstance(rows, list) else ():
            if isinstance(row, dict) and (sensor := self._at(row.get("sensor"))) is not None:
                sensor.row = row

    def take(self, event: Event) -> None:
        """What an event of the recording changes in what `describe` says."""
        sensor = self._at(event.event.get("sensor"))
        if sensor is None:
            return
        settings = event.event.get("settings")
        if isinstance(settings, dict):
            sensor.row = {**sensor.row, "settings": settings}
        state = _STATES.get(event.name)
        if state is not None:
            sensor.row = {**sensor.row, "state": state}

    def handle(self, connection: Connection, request: Request) -> NoReturn:  # noqa: ARG002
        """Refuse everything that only a sensor can do."""
        raise RequestError(
            ErrorCode.NOT_READY,
            f"{request.action} needs a sensor, and this is a replay of a recording: ask the server itself",
        )

    def _at(self, place: object) -> ReplayedSensor | None:
        known = isinstance(place, int) and not isinstance(place, bool) and 0 <= place < len(self.sensors)
        return self.sensors[place] if known and isinstance(place, int) else None


def _row(place: int, sensor: RecordedSensor | None) -> dict[str, Any]:
    if sensor is None:
        sensor = RecordedSensor(place, "?", 0, "?", "?", 0, 0.0, {}, (), 0)
    return {
        "sensor": place,
        "name": sensor.name,
        "serial": sensor.serial,
        "hardware": sensor.hardware,
        "firmware": sensor.firmware,
        "pdo_size": sensor.pdo_size,
        "rate_hz": int(sensor.rate_hz) if sensor.rate_hz.is_integer() else sensor.rate_hz,
        "state": "OP",
        "settings": dict(sensor.settings),
    }
