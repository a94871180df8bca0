"""Everything that the server sends, in order and in batches, across reconnects.

Batches, because waking up for each frame would cost more than all other work on it.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Sequence
from typing import Final

from clients.recording.file_format import RECORDER
from clients.recording.reader import Description, Event
from protocol.address import Address
from protocol.client import Client
from protocol.control import Event as ServerEvent
from protocol.control import request
from protocol.errors import ConnectionFailedError, RefusedError
from protocol.framing import DataMessage
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import rows

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
    """A subscription that is renewed whenever the connection ends, to those of the sensors that are there.

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
            there = {row.get("sensor") for row in rows(client.description.get("sensors"))}
            missing = set[int]() if self.description is None else {*(self._sensors or ())} - there
            wanted = self._sensors and [sensor for sensor in self._sensors if sensor not in missing]
            # After connecting, so that the TCP window can grow to it.
            client.connection.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            # REPEATED frames too: they show that a sensor was silent.
            client.subscribe(wanted, fresh_only=False)
        except BaseException:
            client.close()
            raise
        self._client, self.description, self._refusal = client, client.description, ""
        said = {"message": f"without sensor {', '.join(map(str, sorted(missing)))}"} if missing else {}
        same_machine = client.connection.same_machine
        batch: Batch = [_noted("connected", server=str(self.address), same_machine=same_machine, **said)]
        batch.append(Description(time.time_ns(), client.description))
        with contextlib.suppress(ConnectionFailedError):  # `receive` will find that, too
            batch += client.receive(0.0)
            for event in client.events:
                self._happened(client, event, batch)
        return batch

    def receive(self) -> Batch:
        """Sleep for BATCH_S, then return everything received."""
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
        except (ConnectionFailedError, RefusedError) as error:
            self.close()
            batch.append(_noted("disconnected", reason=str(error)))
        return batch

    def close(self) -> None:
        """End the connection, if there is one."""
        if self._client is not None:
            self._client.close()
            self._client = None
            self._retry_at = time.monotonic() + _RETRY_S

    def _connect_again(self) -> Batch:
        if time.monotonic() < self._retry_at:
            return []
        try:
            return self.connect()
        except (ConnectionFailedError, RefusedError) as error:
            self._retry_at = time.monotonic() + _RETRY_S
            if not isinstance(error, RefusedError) or str(error) == self._refusal:
                return []
            self._refusal = str(error)
            return [_noted("disconnected", reason=self._refusal)]

    def _take(self, client: Client, batch: Batch) -> None:
        while (message := client.connection.next_message()) is not None:
            if isinstance(message, DataMessage):
                batch.append(message)
            elif "event" in message:
                self._happened(client, message, batch)
            elif message.get("ok") is not True:
                raise RefusedError.of(message)
            else:
                self.description = message
                batch.append(Description(time.time_ns(), message))

    @staticmethod
    def _happened(client: Client, event: JsonObject, batch: Batch) -> None:
        if event.get("source") == RECORDER:
            del event["source"]  # reserved for the recorder's own events
        batch.append(Event(time.time_ns(), event))
        if event["event"] in _CHANGES:
            client.connection.send(request("describe", "record"))


def _noted(name: str, **values: object) -> Event:
    """An event of the recorder."""
    return Event(time.time_ns(), {"event": name, "source": RECORDER, **values})


def lost(frames: int, reason: str) -> Event:
    """The event that `frames` frames were received but not recorded."""
    return _noted("lost", frames=frames, reason=reason)
