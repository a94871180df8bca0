"""Fault injection by text commands: what each command of `commands.COMMANDS` does.

A command is one line: its name, arguments, and anywhere `@N` to mean sensor N, or `#N` the slave at
position N of the chain (from 0; without it sensor 0). The answer is one line: `ok ...`, or `error: ` and a
sentence.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from bota_ethercat.program.arguments import whole
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.virtual_sensor.application import Application, VirtualSlave
from ethercat_server.virtual_sensor.bus import SlaveChain
from ethercat_server.virtual_sensor.commands import COMMANDS, parse_clock_word
from ethercat_server.virtual_sensor.esc import SiiInterface
from ethercat_server.virtual_sensor.options import UsageError
from ethercat_server.virtual_sensor.sensor import Firmware, VirtualSensor
from ethercat_server.virtual_sensor.signals import CHANNELS

LONGEST_LINE: Final = 1000


@dataclass(frozen=True, slots=True)
class Call:
    """A command for a slave of a bus."""

    bus: SlaveChain
    slave: VirtualSlave

    @property
    def sensor(self) -> VirtualSensor:
        if not isinstance(self.slave, VirtualSensor):
            raise UsageError("that slave is no sensor: choose one with `@N`")
        return self.slave

    @property
    def application(self) -> Application:
        if self.slave.life is None:
            raise UsageError("it has no power: use `power on` first")
        return self.slave.life

    @property
    def firmware(self) -> Firmware:
        if self.sensor.life is None:
            raise UsageError("the sensor has no power: use `power on` first")
        return self.sensor.life

    def _power(self, how: str, seconds: float | None = None) -> None:
        if how not in ("on", "off", "cycle") or (how == "cycle") == (seconds is None):
            raise UsageError("power takes `on`, `off` or `cycle SECONDS`")
        self.bus.power(self.slave, how == "on", seconds)

    def _swap(self, model: str, serial: int) -> None:
        self.sensor.swap(model, serial)
        self.bus.power(self.sensor, True)

    def _on_write(self, index: int, subindex: int, *command: str) -> None:
        action = _parse(self.bus, command, self.slave)  # for the same slave, at the end of the frame
        self.sensor.on_write[index, subindex] = lambda: self.bus.due.append(action)

    def _saving(self, seconds: float, result: int = 0) -> None:
        self.sensor.flash.seconds, self.sensor.flash.result = seconds, result

    def _cut_save(self, count: int) -> None:
        sensor = self.sensor
        sensor.flash.cut = count, lambda: self.bus.due.append(lambda: self.bus.power(sensor, False))

    def _emergency(self, code: int, register: int = 0, data: bytes = b"") -> None:
        if self.application.state < AlState.PREOP or not self.application.device.protocols:
            raise UsageError("its mailbox is off: it needs one, and PREOP or above")
        self.application.mailbox.raise_emergency(code, register, data)

    def _channel_fault(self, kind: str, channel: str, value: float | None, on: bool) -> None:
        sampler, position = self.firmware.sampler, CHANNELS.index(channel)
        faults: dict[int, float | None] = getattr(sampler, kind)
        if not on:
            faults.pop(position, None)
        elif kind != "frozen" or position not in faults:
            faults[position] = value
        sampler.changed()

    def _dc(self, word: str, *values: str) -> None:
        name, numbers = parse_clock_word(word, values, running=True)
        if not self.application.esc.clock.present:
            raise UsageError("that slave has no distributed clock: start it without `--dc none`")
        self.application.esc.clock.apply(name, numbers)


# By the names of `COMMANDS`.
EFFECTS: Final[dict[str, Callable[..., Any]]] = {
    "lose": lambda c, n: c.bus.lose(n),
    "deaf": lambda c, seconds=math.inf: setattr(c.bus, "deaf_until", c.bus.now + seconds * 1e9),
    "deaf-after": lambda c, n: c.bus.lose(math.inf, n),
    "hear": lambda c: c.bus.repair(),
    "damage": lambda c, n: setattr(c.bus, "damage", (c.slave, n) if n else None),
    "flap": lambda c: c.bus.flap(c.slave),
    "power": Call._power,
    "disconnect": lambda c: c.bus.connect(c.slave, False),
    "connect": lambda c: c.bus.connect(c.slave, True),
    "swap": Call._swap,
    "safeop": lambda c, code: c.application.fail(AlState.SAFEOP, code),
    "error": lambda c, code: c.application.fail(c.application.state, code),
    "abort": lambda c, index, sub, code: c.firmware.dictionary.aborts.update({(index, sub): code}),
    "on-write": Call._on_write,
    "saving": Call._saving,
    "cut-save": Call._cut_save,
    "mute-mailbox": lambda c, n: setattr(c.application.mailbox, "mute", n),
    "emergency": Call._emergency,
    "sii": lambda c, result: c.application.esc.sii.fail(SiiInterface.FAULTS[result]),
    "warn": lambda c, bits, samples=None: c.firmware.sampler.set_warnings(bits, samples),
    "stick": lambda c: setattr(c.firmware.sampler, "stuck", c.firmware.sampler.newest()),
    "unstick": lambda c: setattr(c.firmware.sampler, "stuck", b""),
    "noise": lambda c, channel, value: c._channel_fault("noise", channel, value, value > 0),
    "limit": lambda c, channel, value: c._channel_fault("limits", channel, value, value is not None),
    "freeze": lambda c, channel: c._channel_fault("frozen", channel, None, True),
    "thaw": lambda c, channel: c._channel_fault("frozen", channel, None, False),
    "skip": lambda c, percent: c.firmware.sampler.set_skip(percent),
    "ppm": lambda c, ppm: c.sensor.set_ppm(ppm),
    "signal": lambda c, name: c.sensor.set_signal(name),
    "dc": Call._dc,
    "stats": lambda c: json.dumps(c.bus.statistics(), separators=(",", ":")),
    "help": lambda _: " | ".join(f"{c.usage}: {c.meaning}" for c in COMMANDS),
    "quit": lambda c: setattr(c.bus, "quit", True),
}

BY_NAME: Final = {command.name: (command, EFFECTS[command.name]) for command in COMMANDS}


def obey(bus: SlaveChain, line: str) -> str:
    """Execute one command; returns the answer without a line end."""
    try:
        result = _parse(bus, line.split(), None)()
    except UsageError as error:
        return f"error: {error}"
    return f"ok {result}" if result else "ok"


def _parse(bus: SlaveChain, line: Sequence[str], slave: VirtualSlave | None) -> Callable[[], str | None]:
    """The command in `line`, for `slave` unless it names another; UsageError if it is invalid.

    What it returns executes it, and returns the text after `ok`.
    """
    positions = [word for word in line if word.startswith(("@", "#"))]
    words = [word for word in line if word not in positions]
    if not words:
        raise UsageError("an empty line: type `help` for the commands")
    if (name := words[0].lower()) not in BY_NAME:
        raise UsageError(f"no command {words[0][:40]!r}: type `help` for the commands")
    command, run = BY_NAME[name]
    arguments = command.parse(words[1:])
    if len(positions) > 1:
        raise UsageError("more than one slave: use `@N` or `#N` once")
    for position in positions:
        slaves: Sequence[VirtualSlave] = bus.sensors if position[0] == "@" else bus.slaves
        slave = slaves[whole(0, len(slaves) - 1)(position[1:])]
    call = Call(bus, slave or (bus.sensors or bus.slaves)[0])
    return lambda: run(call, *arguments)
