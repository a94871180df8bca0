"""What the subcommands share: their arguments, and their output as text in columns or one JSON object."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.program.server_choice import HELP
from bota_ethercat.text.json_text import finite
from ethercat_server.access.sensors import Sensors, choose, find_server
from ethercat_server.errors import BusError
from ethercat_server.ethercat.options import ALLOW_IP, ALLOW_IP_HELP
from ethercat_server.sensor.sensor import FoundSensor

DONE: Final = 0
CHANGES: Final = 3  # exit code of `apply --dry-run` when there is something to change
_FORCE: Final = "--force"

Argument = Callable[[Any], object]  # adds it to a parser


def argument(name: str, help_text: str, **options: Any) -> Argument:
    """An argument of a subcommand, as `add_argument` takes it; an option without a metavar is a switch."""
    if name.startswith("--") and "metavar" not in options:
        options["action"] = "store_true"
    return lambda parser: parser.add_argument(name, help=help_text, **options)


class Subcommand(NamedTuple):
    """One subcommand."""

    arguments: Sequence[Argument]
    run: Callable[[argparse.Namespace], int]  # returns the exit code; raises ServerError


def sensor_arguments(*, all_if_none: bool = False, take_over: str = _FORCE) -> tuple[Argument, ...]:
    """IFACE or --server, and --sensor; `take_over` is the option that takes over a bus in use."""
    iface = "interface the sensors are connected to ('virtual' for a virtual sensor); through the "
    force = "take over a bus in use: slaves of others in SAFEOP or OP are taken to PREOP, machines stop"
    default = "all" if all_if_none else "the only one"
    which = f"number on the bus from 0, serial:1234, or name (default: {default})"
    return (
        argument("iface", f"{iface}server that uses it, if there is one", nargs="?", metavar="IFACE"),
        argument("--server", f"connect to this server, as without IFACE {HELP}", metavar="HOST:PORT"),
        argument(take_over, force, dest="take_over"),
        lambda parser: parser.set_defaults(take_over_option=take_over),
        argument(ALLOW_IP, ALLOW_IP_HELP),
        argument("--sensor", which, metavar="WHICH"),
    )


@contextlib.contextmanager
def sensors_of(args: argparse.Namespace) -> Iterator[Sensors]:
    """The sensors given by the arguments; closed at the end.

    If a server uses the interface, through that server, with a note.
    """
    found = find_server(args.iface, args.server)
    if found is None:
        try:
            found = Sensors.on_interface(args.iface, force=args.take_over, allow_ip=args.allow_ip)
        except BusError as error:  # which advises the option that most commands have
            text = str(error).replace(f"; {_FORCE} ", f"; {args.take_over_option} ")
            raise BusError(text) from None
    with contextlib.closing(found):
        yield found


@contextlib.contextmanager
def sensor_of(args: argparse.Namespace) -> Iterator[tuple[Sensors, FoundSensor]]:
    """The same, and the one that is selected; UsageError if it is not unique."""
    with sensors_of(args) as opened:
        yield opened, choose(opened.sensors, args.sensor)


def chosen(opened: Sensors, args: argparse.Namespace) -> list[FoundSensor]:
    """The selected sensor, or all."""
    return opened.sensors if args.sensor is None else [choose(opened.sensors, args.sensor)]


def say(text: str) -> None:
    """One line, or several, on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def say_json(value: dict[str, Any]) -> None:
    """One JSON object; infinite and NaN become null."""
    say(json.dumps(finite(value), indent=2, allow_nan=False))


def report(as_json: bool, opened: Sensors, found: FoundSensor, values: dict[str, Any], *lines: str) -> None:
    """The result for one sensor: a JSON object with `values`, or the sensor's name and `lines`."""
    if as_json:
        say_json({"through": opened.used, **found.as_json(), **values})
    else:
        say("\n".join([str(found), *lines]))


def columns(rows: Sequence[Sequence[str]], indent: int = 0) -> str:
    """The rows with their columns aligned; the last column is not padded."""
    widths = [max(len(row[n]) for row in rows if len(row) > n + 1) for n in range(max(map(len, rows)) - 1)]
    lines = []
    for row in rows:
        cells = [cell.ljust(widths[n]) if n < len(row) - 1 else cell for n, cell in enumerate(row)]
        lines.append((" " * indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)


def value_text(value: object) -> str:
    """A setting's or an object's value as text."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:g}"
    return "--" if value is None else str(value)
