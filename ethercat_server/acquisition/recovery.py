"""Notices that a sensor no longer takes part, tells the clients, and brings it back step by step.

One step is taken after each exchange, so that neither the other sensors nor the clients wait.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from bota_ethercat.control import Event, event
from bota_ethercat.settings import SettingValue
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.health import Causes, Mailboxes
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.errors import BusError, extended
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import ByPosition
from ethercat_server.ethercat.nic import CHECK_CABLE
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import STATE_S, AlState, AlStatus
from ethercat_server.ethercat.slave.coe import Steps
from ethercat_server.ethercat.slave.controller import GoneError
from ethercat_server.ethercat.slave.sii import read_sii
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.objects.dictionary import is_sensor
from ethercat_server.sensor.scan import OtherSlaves
from ethercat_server.sensor.sensor import Identity, Sensor, SensorState
from ethercat_server.sensor.set_up import IN_FORCE, LATER, Change, identify, set_up, set_up_in_op

_SHORT_EXCHANGES: Final = 2  # short working counters, almost in a row, before the sensors' states are read
# Time without a frame coming back after which all sensors are lost; a single lost frame never suffices.
_SILENCE_NS: Final = 50_000_000
# The same for a change of settings, which goes on when frames come back.
_SILENT_CHANGE_NS: Final = 1_000_000_000
# A sensor can leave OP and still be counted, so its AL status is read this often; and its mailbox.
_WATCH_EVERY_NS: Final = 100_000_000
_FAILED_PAUSE_S: Final = 0.25
_REVERT_S: Final = STATE_S[AlState.OP]  # for a sensor whose change failed to be back in OP
_ABSENT_PAUSE_S: Final = 0.005
_REFUSED_PAUSE_S: Final = 0.1
_STRANGER_PAUSE_S: Final = 0.25  # reading the SII of a device in the sensor's place writes to its controller
_REMOVED_READS: Final = 3  # unanswered in a row mean removal; one is a lost datagram
_SII_IDENTITY: Final = 0x08  # first of four words: vendor ID, product code

log = logging.getLogger(__name__)


class DifferentSensorError(Exception):
    """Another sensor is in the place of the one that was lost."""

    def __init__(self, found: Identity) -> None:
        super().__init__(str(found))
        self.found = found


class SensorReturn:
    """Brings one sensor back to OP, one or two datagrams a step; to be made while it is in OP.

    It goes by the sensor's AL status: SAFEOP with error is acknowledged; SAFEOP goes to OP; any other state
    means that the sensor started anew, so it is set up from INIT. One that does not answer may have lost its
    station address with its power: it gets it again.
    """

    def __init__(self, bus: Bus, sensor: Sensor) -> None:
        self._bus, self._sensor = bus, sensor
        self.slave = bus.slaves[sensor.number]
        self.sdo = GuardedSdo(self.slave.sdo)
        self._left_op = False  # since it was back last: also if the steps began anew

    def bring_back(self, pause_s: float = 0.0) -> Steps[bool]:
        """Returns once the sensor is in OP: True if it had left it, False if it had only been out of reach.

        Raises GoneError, DifferentSensorError, or BusError if the sensor refuses something.
        """
        yield from self._pause(pause_s)
        while True:
            status = self.slave.status()
            if status is None:
                if not (yield from self._restore_station()):
                    yield from self._pause(_ABSENT_PAUSE_S)
            elif status.is_op:
                if not self._left_op:
                    self.slave.latch_events()
                if self._sensor.change_interrupted:
                    yield from set_up_in_op(self.sdo, self._sensor)
                left_op, self._left_op = self._left_op, False
                return left_op
            elif status.state is AlState.SAFEOP:
                self._left_op = True
                self.slave.latch_events()
                yield from self.slave.go(AlState.OP)
            else:
                self._left_op = True
                yield from self._set_up_anew()
            yield

    def wait_for_removal(self) -> Steps[bool]:
        """Leave a refused sensor in INIT until it is taken away, then bring back the one that comes."""
        unanswered = 0
        while unanswered < _REMOVED_READS:
            unanswered = 0 if self.slave.status() is not None else unanswered + 1
            yield from self._pause(_REFUSED_PAUSE_S)
        return (yield from self.bring_back())

    def reconfigure(self) -> Steps[bool]:
        """Take the sensor to PREOP, write what is wanted, and back to OP; raises as `bring_back`."""
        self._left_op = True
        yield from self.slave.go(AlState.PREOP)
        yield from self._set_up()
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
        if (station := int.from_bytes(data, "little")) in bus.stations:
            return station == bus.stations[number]
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
        identity = self._sensor.identity
        yield from self.slave.enter_preop()
        found = yield from identify(self.sdo, identity.name)
        if (found.name, found.serial) != (identity.name, identity.serial):
            yield from self.slave.go(AlState.INIT)
            raise DifferentSensorError(found)
        yield from self._set_up()

    def _set_up(self) -> Steps[None]:
        """From PREOP to OP."""
        yield from set_up(self.sdo, self._sensor)
        self.slave.map()
        yield from self.slave.enter_op()

    def _pause(self, seconds: float) -> Steps[None]:
        """Steps that take at least `seconds`."""
        deadline = Deadline(self._bus.clock, seconds)
        while not deadline.passed:
            yield


class _Reconfiguration(NamedTuple):
    """A change of settings under way: what to go back to, whom to tell, why it failed if it did."""

    wanted: dict[str, SettingValue]
    asked: frozenset[str]
    done: Callable[[BusError | None], None]
    failed: BusError | None = None
    # Once it has failed: when whoever asked gets an answer, even if the sensor is not back.
    until: Deadline | None = None


class Recovery:
    """Watches over all sensors of the bus. `announce` sends an event to the clients."""

    def __init__(
        self,
        bus: Bus,
        sensors: Sequence[Sensor],
        streams: Sequence[SensorStream],
        announce: Callable[[JsonObject], None],
        others: OtherSlaves,
    ) -> None:
        self._bus = bus
        self._sensors = sensors
        self._streams = streams
        self._announce = announce
        self._others = others
        self._returns = [SensorReturn(bus, sensor) for sensor in sensors]
        self._mailboxes = Mailboxes(bus, sensors, announce)
        self._clock = bus.clock
        self.causes = Causes(bus.ifname)
        self._work: dict[int, Steps[bool]] = {}  # what is under way to bring back those that do not stream
        self._lost_at_ns: dict[int, int] = {}
        self._changing: dict[int, _Reconfiguration] = {}
        self._short = 0
        self._watch_ns = 0
        self.attend_at_ns = 0  # `attend` need not be called before if all sensors took part
        self._watched = 0
        # Or at the mailboxes: in turns, so that no exchange has to wait for both.
        self._looks_at_states = False
        # The working counter of each frame if all sensors that are not lost take part.
        self.alive_wkc: list[int]
        self.all_lost: bool  # whether no sensor is left to be read
        self._count_alive()

    def reconfigure(self, number: int, change: Change, done: Callable[[BusError | None], None]) -> None:
        """Take a sensor out of OP to change its settings. `done` is called once it gives samples again.

        If it fails the former settings come back into force, and `done` gets the reason; at once if the
        sensor is lost over it.
        """
        sensor = self._sensors[number]
        self._changing[number] = _Reconfiguration(sensor.wanted, sensor.asked, done)
        sensor.wanted, sensor.asked = change.wanted, sensor.asked | set(change.names)
        self._take_out(number, SensorState.CHANGING, self._returns[number].reconfigure())

    def is_changing(self, number: int) -> bool:
        """Whether the sensor `number` is out of OP to have its settings changed."""
        return number in self._changing

    def sdo(self, number: int) -> GuardedSdo:
        """SDO transfers to a sensor that is not lost, in steps."""
        return self._returns[number].sdo

    def check(self) -> None:
        """To be called once a second: name another master, and try refused event times again when it is time.

        Another master may have changed what they need.
        """
        self.causes.check()
        for number, stream in enumerate(self._streams):
            events = stream.clock.events
            if events and self._sensors[number].streams and events.trust.is_due(self._clock.monotonic_ns()):
                self._bus.slaves[number].latch_events()
                if (clock := self._bus.read_clock(number)) is not None:
                    events.retry(clock)

    def attend(self, complete: bool, now_ns: int) -> None:
        """To be called after an exchange that is back.

        `complete`: all sensors took part that are not lost.
        """
        self._short = max(0, self._short - 1) if complete else self._short + 2
        if self._short >= 2 * _SHORT_EXCHANGES:
            self._short = 0
            for number in self._alive():
                self._look_at(number, counted=False)
        if self._work:
            for number in list(self._work):
                self._step(number)
        if now_ns >= self._watch_ns:
            self._watch_ns = now_ns + _WATCH_EVERY_NS // (2 * len(self._sensors))
            self._looks_at_states = not self._looks_at_states
            if not self._looks_at_states:
                self._mailboxes.look_at_next()
            else:
                if alive := self._alive():
                    self._watched = next((number for number in alive if number > self._watched), alive[0])
                    # One that is out may be counted in place of one that is not there any more.
                    self._look_at(self._watched, counted=not self._work)
                self._others.look_at_next()
        self.attend_at_ns = 0 if self._work or self._short else self._watch_ns

    def miss(self, silent_ns: int, now_ns: int) -> None:
        """To be called while exchanges are not answered, and have not been for `silent_ns`.

        Without frames coming back there is nothing that could be done. InterfaceError if the network
        interface is gone for good.
        """
        if not self.all_lost:
            if silent_ns > _SILENCE_NS:
                why = self._silence()
                for number in range(len(self._sensors)):
                    self._lose(number, why)
        elif now_ns >= self._watch_ns:
            self._watch_ns = now_ns + _WATCH_EVERY_NS
            self._bus.backend.check_present()
            if silent_ns > _SILENT_CHANGE_NS:
                for number in list(self._changing):
                    self._lose_in_change(number, self._silence())

    def _silence(self) -> str:
        why, lost = self._bus.backend.why_silent(), "no frame comes back"
        return self._explain(lost, why) if why == CHECK_CABLE else f"{lost}: {why}"

    def _explain(self, reason: str, otherwise: str = "") -> str:
        return self.causes.explain(reason, self._clock.monotonic_ns(), otherwise)

    def _look_at(self, number: int, *, counted: bool) -> None:
        slave = self._bus.slaves[number]
        status = slave.status()
        if status is None and counted:
            return  # as long as the working counter is right, one datagram got lost
        if status is None and (status := slave.status()) is None:
            self._lose(number, self._explain("it does not answer"))
        elif not status.is_op:
            self._lose(number, self._explain(f"it is in {status}"))

    def _alive(self) -> list[int]:
        return [sensor.number for sensor in self._sensors if sensor.streams]

    def _lose(self, number: int, reason: str) -> None:
        if self._sensors[number].streams:
            self._take_out(number, SensorState.LOST, self._returns[number].bring_back())
            self._report_lost(number, reason)

    def _report_lost(self, number: int, reason: str) -> None:
        sensor = self._sensors[number]
        self._lost_at_ns[number] = self._clock.monotonic_ns()
        log.warning("sensor %d (%s) is lost: %s", number, sensor.identity, reason)
        message = f"sensor {number} is lost: {reason}"
        self._announce(event(Event.SENSOR_LOST, sensor=number, reason=reason, message=message))

    def _take_out(self, number: int, state: SensorState, steps: Steps[bool]) -> None:
        self._sensors[number].enter(state)
        self._work[number] = steps
        self.attend_at_ns = 0
        self._count_alive()

    def _count_alive(self) -> None:
        alive = self._alive()
        counters = self._bus.process_data.counters
        frames = range(len(self._bus.process_data.inputs))
        self.alive_wkc = [sum(counters[number][which] for number in alive) for which in frames]
        self.all_lost = not alive

    def _step(self, number: int) -> None:
        change = self._changing.get(number)
        try:
            next(self._work[number])
            if change is not None and change.until is not None and change.until.passed:
                self._lose_in_change(number, self._explain("it does not come back to OP"))
        except StopIteration as stop:
            self._bring_back(number, left_op=stop.value)
        except GoneError:
            if change is not None:
                self._lose_in_change(number, f"sensor {number} went away while its settings were changed")
            else:
                self._work[number] = self._returns[number].bring_back()
        except BusError as error:
            if change is None:
                log.warning("sensor %d is not back yet: %s", number, error)
                self._work[number] = self._returns[number].bring_back(_FAILED_PAUSE_S)
            elif change.failed is not None:
                self._lose_in_change(number, f"restoring the former settings failed too: {error}")
            else:
                self._work[number] = self._returns[number].bring_back()
                self._revert(number, error)
                if self._bus.slaves[number].status() is None:
                    self._lose_in_change(number, self._explain("it does not answer any more"))
        except DifferentSensorError as error:
            self._refuse(number, error.found)

    def _revert(self, number: int, error: BusError) -> None:
        """The change failed: the former settings are what is wanted again."""
        sensor, change = self._sensors[number], self._changing[number]
        log.warning("sensor %d keeps its former settings: %s", number, error)
        self._changing[number] = change._replace(failed=error, until=Deadline(self._clock, _REVERT_S))
        sensor.enter(SensorState.REVERTING)
        sensor.wanted, sensor.asked = change.wanted, change.asked

    def _lose_in_change(self, number: int, reason: str) -> None:
        """The sensor has gone, or does not take its former settings either: whoever asked is told now."""
        failed = self._changing[number].failed
        if failed is None:
            self._revert(number, BusError(reason))
            error = BusError(reason)
        else:
            error = extended(failed, f"; {reason}")
        change = self._changing.pop(number)
        self._sensors[number].enter(SensorState.LOST)
        self._work[number] = self._returns[number].bring_back(_FAILED_PAUSE_S)
        self._report_lost(number, reason)
        change.done(extended(error, LATER))

    def _bring_back(self, number: int, *, left_op: bool) -> None:
        sensor, stream = self._sensors[number], self._streams[number]
        del self._work[number]
        # Exchanges go on while the clock is read: none may bring a sample before the stream begins anew.
        latching = self._bus.read_clock(number) if left_op else None
        stream.recover(
            sensor.period_ns if left_op else None, lost=number in self._lost_at_ns, latching=latching
        )
        sensor.enter(SensorState.STREAMING)
        if left_op:
            sensor.settle(self._clock)
        self._count_alive()
        if (change := self._changing.pop(number, None)) is not None:
            if change.failed is None:
                self._announce(event(Event.RECONFIGURED, sensor=number, **sensor.in_force()))
            change.done(change.failed and extended(change.failed, IN_FORCE))
        if number not in self._lost_at_ns:
            return
        lost_s = round((self._clock.monotonic_ns() - self._lost_at_ns.pop(number)) * 1e-9, 3)
        log.info("sensor %d (%s) is back after %.3f s", number, sensor.identity, lost_s)
        self._announce(event(Event.SENSOR_BACK, sensor=number, lost_s=lost_s, **sensor.in_force()))

    def _refuse(self, number: int, found: Identity) -> None:
        sensor = self._sensors[number]
        sensor.enter(SensorState.REFUSED)
        self._lost_at_ns.setdefault(number, self._clock.monotonic_ns())
        if (change := self._changing.pop(number, None)) is not None:
            change.done(BusError(f"sensor {number} was replaced by a {found} meanwhile"))
        message = (
            f"sensor {number} is now a {found}, not the {sensor.identity}: connect that one again, "
            "or restart the server to use the new one"
        )
        log.error("%s", message)
        who = {"name": found.name, "serial": found.serial}
        self._announce(
            event(Event.SENSOR_LOST, sensor=number, reason="different_sensor", message=message, found=who)
        )
        self._work[number] = self._returns[number].wait_for_removal()
