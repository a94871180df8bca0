"""What shells complete of the programs (bash, zsh, fish) and what `man` shows, from the programs' parsers.

python -m scripts.completions FOLDER    writes FOLDER/share/, for the programs in FOLDER/pyproject.toml
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import tomllib
from pathlib import Path
from typing import Any, Final
from unittest import mock

import shtab
from argparse_manpage.manpage import Manpage

from bota_ethercat.program.arguments import Parser, examples_of

# Below share/, where shells and `man` look.
PLACES: Final = {
    "bash": "bash-completion/completions/{}",
    "zsh": "zsh/site-functions/_{}",
    "fish": "fish/vendor_completions.d/{}.fish",
    "man": "man/man1/{}.1",
}
OF_ROS: Final = "bridge-"  # programs whose names begin so take the arguments of ROS
_INTERFACES: Final = shtab.cmd("ls /sys/class/net")


class _ParsesError(Exception):
    """A program has made its parser and is about to parse."""


def parser_of(entry: str, *subcommand: str) -> argparse.ArgumentParser:
    """The parser that an entry point of [project.scripts] makes; with what shells complete of its values."""
    made = []

    def parse(parser: argparse.ArgumentParser, *_: Any) -> Any:
        made.append(parser)
        if subcommand and " " not in parser.prog:  # that of the subcommand comes next
            return argparse.Namespace(command=subcommand[0]), []
        raise _ParsesError

    module, _, name = entry.partition(":")
    with (
        mock.patch("argparse.ArgumentParser.parse_known_args", parse),
        mock.patch("argparse.ArgumentParser.parse_known_intermixed_args", parse),
        mock.patch("sys.argv", ["program", *subcommand]),
    ):
        try:
            getattr(importlib.import_module(module), name)()
        except _ParsesError:
            parser = made[-1]
        else:
            raise ValueError(f"{entry} parses no arguments: it has nothing that could be completed")
    for action in parser._actions:
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif action.metavar == "IFACE":
            action.complete = _INTERFACES  # type: ignore[attr-defined]
        elif action.dest == "command" and not subcommand:
            return _with_subcommands(parser, [parser_of(entry, name) for name in action.choices or ()])
    return parser


def _with_subcommands(
    parser: argparse.ArgumentParser, subcommands: list[argparse.ArgumentParser]
) -> argparse.ArgumentParser:
    whole = Parser(parser.prog, parser.description or "", subcommands[0].epilog or "", usage=parser.usage)
    added = whole.add_subparsers(metavar="COMMAND", title="commands", parser_class=argparse.ArgumentParser)
    for own in subcommands:
        what = own.description
        name = own.prog.rpartition(" ")[2]
        added.add_parser(name, prog=own.prog, parents=[own], add_help=False, description=what, help=what)
    return whole


def man_page(parser: argparse.ArgumentParser) -> str:
    """In the macros of man(7); a text that keeps its lines in --help does here."""
    page = Manpage(parser, {"manual_title": "EtherCAT force/torque sensors"})
    page.description = (parser.description or "").partition(". ")[0].rstrip(".")
    texts = {"examples": "\n".join(examples_of(parser.prog))}
    if parser.formatter_class is argparse.RawDescriptionHelpFormatter:
        texts["comments"] = parser.epilog or ""
    for heading, text in texts.items():
        escaped = re.sub(r"^(?=[.'])", r"\\&", text.replace("\\", r"\e").replace("-", r"\-"), flags=re.M)
        page.add_section(heading, "=", f".nf\n{escaped}\n.fi")
    return re.sub(r"^'", r"\\&'", str(page), flags=re.M)  # no request of roff


def write(folder: Path) -> None:
    """Raises ValueError and OSError."""
    os.environ["COLUMNS"] = "100"  # not those of this terminal
    scripts = tomllib.loads((folder / "pyproject.toml").read_text())["project"]["scripts"]
    for name, entry in scripts.items():
        if name.startswith(OF_ROS):
            continue
        parser = parser_of(entry)
        for kind, place in PLACES.items():
            path = folder / "share" / place.format(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(man_page(parser) if kind == "man" else shtab.complete(parser, kind))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="scripts.completions", description=__doc__)
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder)
