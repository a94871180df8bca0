"""The pictures of the monitor in docs/: `python -m tests.clients.pictures` makes them again."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.text import Text

from bota_clients.monitor.model import State
from bota_clients.monitor.screen import ViewOptions, render
from tests.clients import monitor_states as made

DOCS: Final = Path(__file__).resolve().parents[2] / "docs"
AGAIN: Final = "make it again: python -m tests.clients.pictures"


def svg(state: State, look: ViewOptions, width: int, height: int) -> str:
    console = Console(
        width=width, height=height, record=True, file=io.StringIO(), force_terminal=True,
        color_system="truecolor", legacy_windows=False, _environ={},
    )  # fmt: skip
    head, body, foot = render(state, look, width)
    room = height - len(head) - len(foot)
    for row in [*head, *body[:room], *[Text()] * (room - len(body)), *foot]:
        console.print(row, soft_wrap=True)
    return console.export_svg(title="ethercat-monitor", unique_id="monitor")


def captures() -> Mapping[str, str]:
    """The terminal's view: name of the file to what it holds."""
    return {
        "monitor.svg": svg(made.healthy(), ViewOptions(recording="REC 42 s"), 80, 24),
        "monitor-warnings.svg": svg(made.troubled(), ViewOptions(), 80, 24),
        "monitor-gone.svg": svg(made.gone(), ViewOptions(), 60, 15),
    }


if __name__ == "__main__":
    for file, drawing in captures().items():
        (DOCS / file).write_text(drawing)
