"""Makes what docs/compensation.md shows of the simulation: its figure and its table of gravity's error.

usage: python -m tests.compensation.figures. Takes about 10 s.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from tests.compensation import figure, gravity_table

PAGE: Final = figure.FIGURE.with_suffix(".md")


def with_table(page: str, lines: list[str]) -> str:
    """`page` with these lines in place of its table of gravity's error."""
    found, count = re.subn(r"(?m)^\| Tilt.*\n(\|.*\n)+", "\n".join(lines) + "\n", page)
    if count != 1:
        raise ValueError(f"{PAGE} has {count} tables that begin with '| Tilt', and not one")
    return found


def make(figure_path: Path = figure.FIGURE, page: Path = PAGE) -> None:
    """Write both."""
    turn = figure.samples()
    figure.draw(figure_path, turn, dict(figure.panels(turn)))
    table = gravity_table.lines(gravity_table.table())
    page.write_text(with_table(page.read_text(encoding="utf-8"), table), encoding="utf-8")


if __name__ == "__main__":
    make()
