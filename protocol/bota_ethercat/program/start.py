# SPDX-License-Identifier: Apache-2.0
"""Starts a program: Ctrl-C is never a traceback, whatever is being imported, and output never fails, also
where a standard stream is closed (`>&-`).

Few imports, for Python's own handler raises KeyboardInterrupt in the middle of them. While a program loads,
SIGINT and SIGTERM have their default action; `signals` is for when all is loaded.
"""

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # as early as can be: this is imported by entry points only

import io  # noqa: E402
import os  # noqa: E402
import sys  # noqa: E402
from importlib import import_module  # noqa: E402

INTERRUPTED = 130  # Exit code after Ctrl-C, as shells have it


def run(module: str) -> int:
    """The exit code of `main` of this module, which handles Ctrl-C itself once it can."""
    open_streams()
    try:
        code: int = import_module(module).main()
    except KeyboardInterrupt:
        code = INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return code


def open_streams() -> None:
    """Have nothing on closed standard streams; else files and sockets would get their descriptors.

    What the encoding of an open one lacks is escaped.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)  # the lowest that is free
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
            stream = open(number, "w" if number else "r", encoding="utf-8", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)
    for output in (sys.stdout, sys.stderr):
        if isinstance(output, io.TextIOWrapper):
            output.reconfigure(errors="backslashreplace")
