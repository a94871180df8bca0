"""The firmware of one sensor from power-on to power-off.

It sits behind the EtherCAT controller and connects AL states, mailbox, objects and measurement.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final

from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.esc.controller import Esc
from ethercat_server.virtual_sensor.esc.sii import build_image
from ethercat_server.virtual_sensor.faults.aborts import AbortFaults
from ethercat_server.virtual_sensor.firmware.al import AlCode, AlState, AlStateMachine
from ethercat_server.virtual_sensor.firmware.coe import CoeServer
from ethercat_server.virtual_sensor.firmware.dictionary import Dictionary, SdoAbortError
from ethercat_server.virtual_sensor.firmware.flash import Flash
from ethercat_server.virtual_sensor.firmware.layout import SYNC_MANAGERS, sync_manager_lengths
from ethercat_server.virtual_sensor.firmware.mailbox import Mailbox
from ethercat_server.virtual_sensor.firmware.sdo_information import SdoInformation
from ethercat_server.virtual_sensor.measurement.sampler import Sampler
from ethercat_server.virtual_sensor.options import SensorOptions

_SM_CONTROL_MASK: Final = 0x0F  # operation mode and direction
_WATCHDOG_UNIT_NS: Final = 40

OnWrite = Callable[[int, int, bytes, AlState, int], None]


class Firmware:
    """What the EtherCAT controller calls (`esc.Pdi`) and what SDOs access (`coe.Objects`).

    `clock` gives the time in ns; `on_write` is called for every SDO write: index, sub-index, data, AL state,
    abort code or 0.
    """

    def __init__(
        self, options: SensorOptions, flash: Flash, clock: Callable[[], int], on_write: OnWrite
    ) -> None:
        self.clock = clock
        self._on_write = on_write
        self._options = options
        self.dictionary = Dictionary(
            options.model, options.serial, options.pdo_size,
            flash, self.inputs, self._settings_changed, clock,
        )  # fmt: skip
        self.dictionary.let_chop_divide(options.chop_divides)
        self.sampler = Sampler(options, self.dictionary, clock)
        self.esc = Esc(self, build_image(options.model, options.serial, options.pdo_size))
        self.al = AlStateMachine(self._mailbox_fault, self._process_data_fault)
        self._coe = CoeServer(self, SdoInformation(self.dictionary))
        managers = self.esc.sync_managers
        self.mailbox = Mailbox(managers[0], managers[1], self._coe.answer)
        self.aborts = AbortFaults()
        self._fed = 0  # when the process data watchdog was last triggered; 0 = not running
        self._show_state()

    # Process data.

    def inputs(self) -> bytes:
        """The newest process data."""
        return self.sampler.newest()

    def _settings_changed(self) -> None:
        self.sampler.settings_changed()

    def outputs(self, data: bytes) -> None:
        """The master wrote the outputs; they count in OP only."""
        self._fed = self.clock()
        self.esc.memory[reg.WATCHDOG_STATUS] = 1
        if self.al.state is AlState.OP:
            self.dictionary.set_output(data)

    # Application layer.

    def al_control(self, value: int) -> None:
        """The master asks for a state."""
        before = self.al.state
        self.al.request(value)
        if self.al.state is not before:
            self._fed = 0
        self._show_state()

    def sync_managers_changed(self) -> None:
        """The master wrote sync manager registers: they may no longer fit the state."""
        self.al.check()
        self._show_state()

    def fail(self, state: AlState, code: int) -> None:
        """Fall to `state` with the error bit and `code`."""
        self.al.drop(state, code)
        self._show_state()

    def _show_state(self) -> None:
        state, managers = self.al.state, self.esc.sync_managers
        mailbox_on = state >= AlState.PREOP
        if mailbox_on == managers[0].locked:
            self.mailbox.reset()
        # Writes to the outputs count in SAFEOP too, as with most controllers. After an error they do not:
        # that is how a master that looks only at the working counter sees it.
        inputs_on = state >= AlState.SAFEOP
        wanted = (mailbox_on, mailbox_on, inputs_on and not self.al.error, inputs_on)
        for manager, on in zip(managers, wanted, strict=True):
            if on == manager.locked:
                manager.allow(on)
        shown = struct.unpack_from("<H", self.esc.memory, reg.AL_STATUS)[0]
        code = struct.unpack_from("<H", self.esc.memory, reg.AL_STATUS_CODE)[0]
        if (shown, code) != (self.al.status, self.al.code):
            self.esc.set_al_status(self.al.status, self.al.code)

    def _manager_wrong(self, number: int) -> bool:
        manager, row = self.esc.sync_managers[number], SYNC_MANAGERS[number]
        length = sync_manager_lengths(self._options.pdo_size)[number]
        right = (row.start, length, row.control & _SM_CONTROL_MASK)
        found = (manager.start, manager.length, manager.control & _SM_CONTROL_MASK)
        return not manager.active or found != right

    def _mailbox_fault(self) -> int:
        wrong = self._manager_wrong(0) or self._manager_wrong(1)
        return AlCode.INVALID_MAILBOX_CONFIGURATION if wrong else 0

    def _process_data_fault(self) -> int:
        if self._manager_wrong(2):
            return AlCode.INVALID_OUTPUT_CONFIGURATION
        return AlCode.INVALID_INPUT_CONFIGURATION if self._manager_wrong(3) else 0

    def check_watchdog(self, now: int) -> None:
        """Fall to SAFEOP if no outputs came within the timeout. To be called when no frame is waiting."""
        if self.al.state is not AlState.OP or not self._fed or not self.esc.sync_managers[2].watched:
            return
        memory = self.esc.memory
        (divider,) = struct.unpack_from("<H", memory, reg.WATCHDOG_DIVIDER)
        (ticks,) = struct.unpack_from("<H", memory, reg.WATCHDOG_TIME)
        if ticks and now - self._fed > ticks * (divider + 2) * _WATCHDOG_UNIT_NS:
            counter = memory[reg.WATCHDOG_COUNTER]
            memory[reg.WATCHDOG_COUNTER] = min(counter + 1, 0xFF)
            memory[reg.WATCHDOG_STATUS] = 0  # until outputs come again
            self._fed = 0
            self.fail(AlState.SAFEOP, AlCode.SYNC_MANAGER_WATCHDOG)

    # Mailbox and SDO.

    def mailbox_written(self) -> None:
        """A request has arrived."""
        self.mailbox.work()

    def mailbox_read(self) -> None:
        """The last reply has been taken."""
        self.mailbox.work()

    def repeat_requested(self) -> None:
        """The last reply was lost on the way."""
        self.mailbox.repeat()

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
