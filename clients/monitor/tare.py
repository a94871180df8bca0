"""Tares a sensor through the server, in a thread and on a connection of its own: the stream is left alone."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

from protocol.address import Address
from protocol.client import Client
from protocol.errors import NoReplyError, ProtocolError, RefusedError
from protocol.untrusted import number

_TIMEOUT_S: Final = 60.0

Say = Callable[[str, bool], None]
"""Takes a sentence, and whether it is bad news."""


def start_tare(address: Address, place: int, say: Say) -> threading.Thread:
    """Tare the sensor at `place`; `say` is told how it ended, from the thread that is returned."""
    thread = threading.Thread(target=lambda: say(*tare(address, place)), name="tare", daemon=True)
    thread.start()
    return thread


def tare(address: Address, place: int) -> tuple[str, bool]:
    """Tare the sensor; what to say of it, and whether it is bad news."""
    try:
        with Client(address.port, address.host) as client:
            reply = client.ask("tare", _TIMEOUT_S, sensor=place)
    except RefusedError as error:
        return f"Sensor {place} is not tared: {error}", True
    except NoReplyError as error:
        return f"Whether sensor {place} is tared is not known: {error}", True
    except ProtocolError as error:
        return f"Sensor {place} is not tared: no connection to the server ({error})", True
    return f"Sensor {place} is tared{_residual(reply.get('residual'))}", False


def _residual(values: Any) -> str:
    found = [number(value) for value in values] if isinstance(values, list) else []
    known = [abs(value) for value in found if value is not None]
    if len(known) != 6:
        return ""
    return f"; what is left is at most {max(known[:3]):.3f} N and {max(known[3:]):.4f} Nm"
