"""Numbers, times and lists as people read them."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence

_LAST_STAMP_NS = 4_102_444_800 * 10**9
"""The year 2100: later stamps come from a broken clock."""


def figure(value: float, digits: int = 3) -> str:
    """A number with `digits` significant digits, without an exponent from 1e-5 to 1e7."""
    if not math.isfinite(value):
        return "not a number" if math.isnan(value) else "infinite"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -5 <= exponent < 7:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - exponent)
    return f"{value:.{decimals}f}"


def share(part: float, whole: float) -> str:
    return f"{figure(100 * part / whole, 2)} %" if whole else "not known"


def listing(texts: Sequence[str], most: int = 6) -> str:
    """`a, b and c`; only the first `most` if there are more."""
    if len(texts) > most:
        return ", ".join(texts[:most]) + f" and {len(texts) - most} more"
    return " and ".join([", ".join(texts[:-1]), texts[-1]] if len(texts) > 1 else texts)


def count(number: int, noun: str) -> str:
    """`1 sample`, `12 345 samples`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}".replace(",", " ")


def seconds(value: float) -> str:
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
    if not 0 < stamp_ns < _LAST_STAMP_NS:
        return "at an invalid time"
    then = datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.UTC)
    return then.strftime("%Y-%m-%d %H:%M:%S UTC")


def quantity(value: float, digits: int, width: int = 0) -> str:
    """A number with its sign; one that does not fit `width` loses digits, not magnitude."""
    if not math.isfinite(value):
        return "nan".rjust(width)
    if value == 0:
        value = 0.0  # -0.0 has a sign
    text = f"{value:+.{digits}f}"
    if width and len(text) > width:
        text = f"{value:+.{max(0, width - 7)}e}"
    return text.rjust(width)


def duration(seconds: float) -> str:
    """A duration in whole seconds: `4 s`, `3m05s`, `1h02m`, `2d03h`."""
    whole = max(0, int(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes, second = divmod(whole, 60)
    hours, minute = divmod(minutes, 60)
    days, hour = divmod(hours, 24)
    if days:
        return f"{days}d{hour:02d}h"
    return f"{hour}h{minute:02d}m" if hours else f"{minute}m{second:02d}s"


def milliseconds(value_us: float) -> str:
    """A time in µs as milliseconds."""
    return f"{value_us / 1e3:.2f}" if value_us < 99_950 else f"{value_us / 1e3:.0f}"
