"""Faults on command: one table of text commands, what they do, and the help text made from it.

A command is one line: its name, arguments, and `@N` anywhere to mean sensor N of the chain (from 0;
without it sensor 0). The answer is one line: `ok ...`, or `error: ` and a sentence.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from ethercat_server.objects import MODELS
from ethercat_server.virtual_sensor.al import AlState
from ethercat_server.virtual_sensor.bus import Bus, Damage
from ethercat_server.virtual_sensor.disturbance import CHANNELS, MOST_SKIPPED, Disturbances
from ethercat_server.virtual_sensor.firmware import Firmware
from ethercat_server.virtual_sensor.sensor import VirtualSensor
from ethercat_server.virtual_sensor.signals import SIGNALS
from ethercat_server.virtual_sensor.sii import SiiInterface

LONGEST_LINE: Final = 1000
PPM_LIMIT: Final = 100_000.0


class CommandError(Exception):
    """A command that cannot be done; its text is a sentence."""


class QuitCommand(Exception):  # noqa: N818
    """Someone asked the virtual sensor to end."""


@dataclass(frozen=True, slots=True)
class _Call:
    bus: Bus
    sensor: VirtualSensor
    arguments: list[str]

    @property
    def life(self) -> Firmware:
        if self.sensor.life is None:
            raise CommandError("that sensor has no power: switch it on first with `power on`")
        return self.sensor.life


@dataclass(frozen=True, slots=True)
class FaultCommand:
    """One command."""

    name: str
    usage: str
    counts: Sequence[int]
    """Numbers of arguments that it takes."""
    meaning: str
    run: Callable[[_Call], str | None]


def whole(text: str, lowest: int, highest: int) -> int:
    """A whole number, decimal or 0x...; CommandError if it is none or out of range."""
    try:
        value = int(text, 0)
    except ValueError:
        raise CommandError(f"{text!r} is no whole number: write it as 27 or 0x1B") from None
    if not lowest <= value <= highest:
        raise CommandError(f"{text} is out of range: it must be from {lowest} to {highest}")
    return value


def real(text: str, lowest: float, highest: float) -> float:
    """A finite number; CommandError if it is none or out of range."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not lowest <= value <= highest:
        raise CommandError(f"{text!r} must be a number from {lowest:g} to {highest:g}")
    return value


def _lose(call: _Call) -> None:
    call.bus.lose = whole(call.arguments[0], 0, 2**31)


def _deaf(call: _Call) -> None:
    seconds = real(call.arguments[0], 0, 1e6) if call.arguments else math.inf
    call.bus.deaf_until = call.bus.now + seconds * 1e9


def _deaf_after(call: _Call) -> None:
    call.bus.deaf_after = whole(call.arguments[0], 0, 2**31)


def _hear(call: _Call) -> None:
    call.bus.deaf_until = call.bus.deaf_after = None
    call.bus.lose = 0
    call.bus.damage = None


def _port(call: _Call, at: int) -> int:
    port = whole(call.arguments[at], 0, 1) if len(call.arguments) > at else 0
    if port == 1 and call.sensor is call.bus.sensors[-1]:
        raise CommandError("port 1 of the last sensor is open: nothing comes from there")
    return port


def _damage(call: _Call) -> None:
    frames, port = whole(call.arguments[0], 0, 2**31), _port(call, 1)
    call.bus.damage = Damage(call.sensor, port, frames) if frames else None


def _flap(call: _Call) -> None:
    call.bus.flap(call.sensor, _port(call, 0))


def _power(call: _Call) -> None:
    match call.arguments:
        case ["on"]:
            call.bus.power(call.sensor, True)
        case ["off"]:
            call.bus.power(call.sensor, False)
        case ["cycle", seconds]:
            call.bus.power(call.sensor, False, real(seconds, 0, 1e6))
        case _:
            raise CommandError("power takes `on`, `off` or `cycle SECONDS`")


def _safeop(call: _Call) -> None:
    code = whole(call.arguments[0], 0, 0xFFFF)
    call.life.fail(AlState.SAFEOP, code)


def _error(call: _Call) -> None:
    code = whole(call.arguments[0], 0, 0xFFFF)
    call.life.fail(call.life.al.state, code)


def _warn(call: _Call) -> None:
    bits = whole(call.arguments[0], 0, 0xFFFFFFFF)
    samples = whole(call.arguments[1], 1, 2**31) if len(call.arguments) > 1 else None
    call.life.set_warnings(bits, samples)


def _stick(call: _Call) -> None:
    call.life.stick(True)


def _unstick(call: _Call) -> None:
    call.life.stick(False)


def _channel(call: _Call) -> tuple[str, Disturbances]:
    name = call.arguments[0].lower()
    if name not in CHANNELS:
        raise CommandError(f"no channel {name[:40]!r}: the channels are {', '.join(CHANNELS)}")
    life = call.life
    if life.exact:
        raise CommandError("the signal `clock` is always exact: use another one")
    life.disturbed()
    return name, life.disturbances


def _noise(call: _Call) -> None:
    channel, disturbances = _channel(call)
    disturbances.set_noise(channel, real(call.arguments[1], 0, 1e6))


def _limit(call: _Call) -> None:
    channel, disturbances = _channel(call)
    text = call.arguments[1]
    disturbances.set_limit(channel, None if text == "off" else real(text, 0, 1e6))


def _freeze(call: _Call) -> None:
    channel, disturbances = _channel(call)
    disturbances.freeze(channel, True)


def _thaw(call: _Call) -> None:
    channel, disturbances = _channel(call)
    disturbances.freeze(channel, False)


def _skip(call: _Call) -> None:
    call.life.set_skip(real(call.arguments[0], 0, MOST_SKIPPED))


def _swap(call: _Call) -> None:
    model, serial = call.arguments
    if not model.isascii() or not 1 <= len(model) <= 20:
        raise CommandError(f"model {model!r} must have 1 to 20 ASCII characters, such as {MODELS[0]}")
    call.sensor.swap(model, whole(serial, 0, 0xFFFFFFFF))
    call.bus.power(call.sensor, True)


def _abort(call: _Call) -> None:
    index, subindex = whole(call.arguments[0], 0, 0xFFFF), whole(call.arguments[1], 0, 0xFF)
    call.life.aborts.arm((index, subindex), whole(call.arguments[2], 0, 0xFFFFFFFF))


def _on_write(call: _Call) -> None:
    address = whole(call.arguments[0], 0, 0xFFFF), whole(call.arguments[1], 0, 0xFF)
    later = _parse(call.bus, " ".join(call.arguments[2:]), call.sensor)

    def do() -> None:
        with contextlib.suppress(CommandError):  # it has no power then
            later()

    call.sensor.on_write(address, do)


def _saving(call: _Call) -> None:
    flash = call.sensor.flash
    flash.seconds = real(call.arguments[0], 0, 1e6)
    flash.result = whole(call.arguments[1], 0, 0xFE) if len(call.arguments) > 1 else 0


def _cut_save(call: _Call) -> None:
    sensor, count = call.sensor, whole(call.arguments[0], 0, 1000)
    sensor.flash.cut = count, lambda: sensor.due.append(lambda: call.bus.power(sensor, False))


def _sii(call: _Call) -> None:
    faults = SiiInterface.FAULTS.get(call.arguments[0])
    if faults is None:
        raise CommandError(f"sii takes {', '.join(SiiInterface.FAULTS)}")
    call.life.esc.sii.fail(faults)


def _mute(call: _Call) -> None:
    call.life.mailbox.mute = whole(call.arguments[0], 0, 2**31)


def _ppm(call: _Call) -> None:
    call.sensor.set_ppm(real(call.arguments[0], -PPM_LIMIT, PPM_LIMIT))


def _signal(call: _Call) -> None:
    name = call.arguments[0].lower()
    if name not in SIGNALS:
        raise CommandError(f"no signal {name[:40]!r}: there are {', '.join(SIGNALS)}")
    call.sensor.set_signal(name)


def _stats(call: _Call) -> str:
    return json.dumps(call.bus.statistics(), separators=(",", ":"))


def _help(_call: _Call) -> str:
    return " | ".join(f"{c.usage}: {c.meaning}" for c in COMMANDS)


def _quit(_call: _Call) -> None:
    raise QuitCommand


COMMANDS: Final[tuple[FaultCommand, ...]] = (
    FaultCommand("lose", "lose N", (1,), "lose the next N frames", _lose),
    FaultCommand("deaf", "deaf [SECONDS]", (0, 1), "lose every frame, until `hear` or for a time", _deaf),
    FaultCommand("deaf-after", "deaf-after N", (1,), "answer N frames more, then be `deaf`", _deaf_after),
    FaultCommand("hear", "hear", (0,), "end `deaf`, `deaf-after`, `lose` and `damage`", _hear),
    FaultCommand(
        "damage", "damage N [PORT] [@N]", (1, 2),
        "damage the next N frames on their way to this sensor: to port 0, or back to port 1", _damage,
    ),
    FaultCommand("flap", "flap [PORT] [@N]", (0, 1), "the link at port 0 or 1 goes and comes back", _flap),
    FaultCommand(
        "power", "power off|on|cycle SECONDS [@N]", (1, 2),
        "switch a sensor off or on; what was not saved is gone, and sensors behind it are cut off", _power,
    ),
    FaultCommand("safeop", "safeop CODE [@N]", (1,), "fall to SAFEOP with this AL status code", _safeop),
    FaultCommand("error", "error CODE [@N]", (1,), "set the error bit and this AL status code", _error),
    FaultCommand(
        "warn", "warn BITS [SAMPLES] [@N]", (1, 2), "set warnings, for ever or some samples", _warn
    ),
    FaultCommand("stick", "stick [@N]", (0,), "give the same process data for ever", _stick),
    FaultCommand("unstick", "unstick [@N]", (0,), "end `stick`", _unstick),
    FaultCommand(
        "noise", "noise CHANNEL DEVIATION [@N]", (2,),
        "add noise of this standard deviation to a channel; 0 ends it", _noise,
    ),
    FaultCommand(
        "limit", "limit CHANNEL VALUE|off [@N]", (2,), "saturate a channel at plus and minus VALUE", _limit
    ),
    FaultCommand("freeze", "freeze CHANNEL [@N]", (1,), "keep a channel at what it reads next", _freeze),
    FaultCommand("thaw", "thaw CHANNEL [@N]", (1,), "end `freeze`", _thaw),
    FaultCommand(
        "skip", "skip PERCENT [@N]", (1,), "withhold this share of the samples, at random; 0 ends it", _skip
    ),
    FaultCommand("swap", "swap MODEL SERIAL [@N]", (2,), "put another sensor in its place", _swap),
    FaultCommand(
        "abort", "abort INDEX SUBINDEX CODE [@N]", (3,), "abort the next SDO on that entry", _abort
    ),
    FaultCommand(
        "on-write", "on-write INDEX SUBINDEX COMMAND ...", range(3, 7),
        "do a command right after the next SDO write to that entry", _on_write,
    ),
    FaultCommand(
        "saving", "saving SECONDS [STATUS] [@N]", (1, 2),
        "from now on the save command takes so long, and ends with this status", _saving,
    ),
    FaultCommand(
        "cut-save", "cut-save N [@N]", (1,), "lose power in the next save, after N entries of it", _cut_save
    ),
    FaultCommand("mute-mailbox", "mute-mailbox N [@N]", (1,), "swallow the next N mailbox requests", _mute),
    FaultCommand("sii", "sii error|busy|ok [@N]", (1,), "how reading its EEPROM ends", _sii),
    FaultCommand("ppm", "ppm X [@N]", (1,), "change the error of the sensor's clock", _ppm),
    FaultCommand("signal", "signal NAME [@N]", (1,), "measure another signal, from its beginning", _signal),
    FaultCommand("stats", "stats", (0,), "counters and states, as JSON", _stats),
    FaultCommand("help", "help", (0,), "this list", _help),
    FaultCommand("quit", "quit", (0,), "end the virtual sensor", _quit),
)  # fmt: skip

_BY_NAME: Final = {command.name: command for command in COMMANDS}


def obey(bus: Bus, line: str) -> str:
    """Do one command and give the answer, without a line end. QuitCommand if it was `quit`."""
    try:
        result = _run(bus, line)
    except CommandError as error:
        return f"error: {error}"
    return f"ok {result}" if result else "ok"


def _run(bus: Bus, line: str) -> str | None:
    return _parse(bus, line, None)()


def _parse(bus: Bus, line: str, sensor: VirtualSensor | None) -> Callable[[], str | None]:
    """What the command in `line` does, to `sensor` unless it names another; CommandError if it is none."""
    words = line.split()
    places = [word for word in words if word.startswith("@")]
    words = [word for word in words if not word.startswith("@")]
    if not words:
        raise CommandError("an empty line: type `help` for the commands")
    command = _BY_NAME.get(words[0].lower())
    if command is None:
        raise CommandError(f"no command {words[0][:40]!r}: type `help` for the commands")
    if len(words) - 1 not in command.counts:
        raise CommandError(f"wrong number of arguments: {command.usage}")
    if len(places) > 1:
        raise CommandError("more than one sensor named: one `@N` a command")
    if places:
        sensor = bus.sensors[whole(places[0][1:], 0, len(bus.sensors) - 1)]
    call = _Call(bus, sensor or bus.sensors[0], words[1:])
    return lambda: command.run(call)
