"""Everything that the server sends, in order and in batches, across reconnects.

Batches, because waking up for each frame would cost more than all other work on it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import Final

from bota_clients.recording.file_format import RECORDER
from bota_clients.recording.reader import Description, Event
from bota_ethercat.address import Address
from bota_ethercat.client import Client, Connected, Disconnected
from bota_ethercat.control import Event as ServerEvent
from bota_ethercat.errors import ProtocolError
from bota_ethercat.framing import DataMessage
from bota_ethercat.text.json_text import JsonObject

Batch = list[DataMessage | Description | Event]

BATCH_S: Final = 0.02
"""Two sensors at 1600 Hz make 64 frames in this time."""
_RECEIVE_BUFFER: Final = 4 * 1024 * 1024
"""Bytes that the kernel may buffer, as far as it allows: seconds in which nothing is lost."""
_CHANGES: Final = frozenset({ServerEvent.RECONFIGURED, ServerEvent.SENSOR_BACK})
"""After these events the server is asked to describe itself again."""


class Source:
    """A subscription that is renewed whenever the connection ends, to those of the sensors that are there."""

    def __init__(self, address: Address, sensors: Sequence[int] | None) -> None:
        """Nothing is sent before `connect`. `sensors` are positions on the bus, None for all."""
        self.address = address
        # REPEATED frames too: they show that a sensor was silent.
        self._client = Client(
            address.port, address.host, sensors=sensors, fresh_only=False, raw=True,
            receive_buffer=_RECEIVE_BUFFER,
        )  # fmt: skip
        self._problem = ""

    @property
    def connected(self) -> bool:
        """Whether there is a connection now."""
        return self._client.session.connected

    @property
    def description(self) -> JsonObject | None:
        """The newest; None before `connect`."""
        return self._client.session.description

    def connect(self) -> Batch:
        """Connect and subscribe; returns the first batch. Errors as `Client.connect`."""
        self._client.connect()
        return self._batch()

    def receive(self) -> Batch:
        """Sleep for BATCH_S, then return everything received."""
        time.sleep(BATCH_S)
        return self._batch()

    def close(self) -> None:
        """End the connection, if there is one."""
        self._client.close()

    def _batch(self) -> Batch:
        batch: Batch = []
        for item in self._client.poll_all():
            if isinstance(item, DataMessage):
                batch.append(item)
            elif isinstance(item, Connected):
                self._problem = ""
                missing = ", ".join(map(str, item.missing))
                said = {"message": f"without sensor {missing}"} if missing else {}
                same_machine = self._client.session.same_machine
                batch.append(_noted("connected", server=str(self.address), same_machine=same_machine, **said))
                batch.append(Description(time.time_ns(), item.description))
            elif isinstance(item, Disconnected):
                if item.was_connected:
                    batch.append(_noted("disconnected", reason=item.reason))
                elif item.reachable and item.reason != self._problem:
                    # A server that was started again without one of its sensors, say: it is tried again.
                    self._problem = item.reason
                    batch.append(_noted("refused", message=item.reason))
            else:
                if item.get("source") == RECORDER:
                    del item["source"]  # reserved for the recorder's own events
                batch.append(Event(time.time_ns(), item))
                if item["event"] in _CHANGES:
                    with contextlib.suppress(ProtocolError):
                        batch.append(Description(time.time_ns(), self._client.ask("describe")))
        return batch


def _noted(name: str, **values: object) -> Event:
    """An event of the recorder."""
    return Event(time.time_ns(), {"event": name, "source": RECORDER, **values})


def lost(frames: int, reason: str) -> Event:
    """The event that `frames` frames were received but not recorded."""
    return _noted("lost", frames=frames, reason=reason)
