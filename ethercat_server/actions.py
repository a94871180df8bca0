"""What the server does for each request: the control channel's actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ethercat_server import __version__
from ethercat_server.authority import may_control
from ethercat_server.connection import Connection, Subscription
from ethercat_server.cycle import Cycle
from ethercat_server.hub import Hub
from ethercat_server.sensor import Sensor
from protocol.control import ACTIONS, PROTOCOL_VERSION, ErrorCode, Request, parse_request, reply
from protocol.errors import RequestError
from protocol.framing import JsonObject


class Actions:
    """Answers requests. One method an action, found by its name."""

    def __init__(self, hub: Hub, cycle: Cycle, sensors: Sequence[Sensor]) -> None:
        self._hub = hub
        self._cycle = cycle
        self._sensors = sensors
        self._handlers: dict[str, Callable[[Connection, Request], JsonObject]] = {
            "describe": self._describe,
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "status": self._status,
            "shutdown": self._shutdown,
        }

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject:
        """The reply to `message`; RequestError refuses it."""
        request = parse_request(message)
        action = ACTIONS[request.action]
        if action.framed_only and connection.framed is None:
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                f"{request.action} works on framed connections only: a bare JSON connection carries no DATA",
            )
        if action.controls and not may_control(connection.sock):
            raise RequestError(
                ErrorCode.DENIED,
                f"{request.action} is for root, the server's own user and the user who ran sudo: "
                "run the client as one of them",
            )
        return self._handlers[request.action](connection, request)

    def _describe(self, _: Connection, request: Request) -> JsonObject:
        return reply(
            request,
            protocol=PROTOCOL_VERSION,
            version=__version__,
            sensors=[sensor.describe() for sensor in self._sensors],
        )

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
            {"peer": c.peer, "sent": c.sent, "withheld": c.withheld} for c in self._hub.connections.values()
        ]
        return reply(request, **self._cycle.status(), clients=clients)

    def _shutdown(self, _: Connection, request: Request) -> JsonObject:
        self._cycle.stop()
        return reply(request)
