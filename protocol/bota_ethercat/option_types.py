# SPDX-License-Identifier: Apache-2.0
"""Types of options, within limits: arguments, files, control messages, settings, parameters of the node."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

_Value = TypeVar("_Value")
_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


@dataclass(frozen=True)
class OptionType(Generic[_Value]):
    """Values of one type within limits."""

    allowed: str  # which, after "it must be"
    convert: Callable[[Any], _Value]  # ValueError
    holds: Callable[[Any], object] = lambda _: True  # whether a value may be converted
    read: Callable[[str], object] = str  # what is written on a command line; ValueError
    limits: tuple[float, ...] = ()  # lowest and highest, of one number

    def check(self, value: object) -> _Value:
        """`value` if it is allowed; the text of ValueError is what is."""
        # Files and messages have whole numbers that no float can be.
        with contextlib.suppress(ValueError, OverflowError):
            if self.holds(value):
                return self.convert(value)
        raise ValueError(self.allowed)

    def parse(self, text: str) -> _Value:
        """The value that is written as `text`; ValueError as of `check`."""
        with contextlib.suppress(ValueError):
            return self.check(self.read(text))
        raise ValueError(self.allowed)


def integer(low: int, high: int) -> OptionType[int]:
    """A whole number; written, it may be 0x..., too."""
    return OptionType(
        f"a whole number from {low} to {high}", int,
        lambda value: type(value) is int and low <= value <= high, lambda text: int(text, 0), (low, high),
    )  # fmt: skip


def number(low: float, high: float, what: str = "a number") -> OptionType[float]:
    """A number, which may be whole; NaN is none."""
    return OptionType(
        f"{what} from {low:g} to {high:g}", float,
        lambda value: type(value) in (int, float) and low <= value <= high, float, (float(low), float(high)),
    )  # fmt: skip


def choice(*values: _Value) -> OptionType[_Value]:
    """One of several texts or whole numbers."""
    kind = type(values[0])
    return OptionType(
        f"one of {', '.join(map(str, values))}", lambda value: value,
        lambda value: type(value) is kind and value in values,
        str if kind is str else lambda text: int(text, 0),
    )  # fmt: skip


def text(allowed: str, holds: Callable[[str], object] = lambda _: True) -> OptionType[str]:
    """A text of which something holds."""
    return OptionType(allowed, str, lambda value: isinstance(value, str) and holds(value))


def hexadecimal(low: int, high: int) -> OptionType[bytes]:
    """Bytes, written in hexadecimal digits."""
    return OptionType(
        f"{low} to {high} bytes as hexadecimal digits, two each", bytes.fromhex,
        lambda value: isinstance(value, str) and low <= len(bytes.fromhex(value)) <= high,
    )  # fmt: skip


def several(each: OptionType[_Value], counts: Container[int], allowed: str) -> OptionType[tuple[_Value, ...]]:
    """A list."""
    return OptionType(
        allowed, lambda values: tuple(map(each.convert, values)),
        lambda values: hasattr(values, "__iter__") and not isinstance(values, str | bytes)
        and len(values) in counts and all(map(each.holds, values)),
    )  # fmt: skip


flag: Final = OptionType[bool](
    "true or false", bool, lambda value: type(value) is bool,
    lambda text: {**dict.fromkeys(_TRUE, True), **dict.fromkeys(_FALSE, False)}.get(text.strip().lower()),
)  # fmt: skip
