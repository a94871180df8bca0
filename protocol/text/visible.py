"""Text from the other side, made safe to print."""

from __future__ import annotations


def visible(text: str) -> str:
    """The same length of text on one line: `?` for each character that is none or that a terminal obeys."""
    return "".join(c if c.isprintable() else "?" for c in text)


def printable(value: object, limit: int = 200) -> str:
    """Text from the other side as it may appear in a log: one line, no control characters, not endless."""
    text = visible(str(value)[: limit + 1])
    return text if len(text) <= limit else text[: limit - 3] + "..."
