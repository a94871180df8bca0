"""Faults of the distributed clock: the words of `dc.kinds` as a command."""

from __future__ import annotations

from typing import Final

from ethercat_server.virtual_sensor.dc.kinds import ClockWordError, parse_word
from ethercat_server.virtual_sensor.faults.command import Call, CommandError, FaultCommand


def _dc(call: Call) -> None:
    word, *values = call.arguments
    try:
        apply = parse_word(word, values, running=True)
    except ClockWordError as error:
        raise CommandError(str(error)) from None
    if not call.application.esc.has_dc:
        raise CommandError("that slave has no distributed clock: start it without `--dc none`")
    apply(call.application.esc)


COMMANDS: Final[tuple[FaultCommand, ...]] = (
    FaultCommand(
        "dc", "dc WORD [VALUE] ... [@N]", (1, 2, 3),
        "a fault of the distributed clock, as in --dc; `dc ok` ends it", _dc,
    ),
)  # fmt: skip
