"""Sync managers and PDO mapping of the sensor, derived from the tables of process data and objects.

Source: the dump of a real Rokubi (see `bota_ethercat.pdo`).
"""

from __future__ import annotations

from typing import Final

from bota_ethercat.pdo import INPUT_OBJECT, LAYOUTS
from ethercat_server.ethercat.slave.sii import MailboxProtocol
from ethercat_server.sensor.objects.dictionary import BY_ADDRESS, PRODUCT_CODE, REVISION, VENDOR_ID
from ethercat_server.virtual_sensor.slave.device import (
    INPUTS,
    MAILBOX_IN,
    MAILBOX_OUT,
    OUTPUTS,
    Device,
    Mapping,
    SyncManagerRow,
)

RXPDO: Final = Mapping(0x1600, "Outputs", 2, (BY_ADDRESS[0x7000, 0],))
TXPDO: Final = {
    size: Mapping(
        0x1A00, "Inputs", 3, tuple(BY_ADDRESS[INPUT_OBJECT, field.subindex] for field in layout.fields)
    )
    for size, layout in LAYOUTS.items()
}
"""The TxPDO of each process data size."""


def sensor_device(model: str, serial: int, pdo_size: int) -> Device:
    """A sensor with `pdo_size` bytes of inputs."""
    return Device(
        model, "Force/torque sensors", VENDOR_ID, PRODUCT_CODE, REVISION, serial,
        (
            SyncManagerRow(0x1000, 128, 0x26, MAILBOX_OUT),
            SyncManagerRow(0x1080, 128, 0x22, MAILBOX_IN),
            SyncManagerRow(0x1100, RXPDO.size, 0x24, OUTPUTS),  # without 0x40: no process data watchdog
            SyncManagerRow(0x1180, pdo_size, 0x20, INPUTS),
        ),
        (RXPDO,),
        (TXPDO[pdo_size],),
        MailboxProtocol.CoE | MailboxProtocol.FoE,
    )  # fmt: skip
