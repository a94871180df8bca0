"""Fault injection by text commands.

A command is one line: its name, arguments, and anywhere `@N` to mean sensor N, or `#N` the slave at
position N of the chain (from 0; without it sensor 0). The answer is one line: `ok ...`, or `error: ` and a
sentence.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from bota_ethercat.option_types import choice, hexadecimal
from bota_ethercat.program.arguments import number, of_type, whole
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.virtual_sensor.distributed_clock import parse_clock_word
from ethercat_server.virtual_sensor.fault import PPM_LIMIT, Fault
from ethercat_server.virtual_sensor.options import UsageError, model_name
from ethercat_server.virtual_sensor.signals import CHANNELS, SIGNALS

if TYPE_CHECKING:  # --help, which shows the table, need not wait for the sensor
    from ethercat_server.virtual_sensor.application import Application, VirtualSlave
    from ethercat_server.virtual_sensor.bus import SlaveChain
    from ethercat_server.virtual_sensor.sensor import Firmware, VirtualSensor

LONGEST_LINE: Final = 1000
_MOST_SKIPPED: Final = 90.0  # %


@dataclass(frozen=True, slots=True)
class Call:
    """A command for a slave of a bus."""

    bus: SlaveChain
    slave: VirtualSlave

    @property
    def sensor(self) -> VirtualSensor:
        for sensor in self.bus.sensors:
            if sensor is self.slave:
                return sensor
        raise UsageError("that slave is no sensor: choose one with `@N`")

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
        fault, numbers = parse_clock_word(word, values, running=True)
        if not self.application.esc.clock.present:
            raise UsageError("that slave has no distributed clock: start it without `--dc none`")
        self.application.esc.clock.apply(fault, numbers)


_COUNT, _LONG, _WORD, _BYTE = (whole(0, most) for most in (2**31, 2**32 - 1, 0xFFFF, 0xFF))
_AMOUNT = number(0, 1e6)


def _limit(text: str) -> float | None:
    return None if text == "off" else _AMOUNT(text)


_CHANNEL = of_type(choice(*CHANNELS))

COMMANDS: Final[tuple[Fault, ...]] = (
    Fault("lose N", "lose the next N frames", lambda c, n: c.bus.lose(n), (_COUNT,)),
    Fault("deaf [SECONDS]", "lose every frame until `hear`, or for this time",
          lambda c, seconds=math.inf: setattr(c.bus, "deaf_until", c.bus.now + seconds * 1e9), (_AMOUNT,)),
    Fault("deaf-after N", "lose every frame after the next N",
          lambda c, n: c.bus.lose(math.inf, n), (_COUNT,)),
    Fault("hear", "end `deaf`, `deaf-after`, `lose` and `damage`", lambda c: c.bus.repair()),
    Fault("damage N [@N]", "corrupt the next N frames on the cable before this slave",
          lambda c, n: setattr(c.bus, "damage", (c.slave, n) if n else None), (_COUNT,)),
    Fault("flap [@N]", "interrupt the link before this slave for a moment", lambda c: c.bus.flap(c.slave)),
    Fault("power off|on|cycle [SECONDS] [@N]",
          "switch a slave off or on; those behind one without power are cut off",
          Call._power, (str, _AMOUNT)),
    Fault("disconnect [@N]", "unplug the cable at port 0", lambda c: c.bus.connect(c.slave, False)),
    Fault("connect [@N]", "end `disconnect`", lambda c: c.bus.connect(c.slave, True)),
    Fault("swap MODEL SERIAL [@N]", "replace the sensor by another one", Call._swap, (model_name, _LONG)),
    Fault("safeop CODE [@N]", "fall to SAFEOP with this AL status code",
          lambda c, code: c.application.fail(AlState.SAFEOP, code), (_WORD,)),
    Fault("error CODE [@N]", "set the error bit and this AL status code",
          lambda c, code: c.application.fail(c.application.state, code), (_WORD,)),
    Fault("abort INDEX SUBINDEX CODE [@N]", "abort the next SDO on that entry",
          lambda c, index, sub, code: c.firmware.dictionary.aborts.update({(index, sub): code}),
          (_WORD, _BYTE, _LONG)),
    Fault("on-write INDEX SUBINDEX COMMAND ...", "execute a command after the next SDO write to that entry",
          Call._on_write, (_WORD, _BYTE, str)),
    Fault("saving SECONDS [STATUS] [@N]", "duration and final status of the save command (0 = success)",
          Call._saving, (_AMOUNT, whole(0, 0xFE))),
    Fault("cut-save N [@N]", "lose power in the next save after N entries",
          Call._cut_save, (whole(0, 1000),)),
    Fault("mute-mailbox N [@N]", "drop the next N mailbox requests",
          lambda c, n: setattr(c.application.mailbox, "mute", n), (_COUNT,)),
    Fault("emergency CODE [REGISTER [HEX]] [@N]", "send a CoE emergency before anything else in the mailbox",
          Call._emergency, (_WORD, _BYTE, of_type(hexadecimal(0, 5)))),
    Fault("sii error|busy|ok [@N]", "result of reading the EEPROM",
          lambda c, result: c.application.esc.sii.fail(c.application.esc.sii.FAULTS[result]),
          (of_type(choice("error", "busy", "ok")),)),
    Fault("warn BITS [SAMPLES] [@N]", "set warnings, permanently or for some samples",
          lambda c, bits, samples=None: c.firmware.sampler.set_warnings(bits, samples),
          (_LONG, whole(1, 2**31))),
    Fault("stick [@N]", "repeat the same process data",
          lambda c: setattr(c.firmware.sampler, "stuck", c.firmware.sampler.newest())),
    Fault("unstick [@N]", "end `stick`", lambda c: setattr(c.firmware.sampler, "stuck", b"")),
    Fault("noise CHANNEL DEVIATION [@N]", "add noise of this standard deviation to a channel; 0 ends it",
          lambda c, channel, value: c._channel_fault("noise", channel, value, value > 0),
          (_CHANNEL, _AMOUNT)),
    Fault("limit CHANNEL VALUE|off [@N]", "saturate a channel at plus and minus VALUE",
          lambda c, channel, value: c._channel_fault("limits", channel, value, value is not None),
          (_CHANNEL, _limit)),
    Fault("freeze CHANNEL [@N]", "freeze a channel at its next value",
          lambda c, channel: c._channel_fault("frozen", channel, None, True), (_CHANNEL,)),
    Fault("thaw CHANNEL [@N]", "end `freeze`",
          lambda c, channel: c._channel_fault("frozen", channel, None, False), (_CHANNEL,)),
    Fault("skip PERCENT [@N]", "skip this percentage of the samples at random; 0 ends it",
          lambda c, percent: c.firmware.sampler.set_skip(percent), (number(0, _MOST_SKIPPED),)),
    Fault("ppm X [@N]", "set the error of the sensor's clock",
          lambda c, ppm: c.sensor.set_ppm(ppm), (number(-PPM_LIMIT, PPM_LIMIT),)),
    Fault("signal NAME [@N]", "measure another signal, from its beginning",
          lambda c, name: c.sensor.set_signal(name), (of_type(choice(*SIGNALS)),)),
    Fault("dc WORD [VALUE] ... [@N]", "a fault of the distributed clock, as in --dc; `dc ok` ends it",
          Call._dc, (str, str)),
    Fault("stats", "counters and states, as JSON",
          lambda c: json.dumps(c.bus.statistics(), separators=(",", ":"))),
    Fault("help", "this list", lambda _: " | ".join(f"{c.usage}: {c.meaning}" for c in COMMANDS)),
    Fault("quit", "end the program", lambda c: setattr(c.bus, "quit", True)),
)  # fmt: skip
BY_NAME: Final = {command.name: command for command in COMMANDS}


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
    if (command := BY_NAME.get(words[0].lower())) is None:
        raise UsageError(f"no command {words[0][:40]!r}: type `help` for the commands")
    arguments = command.parse(words[1:])
    if len(positions) > 1:
        raise UsageError("more than one slave: use `@N` or `#N` once")
    for position in positions:
        slaves: Sequence[VirtualSlave] = bus.sensors if position[0] == "@" else bus.slaves
        slave = slaves[whole(0, len(slaves) - 1)(position[1:])]
    call = Call(bus, slave or (bus.sensors or bus.slaves)[0])
    return lambda: command.effect(call, *arguments)
