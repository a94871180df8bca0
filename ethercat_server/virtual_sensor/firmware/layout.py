"""Sync managers and PDO mapping, derived from the tables of process data and objects.

Source: the dump of a real Rokubi (see `protocol.pdo`). SII, CoE dictionary and AL checks all follow it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from ethercat_server.sensor.objects.dictionary import BY_ADDRESS, ObjectEntry
from protocol.pdo import INPUT_OBJECT, LAYOUTS


class SyncManagerRow(NamedTuple):
    """Required configuration of one sync manager."""

    start: int
    length: int
    """Bytes; 0 = the size of what is mapped."""
    control: int
    kind: int
    """As in object 0x1C00: 1 mailbox from the master, 2 to the master, 3 outputs, 4 inputs."""


SYNC_MANAGERS: Final = (
    SyncManagerRow(0x1000, 128, 0x26, 1),
    SyncManagerRow(0x1080, 128, 0x22, 2),
    SyncManagerRow(0x1100, 1, 0x64, 3),  # 0x40: writes trigger the process data watchdog
    SyncManagerRow(0x1180, 0, 0x20, 4),
)


@dataclass(frozen=True, slots=True)
class Mapping:
    """One PDO: its mapping object and the entries in it."""

    index: int
    name: str
    sync_manager: int
    entries: tuple[ObjectEntry, ...]

    @property
    def size(self) -> int:
        """Bytes of process data."""
        return sum(entry.type.size for entry in self.entries)


RXPDO: Final = Mapping(0x1600, "Outputs", 2, (BY_ADDRESS[0x7000, 0],))
TXPDO: Final = {
    size: Mapping(
        0x1A00, "Inputs", 3, tuple(BY_ADDRESS[INPUT_OBJECT, field.subindex] for field in layout.fields)
    )
    for size, layout in LAYOUTS.items()
}
"""The TxPDO of each process data size."""


def sync_manager_lengths(pdo_size: int) -> tuple[int, ...]:
    """Bytes of each sync manager for a sensor with `pdo_size` bytes of inputs."""
    return tuple(row.length or pdo_size for row in SYNC_MANAGERS)
