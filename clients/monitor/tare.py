"""Tares a sensor through the server, in a thread and on a connection of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

from protocol.address import Address
from protocol.client import Client
from protocol.errors import ConnectionFailedError, ProtocolError, RefusedError
from protocol.text.untrusted import number

_TIMEOUT_S: Final = 60.0

Say = Callable[[str, bool], None]
"""Takes a message, and whether it is an error."""


def start_tare(address: Address, position: int, say: Say) -> threading.Thread:
    """Tare the sensor at `position`; the thread, which is returned, calls `say` with the result."""
    thread = threading.Thread(target=lambda: say(*tare(address, position)), name="tare", daemon=True)
    thread.start()
    return thread


def tare(address: Address, position: int) -> tuple[str, bool]:
    """Tare the sensor; a message, and whether it is an error."""
    try:
        with Client(address.port, address.host) as client:
            try:
                reply = client.ask("tare", _TIMEOUT_S, sensor=position)
            except ConnectionFailedError as error:
                return f"It is unknown whether sensor {position} was tared: {error}", True
    except RefusedError as error:
        return f"Sensor {position} was not tared: {error}", True
    except ProtocolError as error:
        return f"Sensor {position} was not tared: no connection to the server ({error})", True
    return f"Sensor {position} was tared{_residual(reply.get('residual'))}", False


def _residual(values: Any) -> str:
    found = [number(value) for value in values] if isinstance(values, list) else []
    known = [abs(value) for value in found if value is not None]
    if len(known) != 6:
        return ""
    return f"; residual at most {max(known[:3]):.3f} N and {max(known[3:]):.4f} Nm"
