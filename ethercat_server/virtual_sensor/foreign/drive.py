"""The state machine of a servo drive, and a motor that follows its target velocity at once.

Source: the CiA 402 drive profile (IEC 61800-7-201).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from ethercat_server.virtual_sensor.slave.objects import Address

ERROR_CODE: Final = (0x603F, 0)
CONTROLWORD: Final = (0x6040, 0)
STATUSWORD: Final = (0x6041, 0)
POSITION: Final = (0x6064, 0)
"""Increments."""
TARGET_VELOCITY: Final = (0x60FF, 0)
"""Increments per second."""
ENABLE: Final = 0x000F
"""Controlword in normal operation."""

_SWITCH_ON, _VOLTAGE, _NO_QUICK_STOP, _ENABLE_OPERATION, _FAULT_RESET = 0x01, 0x02, 0x04, 0x08, 0x80
_VOLTAGE_ENABLED, _REMOTE = 0x0010, 0x0200
_COMMUNICATION_LOST: Final = 0x8130


class DriveState(IntEnum):
    """States, as bits of the statusword."""

    SWITCH_ON_DISABLED = 0x0040
    READY_TO_SWITCH_ON = 0x0021
    SWITCHED_ON = 0x0023
    OPERATION_ENABLED = 0x0027
    QUICK_STOP_ACTIVE = 0x0007
    FAULT = 0x0008


class Drive:
    """State and position of one drive. Times are in ns."""

    def __init__(self, now: int) -> None:
        self.state = DriveState.SWITCH_ON_DISABLED
        self.error = 0
        self._controlword = 0
        self._velocity = 0
        self._position = 0.0
        self._since = now

    @property
    def turning(self) -> bool:
        """Whether the motor moves."""
        return self.state is DriveState.OPERATION_ENABLED and self._velocity != 0

    def command(self, controlword: int, velocity: int, now: int) -> None:
        """The master set controlword and target velocity."""
        self._move(now)
        reset = controlword & ~self._controlword & _FAULT_RESET
        self._controlword, self._velocity = controlword, velocity
        if self.state is not DriveState.FAULT:
            self.state = self._next(controlword)
        elif reset:
            self.state, self.error = DriveState.SWITCH_ON_DISABLED, 0

    def disconnect(self, lost: bool, now: int) -> None:
        """Process data has ended, `lost` if the master did not say so: the motor stops."""
        self._move(now)
        energized = self.state in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
        if lost and energized:
            self.state, self.error = DriveState.FAULT, _COMMUNICATION_LOST
        elif self.state is not DriveState.FAULT:
            self.state = DriveState.SWITCH_ON_DISABLED

    def values(self, now: int) -> dict[Address, int]:
        """The objects that the drive itself changes."""
        self._move(now)
        powered = self.state not in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
        position = (round(self._position) + 2**31) % 2**32 - 2**31
        return {
            ERROR_CODE: self.error,
            STATUSWORD: self.state | _REMOTE | (_VOLTAGE_ENABLED if powered else 0),
            POSITION: position,
        }

    def _move(self, now: int) -> None:
        if self.state is DriveState.OPERATION_ENABLED:
            self._position += self._velocity * (now - self._since) * 1e-9
        self._since = now

    def _next(self, word: int) -> DriveState:
        state = self.state
        if not word & _VOLTAGE:
            return DriveState.SWITCH_ON_DISABLED
        if state in (DriveState.SWITCH_ON_DISABLED, DriveState.QUICK_STOP_ACTIVE):
            ready = state is DriveState.SWITCH_ON_DISABLED and word & _NO_QUICK_STOP and not word & _SWITCH_ON
            return DriveState.READY_TO_SWITCH_ON if ready else state
        if not word & _NO_QUICK_STOP:
            stops = state is DriveState.OPERATION_ENABLED
            return DriveState.QUICK_STOP_ACTIVE if stops else DriveState.SWITCH_ON_DISABLED
        if not word & _SWITCH_ON:
            return DriveState.READY_TO_SWITCH_ON
        if word & _ENABLE_OPERATION and state is not DriveState.READY_TO_SWITCH_ON:
            return DriveState.OPERATION_ENABLED
        return DriveState.SWITCHED_ON
