"""Values from the peer's JSON: used if they are of the right type, else treated as absent.

Texts lose what a terminal would obey.
"""

from __future__ import annotations

from protocol.text.json_text import JsonObject
from protocol.text.visible import printable


def text(value: object) -> str:
    """A printable text; empty if it is none."""
    return printable(value) if isinstance(value, str) else ""


def number(value: object) -> float | None:
    """A number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def whole(value: object) -> int | None:
    """A whole number of a size that counts have."""
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= 1 << 64:
        return None
    return value


def rows(value: object) -> list[JsonObject]:
    """The objects in a list."""
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []
