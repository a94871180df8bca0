"""One simulated sensor: its firmware from power-on to power-off, replacement, its record of SDO writes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.sensor.objects.dictionary import BY_SETTING, FACTORY_CALIBRATION
from ethercat_server.virtual_sensor.application import Application, VirtualSlave
from ethercat_server.virtual_sensor.dictionary import Dictionary, Flash, OnWrite, sensor_device
from ethercat_server.virtual_sensor.distributed_clock import parse_clock
from ethercat_server.virtual_sensor.mailbox import Address
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.sampler import Sampler

_WRITES_REMEMBERED: Final = 200


class Firmware(Application):
    """Objects and measurement behind the application. `clock` gives the time in ns."""

    def __init__(
        self,
        options: SensorOptions,
        flash: Flash,
        clock: Callable[[], int],
        on_write: OnWrite,
        stamp: Callable[[int], int] = int,
    ) -> None:
        self.dictionary = Dictionary(options, flash, self.inputs, clock, on_write)
        self.sampler = Sampler(options, self.dictionary, clock, stamp)
        self.dictionary.changed = self.sampler.settings_changed
        device = sensor_device(options.model, options.serial, options.pdo_size)
        super().__init__(device, clock, self.dictionary, options.eeprom_ms)
        self.esc.clock.events.follow(self.sampler.number_at, self.sampler.clock.instant)
        for word, numbers in parse_clock(options.dc):
            self.esc.clock.apply(word, numbers)

    def inputs(self) -> bytes:
        """The newest process data when its first byte passes."""
        return self.sampler.newest(self.esc.clock.propagation_delay_ns + self.esc.into_ns)

    def prepare(self, expected: int) -> None:
        self.sampler.prepare(expected)


class VirtualSensor(VirtualSlave):
    """A sensor."""

    options: SensorOptions  # its current ones
    life: Firmware | None

    def __init__(self, options: SensorOptions, clock: Callable[[], int], stamp: Callable[[int], int]) -> None:
        super().__init__(clock)
        self._stamp = stamp
        self.options = options
        # The latest, oldest first, across power cycles, as `stats` reports them.
        self.sdo_writes: deque[dict[str, Any]] = deque(maxlen=_WRITES_REMEMBERED)
        self.sdo_write_count = self.calibration_writes = 0
        self.on_write: dict[Address, Callable[[], None]] = {}  # actions for the next SDO write to an entry
        self._begin()

    def _begin(self) -> None:
        self.flash = Flash()
        if self.options.sinc_length is not None:
            row = BY_SETTING["sinc_length"]
            self.flash.entries[row.address] = row.type.pack(self.options.sinc_length)
        self.life = None
        self.power(True)

    def _remember(self, index: int, subindex: int, data: bytes, state: AlState, abort: int) -> None:
        self.sdo_writes.append(
            {
                "index": f"0x{index:04X}",
                "subindex": subindex,
                "hex": data.hex(),
                "state": state.name,
                "abort": f"0x{abort:08X}" if abort else None,
            }
        )
        self.sdo_write_count += 1
        self.calibration_writes += index == FACTORY_CALIBRATION
        if (action := self.on_write.pop((index, subindex), None)) is not None:
            action()

    def _switched_on(self) -> Firmware:
        return Firmware(self.options, self.flash, self._clock, self._remember, self._stamp)

    def power(self, on: bool) -> None:
        super().power(on)
        if not on:
            self.flash.power_cut(self._clock())

    def swap(self, model: str, serial: int) -> None:
        """Replace it by a new sensor of another model or serial number, just switched on."""
        self.options = replace(self.options, model=model, serial=serial)
        self._begin()

    def set_ppm(self, ppm: float) -> None:
        self.options = replace(self.options, ppm=ppm)
        if self.life is not None:
            self.life.esc.clock.settle()
            self.life.sampler.set_ppm(ppm)

    def set_signal(self, signal: str) -> None:
        self.options = replace(self.options, signal=signal, world=None)
        if self.life is not None:
            self.life.sampler.measure(self.options)

    def statistics(self) -> dict[str, Any]:
        life = self.life
        return {
            "model": self.options.model,
            "serial": self.options.serial,
            **super().statistics(),
            "sample": life.sampler.clock.number_at(self._clock()) if life else None,
            "samples_made": life.sampler.made if life else 0,
            "sinc_length": life.sampler.clock.sinc_length if life else None,
            "ppm": self.options.ppm,
            "world": getattr(self.options.world, "counts", None),
            "calibration_writes": self.calibration_writes,
            "sdo_write_count": self.sdo_write_count,
            "sdo_writes": list(self.sdo_writes),
        }
