"""How the subcommands write: text for people in columns, one JSON object for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from typing import Any


def say(text: str) -> None:
    """One line, or several, on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """One line for people on standard error."""
    sys.stderr.write(f"ethercat-sensor: {text}\n")


def say_json(value: dict[str, Any], *, indent: int | None = 2) -> None:
    """One JSON object; numbers that JSON has not are null."""
    say(json.dumps(_clean(value), indent=indent, ensure_ascii=False, allow_nan=False))


def columns(rows: Sequence[Sequence[str]], indent: int = 0) -> str:
    """The rows with their columns aligned; the last column is left as it is."""
    widths = [max(len(row[n]) for row in rows if len(row) > n + 1) for n in range(max(map(len, rows)) - 1)]
    lines = []
    for row in rows:
        cells = [cell.ljust(widths[n]) if n < len(row) - 1 else cell for n, cell in enumerate(row)]
        lines.append((" " * indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)


def value_text(value: object) -> str:
    """A setting's or an object's value as people write it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:g}"
    return "--" if value is None else str(value)


def _clean(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _clean(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
