"""What a replay says of its sensors: identities and settings over time, and the counters of `status`."""

from __future__ import annotations

import time
from collections import Counter
from itertools import takewhile
from typing import Any, Final, NoReturn

from bota_clients.recording.file_format import Note, RecordedDescription, RecordedEvent
from bota_clients.recording.reader import Recording, follow
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.control import ErrorCode, Event, Request, event
from bota_ethercat.errors import RequestError
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import is_finite
from bota_ethercat.stream.timeline import InForce, Timeline
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import rows, whole
from ethercat_server.serving.connection import Connection

_NO_BUS: Final = {"p50": 0.0, "p99": 0.0, "p999": 0.0, "max": 0.0}


class ReplayedSensor:
    """One sensor as the recording last described it, and what was sent of it."""

    def __init__(self, position: int) -> None:
        self.row: dict[str, Any] = {
            "sensor": position, "name": "?", "serial": 0, "hardware": "?", "firmware": "?", "pdo_size": 0,
            "rate_hz": 0.0, "settings": {}, "state": "OP",
        }  # fmt: skip
        self.in_force: InForce | None = None  # if the recording says so
        self._frames = Counter[int]()  # by the flags that say that they are not new
        self._not_finite = 0
        self._emergencies = 0
        self._emergency: dict[str, Any] | None = None
        self._emergency_at = 0.0

    def apply(self, event: RecordedEvent) -> None:
        said = event.event
        if event.name == Event.EMERGENCY:
            self._emergencies += 1
            self._emergency = {key: said.get(key) for key in ("code", "text", "register", "data")}
            self._emergency_at = time.monotonic()

    def count(self, frame: DataMessage) -> None:
        old = frame.flags & NOT_NEW
        self._frames[old] += 1
        self._not_finite += not old and not is_finite(frame.process_data)

    def describe(self) -> dict[str, Any]:
        if self.in_force is None:
            return self.row
        # Its data was settling, if it was, when it was described.
        return self.row | self.said() | {"state": self.in_force.info.state, "settling": False}

    def said(self) -> dict[str, Any]:
        """What replies and events carry of what is in force."""
        assert self.in_force is not None
        return self.in_force.info.as_message()

    def status(self) -> dict[str, Any]:
        rate_hz = self.in_force.info.rate_hz if self.in_force else 0.0
        ago_s = round(time.monotonic() - self._emergency_at, 3)
        return {
            "sensor": self.row["sensor"],
            "fresh": self._frames[0],
            "repeated": self._frames[DataFlag.REPEATED],
            "invalid": self._frames[DataFlag.INVALID] + self._frames[NOT_NEW],
            "lost_samples": 0,
            "not_finite": self._not_finite,
            "recoveries": 0,
            "emergencies": self._emergencies,
            "emergency": self._emergency and {**self._emergency, "ago_s": ago_s},
            "drift": None,
            "history": {"since": None, "peak": [0.0] * 6, "saturations": 0, "saturated_at": None},
            "settling": False,
            "age_us": _NO_BUS,
            "clock": {
                "mode": "locked",
                "stamps": "polling",
                "period_us": 1e6 / rate_hz if rate_hz else None,
                "offset_ppm": 0.0,
                "uncertainty_us": 0.0,
            },
        }


def needs_sensor(action: str) -> RequestError:
    """What needs a real sensor is refused."""
    return RequestError(
        ErrorCode.NOT_READY,
        f"{action} needs a sensor, but this is a replay of a recording: connect to the server",
    )


class ReplayedSensors:
    """All sensors, by position; also those without frames, so that positions are kept.

    Attributes:
        sent: number of frames.
    """

    def __init__(self, recording: Recording) -> None:
        count = max((sensor.sensor + 1 for sensor in recording.sensors), default=0)
        self.sensors = [ReplayedSensor(position) for position in range(count)]
        # As the first subscriber finds them: their description comes before their first frame.
        self._timeline = Timeline()
        for item in takewhile(lambda item: not isinstance(item, DataMessage), recording.everything()):
            if isinstance(item, RecordedDescription):
                self.follow(item)
        self.sent = 0
        self._started = time.monotonic()

    def follow(self, note: Note) -> list[JsonObject]:
        """Take the next description or event of the recording; the events to send."""
        changed = follow(self._timeline, note)
        before = {now.sensor: self.sensors[now.sensor].in_force for now in changed}
        for now in changed:
            self.sensors[now.sensor].in_force = now
        if isinstance(note, RecordedEvent):
            if (sensor := self._at(note.event.get("sensor"))) is not None:
                sensor.apply(note)
            # It was the recorded server that shut down, not this one.
            hidden = note.by_recorder or note.name == Event.SHUTTING_DOWN
            return [] if hidden else [note.event]
        for row in rows(note.reply.get("sensors")):
            if (sensor := self._at(row.get("sensor"))) is not None:
                sensor.row |= row
        return [
            event(Event.RECONFIGURED, sensor=now.sensor, **self.sensors[now.sensor].said())
            for now in changed
            if (was := before[now.sensor]) and was.info.as_message() != now.info.as_message()
        ]

    def count(self, frame: DataMessage) -> None:
        self.sent += 1
        self.sensors[frame.sensor].count(frame)

    def status(self) -> dict[str, Any]:
        """The `status` reply, except for the clients; there are no times of a bus."""
        return {
            "cycles": self.sent,
            "round_trip": {"least_us": None, "usual_us": None},
            "missed_deadlines": 0,
            "lost_frames": 0,
            "duplicate_frames": 0,
            "wake_us": _NO_BUS,
            "exchange_us": _NO_BUS,
            "last_10s": {"wake_us": _NO_BUS, "exchange_us": _NO_BUS, "age_us": [_NO_BUS] * len(self.sensors)},
            "sensors": [sensor.status() for sensor in self.sensors],
            "uptime_s": round(time.monotonic() - self._started, 3),
        }

    def handle(self, connection: Connection, request: Request) -> NoReturn:  # noqa: ARG002
        """Refuse what needs a real sensor."""
        raise needs_sensor(request.action)

    def _at(self, position: object) -> ReplayedSensor | None:
        number = whole(position)
        return self.sensors[number] if number is not None and 0 <= number < len(self.sensors) else None
