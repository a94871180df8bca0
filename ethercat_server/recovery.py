"""Notices that a sensor no longer takes part, tells the clients, and has it brought back step by step.

The steps are `ladder.py`'s, one for each exchange, so that neither the other sensors nor the clients wait.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from ethercat_server.al import AlState
from ethercat_server.bus import Bus
from ethercat_server.configuration import IN_FORCE, LATER, Change
from ethercat_server.errors import BusError, extended
from ethercat_server.interface import check_present
from ethercat_server.ladder import DifferentSensorError, GoneError, Ladder
from ethercat_server.sdo import CyclicSdo, Steps
from ethercat_server.sensor import Identity, Sensor
from ethercat_server.stream import SensorStream
from protocol.control import Event, event
from protocol.json_text import JsonObject
from protocol.settings import SettingValue

_SHORT_EXCHANGES: Final = 2
"""So many exchanges in a row with a short working counter are looked into."""
_SILENCE_NS: Final = 50_000_000
"""So long with no frame coming back, and all sensors are lost; single lost frames are not, however slow."""
_SILENT: Final = "no frame comes back: check cable and power"
_SILENT_CHANGE_NS: Final = 1_000_000_000
"""So long it may be in the middle of a change, which goes on when the frames do."""
_WATCH_EVERY_NS: Final = 100_000_000
"""A sensor can leave OP and still be counted, so its AL status is read this often."""
_FAILED_PAUSE_S: Final = 0.25
_TAKING_BACK_S: Final = 2.0
"""So long a sensor whose change failed may take until it is back in OP."""

log = logging.getLogger(__name__)


class _Reconfiguration(NamedTuple):
    """A change of settings under way: what to go back to, whom to tell, why it failed if it did."""

    wanted: dict[str, SettingValue]
    asked: frozenset[str]
    done: Callable[[BusError | None], None]
    failed: BusError | None = None
    until: float = math.inf
    """Once it has failed: when whoever asked is told, even if the sensor is not back."""


class Recovery:
    """Watches over all sensors of the bus. `announce` sends an event to the clients."""

    def __init__(
        self,
        bus: Bus,
        sensors: Sequence[Sensor],
        streams: Sequence[SensorStream],
        announce: Callable[[JsonObject], None],
    ) -> None:
        self._bus = bus
        self._sensors = sensors
        self._streams = streams
        self._announce = announce
        self._ladders = [Ladder(bus, sensor) for sensor in sensors]
        self._climbing: dict[int, Steps[bool]] = {}
        self._lost_at: dict[int, float] = {}
        self._changing: dict[int, _Reconfiguration] = {}
        self._short = 0
        self._frame_ns = time.monotonic_ns()
        self._missed_since_ns = 0
        """When the frame came that was the last before the first that is missing."""
        self._watch_ns = 0
        self._watched = 0
        self.alive_wkc: int
        """The working counter of all sensors that are not lost."""
        self.all_lost: bool
        """Whether no sensor is left to be read."""
        self._count_alive()

    def reconfigure(self, place: int, change: Change, done: Callable[[BusError | None], None]) -> None:
        """Take a sensor out of OP to change its settings. `done` is called once it gives samples again.

        If it fails the former settings come back into force, and `done` gets the reason; at once if the
        sensor is lost over it.
        """
        sensor = self._sensors[place]
        self._changing[place] = _Reconfiguration(sensor.wanted, sensor.asked, done)
        sensor.wanted, sensor.asked = change.wanted, sensor.asked | set(change.names)
        sensor.state = AlState.PREOP.name
        self._take_out(place, self._ladders[place].reconfigure())

    def is_changing(self, place: int) -> bool:
        """Whether the sensor at `place` is out of OP to have its settings changed."""
        return place in self._changing

    def sdo(self, place: int) -> CyclicSdo:
        """SDO transfers to a sensor that is not lost, in steps."""
        return self._ladders[place].sdo

    def attend(self, wkc: int, now_ns: int) -> None:
        """To be called after every exchange; almost always it has nothing to do.

        InterfaceError if the network interface is gone for good.
        """
        if wkc < 0:
            # Without frames coming back there is nothing that could be done.
            if self.all_lost:
                if now_ns >= self._watch_ns:
                    self._watch_ns = now_ns + _WATCH_EVERY_NS
                    check_present(self._bus.ifname, self._bus.ifindex)
                    if now_ns - self._frame_ns > _SILENT_CHANGE_NS:
                        for place in list(self._changing):
                            self._lose_in_change(place, _SILENT)
            elif self._missed_since_ns != self._frame_ns:
                self._missed_since_ns = self._frame_ns  # one only: at a low rate the time alone says nothing
            elif now_ns - self._frame_ns > _SILENCE_NS:
                for place in range(len(self._sensors)):
                    self._lose(place, _SILENT)
            return
        self._frame_ns = now_ns
        self._short = self._short + 1 if wkc < self.alive_wkc else 0
        if self._short >= _SHORT_EXCHANGES:
            self._short = 0
            self._look_for_lost()
        if self._climbing:
            for place in list(self._climbing):
                self._step(place)
        if now_ns >= self._watch_ns:
            self._watch_ns = now_ns + _WATCH_EVERY_NS // len(self._sensors)
            self._watch_next()

    def _watch_next(self) -> None:
        if alive := self._alive():
            self._watched = next((place for place in alive if place > self._watched), alive[0])
            # One that is out may be counted in place of one that is not there any more.
            self._look_at(self._watched, counted=not self._climbing)

    def _look_for_lost(self) -> None:
        for place in self._alive():
            self._look_at(place, counted=False)

    def _look_at(self, place: int, *, counted: bool) -> None:
        status = self._ladders[place].al_status()
        if status is None:
            if counted:
                return  # as long as the working counter is right, one datagram got lost
            status = self._ladders[place].al_status()
        if status is None:
            self._lose(place, "it does not answer")
        elif not status.is_op:
            self._lose(place, f"it is in {status}")

    def _alive(self) -> list[int]:
        return [place for place in range(len(self._sensors)) if place not in self._climbing]

    def _lose(self, place: int, reason: str) -> None:
        if place not in self._climbing:
            self._take_out(place, self._ladders[place].climb())
            self._tell_lost(place, reason)

    def _tell_lost(self, place: int, reason: str) -> None:
        sensor = self._sensors[place]
        sensor.state = "LOST"
        self._lost_at[place] = time.monotonic()
        log.warning("sensor %d (%s) is lost: %s", place, sensor.identity, reason)
        self._announce(
            event(Event.SENSOR_LOST, sensor=place, reason=reason, message=f"sensor {place} is lost: {reason}")
        )

    def _take_out(self, place: int, steps: Steps[bool]) -> None:
        self._streams[place].alive = False
        self._climbing[place] = steps
        self._count_alive()

    def _count_alive(self) -> None:
        alive = self._alive()
        self.alive_wkc = sum(self._bus.working_counter(place) for place in alive)
        self.all_lost = not alive
        self._bus.be_patient(self.all_lost)

    def _step(self, place: int) -> None:
        change = self._changing.get(place)
        try:
            next(self._climbing[place])
            if change is not None and time.monotonic() > change.until:
                self._lose_in_change(place, "it does not come back to OP")
        except StopIteration as stop:
            self._bring_back(place, left_op=stop.value)
        except GoneError:
            if change is not None:
                self._lose_in_change(place, f"sensor {place} went away while its settings were changed")
            else:
                self._climbing[place] = self._ladders[place].climb()
        except BusError as error:
            if change is None:
                log.warning("sensor %d is not back yet: %s", place, error)
                self._climbing[place] = self._ladders[place].climb(_FAILED_PAUSE_S)
            elif change.failed is not None:
                self._lose_in_change(place, f"putting back what was in force failed too: {error}")
            else:
                self._climbing[place] = self._ladders[place].climb()
                self._take_back(place, error)
                if self._ladders[place].al_status() is None:
                    self._lose_in_change(place, "it does not answer any more")
        except DifferentSensorError as error:
            self._refuse(place, error.found)

    def _take_back(self, place: int, error: BusError) -> None:
        """The change failed: the former settings are what is wanted again."""
        sensor, change = self._sensors[place], self._changing[place]
        log.warning("sensor %d keeps its former settings: %s", place, error)
        self._changing[place] = change._replace(failed=error, until=time.monotonic() + _TAKING_BACK_S)
        sensor.wanted, sensor.asked = change.wanted, change.asked

    def _lose_in_change(self, place: int, reason: str) -> None:
        """The sensor has gone, or does not take its former settings either: whoever asked is told now."""
        failed = self._changing[place].failed
        if failed is None:
            self._take_back(place, BusError(reason))
            error = BusError(reason)
        else:
            error = extended(failed, f"; {reason}")
        change = self._changing.pop(place)
        self._climbing[place] = self._ladders[place].climb(_FAILED_PAUSE_S)
        self._tell_lost(place, reason)
        change.done(extended(error, LATER))

    def _bring_back(self, place: int, *, left_op: bool) -> None:
        sensor, stream = self._sensors[place], self._streams[place]
        del self._climbing[place]
        self._count_alive()
        sensor.state = AlState.OP.name
        stream.recover(sensor.period_ns if left_op else None, lost=place in self._lost_at)
        if (change := self._changing.pop(place, None)) is not None:
            if change.failed is None:
                self._announce(event(Event.RECONFIGURED, sensor=place, settings=dict(sensor.settings)))
            change.done(change.failed and extended(change.failed, IN_FORCE))
        if place not in self._lost_at:
            return
        lost_s = round(time.monotonic() - self._lost_at.pop(place), 3)
        log.info("sensor %d (%s) is back after %.3f s", place, sensor.identity, lost_s)
        self._announce(event(Event.SENSOR_BACK, sensor=place, lost_s=lost_s, settings=dict(sensor.settings)))

    def _refuse(self, place: int, found: Identity) -> None:
        sensor = self._sensors[place]
        sensor.state = "REFUSED"
        self._lost_at.setdefault(place, time.monotonic())
        if (change := self._changing.pop(place, None)) is not None:
            change.done(BusError(f"sensor {place} was replaced by a {found} meanwhile"))
        message = (
            f"sensor {place} is now a {found}, not the {sensor.identity}: connect that one again, "
            "or restart the server to use the new one"
        )
        log.error("%s", message)
        who = {"name": found.name, "serial": found.serial}
        self._announce(
            event(Event.SENSOR_LOST, sensor=place, reason="different_sensor", message=message, found=who)
        )
        self._climbing[place] = self._ladders[place].wait_for_removal()
