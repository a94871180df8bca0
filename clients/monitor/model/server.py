"""The model: the server, its sensors and its clients.

One thread feeds it, another reads its state; a lock protects it. Its methods take the time as an argument,
except for the time of day.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from itertools import groupby
from operator import attrgetter
from typing import Any, Final

from clients.monitor.model.sensor import SensorModel, spread
from clients.monitor.model.state import Client, Message, ServerState, State
from protocol.accounting import NOT_NEW
from protocol.control import Event
from protocol.framing import DataMessage
from protocol.pdo import ImuUnits
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import number, rows, text, whole

_POSITION: Final = attrgetter("sensor")
_MESSAGE_S: Final = 30.0
"""How long a message is shown."""


class Model:
    """Takes everything that the server sends."""

    def __init__(self, address: str, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        self._lock = threading.Lock()
        self._address = address
        self._imu_units = imu_units
        self._sensors: dict[int, SensorModel] = {}
        self._connected = False
        self._since: tuple[float, str] | None = None
        self._reason = ""
        self._heard_s = 0.0
        self._version = self._replay = ""
        self._own_peer = ""
        self._status: JsonObject = {}
        self._status_s = 0.0
        self._clients: tuple[Client, ...] = ()
        self._message: Message | None = None
        self._message_ends_s = 0.0
        """0: it has not been shown yet."""
        self._events: deque[str] = deque(maxlen=8)

    def connected(self, description: JsonObject, own_peer: str, now_s: float) -> None:
        """Connected; `own_peer` is the address of this end, as in `status`."""
        with self._lock:
            again = self._since is not None
            self._connected, self._reason = True, ""
            self._since = (now_s, clock_text())
            self._heard_s, self._own_peer = now_s, own_peer
            self._status, self._clients = {}, ()
            for sensor in self._sensors.values():
                sensor.restart(now_s, again=again)
            self._describe(description, now_s)

    def described(self, description: JsonObject, now_s: float) -> None:
        """A later reply to `describe`."""
        with self._lock:
            self._describe(description, now_s)

    def gone(self, reason: str, now_s: float) -> None:
        """Disconnected, for this reason."""
        with self._lock:
            if self._connected or self._since is None:
                self._since = (now_s, clock_text())
            self._connected, self._reason = False, text(reason)
            self._clients = ()

    def take(self, frames: Sequence[DataMessage], now_s: float) -> None:
        """Take frames in order of arrival."""
        with self._lock:
            if frames:
                self._heard_s = now_s
            for position, of_one in groupby(sorted(frames, key=_POSITION), _POSITION):
                sensor = self._sensors.get(position)
                if sensor is not None:
                    sensor.take(list(of_one), now_s)

    def note_age(self, frame: DataMessage, now_ns: int) -> None:
        """This frame arrived exactly at this CLOCK_MONOTONIC."""
        with self._lock:
            sensor = self._sensors.get(frame.sensor)
            if sensor is not None and not frame.flags & NOT_NEW:
                sensor.meter.note_age((now_ns - frame.monotonic_ns) * 1e-3, now_ns * 1e-9)
                sensor.judgement.note_age(frame, now_ns)

    def take_status(self, status: JsonObject, now_s: float) -> None:
        """A reply to `status`."""
        with self._lock:
            self._heard_s = now_s
            last_10s = status.get("last_10s")
            ages: Any = last_10s.get("age_us") if isinstance(last_10s, dict) else None
            for position, row in enumerate(rows(status.get("sensors"))):
                sensor = self._sensor(row)
                if sensor is not None:
                    known = isinstance(ages, list) and position < len(ages)
                    row["missed_deadlines"] = status.get("missed_deadlines")
                    sensor.take_status(row, ages[position] if known else None, now_s)
            self._take_clients(rows(status.get("clients")), now_s - self._status_s)
            self._status, self._status_s = status, now_s

    def take_event(self, event: JsonObject, now_s: float) -> None:
        """An event of the server."""
        with self._lock:
            self._heard_s = now_s
            position = whole(event.get("sensor"))
            name, said = text(event.get("event")), text(event.get("message"))
            sensor = self._sensor(event)
            if name == Event.SENSOR_LOST and sensor is not None:
                sensor.lost(said or "The server has lost this sensor")
            elif name == Event.SENSOR_BACK and sensor is not None:
                sensor.lost(None)
            elif name == Event.OFFSET_CHANGED and sensor is not None:
                sensor.reset_peaks()
            where = "" if position is None else f" {position}"
            self._events.append(f"{clock_text()} {name}{where}{': ' + said if said else ''}")

    def reset(self) -> None:
        """Reset peaks and past warnings."""
        with self._lock:
            for sensor in self._sensors.values():
                sensor.reset()

    def say(self, message: str, *, bad: bool = False) -> None:
        """Set the message for the user."""
        with self._lock:
            self._message = Message(text(message), bad) if message else None
            self._message_ends_s = 0.0

    def state(self, now_s: float) -> State:
        """The current state."""
        with self._lock:
            self._message_ends_s = self._message_ends_s or now_s + _MESSAGE_S
            if now_s > self._message_ends_s:
                self._message = None
            server = self._server(now_s)
            speaks = server.connected and not server.silent
            return State(
                server=server,
                sensors=tuple(
                    self._sensors[position].state(now_s, server_speaks=speaks)
                    for position in sorted(self._sensors)
                ),
                clients=self._clients,
                message=self._message,
                events=tuple(self._events),
            )

    def _describe(self, description: JsonObject, now_s: float) -> None:
        self._version = text(description.get("version"))
        self._replay = _replay(description.get("replay"))
        found = {}
        for row in rows(description.get("sensors")):
            position = whole(row.get("sensor"))
            if position is not None:
                found[position] = self._sensors.get(position) or SensorModel(position, self._imu_units)
                found[position].describe(row, now_s)
        self._sensors = found

    def _sensor(self, row: JsonObject) -> SensorModel | None:
        position = whole(row.get("sensor"))
        return None if position is None else self._sensors.get(position)

    def _take_clients(self, found: Iterable[JsonObject], seconds: float) -> None:
        before = {client.peer: client.sent for client in self._clients}
        clients = []
        for row in found:
            peer, sent = text(row.get("peer")), whole(row.get("sent")) or 0
            rate = (sent - before[peer]) / seconds if peer in before and seconds > 0 else None
            clients.append(Client(peer, peer == self._own_peer, rate, sent, whole(row.get("withheld")) or 0))
        self._clients = tuple(sorted(clients, key=lambda c: (not c.is_this, -c.withheld, -c.sent)))

    def _server(self, now_s: float) -> ServerState:
        status = self._status
        last_10s = status.get("last_10s")
        timing = last_10s if isinstance(last_10s, dict) else status
        uptime_s = number(status.get("uptime_s"))
        if uptime_s is not None and self._connected:
            uptime_s += now_s - self._status_s
        return ServerState(
            address=self._address,
            connected=self._connected,
            since_s=None if self._since is None else now_s - self._since[0],
            since_clock="" if self._since is None else self._since[1],
            reason=self._reason,
            heard_s=now_s - self._heard_s if self._connected else None,
            version=self._version,
            replay=self._replay,
            uptime_s=uptime_s,
            cycles=whole(status.get("cycles")),
            missed_deadlines=whole(status.get("missed_deadlines")),
            lost_frames=whole(status.get("lost_frames")),
            wake_us=spread(timing.get("wake_us")),
            exchange_us=spread(timing.get("exchange_us")),
        )


def _replay(given: Any) -> str:
    """What a replay plays; empty for a server with sensors."""
    if not isinstance(given, dict):
        return ""
    files = given.get("files")
    names = [text(name) for name in files] if isinstance(files, list) else []
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"{names[0]}{more}" if names else "a recording"


def clock_text() -> str:
    """The time of day."""
    return time.strftime("%H:%M:%S")
