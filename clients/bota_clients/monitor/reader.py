"""The thread that feeds the model from the server.

It wakes some twenty times a second instead of for every sample: it takes all that is queued, then waits for
one more sample. As it was awake for that one, its arrival time gives the age of a sample on arrival.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Sequence
from typing import Final

from bota_clients.monitor.model import Model
from bota_ethercat.address import Address
from bota_ethercat.client import Client, Connected, Disconnected
from bota_ethercat.client.session import Item
from bota_ethercat.errors import ConnectionFailedError, RefusedError
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.sentences import no_server
from bota_ethercat.stream.timeline import InForce

BATCH_S: Final = 0.05
_STATUS_EVERY_S: Final = 1.0
_NEXT_SAMPLE_S: Final = 0.1
_MOST_PILED: Final = 1000  # more were not read in time: what comes next has waited, too
_ANSWER_TIMEOUT_S: Final = 10.0  # timeout for a reply of the server


class MonitorReader(threading.Thread):
    def __init__(self, address: Address, model: Model, batch_s: float = BATCH_S) -> None:
        """`batch_s`: how long samples queue before they are taken."""
        super().__init__(name="reader", daemon=True)
        # REPEATED frames too: then a jump of the sequence is a loss and nothing else.
        self._client = Client(address.port, address.host, fresh_only=False, raw=True)
        self._model = model
        self._batch_s = batch_s
        self._closing = threading.Event()
        self.tried = threading.Event()  # there was a reply to `status`, or a failed connection

    def close(self) -> None:
        self._closing.set()
        self._client.close()
        self.join(timeout=2.0)

    def run(self) -> None:
        status_at_s = 0.0
        with self._client as client, contextlib.suppress(ConnectionFailedError):
            while not self._closing.wait(self._batch_s):
                self._take(client)
                if client.session.connected and time.monotonic() >= status_at_s:
                    status_at_s = time.monotonic() + _STATUS_EVERY_S
                    self._ask_status(client)

    def _take(self, client: Client) -> None:
        piled_up, fresh = client.poll_all(), client.poll_all(_NEXT_SAMPLE_S)
        now_ns = time.monotonic_ns()
        self._model.note_unread(*client.take_unread(), now_ns * 1e-9)
        self._hand_on(client, piled_up + fresh, now_ns * 1e-9)
        # What arrived while this thread decoded waited for it: its age is not that of the server.
        if len(piled_up) < _MOST_PILED and client.session.same_machine:
            first = {frame.sensor: frame for frame in reversed(fresh) if isinstance(frame, DataMessage)}
            for frame in first.values():
                self._model.note_age(frame, now_ns)

    def _hand_on(self, client: Client, items: Sequence[Item], now_s: float) -> None:
        """All in its order: frames before an event are from before it."""
        frames = list[DataMessage]()
        for item in items:
            if isinstance(item, DataMessage):
                frames.append(item)
                continue
            self._model.add_frames(frames, now_s)
            frames = []
            if isinstance(item, Connected):
                self._model.connected(item.description, str(Address(*client.channel.own)), now_s)
            elif isinstance(item, Disconnected):
                self._failed(item, now_s)
            elif isinstance(item, InForce):
                self._model.tell(item, now_s)
            else:
                self._model.add_event(item, now_s)
        self._model.add_frames(frames, now_s)

    def _failed(self, end: Disconnected, now_s: float) -> None:
        if not self._closing.is_set():
            reason = f"the connection ended: {end.reason}"
            if not end.reachable:
                reason = no_server(self._client.address, end.reason)
            self._model.gone(reason, now_s)
            self.tried.set()

    def _ask_status(self, client: Client) -> None:
        try:
            self._model.add_status(client.ask("status", _ANSWER_TIMEOUT_S), time.monotonic())
        except ConnectionFailedError:
            return  # an event says why
        except RefusedError:
            pass
        self.tried.set()
