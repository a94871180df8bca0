"""The live view: terminal, keys and clock. The only file that uses Textual.

Ten times a second the state is rendered as rows of text, and only rows that changed are drawn.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Final

from rich.text import Text
from textual import events
from textual.app import App, ComposeResult
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from clients.monitor.model.server import Model, clock_text
from clients.monitor.model.state import SensorState, State
from clients.monitor.recorder import Recorder
from clients.monitor.tare import WAYS, start_tare
from clients.monitor.view.glyphs import Glyphs
from clients.monitor.view.screen import Look, render
from clients.numbers import duration
from clients.program import call_on
from protocol.address import Address

REFRESH_S: Final = 0.1
_ANSWERS: Final = {"y": "tare", "u": "undo", "c": "clear"}
"""Keys that answer the question whether to tare, and what they do."""


class View(Widget):
    """Rows of text, of which only those that change are drawn."""

    can_focus = False

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[Text] = []
        self._strips: list[Strip] = []

    def show(self, rows: list[Text]) -> None:
        """Show these rows."""
        width = self.size.width
        if len(rows) != len(self._rows):
            self._rows, self._strips = [], []
            self.refresh()
        for y, row in enumerate(rows):
            if y < len(self._rows):
                if row == self._rows[y]:
                    continue
                self._strips[y] = self._strip(row, width)
                self.refresh(Region(0, y, width, 1))
            else:
                self._strips.append(self._strip(row, width))
        self._rows = rows

    def _strip(self, row: Text, width: int) -> Strip:
        return Strip(row.render(self.app.console)).adjust_cell_length(width)

    def render_line(self, y: int) -> Strip:
        """One row, for Textual."""
        return self._strips[y] if y < len(self._strips) else Strip.blank(self.size.width)


class Monitor(App[None]):
    """Connects the keys, the model and the view."""

    TITLE = "ethercat-monitor"
    CSS = "Screen, View { background: ansi_default; color: ansi_default; width: 100%; height: 100%; }"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar = [("ctrl+z", "suspend_process", "suspend")]

    def __init__(
        self,
        model: Model,
        address: Address,
        glyphs: Glyphs,
        *,
        seconds: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`seconds`: exit after this time."""
        # The terminal's own background; Textual obeys NO_COLOR.
        super().__init__(ansi_color=True)
        self._model = model
        self._address = address
        self._clock = clock
        self._look = Look(glyphs=glyphs)
        self._view = View()
        self._seconds = seconds
        self.recorder = Recorder(address)
        """The caller closes it after the terminal is restored."""
        self._state: State | None = None
        self._to_tare: int | None = None
        """The position that the question is about."""

    def compose(self) -> ComposeResult:
        """The only widget."""
        yield self._view

    def on_mount(self) -> None:
        """Start the timers and the signal handlers."""
        call_on(asyncio.get_running_loop(), self.exit, "SIGTERM", "SIGHUP")
        self.app_resume_signal.subscribe(self, lambda _: self.repaint())
        self.set_interval(REFRESH_S, self.draw)
        if self._seconds is not None:
            self.set_timer(self._seconds, self.exit)

    def on_resize(self) -> None:
        """Draw for the new size."""
        self.call_after_refresh(self.draw)

    def draw(self) -> None:
        """Show the current state, or that of the time of the pause."""
        now_s = self._clock()
        ended = self.recorder.ended()
        if ended is not None:
            self._say(*ended)
        state = self._model.state(now_s)
        if self._look.paused and self._state is not None:
            state = replace(self._state, message=state.message)
        self._state = state
        recording = f"REC {duration(self.recorder.seconds(now_s))}" if self.recorder.running else ""
        look = replace(self._look, recording=recording)
        self._view.show(render(state, look, *self._view.size))

    def repaint(self) -> None:
        """Draw everything again, after something else has written to the terminal."""
        self._view.refresh()

    def action_help_quit(self) -> None:
        """Ctrl-C quits, instead of Textual's hint at another key."""
        self.exit()

    def on_key(self, event: events.Key) -> None:
        """Handle a key."""
        if event.key in {"ctrl+c", "ctrl+q", "ctrl+z"}:
            return
        event.stop()
        if event.key == "ctrl+l":
            self.repaint()
        elif self._look.question:
            self._answer((event.character or "").lower())
        elif self._look.help:
            self._look = replace(self._look, help=False)
        elif self._look.warnings and event.character != "w":
            self._look = replace(self._look, warnings=0)
        else:
            action = {
                "t": self._ask_tare,
                "r": self._record,
                "p": self._pause,
                " ": self._pause,
                "0": self._reset,
                "n": self._next,
                "w": self._warnings,
                "?": self._help,
                "h": self._help,
                "q": self.exit,
            }.get((event.character or "").lower())
            if action is not None:
                action()
        self.draw()

    def _selected(self) -> SensorState | None:
        sensors = self._state.sensors if self._state else ()
        return sensors[self._look.selected % len(sensors)] if sensors else None

    def _say(self, text: str, bad: bool = False) -> None:
        self._model.say(f"{clock_text()} {text}", bad=bad)

    def _ask_tare(self) -> None:
        sensor = self._selected()
        if sensor is None or self._state is None or not self._state.server.connected:
            self._say("No sensor to tare: not connected to the server", True)
            return

        self._to_tare = sensor.position
        answers = "y: yes, u: undo the last tare, c: clear it, any other key: no"
        self._look = replace(self._look, question=f"Tare sensor {sensor.position}? {answers}")

    def _answer(self, key: str) -> None:
        position, self._to_tare = self._to_tare, None
        self._look = replace(self._look, question="")
        way = _ANSWERS.get(key)
        if way is None or position is None:
            self._say("Not tared")
        else:
            self._say(WAYS[way].begins.format(position))
            start_tare(self._address, position, self._say, way)

    def _record(self) -> None:
        if self.recorder.running:
            self.recorder.stop()
            self._say("Stopping the recording")
        else:
            self._say(*self.recorder.start(self._clock()))

    def _pause(self) -> None:
        self._look = replace(self._look, paused="" if self._look.paused else clock_text())

    def _reset(self) -> None:
        self._model.reset()
        self._say("Peaks and past warnings are reset")

    def _next(self) -> None:
        count = len(self._state.sensors) if self._state else 0
        if count < 2:
            self._say("There is only one sensor" if count else "There is no sensor")
        else:
            self._look = replace(self._look, selected=(self._look.selected + 1) % count)

    def _warnings(self) -> None:
        self._look = replace(self._look, warnings=self._look.warnings + 1)

    def _help(self) -> None:
        self._look = replace(self._look, help=True)
