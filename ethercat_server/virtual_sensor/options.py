"""Options of a simulated sensor and of a foreign slave, and of a chain of them."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from bota_ethercat.option_types import choice, text
from bota_ethercat.program.arguments import of_type
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.sensor.models import MODELS
from ethercat_server.virtual_sensor.signals import World

HOLD, ZERO, FAULT = LOST = ("hold", "zero", "fault")  # what a world that has stopped is taken for
COUPLER, ANALOG_INPUTS, DIGITAL_INPUTS, DRIVE = KINDS = ("EK1100", "EL3102", "EL1008", "DRIVE")
SENSOR: Final = "BOTA"  # in a chain with these
MOST_SLAVES: Final = 16
_KIND, _STATE = of_type(choice(SENSOR, *KINDS)), of_type(choice("INIT", "PREOP", "SAFEOP", "OP"))
EEPROM_MS: Final = 2.0  # about what a real EEPROM needs for the eight bytes of a read command


# Wrong or contradictory options, or a command that is wrong or cannot be executed: a sentence.
UsageError = argparse.ArgumentTypeError


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """One sensor."""

    model: str = MODELS[0]
    serial: int = 1
    pdo_size: int = 61
    sinc_length: int | None = None  # None: the value in flash, by default 64
    chop_divides: int = 1  # by what CHOP divides its sampling rate
    ppm: float = 0.0  # error of its clock: positive is fast
    dc: str = ""  # its distributed clock, in `distributed_clock.CLOCK_WORDS`: `32-bit+ppm=20+late=50`
    signal: str = "scene"
    world: World | None = None  # instead of the signal
    noise: bool = True  # of a healthy sensor, in scenes and worlds
    last_bit: bool = True  # noise of the converters where there is no other: no two samples are the same
    seed: int = 0
    state: AlState = AlState.INIT  # in which another master has left it
    eeprom_ms: float = EEPROM_MS  # time that reading from its EEPROM takes


@dataclass(frozen=True, slots=True)
class ForeignOptions:
    """One slave of another vendor."""

    kind: str  # one of `KINDS`
    state: AlState = AlState.INIT  # in which another master has left it; a drive in OP turns


SlaveOptions = SensorOptions | ForeignOptions


model_name: Final = of_type(
    text(f"at most 20 ASCII characters, such as {MODELS[0]}", lambda name: name.isascii() and len(name) <= 20)
)


def parse_chain(slaves: str) -> list[tuple[str, AlState]]:
    """Kind and initial AL state of each slave, such as `EK1100,BOTA,DRIVE:OP`, in wire order.

    UsageError if one is unknown.
    """
    found = []
    for word in slaves.split(","):
        kind, _, state = word.strip().upper().partition(":")
        found.append((_KIND(kind), AlState[_STATE(state or "INIT")]))
    if len(found) > MOST_SLAVES:
        raise UsageError(f"{len(found)} slaves in the chain: at most {MOST_SLAVES}")
    return found


def slaves_in(
    chain: Iterable[tuple[str, AlState]], sensors: Sequence[SensorOptions] = ()
) -> tuple[SlaveOptions, ...]:
    """The options of the slaves in a parsed chain; `sensors` are its sensors, the default ones if too few."""
    slaves: list[SlaveOptions] = []
    given, number = iter(sensors), 0
    for kind, state in chain:
        if kind == SENSOR:
            number += 1
            sensor = next(given, SensorOptions(serial=number))
            slaves.append(replace(sensor, state=state))
        else:
            slaves.append(ForeignOptions(kind, state))
    return tuple(slaves)
