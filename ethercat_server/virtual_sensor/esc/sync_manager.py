"""One sync manager: who may touch its piece of memory, and the mailbox handshake.

Source: ETG.1000.4. A buffer is opened by an access to its first byte and handed over by one to its last; an
access out of turn is refused and changes nothing.
"""

from __future__ import annotations

import struct

from ethercat_server.virtual_sensor.esc import registers as reg


class SyncManager:
    """A view of one sync manager's eight registers, and the state of its buffer."""

    def __init__(self, memory: bytearray, number: int) -> None:
        self._memory = memory
        self.number = number
        self.registers = reg.SYNC_MANAGER + number * reg.SYNC_MANAGER_SIZE
        self.start = self.length = self.end = self.control = 0
        self.enabled = self.active = self.locked = False
        self.mailbox = self.master_writes = False
        self.latches_ecat = self.latches_pdi = False
        self._open = False
        self.reload()

    def reload(self) -> None:
        """Take over what the registers say."""
        self.start, self.length, self.control = struct.unpack_from("<HHB", self._memory, self.registers)
        self.end = self.start + self.length
        self.mailbox = self.control & 0x03 == 0x02
        self.master_writes = self.control & 0x0C == 0x04
        activate = self._memory[self.registers + reg.SM_ACTIVATE]
        self.enabled = bool(activate & 1)
        self.latches_ecat = bool(activate & reg.SM_LATCH_ECAT)
        self.latches_pdi = bool(activate & reg.SM_LATCH_PDI)
        self._refresh()
        if not self.enabled:
            self.full = self._open = False

    def _refresh(self) -> None:
        # Switched off by the firmware, a sync manager goes on guarding its memory: nobody gets in.
        self.locked = bool(self._memory[self.registers + reg.SM_PDI_CONTROL] & 1)
        inside = self.start >= reg.REGISTERS_END and self.end <= reg.MEMORY_END
        self.active = self.enabled and self.length > 0 and inside

    def allow(self, allowed: bool) -> None:
        """Let the firmware (not the master) switch the sync manager on or off."""
        at = self.registers + reg.SM_PDI_CONTROL
        self._memory[at] = self._memory[at] & ~1 | (not allowed)
        self._refresh()
        if not allowed:
            self.full = self._open = False

    @property
    def watched(self) -> bool:
        """Whether writes to it trigger the process data watchdog."""
        return bool(self.control & 0x40)

    @property
    def repeat_request(self) -> bool:
        """The toggle bit by which the master asks for the last mailbox again."""
        return bool(self._memory[self.registers + reg.SM_ACTIVATE] & reg.REPEAT)

    def acknowledge_repeat(self) -> None:
        """Show that the repeat request was seen."""
        at = self.registers + reg.SM_PDI_CONTROL
        self._memory[at] = self._memory[at] & ~reg.REPEAT | (reg.REPEAT if self.repeat_request else 0)

    @property
    def full(self) -> bool:
        """Whether the mailbox holds a message that its reader has not taken."""
        return bool(self._memory[self.registers + reg.SM_STATUS] & reg.MAILBOX_FULL)

    @full.setter
    def full(self, value: bool) -> None:
        at = self.registers + reg.SM_STATUS
        self._memory[at] = self._memory[at] & ~reg.MAILBOX_FULL | (reg.MAILBOX_FULL if value else 0)

    @property
    def unread(self) -> bool:
        """Whether the mailbox is full, and its reader has not begun to take it."""
        return self.full and not self._open

    def access(self, offset: int, length: int) -> bool:
        """The master accesses its buffer; False if it may not now."""
        may = self._open or offset == 0
        self._open = may and offset + length < self.length
        return may

    def put(self, offset: int, data: bytes) -> bool:
        """The master writes into its write mailbox; False if it may not now."""
        if self.full or not self.access(offset, len(data)):
            return False
        at = self.start + offset
        self._memory[at : at + len(data)] = data
        self.full = not self._open
        return True

    def take(self, offset: int, length: int) -> bytes | None:
        """The master reads from its read mailbox; None if it may not now."""
        if not self.full or not self.access(offset, length):
            return None
        self.full = self._open
        at = self.start + offset
        return bytes(self._memory[at : at + length])

    def load(self, message: bytes) -> None:
        """The firmware fills the read mailbox."""
        self._memory[self.start : self.end] = message.ljust(self.length, b"\0")[: self.length]
        self._open = False
        self.full = True

    def content(self) -> bytes:
        """The whole buffer, as the firmware sees it."""
        return bytes(self._memory[self.start : self.end])
