"""Progress on standard error: one line that is updated on a terminal, else a line every ten seconds."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from clients.numbers import data_size, duration
from clients.record.recorder import Recorder

_LINE_EVERY_S: Final = 10.0
_SHOW_EVERY_S: Final = 0.5


class Progress:
    """The progress line."""

    def __init__(self, name: str, seconds: float | None = None) -> None:
        """For a recording of so many seconds, if there is a limit."""
        self._name = name
        self._of = "" if seconds is None else f" of {duration(seconds)}"
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._began = time.monotonic()
        self._next = self._began + (_SHOW_EVERY_S if self._console.is_terminal else _LINE_EVERY_S)
        self._seen: dict[int, int] = {}
        self._seen_at = self._began

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def say(self, sentence: str) -> None:
        """Print a sentence above the progress line."""
        self._console.print(sentence, markup=False, soft_wrap=True)

    def show(self, recorder: Recorder, *, connected: bool) -> None:
        """Update the progress if it is due."""
        now = time.monotonic()
        if now < self._next:
            return
        terminal = self._console.is_terminal
        if not (connected or terminal):
            return  # the disconnect was reported already
        self._next = now + (_SHOW_EVERY_S if terminal else _LINE_EVERY_S)
        line = self._line(recorder, now, connected=connected)
        if terminal:
            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
        else:
            self.say(line)

    def _line(self, recorder: Recorder, now: float, *, connected: bool) -> str:
        rates = []
        for position, sensor in sorted(dict(recorder.tally.sensors).items()):
            rate = (sensor.frames - self._seen.get(position, 0)) / (now - self._seen_at)
            self._seen[position] = sensor.frames
            rates.append(f"{rate:.0f}")
        self._seen_at = now
        state = f"{' + '.join(rates) or '0'} frames/s" if connected else "no server, reconnecting"
        size, lost = data_size(recorder.bytes_written), recorder.tally.brief()
        passed = duration(now - self._began) + self._of
        return f"{self._name}: {passed}, {recorder.saved} frames, {size}, {state}, {lost}"
