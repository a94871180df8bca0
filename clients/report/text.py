"""Escaping by type: plain text becomes `Markup` only through `text`, so nothing gets in unescaped."""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import SupportsIndex

from protocol.text import visible


class Markup(str):
    """HTML that is ours or has been escaped."""

    __slots__ = ()

    def __add__(self, other: str) -> Markup:
        if not isinstance(other, Markup):
            raise TypeError("only Markup can be added to Markup: use text()")
        return Markup(str.__add__(self, other))

    def join(self, parts: Iterable[str]) -> Markup:
        """As `str.join`; every part must be Markup."""
        every = list(parts)
        if not all(isinstance(part, Markup) for part in every):
            raise TypeError("only Markup can be joined to Markup: use text()")
        return Markup(str.join(self, every))

    def __mul__(self, times: SupportsIndex) -> Markup:
        return Markup(str.__mul__(self, times))


def text(words: str) -> Markup:
    """Plain text, escaped; what a terminal or a bidirectional override could play with is shown as `?`."""
    return Markup(html.escape(visible(words)))


def element(name: str, inside: Markup, *, cls: str = "", id: str = "", aria_label: str = "") -> Markup:  # noqa: A002
    """`inside` in a tag of this name. The attributes are ours, never a device's."""
    if not isinstance(inside, Markup):
        raise TypeError("the inside of an element must be Markup: use text()")
    given = (("class", cls), ("id", id), ("aria-label", aria_label))
    attributes = "".join(f' {key}="{html.escape(value)}"' for key, value in given if value)
    return Markup(f"<{name}{attributes}>{inside}</{name}>")
