# SPDX-License-Identifier: Apache-2.0
"""The command line of every program: help with three examples first, `--version`, numbers within limits."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, Final, TypeVar

from bota_ethercat import option_types
from bota_ethercat.errors import SettingError
from bota_ethercat.option_types import OptionType
from bota_ethercat.program.command import command
from bota_ethercat.program.version import VERSION

_Value = TypeVar("_Value")

EXAMPLES: Final = """\
ethercat-server virtual 12001                              # a simulated sensor
sudo ethercat-server ens5 12001                            # the sensors on an interface
sudo ethercat-server ens5 12001 --set sinc_length=128      # with another filter
sudo ethercat-sensor find                                  # on which interface is a sensor?
ethercat-sensor objects                                    # all objects, of the server on this computer
sudo ethercat-sensor apply ens5 --set sinc_length=128      # change a setting
ethercat-doctor                                            # of the server on this computer, its interface
sudo ethercat-doctor ens5                                  # everything, on an interface
sudo ethercat-doctor ens5 --seconds 3600                   # for stalls that are rare
sudo ethercat-virtual-sensor veth0                         # a sensor on one end of a veth pair
sudo ethercat-virtual-sensor veth0 --sensors 2 --pdo 77    # a chain, with orientation
ethercat-virtual-sensor --send 'power cycle 2'             # a fault of the one that runs
ethercat-monitor                                           # of the server on this computer
ethercat-monitor --once                                    # a table and a verdict, for scripts
ethercat-monitor --web                                     # in a browser
ethercat-record run.mcap                                   # until Ctrl-C
ethercat-record run.mcap --for 5min                        # for some time
ethercat-record run.mcap --server robot:12001              # of another computer's server
ethercat-replay run.mcap                                   # as recorded, in place of the server
ethercat-replay run.mcap --loop                            # again and again
ethercat-replay run.mcap --speed max --server 12002        # as fast as clients read, on another port
ethercat-export run.mcap                                   # writes run.csv
ethercat-export run.mcap run.parquet                       # for pandas, polars, DuckDB, MATLAB
ethercat-export run.mcap --at frames.csv                   # what was measured before each camera frame
ethercat-report run.mcap                                   # write run.html
ethercat-report run.mcap -o cell3.html --note 'cell 3'     # into another file, with a remark
ethercat-report run.mcap --json                            # print the checks, too
ethercat-identify poses.mcap                               # mass, center of gravity, bias, with intervals
ethercat-identify poses.mcap --yaml tool.yaml              # also as parameters of the node
ethercat-identify delay shaken.mcap                        # how late force is, by a shaken sensor
"""


def examples_of(program: str) -> list[str]:
    """The rows of `EXAMPLES` that start it."""
    return [row for row in EXAMPLES.splitlines() if program in row.removeprefix("sudo ").split()[:1]]


class Parser(argparse.ArgumentParser):
    """The parser of a program, or of a subcommand."""

    def __init__(self, prog: str, description: str, epilog: str, **options: Any) -> None:
        super().__init__(prog=prog, description=description, epilog=epilog, **options)
        self.add_argument("--version", action="version", version=f"%(prog)s {VERSION}")

    def format_help(self) -> str:
        """The examples, then what argparse has."""
        rows = examples_of(self.prog)
        return "\n".join([*(["examples:", *map(command, rows), ""] if rows else []), super().format_help()])


def typed(convert: Callable[[str], _Value], what: str = "") -> Callable[[str], _Value]:
    """The type of an argument; for an error argparse says `what` it must be, or else itself."""

    def converted(text: str) -> _Value:
        try:
            return convert(text)
        except (ValueError, SettingError) as error:
            raise argparse.ArgumentTypeError(f"{text!r}: it must be {what}" if what else str(error)) from None

    return converted


def of_type(kind: OptionType[_Value]) -> Callable[[str], _Value]:
    """The type of an argument that is one of an option."""
    return typed(kind.parse, kind.allowed)


def number(low: float, high: float, what: str = "a number") -> Callable[[str], float]:
    """The type of an argument that is a number from `low` to `high`."""
    return of_type(option_types.number(low, high, what))


def whole(low: int, high: int) -> Callable[[str], int]:
    """The type of an argument that is a whole number, decimal or 0x..., from `low` to `high`."""
    return of_type(option_types.integer(low, high))


seconds = number(0.001, 1e9, "a number of seconds")
