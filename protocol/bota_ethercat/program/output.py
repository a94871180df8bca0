# SPDX-License-Identifier: Apache-2.0
"""Standard output and error that take every character: what the terminal's encoding lacks is spelled."""

from __future__ import annotations

import codecs
import io
import json
import sys
from typing import Final

# Characters of units and tables, and how ASCII writes them.
SPELLED: Final = {"²": "2", "°": "deg", "µ": "u", "±": "+-", "ω": "w", "…": "...", "·": "|"}


def never_fail() -> None:
    """Make both streams so."""
    codecs.register_error("spelled", _spell)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="spelled")


def _spell(error: UnicodeError) -> tuple[str, int]:
    """The handler of `codecs`: other characters become the escapes of JSON, which stays valid."""
    assert isinstance(error, UnicodeEncodeError)
    lacking = error.object[error.start : error.end]
    return "".join(SPELLED.get(c) or json.dumps(c)[1:-1] for c in lacking), error.end
