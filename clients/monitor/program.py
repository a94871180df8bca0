"""Chooses and runs the view: live on a terminal, else a line per second; or once; or JSON."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import Final

from clients.monitor.model.server import Model, clock_text
from clients.monitor.model.state import State
from clients.monitor.options import Options
from clients.monitor.reader import Reader
from clients.monitor.view.glyphs import ASCII, UNICODE, can_show, to_ascii
from clients.monitor.view.json_line import json_line
from clients.monitor.view.table import line, table, verdict
from clients.monitor.view.words import trouble
from clients.program import interrupt_on_signals
from protocol.health.verdict import Level

_PERIOD_S: Final = 1.0
_ONCE_S: Final = 1.0
_ANSWER_S: Final = 6.0


def run(options: Options) -> int:
    """Run the monitor; returns the exit code."""
    if options.web is not None:
        from clients.monitor.web.program import run_web  # noqa: PLC0415 - not needed otherwise

        return run_web(options, options.web)
    live = not options.once and not options.json and _has_screen()
    if live:
        import clients.monitor.app  # noqa: F401, PLC0415 - slow to import
    interrupt_on_signals()  # the live view replaces the handler of SIGTERM
    model = Model(str(options.address), options.imu_units)
    reader = Reader(options.address, model)
    reader.start()
    try:
        if options.once:
            return _once(options, model, reader)
        if options.json:
            return _every_second(options, reader, lambda: _json(model))
        if live:
            return _live(options, model)
        return _every_second(options, reader, _Lines(options, model).show)
    finally:
        reader.close()


def _has_screen() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in {"", "dumb"}


def _once(options: Options, model: Model, reader: Reader) -> int:
    if not reader.wait_for_answer(_ANSWER_S):
        state = model.state(time.monotonic())
        reason = state.server.reason or f"the server at {options.address} does not answer"
        if options.json:
            _say(json_line(state, time.time()))
        sys.stderr.write(f"ethercat-monitor: {reason}, or give its HOST:PORT\n")
        return 1
    time.sleep(_ONCE_S)
    state = model.state(time.monotonic())
    if options.json:
        _say(json_line(state, time.time()))
    else:
        _say(*table(state), spelled=_spelled(options))
    return 1 if verdict(state)[0] is Level.TROUBLE else 0


def _live(options: Options, model: Model) -> int:
    from clients.monitor.app import Monitor  # noqa: PLC0415 - needs the extra

    app = Monitor(model, options.address, ASCII if _spelled(options) else UNICODE, seconds=options.seconds)
    try:
        app.run(mouse=False)
        if app.recorder.running:
            _say("Finishing the recording")
    finally:
        ended = app.recorder.close()
    if ended:
        _say(ended)
    return app.return_code or 0


def _every_second(options: Options, reader: Reader, show: Callable[[], None]) -> int:
    reader.wait_for_answer(_ANSWER_S)
    for _ in _seconds(options.seconds):
        show()
    return 0


def _seconds(limit_s: float | None) -> Iterator[None]:
    """Once a second, until the limit."""
    start_s = due_s = time.monotonic()
    while True:
        due_s = max(due_s + _PERIOD_S, time.monotonic())
        if limit_s is not None and due_s > start_s + limit_s + 0.5 * _PERIOD_S:
            return
        time.sleep(max(0.0, due_s - time.monotonic()))
        yield


def _json(model: Model) -> None:
    _say(json_line(model.state(time.monotonic()), time.time()))
    # Peaks and warnings of the next line are those of its own second.
    model.reset()


class _Lines:
    """A line per sensor and second; trouble with the server is reported once."""

    def __init__(self, options: Options, model: Model) -> None:
        self._model = model
        self._spelled = _spelled(options)
        self._troubled = False

    def show(self) -> None:
        """One second's lines."""
        state: State = self._model.state(time.monotonic())
        wrong = trouble(state.server)
        if wrong is None:
            now = clock_text()
            _say(*(line(sensor, now) for sensor in state.sensors), spelled=self._spelled)
        elif not self._troubled:
            _say(f"{clock_text()}  server {wrong}", spelled=self._spelled)
        self._troubled = wrong is not None


def _spelled(options: Options) -> bool:
    return options.ascii or not can_show(sys.stdout.encoding)


def _say(*lines: str, spelled: bool = False) -> None:
    text = "".join(f"{line}\n" for line in lines)
    sys.stdout.write(to_ascii(text) if spelled else text)
    sys.stdout.flush()
