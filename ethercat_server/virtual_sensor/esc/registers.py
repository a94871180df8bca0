"""Registers of the virtual sensor's slave controller: what a master may write, power-on values.

The addresses are those of `ethercat_server.ethercat.slave.registers`. The controller has two ports, 3 FMMUs,
4 sync managers, 4 KB of process data memory, and a distributed clock of 64 bits, whose SYNC unit can be set
up but gives no signals.
"""
# ruff: noqa: F403, F405

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.ethercat.slave.registers import *

SII_CONFIGURATION: Final = SII_OWNER
FMMU_COUNT: Final = 3
SYNC_MANAGER_COUNT: Final = 4
MEMORY_KB: Final = 4
MEMORY_END: Final = REGISTERS_END + MEMORY_KB * 1024

REPEAT: Final = 0x02
"""Repeat request in a sync manager's activate register, repeat acknowledge in its PDI control register."""

DC_SYNC_START: Final = 0x0990
DC_SYNC_CYCLES: Final = 0x09A0
"""Of SYNC0, then SYNC1, four bytes each."""

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
    allow(DC_RECEIVE_TIMES, 4)
    allow(DC_SYSTEM_TIME, 8)
    allow(DC_OFFSET, 12)
    allow(DC_SPEED_START, 2)
    allow(DC_FILTERS, 2)
    allow(DC_ACTIVATION, 2)
    allow(DC_SYNC_START, 8)
    allow(DC_SYNC_CYCLES, 8)
    allow(USER_RAM, REGISTERS_END - USER_RAM)
    return bytes(mask)


WRITE_MASK: Final = _write_mask()
"""For every register byte, the bits that a master may write."""


def power_on_values() -> bytearray:
    """Registers and memory of a controller that has just been switched on."""
    memory = bytearray(MEMORY_END)
    # Type, revision, build, FMMUs, sync managers, RAM in KB, ports 0 and 1 MII, features: bit-wise FMMUs,
    # distributed clock, of 64 bits, separate counting of check sum errors.
    struct.pack_into(
        "<BBHBBBBH", memory, DL_INFORMATION,
        0xC0, 2, 0, FMMU_COUNT, SYNC_MANAGER_COUNT, MEMORY_KB, 0x0F, 0x008C,
    )  # fmt: skip
    memory[DL_CONTROL] = 0x01
    memory[AL_CONTROL] = memory[AL_STATUS] = 0x01
    memory[PDI_CONTROL] = PDI_TYPE
    struct.pack_into("<H", memory, WATCHDOG_DIVIDER, 2498)  # (2498 + 2) * 40 ns = 100 µs a tick
    struct.pack_into("<H", memory, WATCHDOG_TIME_PDI, 1000)
    struct.pack_into("<H", memory, WATCHDOG_TIME, 1000)
    memory[WATCHDOG_STATUS] = 1
    return memory
