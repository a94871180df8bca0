"""How far work is that takes longer than two seconds, and how long it will take: on a terminal only."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Final

_AFTER_S: Final = 2.0
_OFF = list[bool]()


def switch_off() -> None:
    """For a process that works beside others."""
    _OFF.append(True)


@contextlib.contextmanager
def progress(what: str, total: float) -> Iterator[Callable[[float], None]]:
    """Gives what is to be told how much of the total is done."""
    if _OFF or sys.stderr is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich import progress as parts  # noqa: PLC0415 - not for help
    from rich.console import Console  # noqa: PLC0415

    names: list[Any] = [parts.TextColumn("{task.description}"), parts.BarColumn()]
    names += [parts.TaskProgressColumn(), parts.TimeRemainingColumn()]
    bar = parts.Progress(*names, console=Console(stderr=True), transient=True)
    task, begun_s = bar.add_task(what, total=total), time.monotonic()

    def reach(done: float) -> None:
        bar.update(task, completed=done)
        if not bar.live.is_started and time.monotonic() - begun_s > _AFTER_S:
            bar.start()

    try:
        yield reach
    finally:
        bar.stop()
