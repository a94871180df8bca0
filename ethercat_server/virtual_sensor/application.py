"""The application of one slave from power-on to power-off: AL states, watchdog, mailbox, objects.

Source: ETG.1000.6. It sits behind the EtherCAT controller; what the slave is good for is in its subclasses.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Any, Final

from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.virtual_sensor.device import Device, build_image
from ethercat_server.virtual_sensor.esc import Esc
from ethercat_server.virtual_sensor.mailbox import CoeServer, Mailbox, ObjectTable
from ethercat_server.virtual_sensor.options import EEPROM_MS, SlaveOptions

_ERROR: Final = 0x10  # error bit of AL status, acknowledge bit of AL control
_ORDER: Final = (AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP)
_SM_CONTROL_MASK: Final = 0x0F  # operation mode and direction
_WATCHDOG_UNIT_NS: Final = 40
_OUTPUTS: Final = 2  # their sync manager


class AlCode(IntEnum):
    """AL status codes of the sensor."""

    INVALID_STATE_CHANGE = 0x0011
    UNKNOWN_STATE = 0x0012
    BOOTSTRAP_NOT_SUPPORTED = 0x0013
    INVALID_MAILBOX_CONFIGURATION = 0x0016
    SYNC_MANAGER_WATCHDOG = 0x001B
    INVALID_OUTPUT_CONFIGURATION = 0x001D
    INVALID_INPUT_CONFIGURATION = 0x001E


# In the order of `Device.sync_managers`, the state that needs one, and the AL status code where it is wrong.
_NEEDED: Final = (
    *((AlState.PREOP, AlCode.INVALID_MAILBOX_CONFIGURATION),) * 2,
    (AlState.SAFEOP, AlCode.INVALID_OUTPUT_CONFIGURATION),
    (AlState.SAFEOP, AlCode.INVALID_INPUT_CONFIGURATION),
)


class Application:
    """What the EtherCAT controller calls: a slave that does nothing with its objects.

    `clock` gives the time in ns; reading its EEPROM takes `eeprom_ms`.
    """

    def __init__(
        self,
        device: Device,
        clock: Callable[[], int],
        objects: ObjectTable,
        eeprom_ms: float = EEPROM_MS,
    ) -> None:
        self.device = device
        self.clock = clock
        self.objects = objects
        self.esc = Esc(self, build_image(device), round(eeprom_ms * 1e6))
        self.state = AlState.INIT
        self.error = False  # the error bit of AL status
        self.code = 0  # the AL status code
        coe = CoeServer(objects, lambda: self.state)
        managers = self.esc.sync_managers
        self.mailbox = Mailbox(managers[0], managers[1], coe.answer, device.protocols)
        self._outputs = [(entry.address, entry.type.size) for entry in device.output_entries]
        self._fed = 0  # when the process data watchdog was last triggered; 0 = not running
        self.show_state()

    def inputs(self) -> bytes:
        return b"".join(self.objects.read(*entry.address) for entry in self.device.input_entries)

    def outputs(self, data: bytes) -> None:
        """The master wrote the outputs; they count in OP only."""
        self._fed = self.clock()
        self.esc.memory[reg.WATCHDOG_STATUS] = 1
        if self.state is AlState.OP:
            self.store_outputs(data)

    def store_outputs(self, data: bytes) -> None:
        at = 0
        for address, size in self._outputs:
            self.objects.values[address] = data[at : at + size]
            at += size

    def prepare(self, expected: int) -> None:
        """Compute what a frame at the time `expected` will read, while there is time."""

    def state_changed(self) -> None: ...

    def al_control(self, control: int) -> None:
        before, wanted = self.state, control & 0x0F
        if self.error and (control & _ERROR or wanted < before or wanted == AlState.INIT):
            self.error, self.code = False, 0
        if not self.error:  # until acknowledged only a lower state can be requested, and INIT in any case
            if wanted == AlState.BOOT:
                self._refuse(AlCode.BOOTSTRAP_NOT_SUPPORTED)
            elif wanted not in _ORDER:
                self._refuse(AlCode.UNKNOWN_STATE)
            elif _ORDER.index(AlState(wanted)) > _ORDER.index(before) + 1:
                self._refuse(AlCode.INVALID_STATE_CHANGE)
            elif wanted >= before and (fault := self._fault_in(AlState(wanted))):
                self._refuse(fault)
            else:
                self.state = AlState(wanted)
        if self.state is not before:
            self._fed = 0
        self.show_state()

    def fail(self, state: AlState, code: int) -> None:
        """Fall to `state`, or stay below it, with the error bit and AL status code `code`."""
        self.state = min(self.state, state)
        self._refuse(code)
        self.show_state()

    def _refuse(self, code: int) -> None:
        self.error, self.code = True, code

    def show_state(self) -> None:
        """Let the sync managers and AL status be those of the state."""
        state, managers = self.state, self.esc.sync_managers
        mailbox_on = state >= AlState.PREOP
        if mailbox_on == managers[0].locked:
            self.mailbox.reset()
        # Writes to the outputs count in SAFEOP too, as with most controllers. After an error they do not:
        # that is how a master that looks only at the working counter sees it.
        inputs_on = state >= AlState.SAFEOP
        wanted = (mailbox_on, mailbox_on, inputs_on and not self.error, inputs_on)
        for manager, on in zip(managers, wanted[-len(self.device.sync_managers) :], strict=False):
            if on == manager.locked:
                manager.allow(on)
        inputs = managers[len(self.device.sync_managers) - 1]
        self.esc.clock.events.latch(inputs.latches and inputs.active and not inputs.locked, self.clock())
        if self.esc.set_al_status(state | (_ERROR if self.error else 0), self.code):
            self.state_changed()

    def _fault_in(self, state: AlState) -> int:
        """The AL status code for sync managers that this state needs and that are wrong; 0 if none is."""
        rows = self.device.sync_managers
        for (needed_in, code), manager, row in zip(
            _NEEDED[-len(rows) :], self.esc.sync_managers, rows, strict=False
        ):
            right = (row.start, row.length, row.control & _SM_CONTROL_MASK)
            found = (manager.start, manager.length, manager.control & _SM_CONTROL_MASK)
            if state >= needed_in and row.length and (not manager.active or found != right):
                return code
        return 0

    def check_watchdog(self, now: int) -> None:
        """Fall to SAFEOP if no outputs came within the timeout. To be called when no frame is waiting."""
        if self.state is not AlState.OP or not self._fed or not self.esc.sync_managers[_OUTPUTS].watched:
            return
        memory = self.esc.memory
        (divider,) = struct.unpack_from("<H", memory, reg.WATCHDOG_DIVIDER)
        (ticks,) = struct.unpack_from("<H", memory, reg.WATCHDOG_TIME)
        if ticks and now - self._fed > ticks * (divider + 2) * _WATCHDOG_UNIT_NS:
            self.esc.count(reg.WATCHDOG_COUNTER)
            memory[reg.WATCHDOG_STATUS] = 0  # until outputs come again
            self._fed = 0
            self.fail(AlState.SAFEOP, AlCode.SYNC_MANAGER_WATCHDOG)

    def mailbox_exchanged(self) -> None:
        self.mailbox.work()

    def repeat_requested(self) -> None:
        self.mailbox.repeat()


class VirtualSlave:
    """A slave, powered or not. `clock` gives the time in ns.

    Attributes:
        life: what runs in it from power-on to power-off.
    """

    options: SlaveOptions
    life: Application | None = None

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock

    def power(self, on: bool) -> None:
        """Switch it off or on; no effect if it already is."""
        if not on:
            self.life = None
        elif self.life is None:
            self.life = self._switched_on()

    def _switched_on(self) -> Application:
        raise NotImplementedError

    def statistics(self) -> dict[str, Any]:
        life = self.life
        return {
            "powered": life is not None,
            "al_state": life.state.name if life else None,
            "al_error": life is not None and life.error,
            "al_status_code": life.code if life else 0,
        }
