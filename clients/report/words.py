"""Numbers and lists for people."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence

_LAST_STAMP_NS = 4_102_444_800 * 10**9
"""The year 2100: later stamps come from a broken clock."""


def figure(value: float, digits: int = 3) -> str:
    """A number with so many digits, without an exponent where that can be read."""
    if not math.isfinite(value):
        return "not a number" if math.isnan(value) else "infinite"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -5 <= exponent < 7:
        return f"{value:.{digits - 1}e}"
    places = max(0, digits - 1 - exponent)
    return f"{value:.{places}f}"


def share(part: float, whole: float) -> str:
    """A part of a whole in per cent."""
    return f"{figure(100 * part / whole, 2)} %" if whole else "not known"


def listing(texts: Sequence[str], most: int = 6) -> str:
    """`a, b and c`; only the first ones if there are many."""
    if len(texts) > most:
        return ", ".join(texts[:most]) + f" and {len(texts) - most} more"
    return " and ".join([", ".join(texts[:-1]), texts[-1]] if len(texts) > 1 else texts)


def count(number: int, noun: str) -> str:
    """`1 sample`, `12 345 samples`."""
    return f"{number:,} {noun}{'' if number == 1 else 'es' if noun.endswith('ch') else 's'}".replace(",", " ")


def seconds(value: float) -> str:
    """A span of time."""
    if value == 0:
        return "0 s"
    if value < 1e-3:
        return f"{figure(value * 1e6)} µs"
    if value < 1:
        return f"{figure(value * 1e3)} ms"
    if value < 600:
        return f"{figure(value)} s"
    return f"{figure(value / 60)} min"


def moment(stamp_ns: int) -> str:
    """CLOCK_REALTIME in UTC."""
    if not 0 < stamp_ns < _LAST_STAMP_NS:
        return "at a time that no clock can have"
    then = datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.UTC)
    return then.strftime("%Y-%m-%d %H:%M:%S UTC")
