"""A slave as a master has left it: station address, sync managers, FMMUs, AL state."""

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.slave.al import AlState
from ethercat_server.virtual_sensor.slave.application import Application
from ethercat_server.virtual_sensor.slave.device import INPUTS, OUTPUTS

_STEPS: Final = (AlState.PREOP, AlState.SAFEOP, AlState.OP)
_FMMU: Final = struct.Struct("<IHBBHBBB3x")
_SYNC_MANAGER: Final = struct.Struct("<HHBBBB")
_OF_FIRMWARE: Final = b"\x01"
_KINDS: Final = ((OUTPUTS, 2), (INPUTS, 1))
"""Kind of sync manager, type of its FMMU."""


def leave_in(life: Application, state: AlState, station: int, outputs_at: int, inputs_at: int) -> None:
    """Take it to `state`, with its process data at these logical addresses, as a master does.

    Its process data watchdog waits for the first outputs.
    """
    rows = life.device.sync_managers
    managers = [
        _SYNC_MANAGER.pack(row.start, row.length, row.control, 0, bool(row.length), 0) for row in rows
    ]
    life.esc.write(reg.STATION_ADDRESS, struct.pack("<H", station))
    life.esc.write(reg.SII_OWNER, _OF_FIRMWARE)
    for step in _STEPS:
        if step > state:
            break
        if step is AlState.PREOP:
            life.esc.write(reg.SYNC_MANAGER, b"".join(managers[:2]))
        elif step is AlState.SAFEOP:
            life.esc.write(reg.SYNC_MANAGER + 2 * reg.SYNC_MANAGER_SIZE, b"".join(managers[2:]))
            logical = (outputs_at, inputs_at)
            units = [
                _FMMU.pack(at, row.length, 0, 7, row.start, 0, kind, 1)
                for at, (wanted, kind) in zip(logical, _KINDS, strict=True)
                for row in rows
                if row.kind == wanted and row.length
            ]
            life.esc.write(reg.FMMU, b"".join(units))
        life.esc.write(reg.AL_CONTROL, struct.pack("<H", step))
    assert life.al.state is state
