"""The words of the virtual sensor's command line: fault commands, and faults of its distributed clock.

What they do is in `faults` and `distributed_clock`, which need the whole sensor; `--help` needs this only.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from bota_ethercat.program.arguments import number, whole
from ethercat_server.virtual_sensor.options import UsageError, model_name
from ethercat_server.virtual_sensor.signals import CHANNELS, SIGNALS

MOST_SKIPPED: Final = 90.0  # %
PPM_LIMIT: Final = 100_000.0


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault command, or a word of a distributed clock.

    Each argument is parsed by one of `arguments`. Those in brackets in `usage` can be left out; the last one
    may be repeated where there are dots.
    """

    usage: str
    meaning: str
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


_COUNT, _LONG, _WORD, _BYTE = (whole(0, most) for most in (2**31, 2**32 - 1, 0xFFFF, 0xFF))
_AMOUNT = number(0, 1e6)


def _hex(text: str) -> bytes:
    with contextlib.suppress(ValueError):
        if len(data := bytes.fromhex(text)) <= 5:
            return data
    raise UsageError("the data of an emergency are at most 5 bytes in hexadecimal digits")


def _one_of(what: str, known: Sequence[str]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text.lower() not in known:
            raise UsageError(f"no {what} {text[:40]!r}: available: {', '.join(known)}")
        return text.lower()

    return parse


def _limit(text: str) -> float | None:
    return None if text == "off" else _AMOUNT(text)


_CHANNEL = _one_of("channel", CHANNELS)

COMMANDS: Final = (
    Fault("lose N", "lose the next N frames", (_COUNT,)),
    Fault("deaf [SECONDS]", "lose every frame until `hear`, or for this time", (_AMOUNT,)),
    Fault("deaf-after N", "lose every frame after the next N", (_COUNT,)),
    Fault("hear", "end `deaf`, `deaf-after`, `lose` and `damage`"),
    Fault("damage N [@N]", "corrupt the next N frames on the cable before this slave", (_COUNT,)),
    Fault("flap [@N]", "interrupt the link before this slave for a moment"),
    Fault("power off|on|cycle [SECONDS] [@N]",
        "switch a slave off or on; those behind one without power are cut off", (str, _AMOUNT)),
    Fault("disconnect [@N]", "unplug the cable at port 0"),
    Fault("connect [@N]", "end `disconnect`"),
    Fault("swap MODEL SERIAL [@N]", "replace the sensor by another one", (model_name, _LONG)),
    Fault("safeop CODE [@N]", "fall to SAFEOP with this AL status code", (_WORD,)),
    Fault("error CODE [@N]", "set the error bit and this AL status code", (_WORD,)),
    Fault("abort INDEX SUBINDEX CODE [@N]", "abort the next SDO on that entry", (_WORD, _BYTE, _LONG)),
    Fault("on-write INDEX SUBINDEX COMMAND ...",
        "execute a command after the next SDO write to that entry", (_WORD, _BYTE, str)),
    Fault("saving SECONDS [STATUS] [@N]",
        "duration and final status of the save command (0 = success)", (_AMOUNT, whole(0, 0xFE))),
    Fault("cut-save N [@N]", "lose power in the next save after N entries", (whole(0, 1000),)),
    Fault("mute-mailbox N [@N]", "drop the next N mailbox requests", (_COUNT,)),
    Fault("emergency CODE [REGISTER [HEX]] [@N]",
        "send a CoE emergency before anything else in the mailbox", (_WORD, _BYTE, _hex)),
    Fault("sii error|busy|ok [@N]",
        "result of reading the EEPROM", (_one_of("result", ("error", "busy", "ok")),)),
    Fault("warn BITS [SAMPLES] [@N]",
        "set warnings, permanently or for some samples", (_LONG, whole(1, 2**31))),
    Fault("stick [@N]", "repeat the same process data"),
    Fault("unstick [@N]", "end `stick`"),
    Fault("noise CHANNEL DEVIATION [@N]",
        "add noise of this standard deviation to a channel; 0 ends it", (_CHANNEL, _AMOUNT)),
    Fault("limit CHANNEL VALUE|off [@N]",
        "saturate a channel at plus and minus VALUE", (_CHANNEL, _limit)),
    Fault("freeze CHANNEL [@N]", "freeze a channel at its next value", (_CHANNEL,)),
    Fault("thaw CHANNEL [@N]", "end `freeze`", (_CHANNEL,)),
    Fault("skip PERCENT [@N]",
        "skip this percentage of the samples at random; 0 ends it", (number(0, MOST_SKIPPED),)),
    Fault("ppm X [@N]", "set the error of the sensor's clock", (number(-PPM_LIMIT, PPM_LIMIT),)),
    Fault("signal NAME [@N]", "measure another signal, from its beginning", (_one_of("signal", SIGNALS),)),
    Fault("dc WORD [VALUE] ... [@N]",
        "a fault of the distributed clock, as in --dc; `dc ok` ends it", (str, str)),
    Fault("stats", "counters and states, as JSON"),
    Fault("help", "this list"),
    Fault("quit", "end the program"),
)  # fmt: skip
CLOCK_WORDS: Final = (
    Fault("ok", "end all faults; rate and time stay as they are"),
    Fault("none", "no distributed clock: no feature bit, its registers read zero"),
    Fault("32-bit", "system and local time have 32 bits"),
    Fault("no-events", "no 0x09FC: it reads zero"),
    Fault("stuck", "0x09FC stands still"),
    Fault("late US", "0x09FC is late by this; negative is early", (number(-1e6, 1e6),)),
    Fault("at NS", "the local clock jumps to this time", (number(0, 2.0**62),)),
    Fault("ppm X", "rate of the local clock, without a jump of the time", (number(-PPM_LIMIT, PPM_LIMIT),)),
)  # fmt: skip
_FROM_POWER_ON: Final = ("none", "32-bit")  # which cannot come about while the controller runs


def parse_clock_word(name: str, values: Sequence[str], *, running: bool) -> tuple[str, list[Any]]:
    """One of `CLOCK_WORDS`, for a clock that is `running`, and its numbers; UsageError if it is wrong."""
    known = {word.name: word for word in CLOCK_WORDS if not (running and word.name in _FROM_POWER_ON)}
    word = known.get(name.lower())
    if word is None:
        raise UsageError(f"no {name[:40]!r} of a distributed clock: available: {', '.join(known)}")
    return word.name, word.parse(values)


def parse_clock(text: str) -> Iterator[tuple[str, list[Any]]]:
    """Words and numbers of an option such as `32-bit+late=50`, for power-on; UsageError if one is wrong."""
    for item in text.split("+") if text else ():
        name, _, values = item.partition("=")
        yield parse_clock_word(name, values.split("/") if values else [], running=False)
