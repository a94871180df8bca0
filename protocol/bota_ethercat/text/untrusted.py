# SPDX-License-Identifier: Apache-2.0
"""Text and rows from files and the network, made safe to print: one line, no control characters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def visible(text: str) -> str:
    """The same length of text on one line: `?` for each character that is none or that a terminal obeys."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)


def printable(value: object, limit: int = 200) -> str:
    """Text from the other side as it may appear in a log: one line, no control characters, not endless."""
    text = visible(str(value)[: limit + 1])
    return text if len(text) <= limit else text[: limit - 3] + "..."


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


def mapping(value: object) -> Mapping[str, Any]:
    """A JSON object; an empty one if it is none."""
    return value if isinstance(value, dict) else {}


def rows(value: object) -> list[dict[str, Any]]:
    """The objects in a list."""
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []
