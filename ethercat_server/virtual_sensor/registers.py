"""Registers of the EtherCAT slave controller: addresses, what a master may write, power-on values.

Source: ETG.1000.4 and the usual register set of a two-port controller with 3 FMMUs, 4 sync managers, 4 KB of
process data memory and no distributed clocks.
"""

from __future__ import annotations

import struct
from typing import Final

DL_INFORMATION: Final = 0x0000
STATION_ADDRESS: Final = 0x0010
STATION_ALIAS: Final = 0x0012
DL_CONTROL: Final = 0x0100
DL_STATUS: Final = 0x0110
AL_CONTROL: Final = 0x0120
AL_STATUS: Final = 0x0130
AL_STATUS_CODE: Final = 0x0134
PDI_CONTROL: Final = 0x0140
EVENT_MASK: Final = 0x0200
EVENT_REQUEST: Final = 0x0210
AL_EVENT_REQUEST: Final = 0x0220
RX_ERRORS: Final = 0x0300
"""Two bytes a port: frames that were not valid, and errors that the physical layer reported."""
FORWARDED_ERRORS: Final = 0x0308
"""A byte a port: frames that another slave before this one found to be damaged."""
PROCESSING_UNIT_ERRORS: Final = 0x030C
PDI_ERRORS: Final = 0x030D
LOST_LINKS: Final = 0x0310
"""A byte a port."""
PORT_COUNT: Final = 4
WATCHDOG_DIVIDER: Final = 0x0400
WATCHDOG_TIME_PDI: Final = 0x0410
WATCHDOG_TIME: Final = 0x0420
WATCHDOG_STATUS: Final = 0x0440
WATCHDOG_COUNTER: Final = 0x0442
SII_CONFIGURATION: Final = 0x0500
SII_CONTROL: Final = 0x0502
SII_ADDRESS: Final = 0x0504
SII_DATA: Final = 0x0508
FMMU: Final = 0x0600
FMMU_SIZE: Final = 16
FMMU_COUNT: Final = 3
SYNC_MANAGER: Final = 0x0800
SYNC_MANAGER_SIZE: Final = 8
SYNC_MANAGER_COUNT: Final = 4
USER_RAM: Final = 0x0F80

REGISTERS_END: Final = 0x1000
"""Process data memory begins here."""
MEMORY_KB: Final = 4
MEMORY_END: Final = REGISTERS_END + MEMORY_KB * 1024

SM_STATUS: Final = 5
SM_ACTIVATE: Final = 6
SM_PDI_CONTROL: Final = 7
MAILBOX_FULL: Final = 0x08
REPEAT: Final = 0x02
"""Repeat request in a sync manager's activate register, repeat acknowledge in its PDI control register."""

EVENT_DL_STATUS: Final = 1 << 2
EVENT_AL_STATUS: Final = 1 << 3
EVENT_SYNC_MANAGER: Final = 1 << 4
"""Sync manager n: this bit shifted left by n."""

PDI_TYPE: Final = 0x05
"""SPI slave, as word 0 of the SII says too."""


CLEARED_BY_WRITE: Final = (
    range(RX_ERRORS, FORWARDED_ERRORS + PORT_COUNT),
    range(PROCESSING_UNIT_ERRORS, PROCESSING_UNIT_ERRORS + 1),
    range(PDI_ERRORS, PDI_ERRORS + 1),
    range(LOST_LINKS, LOST_LINKS + PORT_COUNT),
    range(WATCHDOG_COUNTER, WATCHDOG_COUNTER + 2),
)
"""Counters: a write of any value to one of a group sets the whole group to zero."""


def _write_mask() -> bytes:
    mask = bytearray(REGISTERS_END)

    def allow(start: int, length: int, bits: int = 0xFF) -> None:
        mask[start : start + length] = bytes([bits]) * length

    allow(STATION_ADDRESS, 2)
    allow(DL_CONTROL, 4)
    allow(AL_CONTROL, 2)
    allow(EVENT_MASK, 2)
    for counters in CLEARED_BY_WRITE:
        allow(counters.start, len(counters))
    allow(WATCHDOG_DIVIDER, 2)
    allow(WATCHDOG_TIME_PDI, 2)
    allow(WATCHDOG_TIME, 2)
    allow(SII_CONFIGURATION, 1, 0x03)
    allow(SII_CONTROL, 1, 0x01)
    allow(SII_CONTROL + 1, 1, 0x07)
    allow(SII_ADDRESS, 8)
    for number in range(FMMU_COUNT):
        allow(FMMU + number * FMMU_SIZE, 13)
    for number in range(SYNC_MANAGER_COUNT):
        at = SYNC_MANAGER + number * SYNC_MANAGER_SIZE
        allow(at, 5)
        allow(at + SM_ACTIVATE, 1, 0xC3)
    allow(USER_RAM, REGISTERS_END - USER_RAM)
    return bytes(mask)


WRITE_MASK: Final = _write_mask()
"""For every register byte, the bits that a master may write."""


def power_on_values() -> bytearray:
    """Registers and memory of a controller that has just been switched on."""
    memory = bytearray(MEMORY_END)
    # Type, revision, build, FMMUs, sync managers, RAM in KB, ports 0 and 1 MII, features: bit-wise FMMUs,
    # separate counting of check sum errors; no distributed clocks.
    struct.pack_into(
        "<BBHBBBBH", memory, DL_INFORMATION,
        0xC0, 2, 0, FMMU_COUNT, SYNC_MANAGER_COUNT, MEMORY_KB, 0x0F, 0x0080,
    )  # fmt: skip
    memory[DL_CONTROL] = 0x01
    memory[AL_CONTROL] = memory[AL_STATUS] = 0x01
    memory[PDI_CONTROL] = PDI_TYPE
    struct.pack_into("<H", memory, WATCHDOG_DIVIDER, 2498)  # (2498 + 2) * 40 ns = 100 µs a tick
    struct.pack_into("<H", memory, WATCHDOG_TIME_PDI, 1000)
    struct.pack_into("<H", memory, WATCHDOG_TIME, 1000)
    memory[WATCHDOG_STATUS] = 1
    return memory
