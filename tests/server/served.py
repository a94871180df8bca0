"""A hub with clients in memory, on a clock that stands still until the hub waits or the test advances it."""

from __future__ import annotations

import json

from bota_ethercat.control import parse_request, reply
from bota_ethercat.framing import DataMessage, FrameDecoder, encode_data, encode_json
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.serving.connection import Connection, Subscription
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.in_memory import InMemoryStream, InMemoryTransport, ManualClock

TURN_NS = 1_250_000
"""Time between two deadlines: the acquisition loop's at 800 Hz."""


class Served:
    """The hub, its clock, and what clients do."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.transport = InMemoryTransport(self.clock)
        self.hub = Hub(self.transport, self.clock.monotonic_ns)
        self.hub.start(self.handle)
        self.sequence = 0

    def handle(self, connection: Connection, message: JsonObject) -> JsonObject:
        request = parse_request(message)
        if request.action == "subscribe":
            values = request.values
            connection.subscription = Subscription(
                2, values["sensors"], values["every"], values["fresh_only"]
            )
            self.hub.subscriptions_changed()
        return reply(request)

    def serve(self, seconds: float = 0.02) -> None:
        """Turns of the loop until this much time has passed."""
        span_ns = round(seconds * 1e9)
        end_ns, turn_ns = self.clock.now_ns + span_ns, max(TURN_NS, span_ns // 1000)
        while self.clock.now_ns < end_ns:
            self.hub.serve(min(end_ns, self.clock.now_ns + turn_ns))

    def connect(self, uid: int | None = 0, *, buffer_size: int = 65536) -> InMemoryStream:
        client = self.transport.connect(uid, buffer_size=buffer_size)
        self.serve()
        return client

    def subscribe(self, *, buffer_size: int = 65536, **keys: object) -> InMemoryStream:
        client = self.connect(buffer_size=buffer_size)
        client.send(encode_json({"action": "subscribe", **keys}))
        assert self.read(client) == [{"reply": "subscribe", "ok": True}]
        return client

    def publish(self, position: int = 0, flags: int = 0, now_ns: int | None = None) -> None:
        frame = encode_data(self.sequence, 1, 2, position, flags, 3, bytes(61))
        self.hub.publish([(frame, position, flags)], self.clock.now_ns if now_ns is None else now_ns)
        self.sequence += 1

    def read(self, client: InMemoryStream) -> list[DataMessage | JsonObject]:
        """Everything that arrives within a few turns, decoded."""
        self.serve()
        decoder = FrameDecoder()
        decoder.feed(client.recv_all())
        return list(decoder)

    def read_lines(self, client: InMemoryStream) -> list[JsonObject]:
        """The same of a bare JSON connection."""
        self.serve()
        return [json.loads(line) for line in client.recv_all().splitlines()]

    def sequences(self, client: InMemoryStream) -> list[int]:
        """The sequence numbers of the DATA that arrives."""
        return [message.sequence for message in self.read(client) if isinstance(message, DataMessage)]

    def is_closed(self, client: InMemoryStream) -> bool:
        """Whether the server closes the connection, once everything that it sent was read."""
        self.serve(0.1)
        client.recv_all()
        return client.at_end
