"""Characters and styles of the view.

Nothing is told by colour alone: a bar, a peak mark and a warning differ in their characters too. The three
colours keep apart for the usual kinds of colour blindness, and on a light ground as on a dark one.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Glyphs(NamedTuple):
    """The characters of bars and traces."""

    full: str
    half_left: str
    """The left half of a cell; empty if there are none."""
    half_right: str
    track: str
    zero: str
    low: str
    """Marks the least value since the peaks were reset."""
    high: str
    levels: str
    """Of a trace, lowest first; the highest leaves a gap to the row above."""
    separator: str


UNICODE: Final = Glyphs("█", "▌", "▐", "─", "┼", "├", "┤", "▁▂▃▄▅▆▇", "·")
ASCII: Final = Glyphs("#", "", "", "-", "|", "[", "]", "_.,-=+*#", "|")

LABEL: Final = "dim"
VALUE: Final = "bold"
BAR: Final = "#2a94d6"
TRACK: Final = "dim"
PEAK: Final = "bold #d98200"
BAD: Final = "bold #d55e00"
ALARM: Final = "bold reverse #d55e00"
NOTICE: Final = "bold reverse"

_SPELLED: Final = {
    "²": "2", "°": "deg", "µ": "u", "±": "+-", "ω": "w", "…": "...", "·": "|",
}  # fmt: skip


def to_ascii(text: str) -> str:
    """The text for a terminal that shows nothing but ASCII."""
    if text.isascii():
        return text
    return "".join(_SPELLED.get(c, c if c.isascii() else "?") for c in text)


def can_show(encoding: str | None) -> bool:
    """Whether a stream of this encoding can carry the UNICODE glyphs."""
    try:
        ("".join(UNICODE) + "".join(_SPELLED)).encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True
