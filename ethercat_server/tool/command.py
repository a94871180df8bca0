"""Output of the subcommands: text in columns, or one JSON object."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.program.server_choice import HELP
from bota_ethercat.text.json_text import finite
from ethercat_server.access.sensors import Sensors, open_sensors
from ethercat_server.ethercat.nic import ALLOW_IP, ALLOW_IP_HELP
from ethercat_server.sensor.sensor import Found


def say(text: str) -> None:
    """One line, or several, on standard output."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def report(as_json: bool, opened: Sensors, found: Found, values: dict[str, Any], *lines: str) -> None:
    """The result for one sensor: a JSON object with `values`, or the sensor's name and `lines`."""
    if as_json:
        say_json({"through": opened.used, **found.as_json(), **values})
    else:
        say("\n".join([str(found), *lines]))


def say_json(value: dict[str, Any], *, indent: int | None = 2) -> None:
    """One JSON object; infinite and NaN become null."""
    say(json.dumps(finite(value), indent=indent, ensure_ascii=False, allow_nan=False))


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


DONE: Final = 0
CHANGES: Final = 3
"""Exit code of `plan` when there is something to change."""


class Command(NamedTuple):
    """One subcommand."""

    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    """Returns the exit code; raises ServerError."""


def add_sensor_arguments(
    parser: argparse.ArgumentParser, *, all_if_none: bool = False, take_over: bool = True
) -> None:
    """IFACE or --server, and --sensor; `--force` to take over a bus in use, unless it has another meaning."""
    parser.add_argument(
        "iface", nargs="?", metavar="IFACE",
        help="interface the sensors are connected to ('virtual' for a virtual sensor); "
        "through the server that uses it, if there is one",
    )  # fmt: skip
    parser.add_argument(
        "--server", metavar="HOST:PORT", help=f"connect to this server, as without IFACE {HELP}"
    )
    if take_over:
        parser.add_argument(
            "--force", action="store_true", dest="take_over",
            help="take over a bus in use: slaves of others in SAFEOP or OP are taken to PREOP, machines stop",
        )  # fmt: skip
    parser.set_defaults(take_over=False)
    parser.add_argument(ALLOW_IP, action="store_true", help=ALLOW_IP_HELP)
    default = "all" if all_if_none else "the only one"
    parser.add_argument(
        "--sensor",
        metavar="WHICH",
        help=f"number on the bus from 0, serial:1234, or name (default: {default})",
    )


@contextlib.contextmanager
def sensors_of(args: argparse.Namespace) -> Iterator[Sensors]:
    """The sensors given by the arguments (see `open_sensors`); closed at the end."""
    found = open_sensors(args.iface, args.server, force=args.take_over, allow_ip=args.allow_ip)
    with contextlib.closing(found):
        yield found
