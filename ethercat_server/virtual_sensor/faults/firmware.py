"""Faults of AL states, SDOs, mailbox, flash and EEPROM."""

from __future__ import annotations

import contextlib
from typing import Final

from ethercat_server.virtual_sensor.esc.sii import SiiInterface
from ethercat_server.virtual_sensor.faults.command import Call, CommandError, FaultCommand, real, whole
from ethercat_server.virtual_sensor.slave.al import AlState


def _safeop(call: Call) -> None:
    code = whole(call.arguments[0], 0, 0xFFFF)
    call.application.fail(AlState.SAFEOP, code)


def _error(call: Call) -> None:
    code = whole(call.arguments[0], 0, 0xFFFF)
    call.application.fail(call.application.al.state, code)


def _abort(call: Call) -> None:
    index, subindex = whole(call.arguments[0], 0, 0xFFFF), whole(call.arguments[1], 0, 0xFF)
    call.life.aborts.arm((index, subindex), whole(call.arguments[2], 0, 0xFFFFFFFF))


def _on_write(call: Call) -> None:
    address = whole(call.arguments[0], 0, 0xFFFF), whole(call.arguments[1], 0, 0xFF)
    later = call.parse(" ".join(call.arguments[2:]))

    def do() -> None:
        with contextlib.suppress(CommandError):  # no power by then
            later()

    call.sensor.on_write(address, do)


def _saving(call: Call) -> None:
    flash = call.sensor.flash
    flash.seconds = real(call.arguments[0], 0, 1e6)
    flash.result = whole(call.arguments[1], 0, 0xFE) if len(call.arguments) > 1 else 0


def _cut_save(call: Call) -> None:
    sensor, count = call.sensor, whole(call.arguments[0], 0, 1000)
    sensor.flash.cut = count, lambda: sensor.due.append(lambda: call.bus.power(sensor, False))


def _mute(call: Call) -> None:
    call.application.mailbox.mute = whole(call.arguments[0], 0, 2**31)


def _emergency(call: Call) -> None:
    code, *more = call.arguments
    register = whole(more[0], 0, 0xFF) if more else 0
    try:
        data = bytes.fromhex(more[1]) if len(more) > 1 else b""
    except ValueError:
        data = bytes(6)
    if len(data) > 5:
        raise CommandError("the data of an emergency are at most 5 bytes in hexadecimal digits")
    if call.application.al.state < AlState.PREOP or not call.application.device.protocols:
        raise CommandError("its mailbox is off: it needs one, and PREOP or above")
    call.application.mailbox.raise_emergency(whole(code, 0, 0xFFFF), register, data)


def _on_request(call: Call) -> None:
    later = call.parse(" ".join(call.arguments))

    def do() -> None:
        with contextlib.suppress(CommandError):  # no power by then
            later()

    call.life.on_request = lambda: call.sensor.due.append(do)


def _sii(call: Call) -> None:
    faults = SiiInterface.FAULTS.get(call.arguments[0])
    if faults is None:
        raise CommandError(f"sii takes {', '.join(SiiInterface.FAULTS)}")
    call.application.esc.sii.fail(faults)


COMMANDS: Final[tuple[FaultCommand, ...]] = (
    FaultCommand("safeop", "safeop CODE [@N]", (1,), "fall to SAFEOP with this AL status code", _safeop),
    FaultCommand("error", "error CODE [@N]", (1,), "set the error bit and this AL status code", _error),
    FaultCommand(
        "abort", "abort INDEX SUBINDEX CODE [@N]", (3,), "abort the next SDO on that entry", _abort
    ),
    FaultCommand(
        "on-write", "on-write INDEX SUBINDEX COMMAND ...", range(3, 7),
        "execute a command after the next SDO write to that entry", _on_write,
    ),
    FaultCommand(
        "saving", "saving SECONDS [STATUS] [@N]", (1, 2),
        "duration and final status of the save command (0 = success)", _saving,
    ),
    FaultCommand(
        "cut-save", "cut-save N [@N]", (1,), "lose power in the next save after N entries", _cut_save
    ),
    FaultCommand("mute-mailbox", "mute-mailbox N [@N]", (1,), "drop the next N mailbox requests", _mute),
    FaultCommand(
        "emergency", "emergency CODE [REGISTER [HEX]] [@N]", (1, 2, 3),
        "send a CoE emergency before all that the mailbox holds", _emergency,
    ),
    FaultCommand(
        "on-request", "on-request COMMAND ...", range(1, 7),
        "execute a command after the next mailbox request, before its answer is read", _on_request,
    ),
    FaultCommand("sii", "sii error|busy|ok [@N]", (1,), "result of reading the EEPROM", _sii),
)  # fmt: skip
