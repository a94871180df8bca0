# SPDX-License-Identifier: Apache-2.0
"""`--print-completion SHELL`: what the shell needs to complete a program's options, written by shtab."""

from __future__ import annotations

import argparse
import sys
from typing import Any


def add_completion(parser: argparse.ArgumentParser) -> None:
    """Add the option."""
    parser.add_argument(
        "--print-completion", choices=("bash", "zsh", "tcsh"), action=_Print,
        help="print a script that completes options in this shell (needs shtab)",
    )  # fmt: skip


class _Print(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, _: Any, shell: Any, __: Any = None) -> None:
        try:
            import shtab  # noqa: PLC0415 - optional
        except ImportError:
            parser.exit(1, f"{parser.prog}: shtab is not installed: {sys.executable} -m pip install shtab\n")
        print(shtab.complete(parser, shell))  # noqa: T201 - what was asked for
        parser.exit()
