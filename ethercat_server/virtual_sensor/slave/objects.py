"""The object entries of a slave: which there are, their values, and the aborts of what is refused."""

from __future__ import annotations

from ethercat_server.ethercat.slave.abort_codes import AbortCode, abort_meaning
from ethercat_server.sensor.objects.dictionary import Access, ObjectEntry
from ethercat_server.virtual_sensor.slave.al import AlState

Address = tuple[int, int]
"""Index and sub-index of an object entry."""


class SdoAbortError(Exception):
    """The slave aborts the SDO transfer with `code`."""

    def __init__(self, code: int) -> None:
        super().__init__(abort_meaning(code))
        self.code = code


class ObjectTable:
    """The entries of a slave, and their values unless computed."""

    def __init__(self, entries: dict[Address, ObjectEntry], values: dict[Address, bytes]) -> None:
        self.entries = entries
        self._values = values

    def entry(self, index: int, subindex: int) -> ObjectEntry:
        """The entry at an address; SdoAbortError if there is none."""
        row = self.entries.get((index, subindex))
        if row is None:
            exists = any(known == index for known, _ in self.entries)
            raise SdoAbortError(AbortCode.NO_SUBINDEX if exists else AbortCode.NO_OBJECT)
        return row

    def size(self, row: ObjectEntry) -> int:
        """Bytes of the entry `row`."""
        return row.type.size or len(self._values[row.address])

    def load(self, address: Address) -> bytes:
        """The value of an entry."""
        return self._values[address]

    def store(self, address: Address, data: bytes) -> None:
        """Set the value of an entry."""
        self._values[address] = data

    def check_write(self, row: ObjectEntry, length: int, state: AlState) -> None:
        """SdoAbortError if `length` bytes cannot be written to `row` in `state`, whatever they are."""
        if row.access is Access.RO:
            raise SdoAbortError(AbortCode.READ_ONLY)
        if row.access is Access.RW_PREOP and state is not AlState.PREOP:
            raise SdoAbortError(AbortCode.NOT_IN_THIS_STATE)
        if length > self.size(row):
            raise SdoAbortError(AbortCode.TOO_LONG)
        if length < self.size(row):
            raise SdoAbortError(AbortCode.TOO_SHORT)
