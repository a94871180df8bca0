"""What `ethercat-replay` does: opens the recording, listens and plays."""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import sys
import time
from functools import partial
from typing import Any, Final, NoReturn

from bota_clients.errors import RecordingError
from bota_clients.program import Signals, say
from bota_clients.progress import switch_off
from bota_clients.recording.file_format import Note, RecordedEvent
from bota_clients.recording.reader import Recording, open_recording
from bota_clients.replay.pacing import Pacing
from bota_clients.replay.sensors import ReplayedSensors, needs_sensor
from bota_ethercat.control import Event, event
from bota_ethercat.framing import DataFlag, DataMessage, encode_data
from ethercat_server.errors import ServerError
from ethercat_server.serving.actions import Actions
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.transport import SocketTransport

# Sockets are not served this shortly before a frame is due, because select may wake late.
_MARGIN_NS: Final = 80_000
# Longest time between two turns of the sockets, even if frames are late.
_SERVE_EVERY_NS: Final = 10_000_000
_SLICE_NS: Final = 50_000_000  # a signal is noticed within this time
_DRAIN_NS: Final = 10_000_000_000  # timeout for clients that do not read the last frames

_say = partial(say, "ethercat-replay")


def run(options: argparse.Namespace, signals: Signals) -> int:
    switch_off()
    logging.basicConfig(level=logging.INFO, format="ethercat-replay: %(message)s", stream=sys.stderr)
    try:
        with open_recording(options.path) as recording:
            for remark in recording.remarks:
                _say(f"{recording.path} {remark}")
            player = Player(recording, options, signals)
            with contextlib.closing(player.hub):
                player.run()
    except ServerError as error:
        _say(str(error))
        return error.exit_code
    return 0


class Player:
    """What produces the frames, in place of the server's `Cycle`."""

    def __init__(self, recording: Recording, options: argparse.Namespace, signals: Signals) -> None:
        """RecordingError if there is nothing to play, ServerError if it cannot be served."""
        self.sensors = ReplayedSensors(recording)
        if not self.sensors.sensors:
            raise RecordingError(f"{recording.path} has neither frames nor sensors: there is nothing to play")
        self.hub = Hub(SocketTransport(options.hosts, options.port), time.monotonic_ns)
        self._recording = recording
        self._options = options
        self._signals = signals
        self._pacing = Pacing(options.speed)
        self._serve_by = 0
        self._newest_ns: dict[int, int] = {}  # by sensor, when a frame of it that is not REPEATED was sent

    def stop(self) -> None:
        self._signals.asked = True

    def status(self) -> dict[str, Any]:
        return self.sensors.status()

    def trace(self, offset: int) -> NoReturn:  # noqa: ARG002
        """There are no exchanges."""
        raise needs_sensor("trace")

    def run(self) -> None:
        hub, options, recording = self.hub, self._options, self._recording
        hub.start(Actions(hub, self, self.sensors, lambda: {"replay": self._about()}).handle)
        name = f"{recording.path.name}, {recording.frame_count} frames,"
        _say(f"replaying {name} on port {options.port}, waiting for a subscriber; Ctrl-C ends it")
        try:
            while not (self._signals.asked or self._has_subscriber()):
                hub.serve(time.monotonic_ns() + _SLICE_NS)
            while self._play_once() and options.loop:
                self._pacing.begin_again()
            self._drain()
        finally:
            hub.broadcast(event(Event.SHUTTING_DOWN))
        _say(f"{'stopped' if self._signals.asked else 'ended'} after {self.sensors.sent} frames")

    def _about(self) -> dict[str, object]:
        """By this a client can tell a replay."""
        first, options = self._recording.metadata, self._options
        return {
            "files": [self._recording.path.name],
            "recorded": first.get("started", "?"),
            "recorded_version": first.get("server_version", "?"),
            "pace": "max" if math.isinf(options.speed) else options.speed,
            "loop": options.loop,
        }

    def _play_once(self) -> bool:
        """Play to the end; False if it was stopped or there is no frame."""
        before = self.sensors.sent
        for item in self._recording.everything():
            if self._signals.asked:
                return False
            if isinstance(item, DataMessage):
                self._send(item)
            else:
                self._happen(item)
        return self.sensors.sent > before

    def _has_subscriber(self) -> bool:
        return any(c.subscription is not None for c in self.hub.connections.values())

    def _happen(self, note: Note) -> None:
        if isinstance(note, RecordedEvent) and note.by_recorder and note.name == "connected":
            self._pacing.reconnected()
        for message in self.sensors.follow(note):
            self.hub.broadcast(message)

    def _send(self, frame: DataMessage) -> None:
        due_ns = 0
        if math.isinf(self._options.speed):  # as fast as the clients read: none has a frame queued
            self._drain()
            frame = self._pacing.now(frame)
        else:
            due_ns, frame = self._pacing.due(frame)
        self._wait(due_ns)
        if self._signals.asked:
            return
        now_ns = time.monotonic_ns()
        if not frame.flags & DataFlag.REPEATED:
            self._newest_ns[frame.sensor] = now_ns
        newest_ns = self._newest_ns.get(frame.sensor, 0)
        self.hub.publish(((encode_data(*frame), frame.sensor, frame.flags, newest_ns),), now_ns)
        self.sensors.count(frame)

    def _wait(self, due_ns: int) -> None:
        """Serve the sockets until a frame is due."""
        now = time.monotonic_ns()
        while (due_ns - _MARGIN_NS > now or now > self._serve_by) and not self._signals.asked:
            self.hub.serve(min(due_ns - _MARGIN_NS, now + _SLICE_NS))
            now = time.monotonic_ns()
            self._serve_by = now + _SERVE_EVERY_NS
        if (left := due_ns - time.monotonic_ns()) > 0 and not self._signals.asked:
            time.sleep(left * 1e-9)

    def _drain(self) -> None:
        """Let clients read what is queued for them."""
        until_ns = time.monotonic_ns() + _DRAIN_NS
        while any(c.outbox.waiting for c in self.hub.connections.values()):
            if self._signals.asked or time.monotonic_ns() > until_ns:
                return
            self.hub.serve(time.monotonic_ns() + 1_000_000)
