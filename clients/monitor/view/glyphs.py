"""Characters and styles of the view.

Nothing depends on color alone: bars, peak marks and warnings differ in their characters too. The three colors
can be told apart with common color blindness, on light and dark backgrounds.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from protocol.program.output import SPELLED


class Glyphs(NamedTuple):
    """The characters of bars and traces."""

    full: str
    half_left: str
    """The left half of a cell; empty if there are none."""
    half_right: str
    track: str
    zero: str
    low: str
    """Marks the minimum since the reset."""
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


def to_ascii(text: str) -> str:
    """The text for an ASCII terminal."""
    if text.isascii():
        return text
    return "".join(SPELLED.get(c, c if c.isascii() else "?") for c in text)


def can_show(encoding: str | None) -> bool:
    """Whether this encoding has the UNICODE glyphs."""
    try:
        ("".join(UNICODE) + "".join(SPELLED)).encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True
