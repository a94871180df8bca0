# SPDX-License-Identifier: Apache-2.0
"""What somebody may have meant by a name that there is not."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Final

_MAX_LENGTH: Final = 80
_MIN_PART: Final = 3
_MAX_NAMES: Final = 3
_CLOSE: Final = 0.75  # difflib's own 0.6 takes `tool_frame` for `tool_mass`


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The question to go on with after "no such name", such as "; did you mean 'fir'?"; may be empty."""
    names, word = list(known), word.lower()[:_MAX_LENGTH]
    close = names_with(word, names) or difflib.get_close_matches(word, names, 1, _CLOSE)
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def names_with(word: str, known: Iterable[str]) -> list[str]:
    """The shortest few names of which `word` is a part, as `sinc` is of `sinc_length` and `SINC length`."""
    if len(word) < _MIN_PART:
        return []
    part = re.compile(rf"(?<![^\W_]){re.escape(word)}(?![^\W_])", re.IGNORECASE)
    return sorted(filter(part.search, known), key=len)[:_MAX_NAMES]
