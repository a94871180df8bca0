"""Keeps the CPUs out of idle states during a measurement, as cyclictest and the tuned profile do."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

_LATENCY: Final = Path("/dev/cpu_dma_latency")


@contextmanager
def no_idle_states() -> Iterator[bool]:
    """An idle CPU spins as long as this lasts; yields False where that is not allowed.

    A halted CPU takes tens of µs to wake, and in a virtual machine as long as the host is busy with others.
    """
    try:
        device = _LATENCY.open("wb", buffering=0)
    except OSError:
        yield False
        return
    with device:
        device.write(struct.pack("=i", 0))  # µs that a wake-up may take, until the file is closed
        yield True
