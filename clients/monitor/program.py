"""Chooses and runs the view: live on a terminal, else a line per second; or once; or JSON."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Final

from clients.monitor.model import Model, clock_text
from clients.monitor.options import Options
from clients.monitor.reader import Reader
from clients.monitor.screen import line, table
from clients.monitor.words import can_show, json_line, to_ascii, trouble, verdict
from clients.program import interrupt_on_signals
from protocol.health.verdict import Level

_PERIOD_S: Final = 1.0
_ONCE_S: Final = 1.0
_ANSWER_S: Final = 6.0


def run(options: Options) -> int:
    """Run the monitor; returns the exit code."""
    if options.web is not None:
        from clients.monitor.web.server import run_web  # noqa: PLC0415 - not needed otherwise

        return run_web(options, options.web)
    terminal = (
        sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in {"", "dumb"}
    )
    live = terminal and not options.once and not options.json
    if live:
        import clients.monitor.app  # noqa: F401, PLC0415 - slow to import
    interrupt_on_signals()  # the live view replaces the handler of SIGTERM
    options.ascii = options.ascii or not can_show(sys.stdout.encoding)
    model = Model(str(options.address), options.imu_units)
    reader = Reader(options.address, model)
    reader.start()
    try:
        if live:
            return _live(options, model)
        answered = reader.wait_for_answer(_ANSWER_S)
        if options.once:
            return _once(options, model, answered=answered)
        every_second(options.seconds, _json_lines(model) if options.json else _lines(options, model))
        return 0
    finally:
        reader.close()


def _once(options: Options, model: Model, *, answered: bool) -> int:
    if answered:
        time.sleep(_ONCE_S)
    state = model.state(time.monotonic())
    if options.json:
        _say(json_line(state, time.time()))
    if not answered:
        reason = state.server.reason or f"the server at {options.address} does not answer"
        sys.stderr.write(f"ethercat-monitor: {reason}, or give its HOST:PORT\n")
        return 1
    if not options.json:
        _say(*table(state), ascii_only=options.ascii)
    return 1 if verdict(state)[0] is Level.TROUBLE else 0


def _live(options: Options, model: Model) -> int:
    from clients.monitor.app import Monitor  # noqa: PLC0415 - needs the extra

    app = Monitor(model, options.address, ascii_only=options.ascii, seconds=options.seconds)
    try:
        app.run(mouse=False)
        if app.recorder.running:
            _say("Finishing the recording")
    finally:
        ended = app.recorder.close()
    if ended:
        _say(ended)
    return app.return_code or 0


def every_second(limit_s: float | None, show: Callable[[], None]) -> None:
    """Call once a second, until the limit."""
    start_s = due_s = time.monotonic()
    while True:
        due_s = max(due_s + _PERIOD_S, time.monotonic())
        if limit_s is not None and due_s > start_s + limit_s + 0.5 * _PERIOD_S:
            return
        time.sleep(max(0.0, due_s - time.monotonic()))
        show()


def _json_lines(model: Model) -> Callable[[], None]:
    def show() -> None:
        _say(json_line(model.state(time.monotonic()), time.time()))
        model.reset()  # peaks and warnings of the next line are those of its own second

    return show


def _lines(options: Options, model: Model) -> Callable[[], None]:
    """A line per sensor; trouble with the server is reported once."""
    was_wrong = False

    def show() -> None:
        nonlocal was_wrong
        state, now = model.state(time.monotonic()), clock_text()
        wrong = trouble(state.server)
        if wrong is None:
            _say(*(line(sensor, now) for sensor in state.sensors), ascii_only=options.ascii)
        elif not was_wrong:
            _say(f"{now}  server {wrong}", ascii_only=options.ascii)
        was_wrong = wrong is not None

    return show


def _say(*lines: str, ascii_only: bool = False) -> None:
    text = "".join(f"{line}\n" for line in lines)
    sys.stdout.write(to_ascii(text) if ascii_only else text)
    sys.stdout.flush()
