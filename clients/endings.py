"""Ends that the programs here have in common: a package is missing, nobody reads what is written."""

from __future__ import annotations

import contextlib
import os
import sys


def not_installed(program: str, error: ImportError) -> int:
    """Say what is missing and how to get it; returns the exit code."""
    missing = f"{error.name} is not installed: pip install 'bota-ethercat-bridge[tools]'"
    sys.stderr.write(f"{program}: {missing}\n")
    return 1


def hush() -> None:
    """Nobody reads our output any more: let nothing complain of it at the end."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
