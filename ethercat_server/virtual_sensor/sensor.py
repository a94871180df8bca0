"""One simulated sensor: power, replacement, and a record of the SDO writes it received."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from ethercat_server.sensor.objects.dictionary import FACTORY_CALIBRATION
from ethercat_server.virtual_sensor.firmware.firmware import Firmware
from ethercat_server.virtual_sensor.firmware.flash import Flash
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.slave.al import AlState
from ethercat_server.virtual_sensor.slave.objects import Address

_WRITES_REMEMBERED: Final = 1000
_WRITES_TOLD: Final = 200


@dataclass(frozen=True, slots=True)
class SdoWrite:
    """One SDO write request."""

    index: int
    subindex: int
    data: bytes
    state: AlState
    abort: int
    """Abort code; 0 if it succeeded."""


class VirtualSensor:
    """A sensor, powered or not. `clock` gives the time in ns."""

    def __init__(self, options: SensorOptions, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._options = options
        self.flash = Flash()
        self._writes: deque[SdoWrite] = deque(maxlen=_WRITES_REMEMBERED)
        self.sdo_write_count = self.calibration_writes = 0
        self._on_write: dict[Address, Callable[[], None]] = {}
        self.due: list[Callable[[], None]] = []
        """Actions for the end of the frame that is being processed."""
        self.life: Firmware | None = None
        self._apply_sinc()
        self.power(True)

    def _apply_sinc(self) -> None:
        if self._options.sinc_length is not None:
            self.flash.entries[0x8006, 1] = struct.pack("<H", self._options.sinc_length)

    @property
    def options(self) -> SensorOptions:
        """Its current options."""
        return self._options

    @property
    def sdo_writes(self) -> list[SdoWrite]:
        """The latest SDO writes, oldest first, across power cycles."""
        return list(self._writes)

    def _remember(self, index: int, subindex: int, data: bytes, state: AlState, abort: int) -> None:
        self._writes.append(SdoWrite(index, subindex, data, state, abort))
        self.sdo_write_count += 1
        if index == FACTORY_CALIBRATION:
            self.calibration_writes += 1
        action = self._on_write.pop((index, subindex), None)
        if action is not None:
            self.due.append(action)

    def on_write(self, address: Address, action: Callable[[], None]) -> None:
        """Do `action` right after the next SDO write to this entry."""
        self._on_write[address] = action

    def power(self, on: bool) -> None:
        """Switch it off or on; no effect if it already is."""
        if not on:
            self.life = None
            self.flash.power_cut(self._clock())
        elif self.life is None:
            self.life = Firmware(self._options, self.flash, self._clock, self._remember)

    def swap(self, model: str, serial: int) -> None:
        """Replace it by a new sensor of another model or serial number, just switched on."""
        self._options = replace(self._options, model=model, serial=serial)
        self.flash = Flash()
        self._apply_sinc()
        self.life = None
        self.power(True)

    def set_ppm(self, ppm: float) -> None:
        """Set the error of its clock, now and after a power cycle."""
        self._options = replace(self._options, ppm=ppm)
        if self.life is not None:
            self.life.esc.clock.settle()
            self.life.sampler.set_ppm(ppm)

    def set_signal(self, signal: str) -> None:
        """Measure another signal, now and after a power cycle."""
        self._options = replace(self._options, signal=signal)
        if self.life is not None:
            self.life.sampler.set_signal(self._options)

    def statistics(self) -> dict[str, Any]:
        """Its part of what the command `stats` reports."""
        life = self.life
        return {
            "model": self._options.model,
            "serial": self._options.serial,
            "powered": life is not None,
            "al_state": life.al.state.name if life else None,
            "al_error": life is not None and life.al.error,
            "al_status_code": life.al.code if life else 0,
            "sample": life.sampler.clock.number_at(self._clock()) if life else None,
            "samples_made": life.sampler.made if life else 0,
            "sinc_length": life.sampler.clock.sinc_length if life else None,
            "ppm": self._options.ppm,
            "calibration_writes": self.calibration_writes,
            "sdo_write_count": self.sdo_write_count,
            "sdo_writes": [
                {
                    "index": f"0x{w.index:04X}",
                    "subindex": w.subindex,
                    "hex": w.data.hex(),
                    "state": w.state.name,
                    "abort": f"0x{w.abort:08X}" if w.abort else None,
                }
                for w in self.sdo_writes[-_WRITES_TOLD:]
            ],
        }
