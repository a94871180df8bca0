"""The live view: terminal, keys and clock. The only file that uses Textual.

Ten times a second the state is rendered as rows of text, and only rows that changed are drawn.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from rich.text import Text
from textual import events
from textual.app import App, ComposeResult
from textual.geometry import Size
from textual.scroll_view import ScrollView
from textual.strip import Strip

from bota_clients.monitor.model import Model, State, clock_text
from bota_clients.monitor.recording import MonitorRecording
from bota_clients.monitor.screen import Screen, ViewOptions, render
from bota_clients.monitor.tare import start_tare
from bota_clients.numbers import duration
from bota_clients.program import call_on
from bota_ethercat.address import Address

REFRESH_S: Final = 0.1
_ANSWERS: Final = {"y": "tare", "u": "undo", "c": "clear"}  # to the question whether to tare


class View(ScrollView, can_focus=True):
    """Rows of text, of which only those that change are drawn."""

    def __init__(self, id: str) -> None:  # noqa: A002 - as Textual has it
        super().__init__(id=id)
        self._rows: list[Text] = []

    def show(self, rows: list[Text]) -> None:
        before, self._rows = self._rows, rows
        if len(rows) != len(before):
            self.virtual_size = Size(0, len(rows))
            self.refresh()
        for y, (old, new) in enumerate(zip(before, rows, strict=False)):
            if new != old:
                self.refresh_lines(y)

    def render_line(self, y: int) -> Strip:
        """One row of what is seen, for Textual."""
        y += self.scroll_offset.y
        row = self._rows[y] if y < len(self._rows) else Text()
        return Strip(row.render(self.app.console)).adjust_cell_length(self.size.width)


class Monitor(App[None]):
    """Connects keys, model and view. The caller closes `recorder` once the terminal is restored."""

    TITLE = "ethercat-monitor"
    CSS = """
        Screen, View { background: ansi_default; color: ansi_default; scrollbar-size-vertical: 1; }
        #head { height: 1; }
        #body { height: 1fr; }
    """
    ENABLE_COMMAND_PALETTE = False

    def __init__(
        self,
        model: Model,
        address: Address,
        *,
        seconds: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`seconds`: exit after this time."""
        # The terminal's own background; Textual obeys NO_COLOR.
        super().__init__(ansi_color=True)
        self.animation_level = "none"
        self._model = model
        self._address = address
        self._clock = clock
        self._view = ViewOptions()
        self._views = [View(id=name) for name in Screen._fields]
        self._seconds = seconds
        self.recorder = MonitorRecording(address)
        self._state: State | None = None
        self._to_tare = 0  # the position that the question is about

    def compose(self) -> ComposeResult:
        yield from self._views

    def on_mount(self) -> None:
        call_on(asyncio.get_running_loop(), self.exit, "SIGTERM", "SIGHUP")
        self._views[1].focus()
        self.set_interval(REFRESH_S, self.draw)
        if self._seconds is not None:
            self.set_timer(self._seconds, self.exit)

    def on_resize(self) -> None:
        self.call_after_refresh(self.draw)

    def draw(self) -> None:
        """Show the current state, or that of the time of the pause."""
        if not self.is_headless and not os.isatty(0):
            self.exit()  # the terminal was closed: Textual would block once 30 writes had failed
            return
        now_s = self._clock()
        if ended := self.recorder.ended():
            self._model.say(*ended)
        state = self._model.state(now_s)
        if self._view.paused and self._state is not None:
            state = replace(self._state, message=state.message)
        self._state = state
        recording = f"REC {duration(now_s - self.recorder.since_s)}" if self.recorder.running else ""
        width = self._views[1].scrollable_content_region.width
        screen = render(state, replace(self._view, recording=recording), width)
        self._views[2].styles.height = len(screen.foot)
        for view, rows in zip(self._views, screen, strict=True):
            view.show(rows)

    def action_help_quit(self) -> None:
        """Ctrl-C quits, instead of Textual's hint at another key."""
        self.exit()

    def on_key(self, event: events.Key) -> None:
        if event.key in {"ctrl+c", "ctrl+q"}:
            return
        event.stop()
        look, key = self._view, (event.character or "").lower()
        if event.key == "ctrl+l":
            self.refresh(layout=True)
        elif look.question:
            self._answer(key)
        elif look.help:
            self._view = replace(look, help=False)
        elif key == "t":
            self._ask_tare()
        elif key == "r":
            self._model.say(self.recorder.toggle(self._clock()))
        elif key in {"p", " "}:
            self._view = replace(look, paused="" if look.paused else clock_text())
        elif key == "0":
            self._model.reset()
            self._model.say("Peaks and past warnings are reset")
        elif key == "n":
            self._next()
        elif key in {"?", "h"}:
            self._view = replace(look, help=True)
        elif key == "q":
            self.exit()
        self.draw()

    def _ask_tare(self) -> None:
        state = self._state
        if state is None or not state.sensors or not state.server.connected:
            self._model.say("No sensor to tare: not connected to the server", True)
            return
        self._to_tare = state.sensors[self._view.selected % len(state.sensors)].position
        answers = "y: yes, u: undo the last tare, c: clear it, any other key: no"
        self._view = replace(self._view, question=f"Tare sensor {self._to_tare}? {answers}")

    def _answer(self, key: str) -> None:
        self._view = replace(self._view, question="")
        if key in _ANSWERS:
            start_tare(self._address, self._to_tare, self._model.say, _ANSWERS[key])
        else:
            self._model.say("Not tared")

    def _next(self) -> None:
        count = len(self._state.sensors) if self._state else 0
        if count < 2:
            self._model.say("There is only one sensor" if count else "There is no sensor")
        else:
            self._view = replace(self._view, selected=(self._view.selected + 1) % count)
