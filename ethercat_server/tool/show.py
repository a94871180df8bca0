"""Output of the subcommands: text in columns, or one JSON object."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

from ethercat_server.access.sensors import Sensors
from ethercat_server.sensor.sensor import Found
from protocol.text.json_text import finite


def say(text: str) -> None:
    """One line, or several, on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def report(as_json: bool, opened: Sensors, found: Found, values: dict[str, Any], *lines: str) -> None:
    """The result for one sensor: a JSON object with `values`, or the sensor's name and `lines`."""
    if as_json:
        say_json({"through": opened.used, **found.as_json(), **values})
    else:
        say("\n".join([str(found), *lines]))


def say_json(value: dict[str, Any], *, indent: int | None = 2) -> None:
    """One JSON object; infinite and NaN become null."""
    say(json.dumps(finite(value), indent=indent, ensure_ascii=False, allow_nan=False))


def columns(rows: Sequence[Sequence[str]], indent: int = 0) -> str:
    """The rows with their columns aligned; the last column is not padded."""
    widths = [max(len(row[n]) for row in rows if len(row) > n + 1) for n in range(max(map(len, rows)) - 1)]
    lines = []
    for row in rows:
        cells = [cell.ljust(widths[n]) if n < len(row) - 1 else cell for n, cell in enumerate(row)]
        lines.append((" " * indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)


def value_text(value: object) -> str:
    """A setting's or an object's value as text."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:g}"
    return "--" if value is None else str(value)
