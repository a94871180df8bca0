"""Injected SDO aborts."""

from __future__ import annotations

from typing import Final

from ethercat_server.virtual_sensor.slave.objects import Address, SdoAbortError

_REPETITION_NS: Final = 300_000_000


class AbortFaults:
    """One fault per entry: the next transfer is aborted.

    A write that is repeated soon after is aborted again: its answer was lost.
    """

    def __init__(self) -> None:
        self._codes: dict[Address, int] = {}
        self._last: tuple[Address, bytes] | None = None
        self._last_code = self._last_until = 0

    def arm(self, address: Address, code: int) -> None:
        """Abort the next transfer of this entry with `code`."""
        self._codes[address] = code

    def check_read(self, address: Address) -> None:
        """SdoAbortError if this read is to be aborted."""
        code = self._codes.pop(address, None)
        if code is not None:
            raise SdoAbortError(code)

    def check_write(self, address: Address, data: bytes, now: int) -> None:
        """SdoAbortError if this write at `now`, CLOCK_MONOTONIC in ns, is to be aborted."""
        if (address, data) == self._last and now < self._last_until:
            raise SdoAbortError(self._last_code)
        code = self._codes.pop(address, None)
        if code is not None:
            self._last, self._last_code = (address, data), code
            self._last_until = now + _REPETITION_NS
            raise SdoAbortError(code)
