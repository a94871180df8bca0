"""The steps that bring one lost sensor back to OP: SOEM's recovery ladder, one or two datagrams a step.

By what the sensor's AL status says: SAFEOP with error is acknowledged; SAFEOP goes to OP; any other state
means that the sensor started anew, so it is set up from INIT: mailboxes, identity, settings, process data,
OP. A sensor that does not answer may have lost its station address with its power: it is given back.
"""

from __future__ import annotations

import time
from typing import Final

from ethercat_server.al import AL_CONTROL, AL_STATUS, AL_STATUS_SIZE, AlState, AlStatus
from ethercat_server.bus import Bus
from ethercat_server.errors import BusError
from ethercat_server.sdo import CyclicSdo, Steps
from ethercat_server.sensor import Identity, Sensor, identify, put_right, set_up
from ethercat_server.sii import OF_FIRMWARE, SII_OWNER

_STATE_TIMEOUT_S: Final = 2.0
_ABSENT_PAUSE_S: Final = 0.005
_REFUSED_PAUSE_S: Final = 0.1
_REMOVED_READS: Final = 3
"""So many unanswered reads in a row are a removal; one is a lost datagram."""
_REMEMBER_TIMEOUT_S: Final = 1.0

_COUNTS: Final = 0x0004
"""Two bytes: how many FMMUs and how many sync managers the slave has."""
_FMMU: Final = 0x0600
_FMMU_SIZE: Final = 16
_SM: Final = 0x0800
_SM_SIZE: Final = 8
_MAILBOXES_END: Final = 2 * _SM_SIZE


class GoneError(Exception):
    """The sensor stopped answering in the middle: begin again."""


class DifferentSensorError(Exception):
    """Another sensor is in the place of the one that was lost."""

    def __init__(self, found: Identity) -> None:
        super().__init__(str(found))
        self.found = found


class Ladder:
    """Brings one sensor back. To be made while it is in OP: it remembers the registers that OP needs."""

    def __init__(self, bus: Bus, sensor: Sensor) -> None:
        self._bus = bus
        self._sensor = sensor
        self._place = sensor.place
        fmmus, sync_managers = self._remember(_COUNTS, 2)
        self._fmmus = self._remember(_FMMU, fmmus * _FMMU_SIZE)
        self._sync_managers = rows = self._remember(_SM, sync_managers * _SM_SIZE)
        out, back = (
            (int.from_bytes(row[0:2], "little"), int.from_bytes(row[2:4], "little"))
            for row in (rows[:_SM_SIZE], rows[_SM_SIZE:])
        )
        self.sdo = CyclicSdo(bus, sensor.place, (out, back))
        """SDO transfers in steps. One for all: the sensor takes two messages with one number for one."""

    def climb(self, pause_s: float = 0.0) -> Steps[bool]:
        """Returns once the sensor is in OP: True if it had left it, False if it had only been out of reach.

        Raises GoneError, DifferentSensorError, or BusError if the sensor refuses something.
        """
        yield from pause(pause_s)
        left_op = False
        while True:
            status = self.al_status()
            if status is None:
                if not self._bus.reclaim(self._place):
                    yield from pause(_ABSENT_PAUSE_S)
            elif status.is_op:
                if self._sensor.unsettled:
                    yield from put_right(self.sdo, self._sensor)
                return left_op
            elif status.state is AlState.SAFEOP:
                left_op = True
                yield from self._go(AlState.OP)
            else:
                left_op = True
                yield from self._set_up_anew()
            yield

    def wait_for_removal(self) -> Steps[bool]:
        """Leave a refused sensor in INIT until it is taken away, then climb."""
        unanswered = 0
        while unanswered < _REMOVED_READS:
            unanswered = 0 if self.al_status() is not None else unanswered + 1
            yield from pause(_REFUSED_PAUSE_S)
        return (yield from self.climb())

    def reconfigure(self) -> Steps[bool]:
        """Take the sensor to PREOP, write what is wanted, and back to OP; raises as `climb`."""
        yield from self._go(AlState.PREOP)
        yield from set_up(self.sdo, self._sensor)
        yield from self._go_op()
        return True

    def al_status(self) -> AlStatus | None:
        """The sensor's AL status; None if it does not answer."""
        data = self._bus.read_register(self._place, AL_STATUS, AL_STATUS_SIZE)
        return AlStatus.parse(data) if data is not None else None

    def _set_up_anew(self) -> Steps[None]:
        sensor, rows = self._sensor, self._sync_managers
        yield from self._go(AlState.INIT)
        self._write(SII_OWNER, OF_FIRMWARE)  # the sensor reads its SII on the way to PREOP
        self._write(_SM, rows[:_MAILBOXES_END])
        yield from self._go(AlState.PREOP)
        found = yield from identify(self.sdo, sensor.identity.name)
        if (found.name, found.serial) != (sensor.identity.name, sensor.identity.serial):
            yield from self._go(AlState.INIT)
            raise DifferentSensorError(found)
        yield from set_up(self.sdo, sensor)
        yield from self._go_op()

    def _go_op(self) -> Steps[None]:
        """From PREOP: the process data's sync managers and FMMUs as they were, then SAFEOP and OP."""
        self._write(_SM + _MAILBOXES_END, self._sync_managers[_MAILBOXES_END:])
        self._write(_FMMU, self._fmmus)
        yield from self._go(AlState.SAFEOP)
        yield from self._go(AlState.OP)

    def _go(self, state: AlState) -> Steps[None]:
        """Request an AL state and wait for it; an error is acknowledged first."""
        status = self.al_status()
        if status is not None and status.error:
            yield from self._acknowledge(status)
        self._write(AL_CONTROL, state.request())
        deadline = time.monotonic() + _STATE_TIMEOUT_S
        while True:
            yield
            status = self.al_status()
            if status is None:
                raise GoneError
            if status.state is state and not status.error:
                return
            if status.error or time.monotonic() > deadline:
                raise BusError(f"sensor {self._place} does not go to {state.name}: it is in {status}")

    def _acknowledge(self, status: AlStatus) -> Steps[None]:
        """Acknowledge an error and wait until it is gone: a request before would overwrite the acknowledge.

        The sensor looks at AL control when it comes to it, and sees only what was written last.
        """
        self._write(AL_CONTROL, status.acknowledge())
        deadline = time.monotonic() + _STATE_TIMEOUT_S
        while True:
            yield
            now = self.al_status()
            if now is None:
                raise GoneError
            if not now.error:
                return
            if time.monotonic() > deadline:
                raise BusError(
                    f"sensor {self._place} keeps its error when that is acknowledged: it is in {now}"
                )

    def _remember(self, address: int, size: int) -> bytes:
        deadline = time.monotonic() + _REMEMBER_TIMEOUT_S
        while time.monotonic() < deadline:
            data = self._bus.read_register(self._place, address, size)
            if data is not None:
                return data
            time.sleep(0.005)
        raise BusError(f"sensor {self._place} does not answer in OP: check cable and power")

    def _write(self, address: int, data: bytes) -> None:
        if not self._bus.write_register(self._place, address, data):
            raise GoneError


def pause(seconds: float) -> Steps[None]:
    """Steps that take at least `seconds`."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        yield
