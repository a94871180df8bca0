"""The chain as one line of text: `EK1100,BOTA,EL3102,DRIVE:OP`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

from ethercat_server.virtual_sensor.foreign.kinds import KINDS
from ethercat_server.virtual_sensor.options import EEPROM_MS, ForeignOptions, SensorOptions, SlaveOptions
from ethercat_server.virtual_sensor.slave.al import AlState

SENSOR: Final = "BOTA"
MOST_SLAVES: Final = 16
_STATES: Final = tuple(state.name for state in AlState if state is not AlState.BOOT)


class ChainError(Exception):
    """A chain that cannot be simulated."""


def parse_chain(text: str) -> list[tuple[str, AlState]]:
    """Kind and initial AL state of each slave, in wire order; ChainError if one is unknown."""
    found = []
    for word in text.split(","):
        kind, _, state = word.strip().upper().partition(":")
        if kind != SENSOR and kind not in KINDS:
            raise ChainError(f"no slave {word[:40]!r}: available: {', '.join((SENSOR, *KINDS))}")
        if state and state not in _STATES:
            raise ChainError(f"no AL state in {word[:40]!r}: available: {', '.join(_STATES)}")
        found.append((kind, AlState[state or "INIT"]))
    if len(found) > MOST_SLAVES:
        raise ChainError(f"{len(found)} slaves in the chain: at most {MOST_SLAVES}")
    return found


def slaves_in(
    chain: Iterable[tuple[str, AlState]],
    sensors: Sequence[SensorOptions] = (),
    eeprom_ms: float = EEPROM_MS,
) -> tuple[SlaveOptions, ...]:
    """The options of the slaves in a parsed chain; `sensors` are its sensors, the default ones if too few."""
    slaves: list[SlaveOptions] = []
    number = 0
    for kind, state in chain:
        if kind == SENSOR:
            sensor = (
                sensors[number]
                if number < len(sensors)
                else SensorOptions(serial=number + 1, eeprom_ms=eeprom_ms)
            )
            slaves.append(replace(sensor, state=state))
            number += 1
        else:
            slaves.append(ForeignOptions(kind, state, eeprom_ms))
    return tuple(slaves)
