"""Everything that the server sends, in order and in batches, across reconnects.

Batches, because waking up for each frame would cost more than all other work on it.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from typing import Any, Final

from clients.recording.file_format import RECORDER
from clients.recording.reader import Description, Event
from protocol.address import Address
from protocol.client import Client
from protocol.control import Event as ServerEvent
from protocol.control import request
from protocol.errors import ConnectionFailedError, RefusedError
from protocol.framing import DataMessage
from protocol.text.json_text import JsonObject

Batch = list[DataMessage | Description | Event]

BATCH_S: Final = 0.02
"""Two sensors at 1600 Hz make 64 frames in this time."""
_RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes that the kernel may buffer, as far as it allows: seconds in which nothing is lost."""
_RETRY_S: Final = 0.5
_MOST_READS: Final = 64
_CHANGES: Final = frozenset({ServerEvent.RECONFIGURED, ServerEvent.SENSOR_BACK})
"""After these events the server is asked to describe itself again."""


class Source:
    """A subscription that is renewed whenever the connection ends.

    Attributes:
        connected: whether there is a connection now.
        description: the newest description, None before `connect`.
    """

    def __init__(self, address: Address, sensors: Sequence[int] | None) -> None:
        """Nothing is sent before `connect`. `sensors` are positions on the bus, None for all."""
        self.address = address
        self.description: JsonObject | None = None
        self._sensors = sensors
        self._client: Client | None = None
        self._retry_at = 0.0
        self._refusal = ""
        self._greeting: Batch = []
        """What is to be said of a connection made anew once its subscription is granted."""
        self._subscribed: JsonObject | None = None
        """The latest reply that granted a subscription."""

    @property
    def connected(self) -> bool:
        """Whether there is a connection now."""
        return self._client is not None

    def connect(self) -> Batch:
        """Connect and subscribe; returns the first batch.

        UnreachableError, ConnectionFailedError or RefusedError.
        """
        client = Client(self.address.port, self.address.host)
        try:
            self._ask(client, "subscribe", **self._subscription())
        except BaseException:
            client.close()
            raise
        # After connecting, so that the TCP window can grow to it.
        client.connection.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self._client, self.description = client, client.description
        same_machine = client.connection.same_machine
        return [_noted("connected", server=str(self.address), same_machine=same_machine)]

    def receive(self) -> Batch:
        """Sleep for BATCH_S, then return everything received; RefusedError if the server refuses."""
        time.sleep(BATCH_S)
        client = self._client
        if client is None:
            return self._connect_again()
        batch: Batch = []
        try:
            for _ in range(_MOST_READS):
                more = client.connection.receive(wait=False)
                self._take(client, batch)
                if not more:
                    break
        except ConnectionFailedError as error:
            self.close()
            batch.append(_noted("disconnected", reason=str(error)))
        except RefusedError as error:
            if self._subscribed is None:
                raise
            # A server that was started again: the sensor may be there the next time.
            self.close()
            known, self._refusal = self._refusal == str(error), str(error)
            batch = [] if known else [_noted("refused", message=f"the server refused: {error}")]
        return batch

    def close(self) -> None:
        """End the connection, if there is one."""
        if self._client is not None:
            self._client.close()
            self._client = None
            self._retry_at = time.monotonic() + _RETRY_S

    def _subscription(self) -> dict[str, Any]:
        # REPEATED frames too: they show that a sensor was silent.
        values: dict[str, Any] = {"fresh_only": False}
        if self._sensors is not None:
            values["sensors"] = list(self._sensors)
        return values

    def _connect_again(self) -> Batch:
        if time.monotonic() < self._retry_at:
            return []
        try:
            self._greeting = self.connect()
        except ConnectionFailedError:
            self._retry_at = time.monotonic() + _RETRY_S
        return []

    def _take(self, client: Client, batch: Batch) -> None:
        while (message := client.connection.next_message()) is not None:
            if isinstance(message, DataMessage):
                batch.append(message)
            elif "event" in message:
                if message.get("source") == RECORDER:
                    del message["source"]  # reserved for the recorder's own events
                batch.append(Event(time.time_ns(), message))
                if message["event"] in _CHANGES:
                    self._ask(client, "describe")
            elif message.get("ok") is not True:
                raise RefusedError.of(message)
            else:
                self.description = self._subscribed = message
                self._refusal = ""
                batch += self._greeting
                self._greeting = []
                batch.append(Description(time.time_ns(), message))

    @staticmethod
    def _ask(client: Client, action: str, **values: Any) -> None:
        client.connection.send(request(action, "record", **values))


def _noted(name: str, **values: object) -> Event:
    """An event of the recorder."""
    return Event(time.time_ns(), {"event": name, "source": RECORDER, **values})


def lost(frames: int, reason: str) -> Event:
    """The event that `frames` frames were received but not recorded."""
    return _noted("lost", frames=frames, reason=reason)
