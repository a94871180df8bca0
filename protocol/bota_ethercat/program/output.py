# SPDX-License-Identifier: Apache-2.0
"""Standard output whose reader may go at any moment, as that of `PROGRAM | head` does."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable
from typing import ParamSpec

_P = ParamSpec("_P")


def ends_with_its_reader(main: Callable[_P, int]) -> Callable[_P, int]:
    """A program's `main`, whose exit code is 1 once nobody reads its output; nothing is said of it."""

    @functools.wraps(main)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> int:
        try:
            try:
                return main(*args, **kwargs)
            finally:  # argparse exits when it has printed its help
                if sys.stdout is not None:
                    sys.stdout.flush()
        except BrokenPipeError:
            discard_output()
            return 1

    return wrapped


def discard_output() -> None:
    """Nobody reads it: avoid another error when Python flushes it at exit."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
