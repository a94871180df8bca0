"""The EtherCAT slave controller of one sensor: registers, memory, sync managers, FMMUs.

Source: ETG.1000.4. Datagrams reach it through `commands`; what only the sensor's firmware can do goes through
`Pdi`, the process data interface behind the controller.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

from ethercat_server.virtual_sensor.dc.unit import DistributedClock
from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.esc.fmmu import Fmmu
from ethercat_server.virtual_sensor.esc.sii import SiiInterface
from ethercat_server.virtual_sensor.esc.sync_manager import SyncManager

_U16 = struct.Struct("<H")
_REGISTERS_END, _DC_RECEIVE_TIMES, _DC_END = reg.REGISTERS_END, reg.DC_RECEIVE_TIMES, reg.DC_END
_DC_SYSTEM_TIME, _DC_RECEIVE_TIME, _DC_ECAT_EVENT = reg.DC_SYSTEM_TIME, reg.DC_RECEIVE_TIME, reg.DC_ECAT_EVENT
_LINE_GOES_ON, _LINE_ENDS = 0x5A33, 0x5613
"""DL status: ports 0 and 1 have a link, or only port 0."""


class Pdi(Protocol):
    """What the controller calls in the firmware behind it."""

    clock: Callable[[], int]
    """The time in ns."""

    def al_control(self, value: int) -> None:
        """The master wrote AL control."""

    def sync_managers_changed(self) -> None:
        """The master wrote a sync manager's registers."""

    def repeat_requested(self) -> None:
        """The master toggled the repeat request of the read mailbox."""

    def mailbox_written(self) -> None:
        """The write mailbox is full."""

    def mailbox_read(self) -> None:
        """The master has taken what was in the read mailbox."""

    def inputs(self) -> bytes:
        """The newest process data, as long as the input sync manager."""

    def outputs(self, data: bytes) -> None:
        """The master wrote the output sync manager."""


class Esc:
    """Registers and memory of one controller.

    Attributes:
        fmmus: the active FMMUs.
        plans: what each logical command copies, by address and length; emptied when an FMMU changes.
        into_ns: time from the start of a datagram until the bytes that are being copied pass.
    """

    def __init__(self, pdi: Pdi, sii_image: bytes, sii_read_ns: int = 0) -> None:
        """`sii_read_ns` is how long reading from the EEPROM takes."""
        self._pdi = pdi
        self.memory = reg.power_on_values()
        self.memory[reg.STATION_ALIAS : reg.STATION_ALIAS + 2] = sii_image[8:10]
        self.sii = SiiInterface(self.memory, sii_image, pdi.clock, sii_read_ns)
        self.clock = DistributedClock(self.memory, pdi.clock)
        self.sync_managers = [SyncManager(self.memory, n) for n in range(reg.SYNC_MANAGER_COUNT)]
        self.fmmus: list[Fmmu] = []
        self.plans: dict[tuple[int, int], list[tuple[Fmmu, int, int, int]]] = {}
        self.has_lrw = self.has_dc = True
        self.into_ns = 0
        self._write_mask: bytes | bytearray = reg.WRITE_MASK
        self._events = 0

    def take_lrw_away(self) -> None:
        """Be a controller that does not know LRW."""
        self.has_lrw = False
        features = _U16.unpack_from(self.memory, reg.FEATURES)[0]
        _U16.pack_into(self.memory, reg.FEATURES, features | reg.NO_LRW)

    def take_dc_away(self) -> None:
        """Be a controller without a distributed clock."""
        self.has_dc = False
        self.clock.events.take_away()
        self._miss(reg.DC_AVAILABLE | reg.DC_64_BIT, range(reg.DC_RECEIVE_TIMES, reg.DC_END))

    def narrow_dc(self) -> None:
        """Be a controller whose distributed clock has 32 bits."""
        self.clock.time_mask = 2**32 - 1
        for time in (reg.DC_SYSTEM_TIME, reg.DC_RECEIVE_TIME, reg.DC_OFFSET):
            self._miss(reg.DC_64_BIT, range(time + 4, time + 8))

    def _miss(self, feature: int, registers: range) -> None:
        self.memory[reg.FEATURES] &= ~feature
        self._write_mask = bytearray(self._write_mask)
        for memory in (self.memory, self._write_mask):
            memory[registers.start : registers.stop] = bytes(len(registers))

    def count(self, counter: int) -> None:
        """Add one to the error counter at this register; it stays at 255."""
        self.memory[counter] = min(self.memory[counter] + 1, 0xFF)

    def set_line(self, before: int, behind: int) -> None:
        """So many slaves are before it and behind it. Port 0 is always open; port 1 if one is behind."""
        self.clock.place(before, behind)
        next_slave = behind > 0
        status = _LINE_GOES_ON if next_slave else _LINE_ENDS
        before = _U16.unpack_from(self.memory, reg.DL_STATUS)[0]
        if before == _LINE_GOES_ON and not next_slave:
            self.count(reg.LOST_LINKS + 1)
        if before != status:
            _U16.pack_into(self.memory, reg.DL_STATUS, status)
            self._events |= reg.EVENT_DL_STATUS

    def set_al_status(self, status: int, code: int) -> None:
        """Show the AL state (with its error bit) and the AL status code to the master."""
        _U16.pack_into(self.memory, reg.AL_STATUS, status)
        _U16.pack_into(self.memory, reg.AL_STATUS_CODE, code)
        self._events |= reg.EVENT_AL_STATUS

    @property
    def events(self) -> int:
        """The event request register, before the mask."""
        events = self._events
        for manager in self.sync_managers:
            if manager.mailbox and manager.full and not manager.master_writes:
                events |= reg.EVENT_SYNC_MANAGER << manager.number
        return events

    def read(self, address: int, current: bytes | bytearray) -> bytes | bytearray | None:
        """`len(current)` bytes from `address` on, as a master reads them; None if it may read none of them.

        Bytes that may not be read stay as they are in `current`.
        """
        length = len(current)
        end = address + length
        if end <= _REGISTERS_END:
            return self._read_registers(address, end) if length else None
        end = min(end, reg.MEMORY_END)
        for manager in self.sync_managers:
            if manager.active and manager.start == address and manager.length == length:
                return self._read_manager(manager, 0, length)
        if address >= end:
            return None
        result = bytearray(current)
        any_read = False
        if address < reg.REGISTERS_END:
            data = self._read_registers(address, reg.REGISTERS_END)
            result[: len(data)] = data
            any_read = True
        for start, stop, owner in self._regions(max(address, reg.REGISTERS_END), end):
            part = (
                self.memory[start:stop]
                if owner is None
                else self._read_manager(owner, start - owner.start, stop - start)
            )
            if part is not None:
                result[start - address : stop - address] = part
                any_read = True
        return result if any_read else None

    def write(self, address: int, data: bytes) -> bool:
        """Write `data` as a master does; False if it may write none of it."""
        if not data:
            return False
        for manager in self.sync_managers:
            if manager.active and manager.start == address and manager.length == len(data):
                return self._write_manager(manager, 0, data)
        end = min(address + len(data), reg.MEMORY_END)
        any_written = False
        if address < reg.REGISTERS_END:
            any_written = self._write_registers(address, data[: max(reg.REGISTERS_END - address, 0)])
        for start, stop, owner in self._regions(max(address, reg.REGISTERS_END), end):
            part = data[start - address : stop - address]
            if owner is None:
                self.memory[start:stop] = part
                any_written = True
            else:
                any_written |= self._write_manager(owner, start - owner.start, part)
        return any_written

    def _regions(self, start: int, end: int) -> list[tuple[int, int, SyncManager | None]]:
        """Split memory from `start` to `end` into what each active sync manager guards, and free memory."""
        regions: list[tuple[int, int, SyncManager | None]] = []
        guards = sorted((m for m in self.sync_managers if m.active), key=lambda m: m.start)
        for manager in guards:
            if manager.end <= start or manager.start >= end:
                continue
            if manager.start > start:
                regions.append((start, manager.start, None))
                start = manager.start
            stop = min(manager.end, end)
            regions.append((start, stop, manager))
            start = stop
        if start < end:
            regions.append((start, end, None))
        return regions

    def _read_manager(self, manager: SyncManager, offset: int, length: int) -> bytes | None:
        if manager.locked or manager.master_writes:
            return None
        if manager.mailbox:
            data = manager.take(offset, length)
            if data is not None and not manager.full:
                self._exchanged(manager)
                self._pdi.mailbox_read()
            return data
        if not manager.access(offset, length):
            return None
        if manager.latches_ecat and offset + length == manager.length:
            self._exchanged(manager)
        if offset == 0:  # three buffers: the newest is handed over when the first byte is read
            newest = self._pdi.inputs()[: manager.length].ljust(manager.length, b"\0")
            self.memory[manager.start : manager.end] = newest
            return newest[:length]
        return bytes(self.memory[manager.start + offset : manager.start + offset + length])

    def _write_manager(self, manager: SyncManager, offset: int, data: bytes) -> bool:
        if manager.locked or not manager.master_writes:
            return False
        if manager.mailbox:
            if not manager.put(offset, data):
                return False
            if manager.full:
                self._exchanged(manager)
                self._pdi.mailbox_written()
            return True
        if not manager.access(offset, len(data)):
            return False
        self.memory[manager.start + offset : manager.start + offset + len(data)] = data
        if offset + len(data) == manager.length:  # handed over when the last byte is written
            self._exchanged(manager)
            self._pdi.outputs(bytes(self.memory[manager.start : manager.end]))
        return True

    def _exchanged(self, manager: SyncManager) -> None:
        if manager.latches_ecat and self.has_dc:
            self.clock.exchanged()

    def _read_registers(self, start: int, end: int) -> bytes | bytearray:
        if end > _DC_SYSTEM_TIME and start < _DC_END and self.has_dc:
            if start < _DC_RECEIVE_TIME:
                self.clock.show_system_time()
            if end > _DC_ECAT_EVENT:
                self.clock.show_events()
        if start > _DC_RECEIVE_TIMES:
            return self.memory[start:end]
        if start <= reg.EVENT_REQUEST + 1 and end > reg.EVENT_REQUEST:
            _U16.pack_into(self.memory, reg.EVENT_REQUEST, self.events)
        if start < reg.SII_DATA and end > reg.SII_CONTROL:
            self.sii.advance()
        data = bytes(self.memory[start:end])
        if start <= reg.AL_STATUS < end:
            self._events &= ~reg.EVENT_AL_STATUS
        if start <= reg.DL_STATUS < end:
            self._events &= ~reg.EVENT_DL_STATUS
        return data

    def _write_registers(self, address: int, data: bytes) -> bool:
        end = address + len(data)
        memory = self.memory
        if not any(self._write_mask[address:end]):
            return False
        locked = [m.registers for m in self.sync_managers if m.enabled]
        repeat_before = self.sync_managers[1].repeat_request
        for at, value in zip(range(address, end), data, strict=True):
            mask = self._write_mask[at]
            if not mask or any(first <= at < first + reg.SM_STATUS for first in locked):
                continue  # a sync manager's area can be changed only while it is disabled
            memory[at] = memory[at] & ~mask | value & mask
        for counters in reg.CLEARED_BY_WRITE:
            if address < counters.stop and end > counters.start:
                memory[counters.start : counters.stop] = bytes(len(counters))
        self._after_write(address, end, repeat_before)
        return True

    def _after_write(self, start: int, end: int, repeat_before: bool) -> None:
        """Set in motion what a write to registers `start` to `end` causes."""

        def touched(first: int, length: int) -> bool:
            return start < first + length and end > first

        if touched(reg.SII_CONTROL, 2):
            self.sii.command()
        if touched(reg.FMMU, reg.FMMU_COUNT * reg.FMMU_SIZE):
            self.plans.clear()
            every = (Fmmu.decode(self.memory, n) for n in range(reg.FMMU_COUNT))
            self.fmmus = [fmmu for fmmu in every if fmmu is not None]
        if touched(reg.SYNC_MANAGER, reg.SYNC_MANAGER_COUNT * reg.SYNC_MANAGER_SIZE):
            for manager in self.sync_managers:
                manager.reload()
            self._pdi.sync_managers_changed()
            if self.sync_managers[1].repeat_request != repeat_before:
                self._pdi.repeat_requested()
        if self.has_dc and end > reg.DC_RECEIVE_TIMES and start < reg.DC_END:
            if touched(reg.DC_RECEIVE_TIMES, 4):
                self.clock.latch()
            if touched(reg.DC_SPEED_START, 2):
                self.clock.reset_loop()
            if touched(reg.DC_SYSTEM_TIME, 1):
                self.clock.compare()
        if touched(reg.AL_CONTROL, 2):
            self._pdi.al_control(_U16.unpack_from(self.memory, reg.AL_CONTROL)[0])
