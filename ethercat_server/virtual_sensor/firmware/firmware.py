"""The firmware of one sensor from power-on to power-off: objects and measurement behind the application."""

from __future__ import annotations

from collections.abc import Callable

from ethercat_server.virtual_sensor.dc.kinds import parse_clock
from ethercat_server.virtual_sensor.faults.aborts import AbortFaults
from ethercat_server.virtual_sensor.firmware.dictionary import OBJECT_NAMES, Dictionary
from ethercat_server.virtual_sensor.firmware.flash import Flash
from ethercat_server.virtual_sensor.firmware.layout import sensor_device
from ethercat_server.virtual_sensor.measurement.sampler import Sampler
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.slave.al import AlState
from ethercat_server.virtual_sensor.slave.application import Application
from ethercat_server.virtual_sensor.slave.objects import SdoAbortError
from ethercat_server.virtual_sensor.slave.sdo_information import SdoInformation

OnWrite = Callable[[int, int, bytes, AlState, int], None]


class Firmware(Application):
    """See `Application`.

    `clock` gives the time in ns; `on_write` is called for every SDO write: index, sub-index, data, AL state,
    abort code or 0.
    """

    def __init__(
        self, options: SensorOptions, flash: Flash, clock: Callable[[], int], on_write: OnWrite
    ) -> None:
        self._on_write = on_write
        self.on_request: Callable[[], None] | None = None
        """Called once, after the next mailbox request."""
        self.dictionary = Dictionary(
            options.model, options.serial, options.pdo_size,
            flash, self.inputs, self._settings_changed, clock,
        )  # fmt: skip
        self.dictionary.let_chop_divide(options.chop_divides)
        self.sampler = Sampler(options, self.dictionary, clock)
        self.aborts = AbortFaults()
        device = sensor_device(options.model, options.serial, options.pdo_size)
        information = SdoInformation(self.dictionary, device, OBJECT_NAMES)
        super().__init__(device, clock, information, options.eeprom_ms)
        self.esc.clock.events.follow(self.sampler, round(options.write_us * 1000))
        for apply in parse_clock(options.dc):
            apply(self.esc)

    def mailbox_written(self) -> None:
        """A request has arrived."""
        super().mailbox_written()
        if (action := self.on_request) is not None:
            self.on_request = None
            action()

    def inputs(self) -> bytes:
        """The newest process data when its first byte passes."""
        return self.sampler.newest(self.esc.clock.way_ns + self.esc.into_ns)

    def prepare(self, expected: int) -> None:
        """Compute the sample that a frame at the time `expected` will read."""
        self.sampler.prepare(expected)

    def state_changed(self) -> None:
        """The AL state has changed: it measures in any."""

    def take_outputs(self, data: bytes) -> None:
        """The master wrote the outputs."""
        self.dictionary.set_output(data)

    def _settings_changed(self) -> None:
        self.sampler.settings_changed()

    def read(self, index: int, subindex: int) -> bytes:
        """An SDO upload."""
        self.aborts.check_read((index, subindex))
        return self.dictionary.read(index, subindex)

    def check_download(self, index: int, subindex: int, length: int) -> None:
        """Refuse a download of the wrong length before its data has come."""
        try:
            self.dictionary.check_write(self.dictionary.entry(index, subindex), length, self.al.state)
        except SdoAbortError as error:
            self._on_write(index, subindex, b"", self.al.state, error.code)
            raise

    def length(self, index: int, subindex: int) -> int:
        """Bytes of an entry."""
        return self.dictionary.size(self.dictionary.entry(index, subindex))

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """An SDO download."""
        abort = 0
        try:
            self.aborts.check_write((index, subindex), data, self.clock())
            self.dictionary.write(index, subindex, data, self.al.state)
        except SdoAbortError as error:
            abort = error.code
            raise
        finally:
            self._on_write(index, subindex, data, self.al.state, abort)
