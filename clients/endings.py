"""Ends that the programs here have in common: a package is missing, nobody reads what is written."""

from __future__ import annotations

import contextlib
import os
import sys


def missing(name: object) -> str:
    """That a package or program is not installed, and how to get it."""
    return f"{name} is not installed: pip install 'bota-ethercat-bridge[tools]'"


def not_installed(program: str, error: ImportError) -> int:
    """Say what is missing; returns the exit code."""
    sys.stderr.write(f"{program}: {missing(error.name)}\n")
    return 1


def hush() -> None:
    """Nobody reads our output any more: let nothing complain of it at the end."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
