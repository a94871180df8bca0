"""The application of one slave from power-on to power-off: AL states, process data watchdog, mailbox.

It sits behind the EtherCAT controller; what the slave is good for is in its subclasses.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Final

from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.esc.controller import Esc
from ethercat_server.virtual_sensor.slave.al import AlCode, AlState, AlStateMachine
from ethercat_server.virtual_sensor.slave.coe import CoeServer, Information
from ethercat_server.virtual_sensor.slave.device import Device
from ethercat_server.virtual_sensor.slave.image import build_image
from ethercat_server.virtual_sensor.slave.mailbox import Mailbox

_SM_CONTROL_MASK: Final = 0x0F  # operation mode and direction
_WATCHDOG_UNIT_NS: Final = 40
_OUTPUTS, _INPUTS = 2, 3
"""Sync managers of the process data."""


class Application(ABC):
    """What the EtherCAT controller calls (`esc.Pdi`) and what SDOs access (`coe.Objects`).

    `clock` gives the time in ns; reading its EEPROM takes `eeprom_ms`; `controller` makes the
    EtherCAT controller.
    """

    def __init__(
        self,
        device: Device,
        clock: Callable[[], int],
        information: Information,
        eeprom_ms: float,
        controller: Callable[[Application, bytes, int], Esc] = Esc,
    ) -> None:
        self.device = device
        self.clock = clock
        self.esc = controller(self, build_image(device), round(eeprom_ms * 1e6))
        self.al = AlStateMachine(self._mailbox_fault, self._process_data_fault)
        self.coe = CoeServer(self, information)
        managers = self.esc.sync_managers
        self.mailbox = Mailbox(managers[0], managers[1], self.coe.answer, device.protocols)
        self._fed = 0  # when the process data watchdog was last triggered; 0 = not running
        self._show_state()

    # Process data.

    @abstractmethod
    def inputs(self) -> bytes:
        """The newest process data."""

    @abstractmethod
    def take_outputs(self, data: bytes) -> None:
        """The master wrote the outputs, in OP."""

    @abstractmethod
    def state_changed(self) -> None:
        """The AL state has changed."""

    @abstractmethod
    def prepare(self, expected: int) -> None:
        """Compute what a frame at the time `expected` will read, while there is time."""

    def outputs(self, data: bytes) -> None:
        """The master wrote the outputs; they count in OP only."""
        self._fed = self.clock()
        self.esc.memory[reg.WATCHDOG_STATUS] = 1
        if self.al.state is AlState.OP:
            self.take_outputs(data)
            if self.esc.sync_managers[_OUTPUTS].latches_pdi:
                self.esc.clock.events.outputs_taken(self.clock())

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
        self.esc.clock.events.sync_managers_changed(managers, self.clock())
        shown, _, code = struct.unpack_from("<HHH", self.esc.memory, reg.AL_STATUS)
        if (shown, code) != (self.al.status, self.al.code):
            self.esc.set_al_status(self.al.status, self.al.code)
            self.state_changed()

    def _manager_wrong(self, number: int) -> bool:
        rows = self.device.sync_managers
        if number >= len(rows) or not rows[number].length:
            return False
        manager, row = self.esc.sync_managers[number], rows[number]
        right = (row.start, row.length, row.control & _SM_CONTROL_MASK)
        found = (manager.start, manager.length, manager.control & _SM_CONTROL_MASK)
        return not manager.active or found != right

    def _mailbox_fault(self) -> int:
        wrong = self._manager_wrong(0) or self._manager_wrong(1)
        return AlCode.INVALID_MAILBOX_CONFIGURATION if wrong else 0

    def _process_data_fault(self) -> int:
        if self._manager_wrong(_OUTPUTS):
            return AlCode.INVALID_OUTPUT_CONFIGURATION
        return AlCode.INVALID_INPUT_CONFIGURATION if self._manager_wrong(_INPUTS) else 0

    def check_watchdog(self, now: int) -> None:
        """Fall to SAFEOP if no outputs came within the timeout. To be called when no frame is waiting."""
        if self.al.state is not AlState.OP or not self._fed or not self.esc.sync_managers[_OUTPUTS].watched:
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

    @abstractmethod
    def read(self, index: int, subindex: int) -> bytes:
        """An SDO upload."""

    @abstractmethod
    def length(self, index: int, subindex: int) -> int:
        """Bytes of an entry."""

    @abstractmethod
    def check_download(self, index: int, subindex: int, length: int) -> None:
        """Refuse a download of the wrong length before its data has come."""

    @abstractmethod
    def write(self, index: int, subindex: int, data: bytes) -> None:
        """An SDO download."""
