"""What `ethercat-replay` does: opens the recordings, listens, plays, and turns errors into exit codes."""

from __future__ import annotations

import contextlib
import logging
import math
import sys
import time
from collections.abc import Sequence
from functools import partial

from bota_clients.program import Signals, say
from bota_clients.recording.reader import RecordedSensor, Recording, RecordingError, open_recording
from bota_clients.replay.options import ReplayOptions, parse_options
from bota_clients.replay.player import Player, Timeline
from bota_clients.replay.sensors import ReplayedSensors
from bota_ethercat.control import Event, event
from ethercat_server.errors import ServerError
from ethercat_server.serving.actions import Actions
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.permissions import controlling_uids, local_names
from ethercat_server.serving.transport import SocketTransport

_say = partial(say, "ethercat-replay")


def run(argv: Sequence[str] | None, signals: Signals) -> int:
    """Replay; returns the exit code."""
    options = parse_options(argv)
    _set_up_logging()
    try:
        with contextlib.ExitStack() as cleanup:
            recordings = [cleanup.enter_context(open_recording(path)) for path in options.paths]
            for recording in recordings:
                if recording.cut_off:
                    _say(f"{recording.path} was cut off: {recording.cut_off}; the intact part is played")
            _play(recordings, options, signals, cleanup)
    except RecordingError as error:
        _say(str(error))
        return 1
    except ServerError as error:
        _say(str(error))
        return error.exit_code
    return 0


def _play(
    recordings: Sequence[Recording], options: ReplayOptions, signals: Signals, cleanup: contextlib.ExitStack
) -> None:
    sensors = ReplayedSensors(_all_sensors(recordings))
    if not sensors.sensors:
        raise RecordingError(f"{recordings[0].path} has neither frames nor sensors: there is nothing to play")
    hub = Hub(SocketTransport(options.hosts, options.port))
    cleanup.callback(hub.close)
    hub.permissions.control_uids = controlling_uids(options.control_users, options.control_groups)
    hub.permissions.names = local_names()
    timeline = Timeline(
        options.speed,
        original=options.original,
        monotonic_ns=time.monotonic_ns,
        realtime_ns=time.time_ns,
    )
    player = Player(
        hub,
        recordings,
        sensors,
        timeline,
        loop=options.loop,
        waits=not options.at_once,
        lossless=math.isinf(options.speed),
    )
    signals.call(player.stop)
    hub.start(Actions(hub, player, sensors, {"replay": _describe(recordings, options)}).handle)
    _say(f"replaying {_names(recordings)} on port {options.port}{_waiting(options)}; Ctrl-C ends it")
    try:
        player.run()
    finally:
        hub.broadcast(event(Event.SHUTTING_DOWN))
    times = "" if player.passes < 2 else f", {player.passes} times to the end"
    _say(f"{'stopped' if player.stopping else 'ended'} after {player.meter.sent} frames{times}")


def _all_sensors(recordings: Sequence[Recording]) -> list[RecordedSensor]:
    """The sensors of all recordings, as the first recording with each describes it."""
    found: dict[int, RecordedSensor] = {}
    for recording in recordings:
        for sensor in recording.sensors:
            found.setdefault(sensor.sensor, sensor)
    return list(found.values())


def _describe(recordings: Sequence[Recording], options: ReplayOptions) -> dict[str, object]:
    """The key `replay` in the reply to `describe`, by which a client can tell a replay."""
    first = recordings[0].metadata
    return {
        "files": [recording.path.name for recording in recordings],
        "recorded": first.get("started", "?"),
        "recorded_version": first.get("server_version", "?"),
        "pace": "max" if math.isinf(options.speed) else options.speed,
        "loop": options.loop,
        "stamps": "original" if options.original else "moved",
    }


def _names(recordings: Sequence[Recording]) -> str:
    more = f" and {len(recordings) - 1} more" if len(recordings) > 1 else ""
    frames = sum(recording.frame_count for recording in recordings)
    return f"{recordings[0].path.name}{more}, {frames} frames,"


def _waiting(options: ReplayOptions) -> str:
    return "" if options.at_once else ", waiting for a subscriber"


def _set_up_logging() -> None:
    logging.basicConfig(level=logging.INFO, format="ethercat-replay: %(message)s", stream=sys.stderr)
