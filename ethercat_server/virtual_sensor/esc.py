"""The EtherCAT slave controller: registers, memory, sync managers, FMMUs, and what datagrams do to it.

Source: ETG.1000.4. What only the firmware can do goes through the process data interface behind the
controller, which is `application.Application`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import BYTE_NS, Command, Datagram
from ethercat_server.virtual_sensor.device import PDI_TYPE
from ethercat_server.virtual_sensor.distributed_clock import HOP_NS, DcUnit

_U16, _AL_STATUS = struct.Struct("<H"), struct.Struct("<HHH")
_REGISTERS_END, _DC_RECEIVE_TIMES, _DC_END = reg.REGISTERS_END, reg.DC_RECEIVE_TIMES, reg.DC_END
_DC_SYSTEM_TIME, _DC_RECEIVE_TIME = reg.DC_SYSTEM_TIME, reg.DC_RECEIVE_TIME
_DC_CHANGE_EVENT = reg.DC_PDI_CHANGE_EVENT
_LINE_GOES_ON, _LINE_ENDS = 0x5A33, 0x5613  # DL status: ports 0 and 1 have a link, or only port 0


# The controller has two ports, these, 4 KB of process data memory, and a distributed clock of 64 bits.
FMMU_COUNT: Final = 3
SYNC_MANAGER_COUNT: Final = 4
MEMORY_KB: Final = 4
MEMORY_END: Final = reg.REGISTERS_END + MEMORY_KB * 1024
# Repeat request in a sync manager's activate register, repeat acknowledge in its PDI control register.
REPEAT: Final = 0x02

# Counters: a write of any value to one of a group sets the whole group to zero.
CLEARED_BY_WRITE: Final = (
    range(reg.RX_ERRORS, reg.FORWARDED_ERRORS + reg.PORT_COUNT),
    range(reg.PROCESSING_UNIT_ERRORS, reg.PROCESSING_UNIT_ERRORS + 1),
    range(reg.PDI_ERRORS, reg.PDI_ERRORS + 1),
    range(reg.LOST_LINKS, reg.LOST_LINKS + reg.PORT_COUNT),
    range(reg.WATCHDOG_COUNTER, reg.WATCHDOG_COUNTER + 2),
)
_SYNC_MANAGERS = range(
    reg.SYNC_MANAGER, reg.SYNC_MANAGER + SYNC_MANAGER_COUNT * reg.SYNC_MANAGER_SIZE, reg.SYNC_MANAGER_SIZE
)
# Register, bytes, and which bits of each a master may write.
_WRITABLE: Final = (
    (reg.STATION_ADDRESS, 2, 0xFF), (reg.DL_CONTROL, 4, 0xFF), (reg.AL_CONTROL, 2, 0xFF),
    *((counters.start, len(counters), 0xFF) for counters in CLEARED_BY_WRITE),
    (reg.WATCHDOG_DIVIDER, 2, 0xFF), (reg.WATCHDOG_TIME, 2, 0xFF),
    (reg.SII_OWNER, 1, 0x03), (reg.SII_CONTROL + 1, 1, 0x07), (reg.SII_ADDRESS, 4, 0xFF),
    *((reg.FMMU + number * reg.FMMU_SIZE, 13, 0xFF) for number in range(FMMU_COUNT)),
    *((manager, 5, 0xFF) for manager in _SYNC_MANAGERS),
    *((manager + reg.SM_ACTIVATE, 1, 0xC3) for manager in _SYNC_MANAGERS),
    (reg.DC_RECEIVE_TIMES, 4, 0xFF), (reg.DC_SYSTEM_TIME, 8, 0xFF), (reg.DC_OFFSET, 12, 0xFF),
    (reg.DC_ACTIVATION, 2, 0xFF),
    (reg.USER_RAM, reg.REGISTERS_END - reg.USER_RAM, 0xFF),
)  # fmt: skip


def _write_mask() -> bytearray:
    """For every register byte, the bits that a master may write."""
    mask = bytearray(reg.REGISTERS_END)
    for start, length, bits in _WRITABLE:
        mask[start : start + length] = bytes([bits]) * length
    return mask


def _power_on_values() -> bytearray:
    """Registers of a controller that has just been switched on."""
    memory = bytearray(reg.REGISTERS_END)
    # Type, revision, build, FMMUs, sync managers, RAM in KB, ports 0 and 1 MII, features: FMMUs of bytes,
    # distributed clock, of 64 bits, separate counting of check sum errors.
    struct.pack_into(
        "<BBHBBBBH", memory, reg.DL_INFORMATION,
        0xC0, 2, 0, FMMU_COUNT, SYNC_MANAGER_COUNT, MEMORY_KB, 0x0F, 0x008D,
    )  # fmt: skip
    memory[reg.DL_CONTROL] = memory[reg.AL_CONTROL] = memory[reg.AL_STATUS] = memory[reg.WATCHDOG_STATUS] = 1
    memory[reg.PDI_CONTROL] = PDI_TYPE
    struct.pack_into("<H", memory, reg.WATCHDOG_DIVIDER, 2498)  # (2498 + 2) * 40 ns = 100 µs a tick
    struct.pack_into("<H", memory, reg.WATCHDOG_TIME, 1000)
    return memory


@dataclass(frozen=True, slots=True, eq=False)
class Fmmu:
    """One active FMMU: which logical bytes are which bytes of the slave's memory."""

    logical: int  # first logical byte
    length: int
    physical: int
    reads: bool
    writes: bool

    @classmethod
    def decode(cls, memory: bytearray, number: int) -> Fmmu | None:
        logical, length, first, last, physical, bit, kind, active = reg.FMMU_LAYOUT.unpack_from(
            memory, reg.FMMU + number * reg.FMMU_SIZE
        )
        if not active & 1 or length == 0 or not kind & 3 or (first & 7, last & 7, bit & 7) != (0, 7, 0):
            return None
        return cls(logical, length, physical, bool(kind & reg.FMMU_READ), bool(kind & reg.FMMU_WRITE))

    def is_within(self, address: int, length: int) -> bool:
        """Whether a logical command has all that it maps."""
        return address <= self.logical and self.logical + self.length <= address + length


class SyncManager:
    """A view of one sync manager's eight registers, and its mailbox.

    A mailbox is read when it is full, and written when it is not. Buffers are accessed as a whole, as all
    masters do.
    """

    def __init__(self, memory: bytearray, number: int) -> None:
        self._memory = memory
        self.number = number
        self.registers = reg.SYNC_MANAGER + number * reg.SYNC_MANAGER_SIZE
        self._status, self._activate, self._pdi_control = (
            self.registers + offset for offset in (reg.SM_STATUS, reg.SM_ACTIVATE, reg.SM_PDI_CONTROL)
        )
        self.content = b""  # of the mailbox
        self.reload()

    def reload(self) -> None:
        self.start, self.length, self.control = struct.unpack_from("<HHB", self._memory, self.registers)
        self.end = self.start + self.length
        self.mailbox = self.control & 0x03 == reg.SM_MAILBOX
        self.master_writes = self.control & 0x0C == reg.SM_WRITE
        self.watched = bool(self.control & 0x40)  # writes to it trigger the process data watchdog
        activate = self._memory[self._activate]
        self.enabled = bool(activate & 1)
        self.latches = bool(activate & reg.SM_LATCH_PDI)
        self._refresh(self.enabled)

    def allow(self, allowed: bool) -> None:
        """Let the firmware (not the master) switch the sync manager on or off."""
        self._set(self._pdi_control, 1, not allowed)
        self._refresh(allowed)

    def _refresh(self, on: bool) -> None:
        # Switched off by the firmware, a sync manager goes on guarding its memory: nobody gets in.
        self.locked = bool(self._memory[self._pdi_control] & 1)
        inside = self.start >= reg.REGISTERS_END and self.end <= MEMORY_END
        self.active = self.enabled and self.length > 0 and inside
        if not on:
            self.full = False

    def _set(self, register: int, bit: int, on: bool) -> None:
        self._memory[register] = self._memory[register] & ~bit | (bit if on else 0)

    def repeat_asked(self) -> bool:
        """Whether the master has newly asked for the last mailbox again, by a toggle bit; acknowledges it."""
        asked = self._memory[self._activate] & REPEAT
        if asked == self._memory[self._pdi_control] & REPEAT:
            return False
        self._set(self._pdi_control, REPEAT, bool(asked))
        return True

    @property
    def full(self) -> bool:
        """Whether the mailbox holds a message that its reader has not taken."""
        return bool(self._memory[self._status] & reg.MAILBOX_FULL)

    @full.setter
    def full(self, value: bool) -> None:
        self._set(self._status, reg.MAILBOX_FULL, value)

    @property
    def accessible(self) -> bool:
        """Whether the master may access the buffer now."""
        return not self.locked and not (self.mailbox and self.full == self.master_writes)

    def load(self, message: bytes) -> None:
        self.content = message.ljust(self.length, b"\0")[: self.length]
        self.full = True


_EIGHT_BYTE_READS, _BUSY, _ERROR_COMMAND = 0x0040, 0x8000, 0x2000
_NO_OPERATION, _READ = 0, 1


class SiiInterface:
    """The registers 0x0500 to 0x050F, through which a master reads the EEPROM (SII).

    Reading takes `read_ns`. All other commands end with an error, as does reading what is the firmware's.
    """

    # Error bits by name: an EEPROM that works, that returns an error, that stays busy.
    FAULTS: Final = {"ok": 0, "error": _ERROR_COMMAND, "busy": _BUSY}

    def __init__(self, memory: bytearray, image: bytes, clock: Callable[[], int], read_ns: int) -> None:
        self._memory = memory
        self.image = image
        self._clock = clock
        self._read_ns = read_ns
        self._word = 0  # what is being read
        self._faults = 0
        self._end(0)

    def _show(self, bits: int) -> None:
        _U16.pack_into(self._memory, reg.SII_CONTROL, bits | _EIGHT_BYTE_READS)

    def _end(self, bits: int) -> None:
        self._done_at: int | None = None
        self._show(bits)

    def fail(self, bits: int) -> None:
        """End every read with these bits of the control register; 0: no fault."""
        self._faults = bits
        self._end(0)

    def advance(self) -> None:
        """The registers are about to be read: what was being read may be there."""
        if self._done_at is not None and self._clock() >= self._done_at:
            at = self._word * 2
            self._memory[reg.SII_DATA : reg.SII_DATA + 8] = self.image[at : at + 8].ljust(8, b"\xff")
            self._end(0)

    def command(self) -> None:
        control, word = struct.unpack_from("<HI", self._memory, reg.SII_CONTROL)
        operation = control >> 8 & 0x07
        if operation != _READ or self._memory[reg.SII_OWNER] & 0x01:  # until the master takes it back
            self._end(0 if operation == _NO_OPERATION else _ERROR_COMMAND)
        elif self._faults:
            self._end(self._faults)
        else:
            self._done_at, self._word = self._clock() + self._read_ns, word
            self._show(_BUSY)
            self.advance()


class _Pdi(Protocol):
    """The firmware behind the controller: see `Application`."""

    clock: Callable[[], int]

    def al_control(self, control: int) -> None: ...
    def show_state(self) -> None: ...
    def mailbox_exchanged(self) -> None: ...
    def repeat_requested(self) -> None: ...
    def inputs(self) -> bytes: ...
    def outputs(self, data: bytes) -> None: ...


class Esc:
    """Registers and buffers of one controller."""

    def __init__(self, pdi: _Pdi, sii_image: bytes, sii_read_ns: int) -> None:
        self._pdi = pdi
        self.memory = _power_on_values()
        self.memory[reg.STATION_ALIAS : reg.STATION_ALIAS + 2] = sii_image[8:10]
        self._write_mask = _write_mask()
        self.sii = SiiInterface(self.memory, sii_image, pdi.clock, sii_read_ns)
        self.clock = DcUnit(self.memory, self._write_mask, pdi.clock)
        self.sync_managers = [SyncManager(self.memory, n) for n in range(SYNC_MANAGER_COUNT)]
        self.fmmus: list[Fmmu] = []  # the active ones
        self.has_lrw = True
        self.station = 0  # as the register has it
        self.into_ns = 0  # from the start of a datagram until the bytes that are being copied pass
        self.record: Callable[[int, bytes], None] | None = None  # gets all that a master writes, and where

    def count(self, counter: int) -> None:
        """Add one to the error counter at this register; it stays at 255."""
        self.memory[counter] = min(self.memory[counter] + 1, 0xFF)

    def set_line(self, before: int, behind: int) -> None:
        """So many slaves are before it and behind it. Port 0 is always open; port 1 if one is behind."""
        self.clock.propagation_delay_ns, self.clock.loop_delay_ns = before * HOP_NS, 2 * behind * HOP_NS
        status = _LINE_GOES_ON if behind else _LINE_ENDS
        was = _U16.unpack_from(self.memory, reg.DL_STATUS)[0]
        if was == _LINE_GOES_ON and not behind:
            self.count(reg.LOST_LINKS + 1)
        if was != status:
            _U16.pack_into(self.memory, reg.DL_STATUS, status)

    def set_al_status(self, status: int, code: int) -> bool:
        was, _, code_was = _AL_STATUS.unpack_from(self.memory, reg.AL_STATUS)
        if (was, code_was) == (status, code):
            return False
        _AL_STATUS.pack_into(self.memory, reg.AL_STATUS, status, 0, code)
        return True

    def read(self, address: int, length: int) -> bytes | bytearray | None:
        """`length` bytes from `address` on, as a master reads them; None if it may not."""
        end = address + length
        if end <= _REGISTERS_END:
            return self.read_registers(address, end) if length else None
        manager = self._manager(address, end)
        if manager is None or manager.master_writes or not manager.accessible:
            return None
        if not manager.mailbox:  # the newest of three buffers
            return self._pdi.inputs()[:length].ljust(length, b"\0")
        message, manager.full = manager.content, False
        self._pdi.mailbox_exchanged()
        return message

    def write(self, address: int, data: bytes) -> bool:
        """Write `data` as a master does; False if it may not."""
        if self.record is not None:
            self.record(address, data)
        end = address + len(data)
        if end <= _REGISTERS_END:
            return self._write_registers(address, data)
        manager = self._manager(address, end)
        if manager is None or not manager.master_writes or not manager.accessible:
            return False
        if manager.mailbox:
            manager.load(data)
            self._pdi.mailbox_exchanged()
        else:
            self._pdi.outputs(data)
        return True

    def _manager(self, start: int, end: int) -> SyncManager | None:
        return next((m for m in self.sync_managers if m.active and (m.start, m.end) == (start, end)), None)

    def read_registers(self, start: int, end: int) -> bytes | bytearray:
        clock = self.clock
        if end > _DC_SYSTEM_TIME and start < _DC_END and clock.present:
            if start < _DC_RECEIVE_TIME:
                clock.show_system_time()
            if end > _DC_CHANGE_EVENT:
                clock.events.update(self._pdi.clock() + clock.propagation_delay_ns)
        if start > _DC_RECEIVE_TIMES:
            return self.memory[start:end]
        if start < reg.SII_DATA and end > reg.SII_CONTROL:
            self.sii.advance()
        return bytes(self.memory[start:end])

    def _write_registers(self, address: int, data: bytes) -> bool:
        end = address + len(data)
        if not any(self._write_mask[address:end]):
            return False
        locked = [m.registers for m in self.sync_managers if m.enabled]
        for at, value in enumerate(data, address):
            mask = self._write_mask[at]
            if not mask or any(first <= at < first + reg.SM_STATUS for first in locked):
                continue  # a sync manager's area can be changed only while it is disabled
            self.memory[at] = self.memory[at] & ~mask | value & mask
        for counters in CLEARED_BY_WRITE:
            if address < counters.stop and end > counters.start:
                self.memory[counters.start : counters.stop] = bytes(len(counters))
        self._after_write(address, end)
        return True

    def _after_write(self, start: int, end: int) -> None:
        """Set in motion what a write to registers `start` to `end` causes."""

        def touched(first: int, length: int) -> bool:
            return start < first + length and end > first

        if touched(reg.STATION_ADDRESS, 2):
            (self.station,) = _U16.unpack_from(self.memory, reg.STATION_ADDRESS)
        if touched(reg.SII_CONTROL, 2):
            self.sii.command()
        if touched(reg.FMMU, FMMU_COUNT * reg.FMMU_SIZE):
            every = (Fmmu.decode(self.memory, n) for n in range(FMMU_COUNT))
            self.fmmus = [fmmu for fmmu in every if fmmu is not None]
        if touched(reg.SYNC_MANAGER, SYNC_MANAGER_COUNT * reg.SYNC_MANAGER_SIZE):
            for manager in self.sync_managers:
                manager.reload()
            self._pdi.show_state()
            if self.sync_managers[1].repeat_asked():
                self._pdi.repeat_requested()
        if self.clock.present and touched(reg.DC_RECEIVE_TIMES, 4):
            self.clock.latch()
        if touched(reg.AL_CONTROL, 2):
            self._pdi.al_control(_U16.unpack_from(self.memory, reg.AL_CONTROL)[0])


# Datagrams. A successful read counts 1, a write 1, and in a read-write command a read 1 and a write 2.
_LOGICAL = frozenset({Command.LRD, Command.LWR, Command.LRW})
_READS = frozenset({Command.APRD, Command.FPRD, Command.BRD})
_WRITES = frozenset({Command.APWR, Command.FPWR, Command.BWR})
_READS_AND_WRITES = frozenset({Command.APRW, Command.FPRW, Command.BRW, Command.ARMW, Command.FRMW})
_BROADCAST = frozenset({Command.BRD, Command.BWR, Command.BRW})
_READ_MULTIPLE_WRITE = frozenset({Command.ARMW, Command.FRMW})
# Their position is, by every slave.
_COUNTED_UP = _BROADCAST | {Command.APRD, Command.APWR, Command.APRW, Command.ARMW}


def pass_through(escs: Sequence[Esc], frame: bytearray, datagram: Datagram) -> None:
    """Process one datagram in place as it passes these slaves, in their order."""
    command, _, adp, _, header, _, _ = datagram
    if command in _LOGICAL:
        counted = sum(_logical(esc, frame, datagram) for esc in escs)
    elif command in _READS or command in _WRITES or command in _READS_AND_WRITES:
        meant: Sequence[Esc]
        if command in _COUNTED_UP:
            _U16.pack_into(frame, header + 2, (adp + len(escs)) & 0xFFFF)
            at = -adp & 0xFFFF  # the one that it reaches as 0
            meant = escs if command in _BROADCAST else escs[at : at + 1]
        else:
            meant = [esc for esc in escs if esc.station == adp]
        if command in _READ_MULTIPLE_WRITE:
            counted = sum(
                _physical(esc, frame, datagram, reads=esc in meant, writes=esc not in meant) for esc in escs
            )
        else:
            reads, writes = command not in _WRITES, command not in _READS
            counted = sum(_physical(esc, frame, datagram, reads=reads, writes=writes) for esc in meant)
    else:
        return
    _U16.pack_into(frame, datagram.end, (_U16.unpack_from(frame, datagram.end)[0] + counted) & 0xFFFF)


def _physical(esc: Esc, frame: bytearray, datagram: Datagram, *, reads: bool, writes: bool) -> int:
    start, end = datagram.data, datagram.end
    incoming, counted = bytes(frame[start:end]), 0
    if reads and (read := esc.read(datagram.ado, datagram.length)) is not None:
        counted = 1
        if datagram.command in _BROADCAST:
            read = bytes(a | b for a, b in zip(read, incoming, strict=True))
        frame[start:end] = read
    if writes and esc.write(datagram.ado, incoming):
        counted += 2 if reads else 1
    return counted


def _logical(esc: Esc, frame: bytearray, datagram: Datagram) -> int:
    command, address, length = datagram.command, datagram.ado << 16 | datagram.adp, datagram.length
    if command == Command.LRW and not esc.has_lrw:
        return 0
    read = written = False
    base = datagram.data
    incoming = bytes(frame[base : datagram.end])
    for fmmu in esc.fmmus:
        if not fmmu.is_within(address, length):
            continue
        offset, size = fmmu.logical - address, fmmu.length
        start = base + offset
        esc.into_ns = (start - datagram.header) * BYTE_NS
        if command != Command.LRD and fmmu.writes:
            written |= esc.write(fmmu.physical, incoming[offset : offset + size])
        if command != Command.LWR and fmmu.reads and (data := esc.read(fmmu.physical, size)) is not None:
            frame[start : start + size] = data
            read = True
    esc.into_ns = 0
    return read + (2 * written if command == Command.LRW else written)
