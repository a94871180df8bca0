"""`--print-completion SHELL`: what the shell needs to complete a program's arguments, written by shtab.

shtab is an optional package, loaded only for this: no program depends on it.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from bota_ethercat.sensor.filters import FORCE_TORQUE_FILTERS
from bota_ethercat.settings import SETTINGS

OPTION: Final = "--print-completion"
_SHELLS: Final = ("bash", "zsh", "tcsh")
_FILE: Final = re.compile(r"(FILE|PATH)\b|.*\.[a-z]+")
_BASH: Final = """
_bota_interfaces() { compgen -W "$(ls /sys/class/net) virtual" -- "$1"; }
_bota_settings() { compgen -W "%s" -- "$1"; }
"""

Build = Callable[[], argparse.ArgumentParser]


def add_completion(parser: argparse.ArgumentParser, whole: Build | None = None) -> None:
    """Add the option; `whole` builds the parser to complete if it is another, with subcommands."""
    parser.add_argument(
        OPTION, choices=_SHELLS, action=_Print, whole=whole or (lambda: parser),
        help="print a script that completes arguments in this shell (needs shtab)",
    )  # fmt: skip


class _Print(argparse.Action):
    """Prints the script and ends the program."""

    def __init__(self, *, whole: Build, **values: Any) -> None:
        super().__init__(**values)
        self._whole = whole

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,  # noqa: ARG002
        values: str | Sequence[Any] | None,
        option_string: str | None = None,  # noqa: ARG002
    ) -> None:
        try:
            import shtab  # noqa: PLC0415 - optional
        except ImportError:
            parser.exit(1, f"{parser.prog}: shtab is not installed: {sys.executable} -m pip install shtab\n")
        whole = self._whole()
        for action in _actions(whole):
            if (found := _completer(action, shtab.FILE)) is not None:
                vars(action)["complete"] = found
        preamble = _BASH % " ".join(_assignments()) if values == "bash" else ""
        print(shtab.complete(whole, str(values), preamble=preamble))  # noqa: T201 - what was asked for
        parser.exit()


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """All arguments, of subcommands too."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)


def _completer(action: argparse.Action, file: Any) -> Any:
    """What shtab is to complete the argument with, known by its name in the usage; None for nothing."""
    name = action.metavar if isinstance(action.metavar, str) else ""
    if name.startswith("IFACE"):
        return {"bash": "_bota_interfaces", "zsh": "_net_interfaces"}
    if name == "NAME=VALUE":
        return {"bash": "_bota_settings", "zsh": f"({' '.join(_assignments())})"}
    return file if _FILE.fullmatch(name) else None


def _assignments() -> Iterator[str]:
    """The settings with the values that are worth offering."""
    for name, setting in SETTINGS.items():
        values = FORCE_TORQUE_FILTERS if name == "sinc_length" else setting.choices or ("true", "false")
        yield from (f"{name}={value}" for value in values)
