"""A drive of another vendor at work: a virtual sensor in OP, changed so that nothing says Bota any more.

It is driven by another master, which keeps its watchdog from ending OP; here the watchdog is off instead.
"""

from __future__ import annotations

import struct
from typing import Any

from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.simulation.backend import MemoryBackend

VENDOR = 0x2
_INPUTS = reg.SYNC_MANAGER + 3 * reg.SYNC_MANAGER_SIZE


def _esc(backend: MemoryBackend, position: int) -> Any:
    life = backend.sensors.sensors[position].life
    assert life is not None
    return life.esc


def become_drive(backend: MemoryBackend, position: int) -> None:
    """Make a drive of the sensor at `position`, which must be in OP."""
    esc = _esc(backend, position)
    assert esc.memory[reg.AL_STATUS] == AlState.OP
    esc.memory[_INPUTS : _INPUTS + 4] = struct.pack("<HH", 0x1400, 30)
    image = bytearray(esc.sii.image)
    image[0x10:0x14] = VENDOR.to_bytes(4, "little")
    esc.sii.image = bytes(image)


def watchdog_off(backend: MemoryBackend) -> None:
    """All slaves stay in OP without a master."""
    for position in range(len(backend.sensors.sensors)):
        _esc(backend, position).memory[reg.WATCHDOG_TIME : reg.WATCHDOG_TIME + 2] = bytes(2)


def registers(backend: MemoryBackend) -> list[bytes]:
    """All registers of every slave."""
    count = len(backend.sensors.sensors)
    return [bytes(_esc(backend, position).memory[: reg.REGISTERS_END]) for position in range(count)]
