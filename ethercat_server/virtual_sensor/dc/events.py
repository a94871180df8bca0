"""The event times of the sync managers: when frames and firmware exchanged buffers, in local time.

Source: Beckhoff's ESC data sheets, registers 0x09F0, 0x09F8, 0x09FC. Those of the inputs are computed from
the instants of the samples when somebody looks, or something changes. The firmware's accesses to mailboxes
are left out.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, Protocol

from ethercat_server.virtual_sensor.dc.local_clock import LocalClock
from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.esc.sync_manager import SyncManager

_U32: Final = struct.Struct("<I")
_MASK: Final = 2**32 - 1
_MIX: Final = 0x9E3779B97F4A7C15
_NEVER: Final = -1


class BufferWrites(Protocol):
    """The firmware's writes of the input buffer, numbered."""

    def number_at(self, instant: int) -> int:
        """The newest that is complete at an instant, ns."""

    def completed(self, number: int) -> int:
        """When its last byte is written, ns."""


class EventTimes:
    """Works on the registers in `memory`. All times are in ns.

    Attributes:
        none: there are no such registers.
        stuck: no further end of a write is shown.
        shows_start: instead of the end of a write its start is shown.
        previous: the write before the newest one is shown.
        shift: added to the times of writes.
        jitter: a random time up to this, and down to its negative, is added too.
    """

    def __init__(self, memory: bytearray, local: LocalClock) -> None:
        self._memory = memory
        self._local = local
        self._writes: BufferWrites | None = None
        self._write_ns = 0
        self._since: int | None = None
        self._begun = self._completed = _NEVER
        self._any_shown = False
        self.none = False
        self.repair()

    def repair(self) -> None:
        """End all that is wrong with the times of writes."""
        self.stuck = self.shows_start = self.previous = False
        self.shift = self.jitter = 0

    def take_away(self) -> None:
        """Be a controller without these registers."""
        self.none = True
        self._memory[reg.DC_ECAT_EVENT : reg.DC_END] = bytes(reg.DC_END - reg.DC_ECAT_EVENT)

    def follow(self, writes: BufferWrites, write_ns: int) -> None:
        """Show these writes, each of which takes so long."""
        self._writes, self._write_ns = writes, write_ns

    def sync_managers_changed(self, managers: Sequence[SyncManager], now: int) -> None:
        """Latch the writes from now on if a sync manager of inputs says so."""
        wanted = any(
            manager.latches_pdi
            and manager.active
            and not (manager.locked or manager.mailbox or manager.master_writes)
            for manager in managers
        )
        if wanted != (self._since is not None):
            self.update(now)
            self._since = now if wanted else None

    def update(self, now: int) -> None:
        """Latch what has happened up to now."""
        writes, since = self._writes, self._since
        if since is None or writes is None or self.none:
            return
        number = writes.number_at(now)
        if number != self._completed and not (self.stuck and self._any_shown):
            self._completed = number
            end = self._end(writes, number)
            if end >= since:
                self._any_shown = True
                shown = end - self._write_ns if self.shows_start else end
                self._show(reg.DC_PDI_CHANGE_EVENT, shown, number)
        number = writes.number_at(now + self._write_ns)
        if number != self._begun:
            self._begun = number
            start = self._end(writes, number) - self._write_ns
            if start >= since:
                self._show(reg.DC_PDI_START_EVENT, start, number)

    def _end(self, writes: BufferWrites, number: int) -> int:
        end = writes.completed(number)
        return writes.completed(writes.number_at(end - 1)) if self.previous else end

    def _show(self, register: int, instant: int, number: int) -> None:
        off = self.shift
        if self.jitter:  # a hash of the number: the same for both registers
            word = (number + 1) * _MIX & 0xFFFFFFFFFFFFFFFF
            word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 & 0xFFFFFFFFFFFFFFFF
            off += (word ^ word >> 27) % (2 * self.jitter + 1) - self.jitter
        _U32.pack_into(self._memory, register, self._local.at(instant) + off & _MASK)

    def outputs_taken(self, now: int) -> None:
        """The firmware has read the outputs, in no time, and their sync manager latches that."""
        self.update(now)
        if not self.none:
            for register in (reg.DC_PDI_START_EVENT, reg.DC_PDI_CHANGE_EVENT):
                _U32.pack_into(self._memory, register, self._local.at(now) & _MASK)

    def exchanged(self, frame_start: int) -> None:
        """A frame that began then has exchanged a buffer whose sync manager latches that."""
        if not self.none:
            _U32.pack_into(self._memory, reg.DC_ECAT_EVENT, self._local.at(frame_start) & _MASK)
