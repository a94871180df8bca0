"""The view that `ethercat-monitor` was asked for: live, a table, JSON, or a page."""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

from bota_clients.monitor.model import Model
from bota_clients.monitor.reader import MonitorReader
from bota_clients.monitor.words import json_line, verdict
from bota_clients.program import interrupt_on_signals
from bota_ethercat.health.limits import Level
from bota_ethercat.health.sentences import no_server

if TYPE_CHECKING:
    from bota_clients.monitor.compensated import NewestCompensated

_PERIOD_S: Final = 1.0
_ONCE_S: Final = 1.0
_ANSWER_S: Final = 6.0


def run(options: argparse.Namespace) -> int:
    """Show it; the exit code."""
    try:
        if options.web is None:
            return _in_terminal(options)
        from bota_clients.monitor.web.server import run_web  # noqa: PLC0415

        return run_web(options.address, options.web, options.imu_units, options.seconds)
    except KeyboardInterrupt:
        return 1 if options.once else 0


def _in_terminal(options: argparse.Namespace) -> int:
    terminal = (
        sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in {"", "dumb"}
    )
    live = terminal and not options.once and not options.json
    options.once = options.once or not (live or options.json)
    if live:
        import bota_clients.monitor.app  # noqa: PLC0415
    else:
        import bota_clients.monitor.screen  # noqa: F401, PLC0415
    interrupt_on_signals()  # the live view replaces the handler of SIGTERM
    model = Model(str(options.address), options.imu_units, _compensating(options))
    reader = MonitorReader(options.address, model)
    reader.start()
    try:
        if live:
            return _live(options, model)
        answered = reader.tried.wait(_ANSWER_S) and model.state(time.monotonic()).server.connected
        if options.once:
            return _once(options, model, answered=answered)
        return _each_second(options, model)
    finally:
        reader.close()


def _compensating(options: argparse.Namespace) -> Callable[[], NewestCompensated] | None:
    """What makes what compensates a sensor's samples; RecordingError."""
    if options.tool is None:
        return None
    from bota_clients.export.windows import read_tool  # noqa: PLC0415
    from bota_clients.monitor.compensated import NewestCompensated  # noqa: PLC0415

    make = partial(NewestCompensated, read_tool(options.tool), options.imu_units)
    make()  # whether it can be
    return make


def _once(options: argparse.Namespace, model: Model, *, answered: bool) -> int:
    from bota_clients.monitor.screen import table  # noqa: PLC0415

    if answered:
        time.sleep(_ONCE_S)
    state = model.state(time.monotonic())
    if options.json:
        _say(json_line(state, time.time()))
    if not answered:
        reason = state.server.reason or no_server(options.address, "it does not answer")
        sys.stderr.write(f"ethercat-monitor: {reason}\n")
        return 1
    if not options.json:
        _say(*table(state))
    return 1 if verdict(state)[0] is Level.TROUBLE else 0


def _live(options: argparse.Namespace, model: Model) -> int:
    from bota_clients.monitor.app import Monitor  # noqa: PLC0415

    app = Monitor(model, options.address, seconds=options.seconds)
    try:
        app.run(mouse=False)
        if app.recorder.running:
            _say("Finishing the recording")
    finally:
        ended = app.recorder.close()
    if ended:
        _say(ended)
    return app.return_code or 0


def _each_second(options: argparse.Namespace, model: Model) -> int:
    for _ in itertools.count() if options.seconds is None else range(math.ceil(options.seconds)):
        time.sleep(_PERIOD_S)
        _say(json_line(model.state(time.monotonic()), time.time()))
        model.reset()  # peaks and warnings of the next line are those of its own second
    return 0


def _say(*lines: str) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()
