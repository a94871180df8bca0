"""Notices that a sensor no longer takes part, tells the clients, and brings it back step by step.

`SensorRecovery` does that for one sensor; `Recovery` watches all of a bus.
"""

from __future__ import annotations

import contextlib
import logging
import struct
from collections.abc import Callable, Sequence
from itertools import cycle
from typing import Final, NamedTuple

from bota_ethercat.control import Event, event
from bota_ethercat.settings import SettingValue
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.acyclic import Acyclic, Task
from ethercat_server.acquisition.sensor_loss_causes import SensorLossCauses
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.errors import BusError, extended
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import ByPosition, Steps, repeat
from ethercat_server.ethercat.nic import CHECK_CABLE
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import STATE_S, AlState, AlStatus
from ethercat_server.ethercat.slave.coe import Emergency
from ethercat_server.ethercat.slave.controller import GoneError
from ethercat_server.ethercat.slave.sii import read_sii
from ethercat_server.sampling.observation import DistributedClock
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.objects.dictionary import is_sensor
from ethercat_server.sensor.scan import OtherSlaves
from ethercat_server.sensor.sensor import Identity, Sensor, SensorState
from ethercat_server.sensor.set_up import IN_FORCE, LATER, Change, identify, set_up, set_up_in_op

_INCOMPLETE_EXCHANGES: Final = 2  # almost in a row, before the sensors' states are read
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


class _GivenUpError(Exception):
    """A sensor does not come back from its change of settings; the text says why."""


class _Change(NamedTuple):
    """A change of settings under way: the former settings, whom to answer, why it failed if it did."""

    wanted: dict[str, SettingValue]
    asked: frozenset[str]
    done: Callable[[BusError | None], None]
    failed: BusError | None = None
    until: Deadline | None = None  # once it has failed: when it is answered even if the sensor is not back


def restore_station(bus: Bus, number: int, position: int, is_kind: Callable[[int, int], bool]) -> Steps[bool]:
    """Give a slave that lost its station address with its power the address again; whether it has it.

    One that has another slave's address, is not in INIT, or whose vendor and product are of another kind, is
    left alone; which one of its kind it is remains to be asked.
    """
    data = yield from bus.read_at(position, reg.STATION_ADDRESS, 2)
    if not data:
        return False
    if (station := int.from_bytes(data, "little")) in bus.stations:
        return station == bus.stations[number]
    status = yield from bus.read_at(position, reg.AL_STATUS, reg.AL_STATUS_SIZE)
    owner = yield from bus.read_at(position, reg.SII_OWNER, 1)
    if not status or not owner or AlStatus.parse(status).state is not AlState.INIT:
        return False
    try:
        words = yield from read_sii(ByPosition(bus), position, _SII_IDENTITY, 4, owner)
    except BusError:
        return False
    if not is_kind(*struct.unpack("<II", words)):
        yield _STRANGER_PAUSE_S
        return False
    address = bus.stations[number].to_bytes(2, "little")
    return (yield from bus.write_at(position, reg.STATION_ADDRESS, address))


class SensorRecovery:
    """Notices that one sensor is lost, brings it back, changes its settings; to be made while it is in OP.

    It goes by the sensor's AL status: SAFEOP with error is acknowledged; SAFEOP goes to OP; any other state
    means that the sensor started anew, so it is set up from INIT. One that does not answer may have lost its
    station address with its power: it gets it again.

    Attributes:
        sdo: transfers to it, while it is not lost.
        task: what is under way to bring it back; None while it streams.
    """

    def __init__(self, recovery: Recovery, sensor: Sensor, stream: SensorStream) -> None:
        self._recovery, self._sensor, self._stream = recovery, sensor, stream
        self._bus, self._announce, self._number = recovery.bus, recovery.announce, sensor.number
        self._slave = self._bus.slaves[sensor.number]
        self.sdo = GuardedSdo(self._slave.sdo)
        self.task: Task | None = None
        self._left_op = False  # since it was back last: kept if the steps begin anew
        self._lost_at_ns: int | None = None
        self._change: _Change | None = None

    @property
    def is_changing(self) -> bool:
        """Whether the sensor is out of OP to have its settings changed."""
        return self._change is not None

    def reconfigure(self, change: Change, done: Callable[[BusError | None], None]) -> None:
        """Take the sensor out of OP to change its settings. `done` is called once it gives samples again.

        If it fails the former settings come back into force, and `done` gets the reason; at once if the
        sensor is lost over it.
        """
        sensor = self._sensor
        self._change = _Change(sensor.wanted, sensor.asked, done)
        sensor.wanted, sensor.asked = change.wanted, sensor.asked | set(change.names)
        self._take_out(SensorState.CHANGING, self._reconfigure())

    def check_state(self, *, counted: bool) -> Steps[None]:
        """Find out whether the sensor is in OP; `counted`: the working counter says that it takes part."""
        if not self._sensor.streams:
            return
        # As long as the working counter is right, one datagram got lost.
        status = yield from repeat(1 if counted else 2, self._slave.status)
        if status is None and not counted:
            self.lose(self._recovery.explain("it does not answer"))
        elif status is not None and not status.is_op:
            self.lose(self._recovery.explain(f"it is in {status}"))

    def poll_mailbox(self) -> Steps[None]:
        """Read a message that is there: nobody else does while the sensor is asked for nothing."""
        if self._sensor.streams:
            yield from self._slave.sdo.poll_mailbox()

    def check_events(self) -> Steps[None]:
        """Try refused event times again when it is time: another master may have changed what they need."""
        events = self._stream.clock.events
        if events and self._sensor.streams and events.trust.is_due(self._bus.clock.raw_ns()):
            with contextlib.suppress(GoneError):
                yield from self._slave.latch_events()
                if (clock := (yield from self._bus.read_clock(self._number))) is not None:
                    self._stream.retry_events(clock)

    def lose(self, reason: str) -> None:
        """The sensor does not take part any more, if it did."""
        if self._sensor.streams:
            self._take_out(SensorState.LOST, self._bring_back())
            self._report_lost(reason)

    def abort_change(self, reason: str) -> None:
        """A change does not come to an end: the request is answered now."""
        if self.task is not None:
            self._recovery.acyclic.throw(self.task, _GivenUpError(reason))

    def check_change(self) -> None:
        """To be called regularly: a sensor whose change failed has a limited time to be back."""
        change = self._change
        if change is not None and change.until is not None and change.until.passed:
            self.abort_change(self._recovery.explain("it does not come back to OP"))

    # -- changes of its state

    def _take_out(self, state: SensorState, steps: Steps[bool]) -> None:
        self._sensor.enter(state)
        self.task = self._recovery.acyclic.start(self._restore(steps))
        self._recovery.count_alive()

    def _lose_in_change(self, reason: str) -> None:
        """The sensor has gone, or refuses its former settings too."""
        if (change := self._change) is None:
            return
        if change.failed is None:
            self._revert(BusError(reason))
            error = BusError(reason)
        else:
            error = extended(change.failed, f"; {reason}")
        self._change = None
        self._sensor.enter(SensorState.LOST)
        self._report_lost(reason)
        change.done(extended(error, LATER))

    def _report_lost(self, reason: str) -> None:
        now_ns = self._lost_at_ns = self._bus.clock.raw_ns()
        if not self._recovery.causes.known_cause(now_ns):
            self._recovery.on_unexplained_loss()
        log.warning("sensor %d (%s) is lost: %s", self._number, self._sensor.identity, reason)
        message = f"sensor {self._number} is lost: {reason}"
        self._announce(event(Event.SENSOR_LOST, sensor=self._number, reason=reason, message=message))

    def _revert(self, error: BusError) -> None:
        """The change failed: the former settings are wanted again."""
        sensor, change = self._sensor, self._change
        assert change is not None
        log.warning("sensor %d keeps its former settings: %s", self._number, error)
        self._change = change._replace(
            failed=error.with_traceback(None), until=Deadline(self._bus.clock, _REVERT_S)
        )
        sensor.enter(SensorState.REVERTING)
        sensor.wanted, sensor.asked = change.wanted, change.asked

    def _stream_again(self, latching: DistributedClock | None, *, left_op: bool) -> None:
        sensor, lost_at_ns = self._sensor, self._lost_at_ns
        self.task = self._lost_at_ns = None
        period_ns = sensor.period_ns if left_op else None
        self._stream.recover(period_ns, lost=lost_at_ns is not None, latching=latching)
        sensor.enter(SensorState.STREAMING)
        if left_op:
            sensor.settle(self._bus.clock)
        self._recovery.count_alive()
        if (change := self._change) is not None:
            self._change = None
            if change.failed is None:
                self._announce(event(Event.RECONFIGURED, sensor=self._number, **sensor.as_message()))
            change.done(change.failed and extended(change.failed, IN_FORCE))
        if lost_at_ns is not None:
            lost_s = round((self._bus.clock.raw_ns() - lost_at_ns) * 1e-9, 3)
            log.info("sensor %d (%s) is back after %.3f s", self._number, sensor.identity, lost_s)
            now = sensor.as_message()
            self._announce(event(Event.SENSOR_BACK, sensor=self._number, lost_s=lost_s, **now))

    def _refuse(self, found: Identity) -> None:
        number, sensor = self._number, self._sensor
        sensor.enter(SensorState.REFUSED)
        self._lost_at_ns = self._lost_at_ns or self._bus.clock.raw_ns()
        if (change := self._change) is not None:
            self._change = None
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

    # -- the steps

    def _restore(self, steps: Steps[bool]) -> Steps[None]:
        """Do `steps`, and what follows if they fail, until it streams."""
        while True:
            change = self._change
            try:
                left_op = yield from steps
                # None of the exchanges meanwhile may bring a sample before the stream begins anew.
                latching = (yield from self._bus.read_clock(self._number)) if left_op else None
            except GoneError:
                steps = self._bring_back(_FAILED_PAUSE_S if change else 0.0)
                self._lose_in_change(f"sensor {self._number} went away while its settings were changed")
            except _GivenUpError as error:
                steps = self._bring_back(_FAILED_PAUSE_S)
                self._lose_in_change(str(error))
            except BusError as error:
                steps = self._bring_back(_FAILED_PAUSE_S)
                if change is None:
                    log.warning("sensor %d is not back yet: %s", self._number, error)
                elif change.failed is not None:
                    self._lose_in_change(f"restoring the former settings failed too: {error}")
                else:
                    self._revert(error)
                    steps = self._bring_back_reverted()
            except DifferentSensorError as error:
                self._refuse(error.found)
                steps = self._wait_for_removal()
            else:
                self._stream_again(latching, left_op=left_op)
                return

    def _bring_back_reverted(self) -> Steps[bool]:
        """Bring back the former settings of a sensor whose change failed; returns as `_bring_back`."""
        if (yield from self._slave.status()) is None:
            raise _GivenUpError(self._recovery.explain("it does not answer any more"))
        return (yield from self._bring_back())

    def _bring_back(self, pause_s: float = 0.0) -> Steps[bool]:
        """Returns once the sensor is in OP: True if it had left it, False if it had only been out of reach.

        Raises GoneError, DifferentSensorError, or BusError if the sensor refuses something.
        """
        yield pause_s
        while True:
            status = yield from self._slave.status()
            if status is None:
                where = self._bus, self._number, self._sensor.position
                if not (yield from restore_station(*where, is_sensor)):
                    yield _ABSENT_PAUSE_S
            elif status.is_op:
                if not self._left_op:
                    yield from self._slave.latch_events()
                if self._sensor.change_interrupted:
                    yield from set_up_in_op(self.sdo, self._sensor)
                left_op, self._left_op = self._left_op, False
                return left_op
            elif status.state is AlState.SAFEOP:
                self._left_op = True
                yield from self._slave.latch_events()
                yield from self._slave.go(AlState.OP)
            else:
                self._left_op = True
                yield from self._set_up_anew()
            yield None

    def _wait_for_removal(self) -> Steps[bool]:
        """Leave a refused sensor in INIT until it is taken away, then bring back the one that comes."""
        unanswered = 0
        while unanswered < _REMOVED_READS:
            unanswered = 0 if (yield from self._slave.status()) is not None else unanswered + 1
            yield _REFUSED_PAUSE_S
        return (yield from self._bring_back())

    def _reconfigure(self) -> Steps[bool]:
        """Take the sensor to PREOP, write what is wanted, and back to OP; raises as `_bring_back`."""
        self._left_op = True
        yield from self._slave.go(AlState.PREOP)
        yield from self._set_up()
        self._left_op = False
        return True

    def _set_up_anew(self) -> Steps[None]:
        identity = self._sensor.identity
        yield from self._slave.enter_preop()
        found = yield from identify(self.sdo, identity.name)
        if (found.name, found.serial) != (identity.name, identity.serial):
            yield from self._slave.go(AlState.INIT)
            raise DifferentSensorError(found)
        yield from self._set_up()

    def _set_up(self) -> Steps[None]:
        """Set up, map and take the sensor from PREOP to OP."""
        asked = self._change is not None and self._change.failed is None
        yield from set_up(self.sdo, self._sensor, asked=asked)
        yield from self._slave.map()
        yield from self._slave.enter_op()


class Recovery:
    """Watches all sensors of the bus. `announce` sends an event to the clients.

    Attributes:
        sensors: the recovery of each, by number.
        acyclic: the access to their registers.
        incomplete: grows with working counters that are too low. While it is 0 `check_answer` need not be
            called for an exchange in which all sensors took part.
        alive_wkc: the working counter of each frame if all sensors take part that are not lost.
        polled: the streams of those sensors; empty if no sensor is left to be read.
        on_unexplained_loss: called when a sensor is lost and neither this computer nor another master is why.
    """

    def __init__(
        self,
        bus: Bus,
        acyclic: Acyclic,
        sensors: Sequence[Sensor],
        streams: Sequence[SensorStream],
        announce: Callable[[JsonObject], None],
        others: OtherSlaves,
    ) -> None:
        self.bus, self.acyclic, self.announce = bus, acyclic, announce
        self._all, self._streams, self._others = sensors, streams, others
        self.causes = SensorLossCauses(bus.ifname)
        self.sensors = [
            SensorRecovery(self, sensor, stream) for sensor, stream in zip(sensors, streams, strict=True)
        ]
        self.on_unexplained_loss: Callable[[], object] = lambda: None
        self.incomplete = 0
        self._checks: list[Task] = []
        self._checked_ns = self._next_check_ns = 0
        self.count_alive()
        bus.emergencies.tell = self._announce_emergency
        acyclic.start(self._watch())

    def check(self) -> None:
        """To be called once a second: name another master, and try refused event times again."""
        self.causes.other_master.check()
        for each in self.sensors:
            self.acyclic.start(each.check_events())

    def check_answer(self, *, complete: bool) -> None:
        """To be called after an exchange that is back.

        `complete`: all sensors took part that are not lost.
        """
        self.incomplete = max(0, self.incomplete - 1) if complete else self.incomplete + 2
        if self.incomplete >= 2 * _INCOMPLETE_EXCHANGES and all(task.finished for task in self._checks):
            self.incomplete = 0
            self._checks = [self.acyclic.start(each.check_state(counted=False)) for each in self.sensors]

    def check_silence(self, silent_ns: int, now_ns: int) -> None:
        """To be called while exchanges are not answered, and have not been for `silent_ns`.

        Without frames coming back there is nothing that could be done. InterfaceError if the network
        interface is gone for good.
        """
        if self.polled:
            if silent_ns > _SILENCE_NS:
                why = self._silence()
                for each in self.sensors:
                    each.lose(why)
        elif now_ns - self._checked_ns >= _WATCH_EVERY_NS:
            self._checked_ns = now_ns
            self.bus.backend.check_present()
            if silent_ns > _SILENT_CHANGE_NS:
                for each in self.sensors:
                    if each.is_changing:
                        each.abort_change(self._silence())

    def _watch(self) -> Steps[None]:
        """Check one sensor after the other, without end."""
        for each in cycle(self.sensors):
            yield from each.poll_mailbox()
            yield self._until_next_check_s()
            # The working counter does not tell sensors apart: one that is out may be counted for another.
            yield from each.check_state(counted=not any(one.task for one in self.sensors))
            each.check_change()
            yield from self._others.check_next()
            yield self._until_next_check_s()

    def _until_next_check_s(self) -> float:
        """Time until the next check: they are evenly spaced, however long each of them takes."""
        now_ns = self.bus.clock.raw_ns()
        self._next_check_ns = max(self._next_check_ns + _WATCH_EVERY_NS // (2 * len(self.sensors)), now_ns)
        return (self._next_check_ns - now_ns) * 1e-9

    def _silence(self) -> str:
        why, lost = self.bus.backend.why_silent(), "no frame comes back"
        return self.explain(lost, why) if why == CHECK_CABLE else f"{lost}: {why}"

    def explain(self, reason: str, otherwise: str = "") -> str:
        """Why a sensor is lost, with what explains it."""
        return self.causes.explain(reason, self.bus.clock.raw_ns(), otherwise)

    def count_alive(self) -> None:
        """A sensor has begun or ceased to stream."""
        process_data = self.bus.process_data
        self.polled = [stream for stream in self._streams if self._all[stream.number].streams]
        alive = [process_data.counters[stream.number] for stream in self.polled]
        self.alive_wkc = [sum(counts[which] for counts in alive) for which in range(len(process_data.inputs))]

    def _announce_emergency(self, number: int, emergency: Emergency, count: int) -> None:
        message = f"sensor {number} reports {emergency}"
        keys = {**emergency.as_json(), "count": count, "message": message}
        self.announce(event(Event.EMERGENCY, sensor=number, **keys))
