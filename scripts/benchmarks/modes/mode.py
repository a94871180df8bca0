"""What each file here provides, as `MODE`: a row of the table in program.py, and so an option."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from scripts.benchmarks.chain import Figures, Setup

NONE: Final = "-"


class Mode(NamedTuple):
    """An option of `scripts/benchmark`."""

    help: str
    measure: Callable[[Setup, Any], list[Figures]]
    """Takes a configuration and the option's argument; the rows of the result."""
    columns: Mapping[str, Callable[[Figures], str]]
    """Of the table, by heading: how a row is shown."""
    argument: Mapping[str, Any] | None = None
    """How argparse takes the option's argument, if it has one."""
    rates: tuple[int, ...] = (800,)
    sensors: tuple[int, ...] = (1,)
    seconds: float = 6.0
    page: Any = None
    """The argument with which the page is renewed; None: it is not on the page."""


def points(figures: Mapping[str, float] | None, *names: str, digits: int = 0) -> str:
    """Median and tail, or the points named, with slashes between them."""
    if not figures:
        return NONE
    return " / ".join(f"{figures[name]:.{digits}f}" for name in names or ("p50", "p99", "p999"))


def losses(row: Figures) -> str:
    """Lost samples, of them those lost while the machine stopped."""
    return f"{row['lost']} ({row['lost_in_stops']})" if row.get("lost") is not None else NONE
