"""Tares a sensor through the server, or takes its tare back, in a thread and on a connection of its own."""

from __future__ import annotations

import contextlib
import threading
from array import array
from collections.abc import Callable, Sequence
from typing import Any, Final

from protocol.address import Address
from protocol.client import Client
from protocol.control import six_numbers
from protocol.errors import ConnectionFailedError, ProtocolError, RefusedError
from protocol.program.tare_memory import Tared, recall, remember
from protocol.text.json_text import JsonObject
from protocol.text.untrusted import number, rows, whole

_TIMEOUT_S: Final = 60.0
_OFFSET: Final = 0x8000  # the sensor's force/torque offset, in sub-indices 1 to 6

Say = Callable[[str, bool], None]  # takes a message, and whether it is an error

WAYS: Final = {
    "tare": "Taring sensor {}: keep it stationary",
    "undo": "Undoing the tare of sensor {}",
    "clear": "Clearing the offset of sensor {}",
}  # what can be done, and what is said when it begins


def start_tare(address: Address, position: int, say: Say, way: str = "tare") -> threading.Thread:
    """Do one of WAYS with the sensor at `position`; the thread, which is returned, says the result."""
    say(WAYS[way].format(position), False)
    do = {"tare": tare, "undo": undo, "clear": clear}[way]
    thread = threading.Thread(target=lambda: say(*do(address, position)), name="tare", daemon=True)
    thread.start()
    return thread


def tare(address: Address, position: int) -> tuple[str, bool]:
    """Tare the sensor; a message, and whether it is an error."""
    try:
        with Client(address.port, address.host, stream=False, reconnect=False).connect() as client:
            try:
                reply = client.ask("tare", _TIMEOUT_S, sensor=position)
            except ConnectionFailedError as error:
                return f"It is unknown whether sensor {position} was tared: {error}", True
            with contextlib.suppress(ValueError):
                serial, _ = _found(client.description, position)
                _remember(serial, six_numbers(reply.get("old_offset")), six_numbers(reply.get("new_offset")))
    except RefusedError as error:
        return f"Sensor {position} was not tared: {error}", True
    except ProtocolError as error:
        return f"Sensor {position} was not tared: no connection to the server ({error})", True
    return f"Sensor {position} was tared{_residual(reply.get('residual'))}", False


def undo(address: Address, position: int) -> tuple[str, bool]:
    """Restore the offset of before the last tare by this user; as `tare`."""
    return _set_offset(address, position, _former, f"tare of sensor {position} was {{}}undone")


def clear(address: Address, position: int) -> tuple[str, bool]:
    """Set the offset to zero; as `tare`."""
    return _set_offset(
        address, position, lambda *_: (0.0,) * 6, f"offset of sensor {position} was {{}}cleared"
    )


def _set_offset(
    address: Address, position: int, wanted: Callable[[int, Sequence[float]], Sequence[float]], result: str
) -> tuple[str, bool]:
    try:
        with Client(address.port, address.host, stream=False, reconnect=False).connect() as client:
            serial, before = _found(client.description, position)
            after = wanted(serial, before)
            try:
                _write(client, position, after)
            except ConnectionFailedError as error:
                return f"It is unknown whether the {result.format('')}: {error}", True
            except (ProtocolError, ValueError):
                _write(client, position, before)
                raise
    except (ProtocolError, ValueError) as error:
        return f"The {result.format('not ')}: {error}", True
    _remember(serial, before, after)
    return f"The {result.format('')}", False


def _found(description: JsonObject, position: int) -> tuple[int, Sequence[float]]:
    """Serial number and offset of the sensor; ValueError."""
    for sensor in rows(description.get("sensors")):
        serial, offset = whole(sensor.get("serial")), sensor.get("offset")
        if sensor.get("sensor") == position and serial is not None and offset is not None:
            return serial, six_numbers(offset)
    raise ValueError("its offset is unknown to the server")


def _former(serial: int, now: Sequence[float]) -> Sequence[float]:
    last = recall(serial)
    if last is None:
        raise ValueError("no tare of it by this user is known; its offset can be cleared")
    if _real32(last.after) != _real32(now):
        raise ValueError("its offset has changed since the last tare by this user; it can be cleared")
    return last.before


def _write(client: Client, position: int, offset: Sequence[float]) -> None:
    """Write the offset and verify it; ProtocolError, ValueError."""
    for subindex, value in enumerate(offset, start=1):
        client.ask("sdo_write", sensor=position, index=_OFFSET, subindex=subindex, type="f32", value=value)
    if _real32(_found(client.ask("describe"), position)[1]) != _real32(offset):
        raise ValueError("the sensor did not take the offset")


def _real32(offset: Sequence[float]) -> bytes:
    """As the sensor keeps it."""
    return array("f", offset).tobytes()


def _remember(serial: int, before: Sequence[float], after: Sequence[float]) -> None:
    with contextlib.suppress(OSError):  # then it cannot be undone
        remember(serial, Tared(list(before), list(after)))


def _residual(values: Any) -> str:
    found = [number(value) for value in values] if isinstance(values, list) else []
    known = [abs(value) for value in found if value is not None]
    if len(known) != 6:
        return ""
    return f"; residual at most {max(known[:3]):.3f} N and {max(known[3:]):.4f} Nm"
