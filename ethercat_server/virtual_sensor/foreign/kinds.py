"""The foreign slaves that there are, one table: identity, sync managers, process data, objects.

Vendor, product code and process data of the Beckhoff slaves are public; the drive is nobody's.
"""

from __future__ import annotations

from typing import Final

from ethercat_server.ethercat.slave.sii import MailboxProtocol
from ethercat_server.sensor.objects.dictionary import Access, ObjectEntry, ObjectType
from ethercat_server.virtual_sensor.foreign import drive
from ethercat_server.virtual_sensor.slave.device import (
    INPUTS,
    MAILBOX_IN,
    MAILBOX_OUT,
    OUTPUTS,
    Device,
    Mapping,
    SyncManagerRow,
)

DRIVE: Final = "DRIVE"
_BECKHOFF = 0x00000002
_NOBODY = 0x00007E57
_RO, _RW = Access.RO, Access.RW
_U8, _I16, _U16, _I32, _U32 = (
    ObjectType.U8, ObjectType.I16, ObjectType.U16, ObjectType.I32, ObjectType.U32
)  # fmt: skip
_MAILBOXES = (SyncManagerRow(0x1000, 128, 0x26, MAILBOX_OUT), SyncManagerRow(0x1080, 128, 0x22, MAILBOX_IN))
_CONTROL, _VELOCITY = (
    ObjectEntry(*drive.CONTROLWORD, "Controlword", _U16, _RW),
    ObjectEntry(*drive.TARGET_VELOCITY, "Target velocity", _I32, _RW),
)
_STATUS, _POSITION = (
    ObjectEntry(*drive.STATUSWORD, "Statusword", _U16, _RO),
    ObjectEntry(*drive.POSITION, "Position actual value", _I32, _RO),
)


def _channel(number: int, value: int) -> tuple[ObjectEntry, ...]:
    index = 0x3100 + number
    return (
        ObjectEntry(index, 1, "Status", _U8, _RO, 0),
        ObjectEntry(index, 2, "Value", _I16, _RO, value),
    )


KINDS: Final = {
    "EK1100": Device("EK1100", "System couplers", _BECKHOFF, 0x044C2C52, 0x00110000, bus_current_ma=-2000),
    "EL3102": Device(
        "EL3102", "Analog input terminals", _BECKHOFF, 0x0C1E3052, 0x00100000, 0,
        (*_MAILBOXES, SyncManagerRow(0x1100, 0, 0x24, OUTPUTS), SyncManagerRow(0x1180, 6, 0x20, INPUTS)),
        (),
        # 5 V and -2.5 V, of 10 V.
        (
            Mapping(0x1A00, "Channel 1", 3, _channel(1, 0x4000)),
            Mapping(0x1A01, "Channel 2", 3, _channel(2, -0x2000)),
        ),
        MailboxProtocol.CoE, 130,
    ),
    DRIVE: Device(
        "DRIVE", "Servo drives", _NOBODY, 402, 1, 0,
        # 0x40: writes to the outputs trigger the process data watchdog.
        (*_MAILBOXES, SyncManagerRow(0x1100, 6, 0x64, OUTPUTS), SyncManagerRow(0x1180, 6, 0x20, INPUTS)),
        (Mapping(0x1600, "Outputs", 2, (_CONTROL, _VELOCITY)),),
        (Mapping(0x1A00, "Inputs", 3, (_STATUS, _POSITION)),),
        MailboxProtocol.CoE,
    ),
}  # fmt: skip
"""By the name in `--chain`."""

_DEVICE_TYPES: Final = {"EL3102": 0x00001389, DRIVE: 0x00020192}
"""Object 0x1000: modular device, servo drive."""


def objects_of(device: Device) -> list[ObjectEntry]:
    """The objects beside those of the PDO mapping."""
    rows = [
        ObjectEntry(0x1000, 0, "Device type", _U32, _RO, _DEVICE_TYPES.get(device.name, 0)),
        ObjectEntry(0x1008, 0, "Device name", ObjectType.STRING, _RO, device.name),
        ObjectEntry(0x1018, 1, "Vendor ID", _U32, _RO, device.vendor),
        ObjectEntry(0x1018, 2, "Product code", _U32, _RO, device.product),
        ObjectEntry(0x1018, 3, "Revision", _U32, _RO, device.revision),
        ObjectEntry(0x1018, 4, "Serial number", _U32, _RO, device.serial),
        *(entry for pdo in device.pdos for entry in pdo.entries),
    ]
    if device.name == DRIVE:
        rows.append(ObjectEntry(*drive.ERROR_CODE, "Error code", _U16, _RO))
    return rows
