"""Fieldbus memory management units: which logical bits are which bits of a slave's memory.

Source: ETG.1000.4. An FMMU maps a run of logical bits onto a run of physical bits. Nearly always both are
whole bytes; then a mapping is one copy.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from ethercat_server.virtual_sensor.esc import registers as reg

_LAYOUT = struct.Struct("<IHBBHBBB")


@dataclass(frozen=True, slots=True, eq=False)
class Fmmu:
    """One active FMMU."""

    logical: int
    """First logical byte."""
    length: int
    """Logical bytes that it touches."""
    first_bit: int
    last_bit: int
    physical: int
    physical_bit: int
    reads: bool
    writes: bool
    bitwise: bool
    """Whether it maps anything but whole bytes onto whole bytes."""

    @classmethod
    def decode(cls, memory: bytearray, number: int) -> Fmmu | None:
        """FMMU `number` from the registers; None if it is not active or maps nothing."""
        logical, length, first, last, physical, bit, kind, active = _LAYOUT.unpack_from(
            memory, reg.FMMU + number * reg.FMMU_SIZE
        )
        if not active & 1 or length == 0 or not kind & 3:
            return None
        bits = first & 7, last & 7, bit & 7
        return cls(
            logical, length, *bits[:2], physical, bits[2], bool(kind & 1), bool(kind & 2), bits != (0, 7, 0)
        )

    def overlap(self, address: int, length: int) -> tuple[int, int, int] | None:
        """The part of a logical command that it maps; None if none.

        Returns: offset in the command's data, bytes there, first physical address.
        """
        start = max(address, self.logical)
        end = min(address + length, self.logical + self.length)
        if start >= end:
            return None
        if not self.bitwise:
            return start - address, end - start, self.physical + start - self.logical
        # A bit-wise unit is small: it is always taken whole, or not at all.
        if (start, end) != (self.logical, self.logical + self.length):
            return None
        return start - address, end - start, self.physical

    @property
    def _bits(self) -> int:
        return max((self.length - 1) * 8 + self.last_bit + 1 - self.first_bit, 0)

    def span(self, length: int) -> int:
        """Physical bytes touched for `length` logical bytes."""
        return (self.physical_bit + self._bits + 7) // 8 if self.bitwise else length

    def insert(self, data: bytes, current: bytes) -> bytes:
        """`current` physical bytes with the mapped bits of logical `data` put in."""
        mask = (1 << self._bits) - 1
        value = int.from_bytes(data, "little") >> self.first_bit & mask
        kept = int.from_bytes(current, "little") & ~(mask << self.physical_bit)
        inside = (1 << len(current) * 8) - 1  # the end of memory cuts it off
        return ((kept | value << self.physical_bit) & inside).to_bytes(len(current), "little")

    def extract(self, physical: bytes | bytearray, current: bytes) -> bytes:
        """`current` logical bytes with the mapped bits of `physical` put in."""
        mask = (1 << self._bits) - 1
        value = int.from_bytes(physical, "little") >> self.physical_bit & mask
        kept = int.from_bytes(current, "little") & ~(mask << self.first_bit)
        return (kept | value << self.first_bit).to_bytes(len(current), "little")
