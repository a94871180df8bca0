"""`ethercat-sensor`: reads the command line and runs the subcommand."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NoReturn

from bota_ethercat.program.arguments import Parser
from bota_ethercat.program.output import ends_with_its_reader
from bota_ethercat.text.did_you_mean import did_you_mean
from ethercat_server.process import command_line

if TYPE_CHECKING:
    from ethercat_server.tool.command import Subcommand

_PROGRAM: Final = "ethercat-sensor"
_EXIT_CODES: Final = "exit codes: 0 done, 1 failed, 2 wrong arguments, 3 apply --dry-run: there are changes"

# Subcommands: the module of each, which is loaded for it only, and what it does.
COMMANDS: Final = {
    "adapters": ("bus", "list the network adapters of this machine"),
    "find": ("bus", "look for sensors on all interfaces, without disturbing others"),
    "eeprom": ("bus", "read the slaves' SII (EEPROM): decoded, and raw words"),
    "objects": ("objects", "read and decode every object of the dictionary"),
    "read": ("objects", "read and decode some objects by name"),
    "apply": ("settings", "change settings, all or none, and verify them"),
    "save": ("settings", "store the sensor's parameters in its flash"),
    "tare": ("settings", "set the force/torque offset so that the mean reading becomes zero"),
    "snapshot": ("settings", "write all readable objects to a file"),
    "restore": ("settings", "write back what differs from a snapshot"),
    "filters": ("filters", "filters for a control loop: noise, delay, phase margin; needs no sensor"),
}


_NEGATIVE: Final = re.compile(r"-(\.?\d|inf|nan)")


class _Parser(Parser):
    """Recognizes all negative numbers, and reports errors as JSON with --json."""

    as_json = False

    def __init__(self, *values: Any, **options: Any) -> None:
        super().__init__(*values, **options)
        self._negative_number_matcher = _NEGATIVE  # argparse takes -1e-3 for an option

    def error(self, message: str) -> NoReturn:
        if self.as_json:
            sys.stdout.write(json.dumps({"error": message}) + "\n")
        super().error(message)


def build_parser() -> argparse.ArgumentParser:
    """The command line up to the subcommand's name."""
    width = max(map(len, COMMANDS))
    summaries = "\n".join(f"  {name:{width}}  {summary}" for name, (_, summary) in COMMANDS.items())
    parser = _Parser(
        _PROGRAM,
        "Inspects and configures Bota EtherCAT sensors, on the interface or through a server.",
        f"commands (see COMMAND --help):\n{summaries}\n\n{_EXIT_CODES}",
        usage="%(prog)s COMMAND [ARGUMENT ...]",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=list(COMMANDS), metavar="COMMAND", help="see below")
    return parser


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand; returns its exit code. argparse exits with 2 for what it finds."""
    command_line.begin(_PROGRAM)
    arguments = sys.argv[1:] if argv is None else list(argv)
    # The subcommand has a parser of its own, with options and arguments in any order.
    _Parser.as_json = "--json" in arguments
    parser = build_parser()
    named = bool(arguments) and not arguments[0].startswith("-")
    if named and arguments[0] not in COMMANDS:
        guess = did_you_mean(arguments[0], COMMANDS)
        parser.error(f"no command {arguments[0]!r}: there are {', '.join(COMMANDS)}{guess}")
    name: str = parser.parse_args(arguments[:1] if named else arguments).command
    module, summary = COMMANDS[name]
    command: Subcommand = import_module(f"ethercat_server.tool.{module}").COMMANDS[name]
    description = f"{summary[0].upper()}{summary[1:]}."
    parser = _Parser(f"{_PROGRAM} {name}", description, _EXIT_CODES)
    for add in command.arguments:
        add(parser)
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    args = parser.parse_intermixed_args(arguments[1:])
    return command_line.run(_PROGRAM, lambda: command.run(args), as_json=args.json)


if __name__ == "__main__":
    sys.exit(main())
