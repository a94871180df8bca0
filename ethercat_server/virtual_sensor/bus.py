"""A chain of simulated slaves, in memory: bytes in, bytes out, no sockets, no threads, no clock of its own.

Time is an argument, in ns of any clock that only goes forward; nothing in here asks for it elsewhere:

    bus = SlaveChain((SensorOptions(serial=1), SensorOptions(serial=2)), now=0)
    if bus.process(frame, len(frame), now)  # an Ethernet frame, in place; False if it is lost on the bus
    bus.idle(now)                           # no frame for a while: watchdogs expire, power returns
    faults.obey(bus, "power off @1")        # a fault, as one line of text; answers "ok" or "error: ..."
    bus.statistics()                        # AL states, SDO writes, frames: what the command `stats` prints

The same options (with their seeds), frames, commands and times give the same answers. `bus.slaves` are in
wire order; the sensors among them, with their settings and their flash, are in `bus.sensors`.
"""

from __future__ import annotations

import contextlib
import operator
from collections.abc import Callable, Iterable
from typing import Any, Final

from ethercat_server.ethercat import wire
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.virtual_sensor.application import Application, VirtualSlave
from ethercat_server.virtual_sensor.device import size_of
from ethercat_server.virtual_sensor.esc import Esc, pass_through
from ethercat_server.virtual_sensor.foreign import ForeignSlave, leave_in
from ethercat_server.virtual_sensor.options import SensorOptions, SlaveOptions, UsageError
from ethercat_server.virtual_sensor.sensor import VirtualSensor

_LONGEST_PERIOD_NS = 50_000_000
_FIRST_STATION: Final = 0x1001  # where another master begins


class SlaveChain:
    """Slaves in the order in which frames reach them. All times are in ns, on the caller's clock."""

    def __init__(self, slaves: Iterable[SlaveOptions], now: int, stamp: Callable[[int], int] = int) -> None:
        """All slaves are switched on at `now`. What a sensor says or asks of time is `stamp` of it."""
        self.now = now  # time of the latest call, or at which the latest datagram passed
        self.slaves: list[VirtualSlave] = [
            VirtualSensor(options, lambda: self.now, stamp)
            if isinstance(options, SensorOptions)
            else ForeignSlave(options, lambda: self.now)
            for options in slaves
        ]
        self.sensors = [slave for slave in self.slaves if isinstance(slave, VirtualSensor)]
        self.disconnected: set[VirtualSlave] = set()  # those whose cable at port 0 is unplugged
        self.due: list[Callable[[], object]] = []  # for the end of the frame that is being processed
        self.frames = self.frames_lost = 0
        self.quit = False  # the program is to end
        self.repair()
        self._power_events: list[tuple[int, VirtualSlave]] = []
        self._alive: list[Application] = []
        self._escs: list[Esc] = []
        self._last_frame = 0
        self.rewire()
        self._leave_behind()

    def repair(self) -> None:
        self.lost: tuple[float, float] = (0, 0)  # the numbers of the frames that are: from this, before that
        self.deaf_until: float = 0  # no frame comes back before this time
        self.damage: tuple[VirtualSlave, int] | None = None  # which gets so many more frames corrupted

    def _leave_behind(self) -> None:
        """Take slaves to the state of their options as another master does: all outputs, then all inputs."""
        left = [
            (n, each, each.life) for n, each in enumerate(self.slaves) if each.options.state > AlState.INIT
        ]
        outputs = 0
        inputs = sum(size_of(life.device.output_entries) for _, _, life in left if life)
        for position, slave, life in left:
            assert life is not None
            leave_in(life, slave.options.state, _FIRST_STATION + position, outputs, inputs)
            outputs += size_of(life.device.output_entries)
            inputs += size_of(life.device.input_entries)
            if isinstance(slave, ForeignSlave):
                slave.left_at_work()

    def rewire(self) -> None:
        """Power or a cable has changed: frames reach the slaves before the first that is cut off."""
        self._alive = []
        for slave in self.slaves:
            if slave.life is None or slave in self.disconnected:
                break
            self._alive.append(slave.life)
        self._escs = [life.esc for life in self._alive]
        for position, life in enumerate(self._alive):
            life.esc.set_line(position, len(self._alive) - 1 - position)

    def lose(self, frames: float, after: int = 0) -> None:
        self.lost = self.frames + after, self.frames + after + frames

    def set_time(self, now: int) -> None:
        """Let time pass up to `now`, with what is due meanwhile but the watchdogs: frames may be waiting."""
        now = max(now, self.now)  # a frame lasts some µs
        while self._power_events and self._power_events[0][0] <= now:
            self.now, slave = self._power_events.pop(0)
            slave.power(True)
            self.rewire()
        self.now = now

    def power(self, slave: VirtualSlave, on: bool, seconds: float | None = None) -> None:
        self._power_events = [event for event in self._power_events if event[1] is not slave]
        slave.power(on)
        if seconds is not None:
            self._power_events.append((self.now + round(seconds * 1e9), slave))
            self._power_events.sort(key=operator.itemgetter(0))
        self.rewire()

    def connect(self, slave: VirtualSlave, connected: bool) -> None:
        """Plug or unplug the cable at port 0 of a slave, which keeps its power."""
        if connected:
            self.disconnected.discard(slave)
        elif slave not in self.disconnected:
            self.disconnected.add(slave)
            if slave.life is not None:
                slave.life.esc.count(reg.LOST_LINKS)
        self.rewire()

    def process(self, frame: bytearray, size: int, now: int) -> bool:
        """Pass the frame in the first `size` bytes of `frame`, in position; False if it does not come back.

        `now` is when it arrived.
        """
        datagrams = wire.parse(frame, size)
        if not datagrams:
            return False
        self.set_time(now)
        begin, end = self.lost
        lost = begin <= self.frames < end or self.now < self.deaf_until or not self._alive
        self.frames += 1
        self.frames_lost += lost
        if lost:
            return False
        position = self._damaged_at()
        intact = self._escs[:position]
        for esc in intact:
            esc.clock.frame_start = now
        for datagram in datagrams:
            if datagram.command:  # a NOP passes unchanged
                # What it reads is of the moment at which it passes, not of the start of its frame. Frames of
                # a simulated wire may overlap.
                self.now = max(self.now, now + datagram.header * wire.BYTE_NS)
                pass_through(intact, frame, datagram)
        if position is not None:  # the network card of the master throws it away
            self.frames_lost += 1
            return False
        frame[wire.SOURCE_ADDRESS] |= wire.PROCESSED_BIT
        while self.due:
            with contextlib.suppress(UsageError):  # it has no power any more
                self.due.pop(0)()
        return True

    def _damaged_at(self) -> int | None:
        """Count a corrupted frame in the error counters; how many slaves received it intact, None for all.

        The slave that detects the error marks the frame; those it passes afterwards count it as forwarded, on
        the way out at port 0 and on the way back at port 1.
        """
        if self.damage is None or self.damage[0].life not in self._alive:
            return None
        slave, frames = self.damage
        self.damage = (slave, frames - 1) if frames > 1 else None
        position = [life is slave.life for life in self._alive].index(True)
        for counter in (0, 1):
            self._escs[position].count(reg.RX_ERRORS + counter)
        for esc in self._escs[position + 1 :]:
            esc.count(reg.FORWARDED_ERRORS)
        for esc in self._escs[:-1]:
            esc.count(reg.FORWARDED_ERRORS + 1)
        return position

    def flap(self, slave: VirtualSlave) -> None:
        """The link at port 0 is lost and returns: the controllers at both ends count it."""
        position = self.slaves.index(slave)
        for end, port in ((position, 0), (position - 1, 1)):
            if 0 <= end < len(self._alive):
                self._escs[end].count(reg.LOST_LINKS + port)

    def prepare(self) -> None:
        """All waiting frames are answered: check the watchdogs, and compute the next samples ahead.

        Those are the samples that the next frame will read if frames are periodic.
        """
        period = min(self.now - self._last_frame, _LONGEST_PERIOD_NS)
        expected = self.now + period
        self._last_frame = self.now
        self.idle(self.now)
        for life in self._alive:
            life.prepare(expected)

    def idle(self, now: int) -> None:
        """No frame is waiting: let time pass up to `now`, watchdogs included."""
        self.set_time(now)
        for slave in self.slaves:
            if slave.life is not None:
                slave.life.check_watchdog(now)

    def statistics(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "frames_lost": self.frames_lost,
            "sensors": [sensor.statistics() for sensor in self.sensors],
            "foreign": {
                position: slave.statistics()
                for position, slave in enumerate(self.slaves)
                if isinstance(slave, ForeignSlave)
            },
        }
