"""Registers of an EtherCAT slave controller (ESC): one table of addresses. Source: ETG.1000.4.

The master reads and writes them by these names, and the virtual sensor has them at these addresses.
"""

from __future__ import annotations

import struct
from typing import Final

DL_INFORMATION: Final = 0x0000
FMMU_AND_SM_COUNT: Final = 0x0004  # two bytes: the number of FMMUs, the number of sync managers
FEATURES: Final = 0x0008
DC_AVAILABLE: Final = 1 << 2  # in FEATURES: it has a distributed clock
DC_64_BIT: Final = 1 << 3  # in FEATURES: of 64 bits, not 32
# In FEATURES: logical memory can be read (LRD) and written (LWR), but not both at once.
NO_LRW: Final = 1 << 9
STATION_ADDRESS: Final = 0x0010
STATION_ALIAS: Final = 0x0012
DL_CONTROL: Final = 0x0100
DL_STATUS: Final = 0x0110
AL_CONTROL: Final = 0x0120
AL_STATUS: Final = 0x0130
AL_STATUS_SIZE: Final = 6  # AL status, two reserved bytes, AL status code
PDI_CONTROL: Final = 0x0140
RX_ERRORS: Final = 0x0300  # two bytes a port: invalid frames, physical layer errors
FORWARDED_ERRORS: Final = 0x0308  # a byte a port: frames that another slave had found invalid
PROCESSING_UNIT_ERRORS: Final = 0x030C
PDI_ERRORS: Final = 0x030D
LOST_LINKS: Final = 0x0310  # a byte a port
PORT_COUNT: Final = 4
ERROR_COUNTERS_SIZE: Final = LOST_LINKS + PORT_COUNT - RX_ERRORS
WATCHDOG_DIVIDER: Final = 0x0400
WATCHDOG_TIME: Final = 0x0420
WATCHDOG_STATUS: Final = 0x0440
WATCHDOG_COUNTER: Final = 0x0442
# Who may access the SII: bit 0 set, the slave's own firmware (PDI); bit 1 takes it from the firmware.
SII_OWNER: Final = 0x0500
SII_CONTROL: Final = 0x0502
SII_ADDRESS: Final = 0x0504
SII_DATA: Final = 0x0508
FMMU: Final = 0x0600
FMMU_SIZE: Final = 16
SYNC_MANAGER: Final = 0x0800
SYNC_MANAGER_SIZE: Final = 8
# Offsets within a sync manager.
SM_STATUS: Final = 5
SM_ACTIVATE: Final = 6
SM_LATCH_PDI: Final = 0x80  # in SM_ACTIVATE: an access of the firmware to its buffer is a DC event
SM_PDI_CONTROL: Final = 7
# Bits of the control byte: it is a mailbox (else buffered), the master writes.
SM_MAILBOX, SM_WRITE = 0x02, 0x04
MAILBOX_FULL: Final = 0x08  # bit of a mailbox sync manager's status
# Status of sync manager 1, the mailbox from the slave.
MAILBOX_IN_STATUS: Final = SYNC_MANAGER + SYNC_MANAGER_SIZE + SM_STATUS
DC_RECEIVE_TIMES: Final = 0x0900  # four bytes a port, ns: when the frame that wrote here arrived
DC_SYSTEM_TIME: Final = 0x0910
DC_RECEIVE_TIME: Final = 0x0918  # eight bytes: the same, at the processing unit
DC_OFFSET: Final = 0x0920
DC_ACTIVATION: Final = 0x0980  # two bytes: who controls the SYNC signals, which are active
DC_PDI_CHANGE_EVENT: Final = 0x09FC  # four bytes, local time: the firmware exchanged a buffer, new inputs
DC_END: Final = 0x0A00
USER_RAM: Final = 0x0F80
REGISTERS_END: Final = 0x1000  # process data memory begins here
# Logical start, length, start and end bit, physical start and bit, type, activation.
FMMU_LAYOUT: Final = struct.Struct("<IHBBHBBB3x")
FMMU_READ: Final = 1
FMMU_WRITE: Final = 2
MOST_FMMUS: Final = 16
MOST_SYNC_MANAGERS: Final = 16
SM_CONTROL_MAILBOX_OUT: Final = 0x26
SM_CONTROL_MAILBOX_IN: Final = 0x22
SYNC_MANAGER_LAYOUT: Final = struct.Struct("<HHBBBB")


def pack_sync_manager(start: int, length: int, control: int) -> bytes:
    """The registers of a sync manager, activated; zeros without a length."""
    return SYNC_MANAGER_LAYOUT.pack(start, length, control, 0, 1, 0) if length else bytes(SYNC_MANAGER_SIZE)
