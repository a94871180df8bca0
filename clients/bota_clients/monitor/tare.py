"""Tares a sensor through the server, or takes its tare back, in a thread and on a connection of its own."""

from __future__ import annotations

import contextlib
import threading
from array import array
from collections.abc import Callable, Sequence
from typing import Final

from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.control import SIX_NUMBERS, known_six
from bota_ethercat.errors import ConnectionFailedError, ProtocolError
from bota_ethercat.program.tare_memory import former, remember
from bota_ethercat.replies import Description, SensorInfo
from bota_ethercat.text.json_text import JsonObject

_TIMEOUT_S: Final = 60.0
_OFFSET: Final = 0x8000  # the sensor's force/torque offset, in sub-indices 1 to 6

Say = Callable[[str, bool], None]  # takes a message, and whether it is an error

WAYS: Final = {
    "tare": ("Taring sensor {}: keep it stationary", "sensor {} was {}tared"),
    "undo": ("Undoing the tare of sensor {}", "the tare of sensor {} was {}undone"),
    "clear": ("Clearing the offset of sensor {}", "the offset of sensor {} was {}cleared"),
}  # what can be done, the message when it begins, and that of its end


def start_tare(address: Address, position: int, say: Say, way: str = "tare") -> threading.Thread:
    """Do one of WAYS with the sensor at `position`; the thread, which is returned, says the result."""
    say(WAYS[way][0].format(position), False)
    thread = threading.Thread(target=lambda: say(*tare(address, position, way)), name="tare", daemon=True)
    thread.start()
    return thread


def tare(address: Address, position: int, way: str = "tare") -> tuple[str, bool]:
    """Tare the sensor, undo this user's last tare, or clear the offset; a message, and whether it failed."""
    done, failed = (WAYS[way][1].format(position, word) for word in ("", "not "))
    before: Sequence[float]
    after: Sequence[float]
    residual = ""
    try:
        with Client(address.port, address.host, stream=False, reconnect=False).connect() as client:
            sensor = _sensor(client.description, position)
            try:
                if way == "tare":
                    reply = client.ask("tare", _TIMEOUT_S, sensor=position)
                    before, after = (SIX_NUMBERS.check(reply.get(f"{key}_offset")) for key in ("old", "new"))
                    residual = _residual(reply.get("residual"))
                else:
                    before, after = _offset(sensor), [0.0] * 6
                    if way == "undo":
                        after = former(sensor.serial, before, f"sensor {position}")
                    _replace(client, position, before, after)
            except ConnectionFailedError as error:
                return f"It is unknown whether {done}: {error}", True
    except (ProtocolError, ValueError) as error:
        return f"{failed[0].upper()}{failed[1:]}: {error}", True
    with contextlib.suppress(OSError):  # then it cannot be undone
        if sensor.serial is not None:
            remember(sensor.serial, before, after)
    return f"{done[0].upper()}{done[1:]}{residual}", False


def _sensor(description: JsonObject, position: int) -> SensorInfo:
    return Description.parse(description).find(position) or SensorInfo(position)


def _offset(sensor: SensorInfo) -> Sequence[float]:
    if sensor.offset is None:
        raise ValueError("its offset is unknown to the server")
    return sensor.offset


def _replace(client: Client, position: int, before: Sequence[float], after: Sequence[float]) -> None:
    """Write the offset and verify it; where it is refused, restore the old one. ProtocolError, ValueError."""

    def write(offset: Sequence[float]) -> None:
        for subindex, value in enumerate(offset, start=1):
            client.ask(
                "sdo_write", sensor=position, index=_OFFSET, subindex=subindex, type="f32", value=value
            )
        if array("f", _offset(_sensor(client.ask("describe"), position))) != array("f", offset):
            raise ValueError("the sensor did not take the offset")

    try:
        write(after)
    except ConnectionFailedError:
        raise
    except (ProtocolError, ValueError):
        write(before)
        raise


def _residual(values: object) -> str:
    if (six := known_six(values)) is None:
        return ""
    force, torque = (max(map(abs, part)) for part in (six[:3], six[3:]))
    return f"; residual at most {force:.3f} N and {torque:.4f} Nm"
