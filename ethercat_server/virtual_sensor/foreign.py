"""Slaves of other vendors on the virtual bus, also as other masters leave them.

Vendor, product code and process data of the Beckhoff slaves are public; the drive is nobody's. It has the
objects of the CiA 402 drive profile (IEC 61800-7-201) that say whether its motor turns.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.sii import MailboxProtocol
from ethercat_server.sensor.objects.dictionary import Access, ObjectEntry, ObjectType
from ethercat_server.virtual_sensor.application import Application, VirtualSlave
from ethercat_server.virtual_sensor.device import Device, Pdo, entries_of
from ethercat_server.virtual_sensor.mailbox import ObjectTable
from ethercat_server.virtual_sensor.options import (
    ANALOG_INPUTS,
    COUPLER,
    DIGITAL_INPUTS,
    DRIVE,
    ForeignOptions,
)

_RO, _RW = Access.RO, Access.RW
_CONTROLWORD = ObjectEntry(0x6040, 0, "Controlword", ObjectType.U16, _RW)
_STATUSWORD = ObjectEntry(0x6041, 0, "Statusword", ObjectType.U16, _RO)
_VELOCITY = ObjectEntry(0x60FF, 0, "Target velocity", ObjectType.I32, _RW)  # increments per second


def _bit(number: int) -> Pdo:
    entry = ObjectEntry(0x6000 + 16 * number, 1, "Input", ObjectType.BOOL, _RO)
    return Pdo(0x1A00 + number, f"Channel {number + 1}", (entry,))


def _channel(number: int, value: int) -> Pdo:
    entries = (
        ObjectEntry(0x3100 + number, 1, "Status", ObjectType.U8, _RO, 0),
        ObjectEntry(0x3100 + number, 2, "Value", ObjectType.I16, _RO, value),
    )
    return Pdo(0x1A00 + number - 1, f"Channel {number}", entries)


_DRIVE: Final = Device(
    DRIVE, "Servo drives", 0x7E57, 402, 1, 0,
    (Pdo(0x1600, "Outputs", (_CONTROLWORD, _VELOCITY)),),
    (Pdo(0x1A00, "Inputs", (_STATUSWORD,)),),
    MailboxProtocol.CoE, watchdog=True, device_type=0x00020192,
)  # fmt: skip
_DEVICES: Final = (
    Device(COUPLER, "System couplers", 2, 0x044C2C52, 0x00110000, bus_current_ma=-2000),
    Device(
        ANALOG_INPUTS, "Analog input terminals", 2, 0x0C1E3052, 0x00100000, 0,
        (), (_channel(1, 0x4000), _channel(2, -0x2000)),  # 5 V and -2.5 V, of 10 V
        MailboxProtocol.CoE, device_type=0x00001389, bus_current_ma=130,
    ),
    Device(
        DIGITAL_INPUTS, "Digital input terminals", 2, 0x03F03052, 0x00120000,
        inputs=tuple(map(_bit, range(8))), bus_current_ma=90,
    ),
    _DRIVE,
)  # fmt: skip
_BY_KIND: Final = {device.name: device for device in _DEVICES}


_ENABLE: Final = 0x000F  # controlword in normal operation
# Statuswords: remote, with switch-on disabled and with operation enabled.
_DISABLED, _ENABLED = 0x0240, 0x0237


class _DriveObjects(ObjectTable):
    @property
    def enabled(self) -> bool:
        return int(self.number(_CONTROLWORD.address)) & _ENABLE == _ENABLE

    def read(self, index: int, subindex: int) -> bytes:
        if (index, subindex) == _STATUSWORD.address:
            return _STATUSWORD.type.pack(_ENABLED if self.enabled else _DISABLED)
        return super().read(index, subindex)


def _objects_of(device: Device) -> ObjectTable:
    u32 = ObjectType.U32
    rows = [
        ObjectEntry(0x1000, 0, "Device type", u32, _RO, device.device_type),
        ObjectEntry(0x1008, 0, "Device name", ObjectType.STRING, _RO, device.name),
        ObjectEntry(0x1018, 1, "Vendor ID", u32, _RO, device.vendor),
        ObjectEntry(0x1018, 2, "Product code", u32, _RO, device.product),
        ObjectEntry(0x1018, 3, "Revision", u32, _RO, device.revision),
        ObjectEntry(0x1018, 4, "Serial number", u32, _RO, device.serial),
        *device.output_entries,
        *device.input_entries,
    ]
    entries = entries_of(device, rows)
    kind = _DriveObjects if device is _DRIVE else ObjectTable
    return kind(entries, {a: row.type.pack(row.default) for a, row in entries.items()})


class Drive(Application):
    """A servo drive, which the controlword enables in one step, and the end of process data disables."""

    def state_changed(self) -> None:
        if self.state is not AlState.OP:
            self.objects.values[_CONTROLWORD.address] = bytes(2)


class InputTerminal(Application):
    """An EL3102, whose channels are sines of 1 and 2 Hz and 5 V, sampled each ms, or an EL1008, whose bits
    count tenths of a second."""

    def inputs(self) -> bytes:
        ms = self.clock() // 1_000_000
        if self.device.name == DIGITAL_INPUTS:
            return bytes([ms // 100 & 0xFF])
        sines = (round(0x4000 * math.sin(math.tau * ms * hz / 1000)) for hz in (1, 2))
        return b"".join(struct.pack("<Bh", 0, sine) for sine in sines)


_WRITES_REMEMBERED: Final = 1000
_VELOCITY_AT_WORK: Final = 1000


class ForeignSlave(VirtualSlave):
    """A foreign slave."""

    options: ForeignOptions

    def __init__(self, options: ForeignOptions, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self.options = options
        # Address and data of the latest register and memory writes that reached it; the number of all.
        self.writes: deque[tuple[int, bytes]] = deque(maxlen=_WRITES_REMEMBERED)
        self.write_count = 0
        self.power(True)

    def _switched_on(self) -> Application:
        device = _BY_KIND[self.options.kind]
        kind = Drive if device is _DRIVE else InputTerminal if device.inputs else Application
        life = kind(device, self._clock, _objects_of(device))
        life.esc.record = self._remember
        return life

    def _remember(self, address: int, data: bytes) -> None:
        self.writes.append((address, bytes(data)))
        self.write_count += 1

    def left_at_work(self) -> None:
        """Another master has left it in the AL state it is in: record from now on."""
        if isinstance(self.life, Drive) and self.life.state is AlState.OP:
            self.life.store_outputs(struct.pack("<Hi", _ENABLE, _VELOCITY_AT_WORK))
        self.writes.clear()
        self.write_count = 0

    @property
    def turning(self) -> bool:
        objects = self.life.objects if self.life else None
        return (
            isinstance(objects, _DriveObjects) and objects.enabled and objects.number(_VELOCITY.address) != 0
        )

    def statistics(self) -> dict[str, Any]:
        own = {"turning": self.turning, "write_count": self.write_count}
        return {"kind": self.options.kind, **super().statistics(), **own}


def leave_in(life: Application, state: AlState, station: int, outputs_at: int, inputs_at: int) -> None:
    """Take it to `state`, with its process data at these logical addresses, as a master does.

    Its process data watchdog waits for the first outputs.
    """
    write, rows = life.esc.write, life.device.sync_managers
    write(reg.STATION_ADDRESS, struct.pack("<H", station))
    write(reg.SII_OWNER, b"\x01")  # the firmware
    used = rows[:2] if state is AlState.PREOP and life.device.protocols else rows
    write(reg.SYNC_MANAGER, b"".join(reg.pack_sync_manager(*row[:3]) for row in used))
    mapped = ((outputs_at, reg.FMMU_WRITE), (inputs_at, reg.FMMU_READ))
    units = [
        reg.FMMU_LAYOUT.pack(at, row.length, 0, 7, row.start, 0, kind, 1)
        for row, (at, kind) in zip(used[2:], mapped, strict=False)
        if row.length
    ]
    write(reg.FMMU, b"".join(units))
    for step in (AlState.PREOP, AlState.SAFEOP, AlState.OP):
        if step <= state:
            write(reg.AL_CONTROL, step.request())
