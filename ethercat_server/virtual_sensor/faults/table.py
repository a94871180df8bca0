"""Fault injection by text commands: parsing, execution, and the table of all commands.

A command is one line: its name, arguments, and anywhere `@N` to mean sensor N, or `#N` the slave at
position N of the chain (from 0; without it sensor 0). The answer is one line: `ok ...`, or `error: ` and a
sentence.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Final

from ethercat_server.virtual_sensor.bus import Bus, Slave
from ethercat_server.virtual_sensor.faults import bus, distributed_clock, firmware, measurement
from ethercat_server.virtual_sensor.faults.command import Action, Call, CommandError, FaultCommand, whole

LONGEST_LINE: Final = 1000


class QuitCommand(Exception):  # noqa: N818
    """The command `quit`."""


def _stats(call: Call) -> str:
    return json.dumps(call.bus.statistics(), separators=(",", ":"))


def _help(_call: Call) -> str:
    return " | ".join(f"{c.usage}: {c.meaning}" for c in COMMANDS)


def _quit(_call: Call) -> None:
    raise QuitCommand


COMMANDS: Final[tuple[FaultCommand, ...]] = (
    *bus.COMMANDS,
    *firmware.COMMANDS,
    *measurement.COMMANDS,
    *distributed_clock.COMMANDS,
    FaultCommand("stats", "stats", (0,), "counters and states, as JSON", _stats),
    FaultCommand("help", "help", (0,), "this list", _help),
    FaultCommand("quit", "quit", (0,), "end the program", _quit),
)  # fmt: skip

_BY_NAME: Final = {command.name: command for command in COMMANDS}


def obey(bus: Bus, line: str) -> str:
    """Execute one command; returns the answer without a line end. QuitCommand for `quit`."""
    try:
        result = _parse(bus, line, None)()
    except CommandError as error:
        return f"error: {error}"
    return f"ok {result}" if result else "ok"


def _parse(bus: Bus, line: str, slave: Slave | None) -> Action:
    """The command in `line`, for `slave` unless it names another; CommandError if it is invalid."""
    words = line.split()
    positions = [word for word in words if word.startswith(("@", "#"))]
    words = [word for word in words if word not in positions]
    if not words:
        raise CommandError("an empty line: type `help` for the commands")
    command = _BY_NAME.get(words[0].lower())
    if command is None:
        raise CommandError(f"no command {words[0][:40]!r}: type `help` for the commands")
    if len(words) - 1 not in command.counts:
        raise CommandError(f"wrong number of arguments: {command.usage}")
    if len(positions) > 1:
        raise CommandError("more than one slave: use `@N` or `#N` once")
    if positions:
        slaves: Sequence[Slave] = bus.sensors if positions[0][0] == "@" else bus.slaves
        slave = slaves[whole(positions[0][1:], 0, len(slaves) - 1)]
    chosen = slave or (bus.sensors or bus.slaves)[0]
    call = Call(bus, chosen, words[1:], lambda later: _parse(bus, later, chosen))
    return lambda: command.run(call)
