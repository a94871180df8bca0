"""The steps that bring one sensor back to OP: SOEM's recovery ladder, one or two datagrams a step.

By what the sensor's AL status says: SAFEOP with error is acknowledged; SAFEOP goes to OP; any other state
means that the sensor started anew, so it is set up from INIT: mailboxes, identity, settings, process data,
OP. A sensor that does not answer may have lost its station address with its power: it gets it again.
"""

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.mailbox.mailbox import Mailbox
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState, AlStatus
from ethercat_server.ethercat.slave.coe import MailboxSdo, Steps
from ethercat_server.ethercat.slave.sii import OF_FIRMWARE, ByPosition, read_sii
from ethercat_server.ethercat.slave.states import StateMachine
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.objects.dictionary import is_sensor
from ethercat_server.sensor.sensor import Identity, Sensor
from ethercat_server.sensor.set_up import identify, put_right, set_up

_ABSENT_PAUSE_S: Final = 0.005
_REFUSED_PAUSE_S: Final = 0.1
_STRANGER_PAUSE_S: Final = 0.25
"""Reading the SII of a device in the sensor's place writes to its controller."""
_REMOVED_READS: Final = 3
"""Unanswered reads in a row that mean removal; one is a lost datagram."""
_MAILBOXES_END: Final = 2 * reg.SYNC_MANAGER_SIZE
_SII_IDENTITY: Final = 0x08
"""First of four words: vendor ID, product code."""


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
        self.states = StateMachine(bus, sensor.number)
        count = min(bus.read_surely(sensor.number, reg.FMMU_AND_SM_COUNT, 2)[1], reg.MOST_SYNC_MANAGERS)
        self._sync_managers = rows = bus.read_surely(
            sensor.number, reg.SYNC_MANAGER, count * reg.SYNC_MANAGER_SIZE
        )
        out, back = struct.unpack_from("<HH", rows), struct.unpack_from("<HH", rows, reg.SYNC_MANAGER_SIZE)
        self.mailbox = Mailbox(bus, sensor.number, (out, back))
        self.sdo = GuardedSdo(MailboxSdo(self.mailbox))
        """SDO transfers in steps."""
        self._left_op = False
        """Whether the sensor was out of OP since the last time it was back: also if the steps began anew."""

    def bring_back(self, pause_s: float = 0.0) -> Steps[bool]:
        """Returns once the sensor is in OP: True if it had left it, False if it had only been out of reach.

        Raises GoneError, DifferentSensorError, or BusError if the sensor refuses something.
        """
        yield from self._pause(pause_s)
        while True:
            status = self.states.status()
            if status is None:
                if not (yield from self._restore_station()):
                    yield from self._pause(_ABSENT_PAUSE_S)
            elif status.is_op:
                if not self._left_op:
                    self.latch_events()
                if self._sensor.unsettled:
                    yield from put_right(self.sdo, self._sensor)
                left_op, self._left_op = self._left_op, False
                return left_op
            elif status.state is AlState.SAFEOP:
                self._left_op = True
                self.latch_events()
                yield from self.states.go(AlState.OP)
            else:
                self._left_op = True
                yield from self._set_up_anew()
            yield

    def wait_for_removal(self) -> Steps[bool]:
        """Leave a refused sensor in INIT until it is taken away, then bring back the one that comes."""
        unanswered = 0
        while unanswered < _REMOVED_READS:
            unanswered = 0 if self.states.status() is not None else unanswered + 1
            yield from self._pause(_REFUSED_PAUSE_S)
        return (yield from self.bring_back())

    def reconfigure(self) -> Steps[bool]:
        """Take the sensor to PREOP, write what is wanted, and back to OP; raises as `bring_back`."""
        self._left_op = True
        yield from self.states.go(AlState.PREOP)
        yield from set_up(self.sdo, self._sensor)
        yield from self._go_op()
        self._left_op = False
        return True

    def _restore_station(self) -> Steps[bool]:
        """Give a sensor that lost its station address with its power the address again; whether it has it.

        One that has another slave's address, is not in INIT, or is no Bota sensor, is left alone; which
        sensor it is remains to be asked.
        """
        bus, number, position = self._bus, self._sensor.number, self._sensor.position
        data = bus.read_at(position, reg.STATION_ADDRESS, 2)
        if data is None:
            return False
        if int.from_bytes(data, "little") in bus.stations:
            return bool(int.from_bytes(data, "little") == bus.stations[number])
        yield
        status = bus.read_at(position, reg.AL_STATUS, reg.AL_STATUS_SIZE)
        owner = bus.read_at(position, reg.SII_OWNER, 1)
        if status is None or owner is None or AlStatus.parse(status).state is not AlState.INIT:
            return False
        yield
        try:
            words = yield from read_sii(ByPosition(bus), position, _SII_IDENTITY, 4, owner)
        except BusError:
            return False
        if not is_sensor(*struct.unpack("<II", words)):
            yield from self._pause(_STRANGER_PAUSE_S)
            return False
        return bus.write_at(position, reg.STATION_ADDRESS, bus.stations[number].to_bytes(2, "little"))

    def _set_up_anew(self) -> Steps[None]:
        sensor, rows = self._sensor, self._sync_managers
        yield from self.states.go(AlState.INIT)
        self.states.write(reg.SII_OWNER, OF_FIRMWARE)  # the sensor reads its SII on the way to PREOP
        self.states.write(reg.SYNC_MANAGER, rows[:_MAILBOXES_END])
        yield from self.states.go(AlState.PREOP)
        found = yield from identify(self.sdo, sensor.identity.name)
        if (found.name, found.serial) != (sensor.identity.name, sensor.identity.serial):
            yield from self.states.go(AlState.INIT)
            raise DifferentSensorError(found)
        yield from set_up(self.sdo, sensor)
        yield from self._go_op()

    def _go_op(self) -> Steps[None]:
        """From PREOP: the process data's sync managers and FMMUs as they were, then SAFEOP and OP."""
        self.states.write(reg.SYNC_MANAGER + _MAILBOXES_END, self._sync_managers[_MAILBOXES_END:])
        self.states.write(reg.FMMU, self._bus.fmmus[self._sensor.number])
        yield from self.states.go(AlState.SAFEOP)
        yield from self.states.go(AlState.OP)

    def latch_events(self) -> None:
        """Have the controller latch again when samples come to be: another master may have ended that."""
        for at in range(reg.SM_ACTIVATE, len(self._sync_managers), reg.SYNC_MANAGER_SIZE):
            if self._sync_managers[at] & reg.SM_LATCH_PDI:
                self.states.write(reg.SYNC_MANAGER + at, self._sync_managers[at : at + 1])

    def _pause(self, seconds: float) -> Steps[None]:
        """Steps that take at least `seconds`."""
        deadline = Deadline(self._bus.clock, seconds)
        while not deadline.passed:
            yield
