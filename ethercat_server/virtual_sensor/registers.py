"""Registers of the virtual sensor's slave controller: what a master may write, power-on values.

The addresses are those of `ethercat_server.ethercat.slave.registers`. The controller has two ports, 3 FMMUs,
4 sync managers, 4 KB of process data memory, and a distributed clock of 64 bits.
"""
# ruff: noqa: F403, F405

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.ethercat.slave.registers import *

FMMU_COUNT: Final = 3
SYNC_MANAGER_COUNT: Final = 4
MEMORY_KB: Final = 4
MEMORY_END: Final = REGISTERS_END + MEMORY_KB * 1024
# Repeat request in a sync manager's activate register, repeat acknowledge in its PDI control register.
REPEAT: Final = 0x02
PDI_TYPE: Final = 0x05  # SPI slave, as word 0 of the SII says too

# Counters: a write of any value to one of a group sets the whole group to zero.
CLEARED_BY_WRITE: Final = (
    range(RX_ERRORS, FORWARDED_ERRORS + PORT_COUNT),
    range(PROCESSING_UNIT_ERRORS, PROCESSING_UNIT_ERRORS + 1),
    range(PDI_ERRORS, PDI_ERRORS + 1),
    range(LOST_LINKS, LOST_LINKS + PORT_COUNT),
    range(WATCHDOG_COUNTER, WATCHDOG_COUNTER + 2),
)
_SYNC_MANAGERS = range(SYNC_MANAGER, SYNC_MANAGER + SYNC_MANAGER_COUNT * SYNC_MANAGER_SIZE, SYNC_MANAGER_SIZE)
# Register, bytes, and which bits of each a master may write.
_WRITABLE: Final = (
    (STATION_ADDRESS, 2, 0xFF), (DL_CONTROL, 4, 0xFF), (AL_CONTROL, 2, 0xFF),
    *((counters.start, len(counters), 0xFF) for counters in CLEARED_BY_WRITE),
    (WATCHDOG_DIVIDER, 2, 0xFF), (WATCHDOG_TIME, 2, 0xFF),
    (SII_OWNER, 1, 0x03), (SII_CONTROL, 1, 0x01), (SII_CONTROL + 1, 1, 0x07), (SII_ADDRESS, 8, 0xFF),
    *((FMMU + number * FMMU_SIZE, 13, 0xFF) for number in range(FMMU_COUNT)),
    *((manager, 5, 0xFF) for manager in _SYNC_MANAGERS),
    *((manager + SM_ACTIVATE, 1, 0xC3) for manager in _SYNC_MANAGERS),
    (DC_RECEIVE_TIMES, 4, 0xFF), (DC_SYSTEM_TIME, 8, 0xFF), (DC_OFFSET, 12, 0xFF), (DC_ACTIVATION, 2, 0xFF),
    (USER_RAM, REGISTERS_END - USER_RAM, 0xFF),
)  # fmt: skip


def write_mask() -> bytearray:
    """For every register byte, the bits that a master may write."""
    mask = bytearray(REGISTERS_END)
    for start, length, bits in _WRITABLE:
        mask[start : start + length] = bytes([bits]) * length
    return mask


def power_on_values() -> bytearray:
    """Registers and memory of a controller that has just been switched on."""
    memory = bytearray(MEMORY_END)
    # Type, revision, build, FMMUs, sync managers, RAM in KB, ports 0 and 1 MII, features: FMMUs of bytes,
    # distributed clock, of 64 bits, separate counting of check sum errors.
    struct.pack_into(
        "<BBHBBBBH", memory, DL_INFORMATION,
        0xC0, 2, 0, FMMU_COUNT, SYNC_MANAGER_COUNT, MEMORY_KB, 0x0F, 0x008D,
    )  # fmt: skip
    memory[DL_CONTROL] = memory[AL_CONTROL] = memory[AL_STATUS] = memory[WATCHDOG_STATUS] = 1
    memory[PDI_CONTROL] = PDI_TYPE
    struct.pack_into("<H", memory, WATCHDOG_DIVIDER, 2498)  # (2498 + 2) * 40 ns = 100 µs a tick
    struct.pack_into("<H", memory, WATCHDOG_TIME, 1000)
    return memory
