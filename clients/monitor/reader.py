"""The thread that feeds the model from the server, and reconnects.

It wakes some twenty times a second instead of for every sample: it takes all that is queued, then waits for
one more sample. As it was awake for that one, its arrival time gives the age of a sample on arrival.
"""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Final

from clients.monitor.model.server import Model
from protocol.address import Address
from protocol.client import Client
from protocol.control import Event
from protocol.errors import ProtocolError, RefusedError, UnreachableError
from protocol.framing import DataMessage

BATCH_S: Final = 0.05
_STATUS_EVERY_S: Final = 1.0
_NEXT_SAMPLE_S: Final = 0.1
_MOST_READS: Final = 16
_AGAIN_S: Final = 0.5
_ANSWER_TIMEOUT_S: Final = 10.0
"""Timeout for a reply of the server."""


class Reader:
    """Reads until closed."""

    def __init__(self, address: Address, model: Model, batch_s: float = BATCH_S) -> None:
        """`batch_s`: how long samples queue before they are taken."""
        self._address = address
        self._model = model
        self._batch_s = batch_s
        self._closing = threading.Event()
        self._client: Client | None = None
        self._changed = threading.Condition()
        self.attempts = 0
        """Number of failed connections."""
        self.statuses = 0
        """Number of replies to `status`."""
        self._thread = threading.Thread(target=self._run, name="reader", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the connection and the thread."""
        self._closing.set()
        client = self._client
        if client is not None:
            client.connection.shutdown()  # not close: the thread may be blocked on it
        self._thread.join(timeout=2.0)

    def wait_for_answer(self, timeout_s: float) -> bool:
        """Wait for the first reply to `status` or failed connection; whether there was a reply."""
        with self._changed:
            self._changed.wait_for(lambda: self.statuses or self.attempts, timeout_s)
            return self.statuses > 0

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._read()
            except UnreachableError as error:
                self._failed(error.at(self._address))
            except ProtocolError as error:
                self._failed(f"the connection ended: {error}")
            self._closing.wait(_AGAIN_S)

    def _failed(self, reason: str) -> None:
        if not self._closing.is_set():
            self._model.gone(reason, time.monotonic())
            with self._changed:
                self.attempts += 1
                self._changed.notify_all()

    def _read(self) -> None:
        with Client(self._address.port, self._address.host) as client:
            self._client = client
            # REPEATED frames too: then a jump of the sequence is a loss and nothing else.
            client.subscribe(fresh_only=False)
            self._model.connected(client.description, _own_peer(client), time.monotonic())
            status_at_s = 0.0
            while not self._closing.wait(self._batch_s):
                self._take(client)
                if time.monotonic() >= status_at_s:
                    status_at_s = time.monotonic() + _STATUS_EVERY_S
                    self._ask_status(client)

    def _take(self, client: Client) -> None:
        piled_up: list[DataMessage] = []
        caught_up = False
        for _ in range(_MOST_READS):
            more = client.receive(0.0)
            piled_up += more
            if not more:
                caught_up = True
                break
        fresh = client.receive(_NEXT_SAMPLE_S)
        now_ns = time.monotonic_ns()
        self._model.take(piled_up + fresh, now_ns * 1e-9)
        # What arrived while this thread decoded waited for it: its age is not that of the server.
        if caught_up and client.connection.same_machine:
            first = {frame.sensor: frame for frame in reversed(fresh)}
            for frame in first.values():
                self._model.note_age(frame, now_ns)
        while client.events:
            event = client.events.popleft()
            self._model.take_event(event, now_ns * 1e-9)
            if event.get("event") in {Event.SENSOR_BACK, Event.RECONFIGURED}:
                self._model.described(client.ask("describe", _ANSWER_TIMEOUT_S), time.monotonic())

    def _ask_status(self, client: Client) -> None:
        with contextlib.suppress(RefusedError):
            self._model.take_status(client.ask("status", _ANSWER_TIMEOUT_S), time.monotonic())
        with self._changed:
            self.statuses += 1
            self._changed.notify_all()


def _own_peer(client: Client) -> str:
    return str(Address(*client.connection.sock.getsockname()[:2]))
