"""Faults of cables, power and connected devices."""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.sensor.objects.dictionary import MODELS
from ethercat_server.virtual_sensor.bus import Damage
from ethercat_server.virtual_sensor.faults.command import Call, CommandError, FaultCommand, real, whole


def _lose(call: Call) -> None:
    call.bus.lose = whole(call.arguments[0], 0, 2**31)


def _deaf(call: Call) -> None:
    seconds = real(call.arguments[0], 0, 1e6) if call.arguments else math.inf
    call.bus.deaf_until = call.bus.now + seconds * 1e9


def _deaf_after(call: Call) -> None:
    call.bus.deaf_after = whole(call.arguments[0], 0, 2**31)


def _hear(call: Call) -> None:
    call.bus.deaf_until = call.bus.deaf_after = None
    call.bus.lose = 0
    call.bus.damage = None


def _port(call: Call, at: int) -> int:
    port = whole(call.arguments[at], 0, 1) if len(call.arguments) > at else 0
    if port == 1 and call.slave is call.bus.slaves[-1]:
        raise CommandError("port 1 of the last slave is not connected")
    return port


def _damage(call: Call) -> None:
    frames, port = whole(call.arguments[0], 0, 2**31), _port(call, 1)
    call.bus.damage = Damage(call.slave, port, frames) if frames else None


def _flap(call: Call) -> None:
    call.bus.flap(call.slave, _port(call, 0))


def _power(call: Call) -> None:
    match call.arguments:
        case ["on"]:
            call.bus.power(call.slave, True)
        case ["off"]:
            call.bus.power(call.slave, False)
        case ["cycle", seconds]:
            call.bus.power(call.slave, False, real(seconds, 0, 1e6))
        case _:
            raise CommandError("power takes `on`, `off` or `cycle SECONDS`")


def _connect(call: Call) -> None:
    call.bus.connect(call.slave, True)


def _disconnect(call: Call) -> None:
    call.bus.connect(call.slave, False)


def _swap(call: Call) -> None:
    model, serial = call.arguments
    if not model.isascii() or not 1 <= len(model) <= 20:
        raise CommandError(f"model {model!r} must have 1 to 20 ASCII characters, such as {MODELS[0]}")
    call.sensor.swap(model, whole(serial, 0, 0xFFFFFFFF))
    call.bus.power(call.sensor, True)


COMMANDS: Final[tuple[FaultCommand, ...]] = (
    FaultCommand("lose", "lose N", (1,), "lose the next N frames", _lose),
    FaultCommand("deaf", "deaf [SECONDS]", (0, 1), "lose every frame, until `hear` or for a time", _deaf),
    FaultCommand("deaf-after", "deaf-after N", (1,), "lose every frame after the next N", _deaf_after),
    FaultCommand("hear", "hear", (0,), "end `deaf`, `deaf-after`, `lose` and `damage`", _hear),
    FaultCommand(
        "damage", "damage N [PORT] [@N]", (1, 2),
        "corrupt the next N frames on the cable at port 0 or 1 of this slave", _damage,
    ),
    FaultCommand("flap", "flap [PORT] [@N]", (0, 1), "interrupt the link at port 0 or 1 for a moment", _flap),
    FaultCommand(
        "power", "power off|on|cycle SECONDS [@N]", (1, 2),
        "switch a slave off or on; those behind one without power are cut off", _power,
    ),
    FaultCommand("disconnect", "disconnect [@N]", (0,), "unplug the cable at port 0", _disconnect),
    FaultCommand("connect", "connect [@N]", (0,), "end `disconnect`", _connect),
    FaultCommand("swap", "swap MODEL SERIAL [@N]", (2,), "replace the sensor by another one", _swap),
)  # fmt: skip
