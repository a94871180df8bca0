"""Options of a simulated sensor and of a foreign slave; the numbers in options and commands."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.sensor.objects.dictionary import MODELS
from ethercat_server.virtual_sensor.world import World

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

    kind: str  # one of `foreign.KINDS`
    state: AlState = AlState.INIT  # in which another master has left it; a drive in OP turns


SlaveOptions = SensorOptions | ForeignOptions


def model_name(text: str) -> str:
    """Parses the name of a model; UsageError if a sensor cannot have it."""
    if not text.isascii() or len(text) > 20:
        raise UsageError(f"model {text!r} must have at most 20 ASCII characters, such as {MODELS[0]}")
    return text


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault command, or a word of a distributed clock: `run` takes what it is for, and the arguments.

    Each is parsed by one of `arguments`. Those in brackets in `usage` can be left out; the last one may be
    repeated where there are dots.
    """

    usage: str
    meaning: str
    run: Callable[..., Any]
    arguments: tuple[Callable[[str], Any], ...] = ()

    @property
    def name(self) -> str:
        return self.usage.split()[0]

    def parse(self, words: Sequence[str]) -> list[Any]:
        least = len(self.arguments) - self.usage.replace("[@N]", "").count("[")
        most = math.inf if "..." in self.usage else len(self.arguments)
        if not least <= len(words) <= most:
            raise UsageError(f"wrong number of arguments: {self.usage}")
        parsers = (*self.arguments, *self.arguments[-1:] * len(words))
        return [parse(word) for parse, word in zip(parsers, words, strict=False)]
