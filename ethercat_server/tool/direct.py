"""The link on the interface itself: the tool is the EtherCAT master. Needs what the server needs."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeVar

from ethercat_server import realtime
from ethercat_server.bus import Bus
from ethercat_server.configuration import Change, save
from ethercat_server.cycle import Cycle
from ethercat_server.errors import BusError, ServerError, UsageError
from ethercat_server.interface import claimed
from ethercat_server.jobs import Jobs
from ethercat_server.notify import Notifier
from ethercat_server.options import VIRTUAL_INTERFACE, ServerOptions
from ethercat_server.recovery import Recovery
from ethercat_server.sdo import BlockingSdo, Sdo, Steps, finish
from ethercat_server.sensor import Identity, Sensor, identify, set_up
from ethercat_server.server_settings import DEFAULT_RT_PRIORITY
from ethercat_server.sii import has_coe
from ethercat_server.soem import SlaveIdentity
from ethercat_server.start_up import check_sii, enter_op, find_sensors
from ethercat_server.stream import SensorStream
from ethercat_server.tare import LATER, tare
from ethercat_server.tool.link import (
    Found,
    GuardedSdo,
    Link,
    OnFrame,
    failed_change,
    signals_call,
    signals_held_back,
)
from ethercat_server.virtual_bus import VirtualBus
from protocol.control import ErrorCode
from protocol.errors import RequestError, SettingError
from protocol.framing import DataMessage, FrameDecoder
from protocol.settings import SettingValue

T = TypeVar("T")

_BACK_S: Final = 10.0
"""So long a sensor that was lost in a tare may take to come back for its old offset."""


def open_bus(ifname: str, cleanup: contextlib.ExitStack) -> Bus:
    """The open bus on `ifname`; `virtual` brings up a virtual one. `cleanup` takes all down."""
    if ifname == VIRTUAL_INTERFACE:
        ifname = cleanup.enter_context(VirtualBus()).ifname
    cleanup.enter_context(claimed(ifname))
    bus = Bus(ifname)
    cleanup.callback(bus.close)
    bus.open()
    return bus


def scan_only(ifname: str, cleanup: contextlib.ExitStack) -> tuple[Bus, list[SlaveIdentity]]:
    """The bus and all its slaves, whatever they are."""
    bus = open_bus(ifname, cleanup)
    return bus, bus.scan(_no_check)


class DirectLink(Link):
    """All sensors in PREOP; `watch` and `tare` take them to OP, set as they are."""

    def __init__(self, ifname: str, *, any_slave: bool = False) -> None:
        with contextlib.ExitStack() as cleanup:
            self._bus = open_bus(ifname, cleanup)
            if any_slave:
                self.sensors = _identify_all(self._bus)
            else:
                found = find_sensors(self._bus, ServerOptions(ifname, port=0), _no_check)
                self.sensors = [Found(sensor.place, sensor.identity) for sensor in found]
            self._cleanup = cleanup.pop_all()
        self.used = f"the interface {ifname}"

    def close(self) -> None:
        """Take the bus to INIT and let the interface go."""
        self._cleanup.close()

    def sdo(self, place: int) -> GuardedSdo:
        """See `Link`."""
        return GuardedSdo(BlockingSdo(self._bus, place))

    def configure(self, place: int, settings: Mapping[str, SettingValue], save: bool) -> None:
        """See `Link`."""
        sdo, sensor = self.sdo(place), self.in_force(self.sensors[place])
        _check_rate_known(sensor)
        try:
            change = Change(sensor, settings)
        except SettingError as error:
            raise UsageError(str(error)) from None
        with signals_held_back():
            finish(_change(sdo, sensor, change, save))

    def tare(self, place: int, samples: int, target: Sequence[float]) -> dict[str, Any]:
        """See `Link`."""
        running = _Running(self._bus, self._operational(), lambda _: True)
        sdo = GuardedSdo(running.recovery.sdo(place))
        return running.do(place, tare(sdo, running.sensors[place], running.streams[place], samples, target))

    def watch(self, places: Sequence[int], on_frame: OnFrame, on_idle: Callable[[], bool]) -> None:
        """See `Link`."""

        def wanted(frame: DataMessage) -> bool:
            return frame.sensor not in places or on_frame(frame)

        running = _Running(self._bus, self._operational(), wanted)
        running.on_idle = on_idle
        running.run()

    def _operational(self) -> list[Sensor]:
        sensors = [self.in_force(found) for found in self.sensors]
        for sensor in sensors:
            _check_rate_known(sensor)
        enter_op(self._bus, sensors, _no_check)
        return sensors


class _Running:
    """The server's loop in this process, with the tool in place of the clients (an `Outlet`)."""

    def __init__(self, bus: Bus, sensors: list[Sensor], on_frame: OnFrame) -> None:
        realtime.prepare(DEFAULT_RT_PRIORITY, None)
        self.sensors = sensors
        self.streams = [SensorStream(sensor.place, sensor.period_ns) for sensor in sensors]
        self.recovery = Recovery(bus, sensors, self.streams, lambda _: None)
        self.on_idle: Callable[[], bool] = lambda: True
        self._jobs = Jobs(bus, self.streams)
        self._cycle = Cycle(bus, self.streams, self, self.recovery, self._jobs, Notifier())
        self._on_frame = on_frame
        self._decoder = FrameDecoder()
        self._stopped = False

    def publish(self, frame: bytes, place: int, flags: int, now_ns: int) -> None:  # noqa: ARG002
        """See `Outlet`."""
        self._decoder.feed(frame)
        for message in self._decoder:
            if isinstance(message, DataMessage) and not self._on_frame(message):
                self._cycle.stop()

    def serve(self, until_ns: int) -> None:  # noqa: ARG002
        """See `Outlet`."""
        if not self.on_idle():
            self._cycle.stop()

    def run(self) -> None:
        """Until it is told to stop; KeyboardInterrupt if by a signal."""
        with signals_call(self._stop):
            self._cycle.run()
        if self._stopped:
            raise KeyboardInterrupt

    def do(self, place: int, steps: Steps[T]) -> T:
        """Run until `steps` are done; returns their result. A signal has them take back what is half done."""
        results: list[T] = []
        errors: list[RequestError] = []

        def done(result: T, error: RequestError | None) -> None:
            if error is None:
                results.append(result)
            else:
                errors.append(error)
            self._cycle.stop()

        self._jobs.start(place, self._stoppable(steps), done)
        with signals_call(self._note_signal):
            self._cycle.run()
        if errors:
            kind = UsageError if errors[0].code == ErrorCode.BAD_REQUEST else BusError
            text = str(errors[0])
            if self.sensors[place].unsettled:
                text = text.removesuffix(LATER) + self._put_back(place)
            raise kind(text)
        return results[0]

    def _stoppable(self, steps: Steps[T]) -> Steps[T]:
        told = False
        raised: BusError | None = None
        while True:
            if self._stopped and not told and raised is None:
                told, raised = True, BusError("stopped before it was done")
            try:
                if raised is None:
                    next(steps)
                else:
                    steps.throw(raised)
            except StopIteration as stop:
                result: T = stop.value
                return result
            raised = None
            try:
                yield
            except BusError as error:  # the sensor is lost: the steps have something to say to that
                raised = error

    def _put_back(self, place: int) -> str:
        """Give a sensor that was lost in a tare the time to come back; returns what became of its offset."""
        sensor, stream, deadline = self.sensors[place], self.streams[place], time.monotonic() + _BACK_S
        self.on_idle = lambda: not stream.alive and time.monotonic() < deadline
        self._cycle.stopping = False
        with signals_call(self._note_signal), contextlib.suppress(ServerError):
            self._cycle.run()
        if not sensor.unsettled:
            return "; it is back, and its old offset is in force"
        old = " ".join(f"{value:g}" for value in sensor.offset or ())
        return f"; its offset may be half written (it was {old}): tare it again"

    def _note_signal(self) -> None:
        self._stopped = True

    def _stop(self) -> None:
        self._stopped = True
        self._cycle.stop()


def _change(sdo: Sdo, sensor: Sensor, change: Change, and_save: bool) -> Steps[None]:
    """Put a change in force in PREOP; BusError after everything is as before if it does not take."""
    before = dict(sensor.settings)
    try:
        if change.names:
            sensor.wanted, sensor.asked = change.wanted, frozenset(change.names)
            yield from set_up(sdo, sensor)
    except BusError as error:
        sensor.wanted, sensor.asked = before, frozenset()
        try:
            yield from set_up(sdo, sensor)
        except BusError as again:
            raise BusError(
                f"{error}; and the former settings could not be put back ({again}): power it off and on"
            ) from None
        raise failed_change(error) from None
    if and_save:
        yield from save(sdo, sensor)


def _identify_all(bus: Bus) -> list[Found]:
    """All slaves, whatever they are and however little they say."""
    found = []
    slaves = bus.scan(_no_check)
    for place, slave in enumerate(slaves):
        check_sii(bus.ifname, place, slave)
    bus.check_preop(_no_check)
    for place, slave in enumerate(slaves):
        try:
            identity = finish(identify(GuardedSdo(BlockingSdo(bus, place)), slave.name))
        except BusError:
            if finish(has_coe(bus, place)):
                raise
            found.append(Found(place, Identity(slave.name or "nameless", 0, "", ""), has_objects=False))
        else:
            found.append(Found(place, identity))
    return found


def _check_rate_known(sensor: Sensor) -> None:
    if "sinc_length" not in sensor.wanted:
        raise BusError(f"sensor {sensor.place} does not tell its sampling rate: power it off and on")


def _no_check() -> None:
    """Ctrl-C is an exception here, so nothing has to be asked for."""
