"""The actions of the control channel: what the server does for each request.

What produces the frames and what acts on the sensors are known here as protocols only: a replay, which has
no bus, is served by the same code.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

from bota_ethercat.address import boot_id
from bota_ethercat.control import ACTIONS, PROTOCOL_VERSION, ErrorCode, Request, parse_request, reply
from bota_ethercat.errors import RequestError
from bota_ethercat.program.version import VERSION
from bota_ethercat.sensor_choice import SensorChoice
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.serving.connection import Connection
from ethercat_server.serving.hub import Hub

# With more sensors `describe` omits the meaning of their settings: a reply has at most 65536 bytes.
_MOST_EXPLAINED: Final = 32

log = logging.getLogger(__name__)


class Producer(Protocol):
    """What produces the frames: the server's `Cycle`."""

    def status(self) -> dict[str, Any]:
        """Its part of the `status` reply."""

    def trace(self, offset: int) -> dict[str, Any]:
        """A part of a trace of its exchanges from `offset` on; RequestError if there is none."""

    def stop(self) -> None:
        """End soon."""


class Described(Protocol):
    """A sensor."""

    def describe(self) -> dict[str, Any]:
        """Its part of the `describe` reply."""


class OnSensors(Protocol):
    """What acts on the sensors: the server's `SensorActions`."""

    @property
    def sensors(self) -> Sequence[Described]:
        """All of them, by number."""

    def handle(self, connection: Connection, request: Request) -> None:
        """Start what `request` asks of the sensor whose number it has, and answer later through the hub.

        RequestError refuses it.
        """


class Actions:
    """Answers requests: one method for each action."""

    def __init__(
        self, hub: Hub, cycle: Producer, on_sensors: OnSensors, extra: Callable[[], Mapping[str, Any]] = dict
    ) -> None:
        """What `extra` returns is added to the reply of `describe`."""
        self._hub = hub
        self._cycle = cycle
        boot = boot_id()
        self._extra: Callable[[], dict[str, Any]] = lambda: {
            **({} if boot is None else {"boot_id": boot}),
            **extra(),
        }
        self._on_sensors = on_sensors
        self._sensors = on_sensors.sensors
        self._handlers: dict[str, Callable[[Connection, Request], JsonObject]] = {
            "describe": self._describe,
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "status": self._status,
            "trace": self._trace,
            "shutdown": self._shutdown,
        }

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject | None:
        """The reply to `message`, None if it comes later; RequestError refuses it."""
        request = parse_request(message)
        action = ACTIONS[request.action]
        if action.framed_only and connection.framed is None:
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                f"{request.action} needs a framed connection: a bare JSON connection carries no DATA",
            )
        if action.controls and not self._hub.permissions.may_control(connection):
            kind = f"{connection.uid} {request.action}"
            log.warning("%s: %s denied", connection, request.action, extra={"kind": kind})
            uid = connection.uid
            who = None if uid is None else self._hub.permissions.name(uid)
            raise RequestError(ErrorCode.DENIED, _denial(request.action, who))
        if "sensor" in action.parameters:
            values = {**request.values, "sensor": self._number(request.values["sensor"])}
            self._on_sensors.handle(connection, request._replace(values=values))
            return None
        return self._handlers[request.action](connection, request)

    def _number(self, choice: SensorChoice) -> int:
        rows = [sensor.describe() for sensor in self._sensors]
        found = [row["sensor"] for row in rows if choice.matches(row["sensor"], row["name"], row["serial"])]
        if len(found) != 1:
            available = "; ".join("{sensor}: {name} with serial {serial}".format(**row) for row in rows)
            problem = f"{len(found)} sensors match" if found else "no sensor"
            raise RequestError(ErrorCode.BAD_REQUEST, f"{problem} {choice} (available: {available})")
        return int(found[0])

    def _describe(self, _: Connection, request: Request) -> JsonObject:
        rows = [sensor.describe() for sensor in self._sensors]
        if len(rows) > _MOST_EXPLAINED:
            rows = [{key: value for key, value in row.items() if key != "meaning"} for row in rows]
        return reply(request, protocol=PROTOCOL_VERSION, version=VERSION, sensors=rows, **self._extra())

    def _subscribe(self, connection: Connection, request: Request) -> JsonObject:
        wanted: list[bool] = []
        for kind, rows in ("sensor", self._sensors), ("terminal", self._extra().get("terminals", ())):
            numbers = request.values[f"{kind}s"]
            if absent := [number for number in numbers or () if number >= len(rows)]:
                raise RequestError(
                    ErrorCode.BAD_REQUEST,
                    f"the key '{kind}s' names {kind} {absent[0]}, but the bus has {len(rows)}, counted "
                    "from 0",
                )
            wanted += [numbers is None or number in numbers for number in range(len(rows))]
        connection.subscribe(wanted, request.values["every"], request.values["fresh_only"])
        self._hub.subscriptions_changed()
        return self._describe(connection, request)

    def _unsubscribe(self, connection: Connection, request: Request) -> JsonObject:
        connection.subscription = None
        self._hub.subscriptions_changed()
        return reply(request)

    def _status(self, _: Connection, request: Request) -> JsonObject:
        clients = [
            {"peer": c.peer, "sent": c.outbox.sent, "withheld": c.outbox.withheld}
            for c in self._hub.connections.values()
        ]
        return reply(request, **self._cycle.status(), clients=clients)

    def _trace(self, _: Connection, request: Request) -> JsonObject:
        return reply(request, **self._cycle.trace(request.values["offset"]))

    def _shutdown(self, _: Connection, request: Request) -> JsonObject:
        self._cycle.stop()
        return reply(request)


def _denial(action: str, who: str | None) -> str:
    if who is None:
        return (
            f"{action} is denied because your user is not known: connect from this machine and keep the "
            "connection open until the reply has arrived"
        )
    return (
        f"{action} is denied to {who}: only root, the server's own user, the user who ran sudo and those "
        "named with --control-user or --control-group (control_users, control_groups in a file) may do that"
    )
