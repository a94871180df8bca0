"""`ethercat-sensor`: reads the command line, runs the subcommand, makes errors exit codes."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from types import FrameType
from typing import Final

from ethercat_server import __version__
from ethercat_server.errors import ServerError
from ethercat_server.logs import PlainFormatter
from ethercat_server.tool import (
    bus_commands,
    objects_command,
    settings_commands,
    snapshot,
    tare_command,
    watch,
)
from ethercat_server.tool.command import Command
from protocol.errors import ProtocolError

_FAILED: Final = 1
_EXIT_CODES: Final = (
    "exit codes: 0 done (plan: nothing to change), 1 failed, 2 wrong arguments, 3 plan: there are changes"
)

COMMANDS: Final[Mapping[str, Command]] = {
    command.name: command
    for module in (bus_commands, watch, objects_command, settings_commands, tare_command, snapshot)
    for command in module.COMMANDS
}


class _Formatter(PlainFormatter):
    prefix = "ethercat-sensor: "


def build_parser() -> argparse.ArgumentParser:
    """The command line up to the subcommand's name."""
    width = max(map(len, COMMANDS))
    summaries = "\n".join(f"  {name:{width}}  {command.summary}" for name, command in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="ethercat-sensor",
        usage="%(prog)s COMMAND [ARGUMENT ...]",
        description="Looks at Bota EtherCAT sensors and sets them up, on the interface or through a server.",
        epilog=f"commands (COMMAND --help tells more):\n{summaries}\n\n{_EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=list(COMMANDS), metavar="COMMAND", help="what to do, see below")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    return parser


def build_command_parser(command: Command) -> argparse.ArgumentParser:
    """The command line of one subcommand."""
    parser = argparse.ArgumentParser(
        prog=f"ethercat-sensor {command.name}",
        description=f"{command.summary[0].upper()}{command.summary[1:]}.",
        epilog=_EXIT_CODES,
    )
    command.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="JSON for programs")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand; returns its exit code. argparse exits with 2 for what it finds."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _interrupt)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Formatter())
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    arguments = sys.argv[1:] if argv is None else list(argv)
    # What stands behind the command is its own parser's, options and arguments mixed as one likes.
    command = COMMANDS[build_parser().parse_args(arguments[:1]).command]
    args = build_command_parser(command).parse_intermixed_args(arguments[1:])
    try:
        return command.run(args)
    except (ServerError, ProtocolError) as error:
        return _fail(args, str(error), getattr(error, "exit_code", _FAILED))
    except BrokenPipeError:
        # Whoever read the output has enough; Python would complain again when it closes it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _FAILED
    except OSError as error:
        return _fail(args, f"{error.filename or 'the operating system'}: {error.strerror or error}", _FAILED)
    except KeyboardInterrupt:
        return _fail(args, "stopped", _FAILED)


def _fail(args: argparse.Namespace, text: str, exit_code: int) -> int:
    if args.json:
        print(json.dumps({"error": text}))
    print(f"ethercat-sensor: {text}", file=sys.stderr)
    return exit_code


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
