"""Every exception the server raises on purpose. Each text is one sentence for a person.

ServerError
+-- UsageError        wrong arguments or configuration (exit code 2)
+-- InterfaceError    the network interface cannot be used
+-- BusError          the bus or a sensor on it does not do what it must
|   +-- SetUpError         setting up failed in a way that lost frames explain
|   +-- SdoAbortError      the sensor refused an SDO, with its abort code
|   +-- CutOffError        the sensor was lost in the middle of work on it
+-- ForbiddenWriteError      a write that is never done
+-- StopRequestedError       asked to stop while starting up
"""

from __future__ import annotations

from typing import Final

from bota_ethercat.program.command import command

LIST_ADAPTERS: Final = command("ethercat-sensor adapters")  # in some of them


class ServerError(Exception):
    """Base of all errors here."""

    exit_code = 1


class UsageError(ServerError):
    """Wrong arguments or a wrong configuration file."""

    exit_code = 2


class InterfaceError(ServerError):
    """The network interface does not exist, is down, or may not be used."""


class BusError(ServerError):
    """The bus, or a sensor on it, does not do what it must."""


class SetUpError(BusError):
    """Setting a sensor up went wrong in a way that lost frames explain: worth another attempt."""


class SdoAbortError(BusError):
    """The sensor refused to read or write an object."""

    def __init__(self, message: str, abort_code: int) -> None:
        super().__init__(message)
        self.abort_code = abort_code


class CutOffError(BusError):
    """The sensor went away in the middle of work on it."""


def extended(error: BusError, addition: str) -> BusError:
    """The same error, its sentence going on with `addition`."""
    text = f"{error}{addition}"
    return SdoAbortError(text, error.abort_code) if isinstance(error, SdoAbortError) else type(error)(text)


# Abort codes of an object or sub-index that this firmware does not have.
OBJECT_MISSING = frozenset({0x06020000, 0x06090011})


class ForbiddenWriteError(ServerError):
    """A write of the factory calibration, which is never done."""


class StopRequestedError(ServerError):
    """A signal asked the server to stop before it was up."""

    exit_code = 0
