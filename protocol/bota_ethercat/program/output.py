# SPDX-License-Identifier: Apache-2.0
"""Standard output that cannot be written: its reader is gone, as in `PROGRAM | head`, or the disk is full."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import sys
from collections.abc import Callable
from typing import Final, ParamSpec

_P = ParamSpec("_P")
_NOT_WRITTEN: Final = frozenset({errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


def ends_with_its_reader(main: Callable[_P, int]) -> Callable[_P, int]:
    """A program's `main`, whose exit code is 1 once its output cannot be written: that nobody reads it is not
    told, a full disk is."""

    @functools.wraps(main)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> int:
        try:
            try:
                return main(*args, **kwargs)
            finally:  # argparse exits when it has printed its help
                sys.stdout.flush()
        except OSError as error:
            if not is_of_output(error):
                raise
            discard_output()
            if not isinstance(error, BrokenPipeError):
                program = sys.argv[0].rpartition(os.sep)[2]
                sys.stderr.write(f"{program}: the output cannot be written: {error.strerror}\n")
            return 1

    return wrapped


def is_of_output(error: OSError) -> bool:
    """Whether a program that opens its files by name failed to write its standard output."""
    return error.errno in _NOT_WRITTEN and error.filename is None


def discard_output() -> None:
    """Nobody reads it: avoid another error when Python flushes it at exit."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
