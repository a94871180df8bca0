"""What `ethercat-replay` does: opens the recordings, listens, plays, and makes errors exit codes."""

from __future__ import annotations

import contextlib
import logging
import math
import sys
import time
from collections.abc import Sequence

from clients.recording.reader import RecordedSensor, Recording, RecordingError, open_recording
from clients.replay.options import ReplayOptions, parse_options
from clients.replay.player import Player
from clients.replay.sensors import ReplayedSensors
from clients.replay.steps import Steps
from clients.replay.timeline import Timeline
from clients.signals import Signals
from ethercat_server.actions import Actions
from ethercat_server.authority import controlling_uids
from ethercat_server.errors import ServerError
from ethercat_server.hub import Hub
from ethercat_server.logs import Repetitions
from protocol.control import Event, event


def run(argv: Sequence[str] | None, signals: Signals) -> int:
    """Replay; returns the exit code."""
    options = parse_options(argv)
    _set_up_logging()
    try:
        with contextlib.ExitStack() as cleanup:
            recordings = [cleanup.enter_context(open_recording(path)) for path in options.paths]
            for recording in recordings:
                if recording.cut_off:
                    _say(f"{recording.path} was cut off: {recording.cut_off}; what it has is played")
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
        raise RecordingError(f"{recordings[0].path} has no frames and describes no sensor: nothing to play")
    hub = Hub(options.hosts, options.port)
    cleanup.callback(hub.close)
    hub.door.control_uids = controlling_uids(options.control_users, options.control_groups)
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
        steps=Steps(sys.stdin.fileno()) if options.step else None,
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
    """Every sensor of all recordings, described as the first that has it does."""
    found: dict[int, RecordedSensor] = {}
    for recording in recordings:
        for sensor in recording.sensors:
            found.setdefault(sensor.sensor, sensor)
    return list(found.values())


def _describe(recordings: Sequence[Recording], options: ReplayOptions) -> dict[str, object]:
    """What `describe` says of the replay: by this a client can tell it from a server."""
    first = recordings[0].metadata
    return {
        "files": [recording.path.name for recording in recordings],
        "recorded": first.get("started", "?"),
        "recorded_version": first.get("server_version", "?"),
        "pace": "step" if options.step else "max" if math.isinf(options.speed) else options.speed,
        "loop": options.loop,
        "stamps": "original" if options.original else "moved",
    }


def _names(recordings: Sequence[Recording]) -> str:
    more = f" and {len(recordings) - 1} more" if len(recordings) > 1 else ""
    frames = sum(recording.frame_count for recording in recordings)
    return f"{recordings[0].path.name}{more}, {frames} frames,"


def _waiting(options: ReplayOptions) -> str:
    if options.step:
        return ", a frame for each line"
    return "" if options.at_once else ", as soon as somebody subscribes"


def _set_up_logging() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("ethercat-replay: %(message)s"))
    handler.addFilter(Repetitions())
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def _say(sentence: str) -> None:
    sys.stderr.write(f"ethercat-replay: {sentence}\n")
    sys.stderr.flush()
