"""What the server does for each request: the control channel's actions.

It knows what produces the frames and what answers for the sensors only by what it asks of them, so that a
replay, which has no bus, can be served by it too.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Container, Mapping, Sequence
from typing import Any, Final, Protocol

from ethercat_server import __version__
from ethercat_server.connection import Connection, Subscription
from ethercat_server.hub import Hub
from protocol.control import ACTIONS, PROTOCOL_VERSION, ErrorCode, Request, parse_request, reply
from protocol.errors import RequestError
from protocol.json_text import JsonObject

_MOST_EXPLAINED: Final = 32
"""With more sensors `describe` leaves out what their settings mean: a reply has 65536 bytes at most."""

log = logging.getLogger(__name__)


class Producer(Protocol):
    """What produces the frames: the server's `Cycle`."""

    def status(self) -> dict[str, Any]:
        """Its part of the `status` reply."""
        ...

    def stop(self) -> None:
        """End soon."""
        ...


class Described(Protocol):
    """A sensor."""

    def describe(self) -> dict[str, Any]:
        """Its part of the `describe` reply."""
        ...


class OnSensors(Protocol):
    """What answers for the sensors: the server's `SensorActions`."""

    @property
    def sensors(self) -> Sequence[Described]:
        """All of them, by place."""
        ...

    @property
    def handlers(self) -> Container[str]:
        """The actions that it takes."""
        ...

    def handle(self, connection: Connection, request: Request) -> None:
        """Take one, and answer later through the hub; RequestError refuses it."""
        ...


class Actions:
    """Answers requests. One method an action, found by its name."""

    def __init__(
        self, hub: Hub, cycle: Producer, on_sensors: OnSensors, extra: Mapping[str, Any] | None = None
    ) -> None:
        """`extra` is what `describe` says besides."""
        self._hub = hub
        self._cycle = cycle
        self._extra = extra or {}
        self._on_sensors = on_sensors
        self._sensors = on_sensors.sensors
        self._handlers: dict[str, Callable[[Connection, Request], JsonObject]] = {
            "describe": self._describe,
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "status": self._status,
            "shutdown": self._shutdown,
        }

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject | None:
        """The reply to `message`, None if it comes later; RequestError refuses it."""
        request = parse_request(message)
        action = ACTIONS[request.action]
        if action.framed_only and connection.framed is None:
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                f"{request.action} works on framed connections only: a bare JSON connection carries no DATA",
            )
        if action.controls and not self._hub.door.may_control(connection):
            kind = f"{connection.uid} {request.action}"
            log.warning("%s: %s denied", connection, request.action, extra={"kind": kind})
            raise RequestError(ErrorCode.DENIED, _denial(request.action, connection.uid))
        if request.action in self._on_sensors.handlers:
            self._on_sensors.handle(connection, request)
            return None
        return self._handlers[request.action](connection, request)

    def _describe(self, _: Connection, request: Request) -> JsonObject:
        rows = [sensor.describe() for sensor in self._sensors]
        if len(rows) > _MOST_EXPLAINED:
            rows = [{key: value for key, value in row.items() if key != "meaning"} for row in rows]
        return reply(request, protocol=PROTOCOL_VERSION, version=__version__, sensors=rows, **self._extra)

    def _subscribe(self, connection: Connection, request: Request) -> JsonObject:
        places = request.values["sensors"]
        absent = [place for place in places or () if place >= len(self._sensors)]
        if absent:
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                f"the key 'sensors' names sensor {absent[0]}, but the bus has {len(self._sensors)}, "
                "counted from 0",
            )
        connection.subscription = Subscription(
            len(self._sensors), places, request.values["every"], request.values["fresh_only"]
        )
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

    def _shutdown(self, _: Connection, request: Request) -> JsonObject:
        self._cycle.stop()
        return reply(request)


def _denial(action: str, uid: int | None) -> str:
    if uid is None:
        return (
            f"{action} is refused because the kernel does not say which user of this machine you are: ask "
            "from this machine and keep the connection open until the reply is there"
        )
    return (
        f"{action} is not for uid {uid}, but for root, the server's own user, the one who ran sudo and those "
        "named with --control-user or --control-group: run the client as one of them"
    )
