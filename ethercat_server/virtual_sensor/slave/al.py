"""The application layer state machine: INIT, PREOP, SAFEOP, OP, their transitions and error codes.

Source: ETG.1000.6. Without registers, which the firmware reads and writes.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final

ERROR: Final = 0x10
"""Error bit of AL status, acknowledge bit of AL control."""


class AlState(IntEnum):
    """AL states, as numbered in AL control and AL status."""

    INIT = 1
    PREOP = 2
    BOOT = 3
    SAFEOP = 4
    OP = 8


class AlCode(IntEnum):
    """AL status codes of the sensor."""

    NO_ERROR = 0x0000
    INVALID_STATE_CHANGE = 0x0011
    UNKNOWN_STATE = 0x0012
    BOOTSTRAP_NOT_SUPPORTED = 0x0013
    INVALID_MAILBOX_CONFIGURATION = 0x0016
    SYNC_MANAGER_WATCHDOG = 0x001B
    INVALID_OUTPUT_CONFIGURATION = 0x001D
    INVALID_INPUT_CONFIGURATION = 0x001E


_ORDER = (AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP)


class AlStateMachine:
    """The state of one slave.

    `mailbox_fault` and `process_data_fault` check the sync managers and return an AL status code, or 0.
    """

    def __init__(self, mailbox_fault: Callable[[], int], process_data_fault: Callable[[], int]) -> None:
        self._mailbox_fault = mailbox_fault
        self._process_data_fault = process_data_fault
        self.state = AlState.INIT
        self.error = False
        self.code = 0

    @property
    def status(self) -> int:
        """The AL status register: the state, and the error bit."""
        return self.state | (ERROR if self.error else 0)

    def request(self, control: int) -> None:
        """The master wrote `control` to AL control."""
        wanted = control & 0x0F
        if self.error:
            if control & ERROR:
                self._clear()
            elif wanted >= self.state and wanted != AlState.INIT:
                return  # until acknowledged only a lower state can be requested, and INIT in any case
            else:
                self._clear()
        try:
            target = AlState(wanted)
        except ValueError:
            self._fail(AlCode.UNKNOWN_STATE)
            return
        if target is AlState.BOOT:
            self._fail(AlCode.BOOTSTRAP_NOT_SUPPORTED)
        elif _ORDER.index(target) > _ORDER.index(self.state) + 1:
            self._fail(AlCode.INVALID_STATE_CHANGE)
        elif target < self.state:
            self.state = target
        elif fault := self._fault_in(target):
            self._fail(fault)
        else:
            self.state = target

    def check(self) -> None:
        """The sync managers changed: fall to the state that they still allow."""
        if self.state >= AlState.PREOP and (fault := self._mailbox_fault()):
            self.drop(AlState.INIT, fault)
        elif self.state >= AlState.SAFEOP and (fault := self._process_data_fault()):
            self.drop(AlState.PREOP, fault)

    def drop(self, state: AlState, code: int) -> None:
        """Fall to `state`, or stay below it, with the error bit and AL status code `code`."""
        self.state = min(self.state, state)
        self._fail(code)

    def _fault_in(self, state: AlState) -> int:
        fault = self._mailbox_fault() if state >= AlState.PREOP else 0
        return fault or (self._process_data_fault() if state >= AlState.SAFEOP else 0)

    def _fail(self, code: int) -> None:
        self.error, self.code = True, code

    def _clear(self) -> None:
        self.error, self.code = False, 0
