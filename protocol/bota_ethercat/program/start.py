# SPDX-License-Identifier: Apache-2.0
"""Starts a program: Ctrl-C is never a traceback, whatever is being imported, and output never fails.

Few imports, for Python's own handler raises KeyboardInterrupt in the middle of them. While a program loads,
SIGINT and SIGTERM have their default action; `signals` is for when all is loaded.
"""

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # as early as can be: this is imported by entry points only

import io  # noqa: E402
import sys  # noqa: E402
from importlib import import_module  # noqa: E402

INTERRUPTED = 130  # Exit code after Ctrl-C, as shells have it


def run(module: str) -> int:
    """The exit code of `main` of this module, which handles Ctrl-C itself once it can."""
    for stream in (sys.stdout, sys.stderr):  # its encoding may lack characters
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        code: int = import_module(module).main()
    except KeyboardInterrupt:
        code = INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return code
