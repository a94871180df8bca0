# SPDX-License-Identifier: Apache-2.0
"""What somebody may have meant by a name that there is not."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The question to go on with after "no such name", such as "; did you mean 'fir'?"; may be empty."""
    close = difflib.get_close_matches(word.lower()[:80], list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
