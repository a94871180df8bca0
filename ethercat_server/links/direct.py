"""The link on the interface itself: this process is the EtherCAT master, with the server's privileges."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeVar

from ethercat_server.acquisition.cycle import Cycle
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.start_up import AsFound, enter_op, find_sensors
from ethercat_server.acquisition.stream import Made, make_streams
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.errors import BusError, ServerError, UsageError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import ByPosition
from ethercat_server.ethercat.master.soem import SoemBackend
from ethercat_server.ethercat.nic.claim import claimed
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import MailboxSdo, Sdo, Steps, finish
from ethercat_server.links.link import (
    Found,
    Link,
    OnFrame,
    SettledFrames,
    failed_change,
    signals_call,
    signals_held_back,
)
from ethercat_server.process import realtime
from ethercat_server.process.notify import Notifier
from ethercat_server.sensor import scan
from ethercat_server.sensor.configuration import Change, save
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.scan import OtherSlaves, look_safely
from ethercat_server.sensor.sensor import Identity, Sensor
from ethercat_server.sensor.set_up import set_up
from ethercat_server.sensor.tare import LATER, tare
from ethercat_server.virtual_sensor.virtual_bus import VIRTUAL_INTERFACE, VirtualBus
from protocol.control import ErrorCode
from protocol.errors import RequestError, SettingError
from protocol.framing import DataMessage, FrameDecoder
from protocol.settings import SettingValue

T = TypeVar("T")

_BACK_S: Final = 10.0
"""Timeout for a sensor lost during a tare to come back for its old offset."""


def open_bus(ifname: str, cleanup: contextlib.ExitStack, *, allow_ip: bool = False) -> Bus:
    """The open bus on `ifname`, or on a virtual bus for `virtual`; `cleanup` closes it."""
    if ifname == VIRTUAL_INTERFACE:
        ifname = cleanup.enter_context(VirtualBus()).ifname
    cleanup.enter_context(claimed(ifname, allow_ip=allow_ip))
    backend = SoemBackend(ifname)
    bus = Bus(backend)
    cleanup.callback(bus.close)
    backend.open()
    return bus


def read_images(
    ifname: str, cleanup: contextlib.ExitStack, *, force: bool, allow_ip: bool
) -> dict[int, bytes | BusError]:
    """The SII of every slave on the wire, of any vendor, by position; all stay in the state they are in."""
    bus = open_bus(ifname, cleanup, allow_ip=allow_ip)
    images: dict[int, bytes | BusError] = {}
    for slave in look_safely(bus, _no_check, force=force):
        try:
            images[slave.position] = scan.read_image(bus, slave.position)
        except BusError as error:
            images[slave.position] = error
    return images


class DirectLink(Link):
    """All sensors in PREOP; `watch` and `tare` take them to OP with their present settings."""

    def __init__(
        self, ifname: str, *, slave: str | None = None, force: bool = False, allow_ip: bool = False
    ) -> None:
        """`slave`: the foreign slave POSITION:NAME instead, in the state that it is in."""
        with contextlib.ExitStack() as cleanup:
            self._bus = open_bus(ifname, cleanup, allow_ip=allow_ip)
            self.clock = self._bus.clock
            self._slave: GuardedSdo | None = None
            if slave is not None:
                found_slave, self._slave = _find_slave(self._bus, slave)
                self.sensors = [found_slave]
            else:
                found = find_sensors(self._bus, AsFound(force=force), _no_check).sensors
                self.sensors = [Found(sensor.number, sensor.identity) for sensor in found]
            self._cleanup = cleanup.pop_all()
        self.used = f"the interface {ifname}"

    def close(self) -> None:
        """Take the bus to INIT and release the interface."""
        self._cleanup.close()

    def sdo(self, number: int) -> GuardedSdo:
        """See `Link`."""
        return self._slave or GuardedSdo(self._bus.slaves[number].sdo)

    def configure(self, number: int, settings: Mapping[str, SettingValue], save: bool) -> None:
        """See `Link`."""
        sdo, sensor = self.sdo(number), self.in_force(self.sensors[number], settings)
        _check_rate_known(sensor)
        try:
            change = Change(sensor, settings)
        except SettingError as error:
            raise UsageError(str(error)) from None
        with signals_held_back():
            finish(_change(sdo, sensor, change, save), clock=self.clock)

    def tare(self, number: int, samples: int, target: Sequence[float]) -> dict[str, Any]:
        """See `Link`."""
        running = _Running(self._bus, self._operational(), lambda _: True)
        sdo = running.recovery.sdo(number)
        return running.do(
            number, tare(sdo, running.sensors[number], running.streams[number], samples, target)
        )

    def watch(self, numbers: Sequence[int], on_frame: OnFrame, on_idle: Callable[[], bool]) -> None:
        """See `Link`."""

        sensors, settled = self._operational(), SettledFrames(on_frame)
        begun = False

        def wanted(frame: DataMessage) -> bool:
            return frame.sensor not in numbers or settled.take(frame, sensors[frame.sensor].settling)

        def idle() -> bool:
            nonlocal begun
            begun = begun or not any(sensors[number].settling for number in numbers)
            return not begun or on_idle()

        running = _Running(self._bus, sensors, wanted)
        running.on_idle = idle
        running.run()

    def _operational(self) -> list[Sensor]:
        sensors = [self.in_force(found) for found in self.sensors]
        for sensor in sensors:
            _check_rate_known(sensor)
        realtime.prepare(realtime.DEFAULT_PRIORITY, None)
        enter_op(self._bus, sensors, _no_check)
        return sensors


class _Running:
    """The server's loop in this process, with the tool instead of clients (an `Outlet`)."""

    def __init__(self, bus: Bus, sensors: list[Sensor], on_frame: OnFrame) -> None:
        self.sensors = sensors
        self._clock = bus.clock
        timing = ExchangeTiming(bus.clock.monotonic_ns())
        self.streams = make_streams(bus, sensors, timing)
        self.recovery = Recovery(bus, sensors, self.streams, lambda _: None, OtherSlaves(bus, ()))
        self.on_idle: Callable[[], bool] = lambda: True
        self._jobs = Jobs(bus, sensors)
        self._cycle = Cycle(bus, sensors, self.streams, timing, self, self.recovery, self._jobs, Notifier())
        self._on_frame = on_frame
        self._decoder = FrameDecoder()
        self._stopped = False

    def publish(self, made: Sequence[Made], now_ns: int) -> None:  # noqa: ARG002
        """See `Outlet`."""
        for frame, _, _ in made:
            self._decoder.feed(frame)
        for message in self._decoder:
            if isinstance(message, DataMessage) and not self._on_frame(message):
                self._cycle.stop()

    def serve(self, until_ns: int) -> None:  # noqa: ARG002
        """See `Outlet`."""
        if not self.on_idle():
            self._cycle.stop()

    def run(self) -> None:
        """Run until stopped; KeyboardInterrupt if by a signal."""
        with signals_call(self._stop):
            self._cycle.run()
        if self._stopped:
            raise KeyboardInterrupt

    def do(self, number: int, steps: Steps[T]) -> T:
        """Run until `steps` are done; returns their result. After a signal they undo what is half done."""
        results: list[T] = []
        errors: list[RequestError] = []

        def done(result: T, error: RequestError | None) -> None:
            if error is None:
                results.append(result)
            else:
                errors.append(error)
            self._cycle.stop()

        self._jobs.start(number, self._stoppable(steps), done)
        with signals_call(self._note_signal):
            self._cycle.run()
        if errors:
            kind = UsageError if errors[0].code == ErrorCode.BAD_REQUEST else BusError
            text = str(errors[0])
            if self.sensors[number].unsettled:
                text = text.removesuffix(LATER) + self._put_back(number)
            raise kind(text)
        return results[0]

    def _stoppable(self, steps: Steps[T]) -> Steps[T]:
        informed = False
        raised: BusError | None = None
        while True:
            if self._stopped and not informed and raised is None:
                informed, raised = True, BusError("stopped before it was done")
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
            except BusError as error:  # the sensor is lost: the steps may handle that
                raised = error

    def _put_back(self, number: int) -> str:
        """Give a sensor that was lost in a tare the time to come back; returns what became of its offset."""
        sensor, deadline = self.sensors[number], Deadline(self._clock, _BACK_S)
        self.on_idle = lambda: not sensor.streams and not deadline.passed
        self._cycle.stopping = False
        with signals_call(self._note_signal), contextlib.suppress(ServerError):
            self._cycle.run()
        if not sensor.unsettled:
            return "; it is back with its old offset"
        old = " ".join(f"{value:g}" for value in sensor.offset or ())
        return f"; its offset may be half written (it was {old}): tare it again"

    def _note_signal(self) -> None:
        self._stopped = True

    def _stop(self) -> None:
        self._stopped = True
        self._cycle.stop()


def _change(sdo: Sdo, sensor: Sensor, change: Change, and_save: bool) -> Steps[None]:
    """Change settings in PREOP; BusError if one fails, with the former settings restored."""
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
                f"{error}; the former settings could not be restored ({again}): power it off and on"
            ) from None
        raise failed_change(error) from None
    if and_save:
        yield from save(sdo, sensor)


def _find_slave(bus: Bus, wanted: str) -> tuple[Found, GuardedSdo]:
    """The slave POSITION:NAME and its objects, through the mailboxes that its own master has set up.

    It stays in its state, and nothing is written but its mailbox.
    """
    place, _, name = wanted.partition(":")
    slaves = look_safely(bus, _no_check)
    there = "; ".join(f"{slave.position}:{slave.name}" for slave in slaves)
    slave = next((each for each in slaves if (str(each.position), each.name) == (place, name)), None)
    if slave is None:
        raise UsageError(f"no slave is {wanted!r}, as POSITION:NAME: there are {there}")
    if not slave.has_coe:
        raise UsageError(f"slave {wanted} has no CoE mailbox, and so no objects")
    if slave.status.state in (AlState.INIT, AlState.BOOT):
        raise BusError(
            f"slave {wanted} is in {slave.status.state.name}, where its objects cannot be read: have its own "
            "master take it to PREOP"
        )
    rows = bus.read_surely_at(slave.position, reg.SYNC_MANAGER, 2 * reg.SYNC_MANAGER_SIZE)
    out, back = struct.unpack_from("<HH", rows), struct.unpack_from("<HH", rows, reg.SYNC_MANAGER_SIZE)
    sdo = GuardedSdo(MailboxSdo(ByPosition(bus), slave.position, (out, back)))
    serial = slave.sii["serial"] if slave.sii else 0
    return Found(slave.position, Identity(slave.name, serial, "", ""), "slave"), sdo


def _check_rate_known(sensor: Sensor) -> None:
    if "sinc_length" not in sensor.wanted:
        raise BusError(f"sensor {sensor.number} does not report its sampling rate: power it off and on")


def _no_check() -> None:
    """Ctrl-C is an exception here: no check is needed."""
