"""Plays recordings to the clients of a hub: sends each frame when it is due, serves sockets in between.

One thread does everything, as in the server. `Player.run` returns at the end of the recordings or when it is
stopped; it raises DamagedError where a recording is corrupt.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

from clients.recording.reader import Description, Event, Recording
from clients.replay.meter import Meter
from clients.replay.sensors import ReplayedSensors
from clients.replay.timeline import Timeline
from ethercat_server.serving.hub import Hub
from protocol.control import Event as ServerEvent
from protocol.framing import DataMessage, encode_data

_MARGIN_NS: Final = 80_000
"""Sockets are not served this shortly before a frame is due, because select may wake late."""
_SERVE_EVERY_NS: Final = 10_000_000
"""Longest time between two turns of the sockets, even if frames are late."""
_SLICE_NS: Final = 50_000_000
"""A signal is noticed within this time."""
_DRAIN_NS: Final = 10_000_000_000
"""Timeout for clients that do not read the last frames."""


class Player:
    """What produces the frames, in place of the server's `Cycle`.

    Attributes:
        stopping: whether it was asked to stop.
        passes: how often the end of the recordings was reached.
        meter: counters for `status`.
    """

    def __init__(
        self,
        hub: Hub,
        recordings: Sequence[Recording],
        sensors: ReplayedSensors,
        timeline: Timeline,
        *,
        loop: bool,
        waits: bool,
        lossless: bool,
    ) -> None:
        """`waits`: start with the first subscriber. `lossless`: send a frame only when no client has one
        queued, as fast as the clients read.
        """
        self.stopping = False
        self.passes = 0
        self.meter = Meter(sensors)
        self._hub = hub
        self._recordings = recordings
        self._sensors = sensors
        self._timeline = timeline
        self._loop = loop
        self._waits = waits
        self._lossless = lossless
        self._serve_by = 0

    def stop(self) -> None:
        """End `run` soon."""
        self.stopping = True

    def run(self) -> None:
        """Play."""
        while self._waits and not self.stopping and not self._has_subscriber():
            self._hub.serve(time.monotonic_ns() + _SLICE_NS)
        while self._play_once() and self._loop:
            self._timeline.begin_again()
        self._drain(time.monotonic_ns() + _DRAIN_NS)

    def _play_once(self) -> bool:
        """Play to the end; False if it was stopped or there is no frame."""
        before = self.meter.sent
        for item in self._items():
            if self.stopping:
                return False
            if isinstance(item, DataMessage):
                self._send(item)
            elif isinstance(item, Description):
                self._sensors.describe(item)
            else:
                self._happen(item)
        self.passes += 1
        return self.meter.sent > before

    def status(self) -> dict[str, Any]:
        """Its part of the `status` reply."""
        return self.meter.status()

    def _items(self) -> Iterator[DataMessage | Description | Event]:
        for number, recording in enumerate(self._recordings):
            if number and recording.metadata.get("part", "0") == "0":
                self._timeline.begin_again()  # a new recording, not the next part of one
            yield from recording.everything()

    def _has_subscriber(self) -> bool:
        return any(c.subscription is not None for c in self._hub.connections.values())

    def _happen(self, event: Event) -> None:
        if event.by_recorder:
            if event.name == "connected":
                self._timeline.reconnected()
            return
        self._sensors.take(event)
        # It was the recorded server that shut down, not this one.
        if event.name != ServerEvent.SHUTTING_DOWN:
            self._hub.broadcast(event.event)

    def _send(self, frame: DataMessage) -> None:
        due_ns = 0
        if self._lossless:
            self._drain(time.monotonic_ns() + _DRAIN_NS)
            frame = self._timeline.now(frame)
        else:
            due_ns, frame = self._timeline.due(frame)
        self._wait(due_ns)
        if self.stopping:
            return
        now = time.monotonic_ns()
        self._hub.publish(((encode_data(*frame), frame.sensor, frame.flags),), now)
        self.meter.count(frame, due_ns, now)

    def _wait(self, due_ns: int) -> None:
        """Serve the sockets until a frame is due."""
        now = time.monotonic_ns()
        while (due_ns - _MARGIN_NS > now or now > self._serve_by) and not self.stopping:
            self._hub.serve(min(due_ns - _MARGIN_NS, now + _SLICE_NS))
            now = time.monotonic_ns()
            self._serve_by = now + _SERVE_EVERY_NS
        if (left := due_ns - time.monotonic_ns()) > 0 and not self.stopping:
            time.sleep(left * 1e-9)

    def _drain(self, until_ns: int) -> None:
        """Let clients read what is queued for them."""
        while any(c.outbox.waiting for c in self._hub.connections.values()):
            if self.stopping or time.monotonic_ns() > until_ns:
                return
            self._hub.serve(time.monotonic_ns() + 1_000_000)
