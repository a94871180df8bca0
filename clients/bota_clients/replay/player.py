"""When each frame of a recording is due, and with which sequence number and stamps.


- The time between frames is that of their `monotonic_ns`, divided by the speed, never negative.
- Where the recorder reconnected, the server may have another monotonic clock: the time between the frames
  before and after is that of their `stamp_ns`.
- Moved stamps: the first frame's are now, and the others keep their distance to it, exactly at speed 1.
  Sequence numbers continue when the recording starts again.
- Original stamps: frames are sent as recorded.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from bota_clients.recording.reader import Description, Event, Recording
from bota_clients.replay.sensors import Meter, ReplayedSensors
from bota_ethercat.control import Event as ServerEvent
from bota_ethercat.framing import DataMessage, encode_data
from ethercat_server.serving.hub import Hub

_MAX: Final = (1 << 64) - 1


class Due(NamedTuple):
    """A frame and the CLOCK_MONOTONIC at which to send it."""

    at_ns: int
    frame: DataMessage


class Timeline:
    """Turns recorded frames into those to send."""

    def __init__(
        self, speed: float, *, original: bool, monotonic_ns: Callable[[], int], realtime_ns: Callable[[], int]
    ) -> None:
        """`speed` 1 is the original timing; `original` keeps sequence numbers and stamps."""
        self._speed = speed
        self._original = original
        self._monotonic_ns = monotonic_ns
        self._realtime_ns = realtime_ns
        self._begun = False
        self._first_at_ns = 0
        """When the first frame was due, on our clock."""
        self._first_stamp_ns = 0
        self._moved_stamp_ns = 0
        """The first frame's stamp: recorded, and moved."""
        self._base_ns = 0
        """The recording's `monotonic_ns` that is `_first_at_ns` on ours."""
        self._last_at_ns = 0
        self._last_stamp_ns = 0
        self._reconnected = False
        self._sequence: dict[int, tuple[int | None, int]] = {}
        """By sensor: offset of its sequence numbers, None if not known yet, and the next number."""
        self._moments: dict[int, int] = {}
        """By sensor: recorded time of its last frame."""
        self._step_ns = 0
        """Last replayed interval between two frames of one sensor."""

    def reconnected(self) -> None:
        """The recorder reconnected here: the clocks before and after may differ."""
        self._reconnected = self._begun

    def begin_again(self) -> None:
        """The recording starts again: its first frame is due one interval after the last."""
        self._begun = self._reconnected = False
        self._sequence = {sensor: (None, number) for sensor, (_, number) in self._sequence.items()}

    def now(self, frame: DataMessage) -> DataMessage:
        """The frame as it is sent now, whenever it was due."""
        if self._original:
            return frame
        return self._numbered(frame, self._realtime_ns(), self._monotonic_ns())

    def due(self, frame: DataMessage) -> Due:
        """When the next frame is due, and the frame to send."""
        if not self._begun:
            self._begun = True
            self._base_ns, self._first_stamp_ns = frame.monotonic_ns, frame.stamp_ns
            self._first_at_ns = max(self._monotonic_ns(), self._last_at_ns + self._step_ns)
            self._moments.clear()
            self._moved_stamp_ns = self._realtime_ns() + self._first_at_ns - self._monotonic_ns()
            self._last_at_ns = self._first_at_ns
        elif self._reconnected:
            self._reconnected = False
            pause_ns = max(0, frame.stamp_ns - self._last_stamp_ns)
            passed_ns = round((self._last_at_ns - self._first_at_ns) * self._speed)
            self._base_ns = frame.monotonic_ns - passed_ns - pause_ns
        self._last_stamp_ns = frame.stamp_ns
        since_ns = frame.monotonic_ns - self._moments.get(frame.sensor, frame.monotonic_ns)
        self._moments[frame.sensor] = frame.monotonic_ns
        if since_ns > 0:
            self._step_ns = self._scaled(since_ns)
        moment_ns = self._first_at_ns + self._scaled(frame.monotonic_ns - self._base_ns)
        self._last_at_ns = max(self._last_at_ns, moment_ns)
        if self._original:
            return Due(self._last_at_ns, frame)
        stamp_ns = self._moved_stamp_ns + self._scaled(frame.stamp_ns - self._first_stamp_ns)
        return Due(self._last_at_ns, self._numbered(frame, stamp_ns, moment_ns))

    def _scaled(self, duration_ns: int) -> int:
        # A float would lose nanoseconds in a long recording.
        return duration_ns if self._speed == 1 else round(duration_ns / self._speed)

    def _numbered(self, frame: DataMessage, stamp_ns: int, monotonic_ns: int) -> DataMessage:
        offset, next_number = self._sequence.get(frame.sensor, (0, 0))
        if offset is None:
            offset = next_number - frame.sequence
        sequence = (frame.sequence + offset) & _MAX
        self._sequence[frame.sensor] = offset, sequence + 1
        return frame._replace(
            sequence=sequence,
            stamp_ns=min(max(stamp_ns, 0), _MAX),
            monotonic_ns=min(max(monotonic_ns, 0), _MAX),
        )


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
