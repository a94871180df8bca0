"""A chain of simulated sensors, in memory: bytes in, bytes out, no sockets, no threads, no clock of its own.

Time is an argument, in ns of any clock that only goes forward; nothing in here asks for it elsewhere:

    bus = Bus(BusOptions((SensorOptions(serial=1), SensorOptions(serial=2))), now=0)
    answer = bus.exchange(frame, now)       # an Ethernet frame; None if it is lost on the bus
    bus.idle(now)                           # no frame for a while: watchdogs expire, power returns
    faults.table.obey(bus, "power off @1")  # a fault, as one line of text; answers "ok" or "error: ..."
    bus.statistics()                        # AL states, SDO writes, frames: what the command `stats` prints

The same options (with their seeds), frames, commands and times give the same answers. A sensor that loses
power, its settings and its flash are in `bus.sensors[n]`.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Any

from ethercat_server.ethercat import wire
from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.esc.commands import execute
from ethercat_server.virtual_sensor.firmware.firmware import Firmware
from ethercat_server.virtual_sensor.options import BusOptions
from ethercat_server.virtual_sensor.sensor import VirtualSensor

_LONGEST_PERIOD_NS = 50_000_000


@dataclass(slots=True)
class Damage:
    """Frames that arrive corrupted at one port of one sensor."""

    sensor: VirtualSensor
    port: int
    """0: on the way out; 1: on the way back, from the sensor behind."""
    frames: int
    """How many more."""


class Bus:
    """Sensors in the order in which frames reach them. All times are in ns, on the caller's clock.

    Attributes:
        now: time of the latest call.
        lose: number of the next frames that are lost.
        deaf_until: no frame comes back before this time; None if the bus answers.
        deaf_after: number of frames after which the bus stops answering; None for never.
        damage: corruption of the next frames on the cable; None for none.
    """

    def __init__(self, options: BusOptions, now: int) -> None:
        """All sensors are switched on at `now`."""
        self.now = now
        self.sensors = [VirtualSensor(each, lambda: self.now) for each in options.sensors]
        self.lose = 0
        self.deaf_until: float | None = None
        self.deaf_after: int | None = None
        self.damage: Damage | None = None
        self.frames = self.frames_lost = 0
        self._power_events: list[tuple[int, VirtualSensor]] = []
        self._alive: list[Firmware] = []
        self._last_frame = 0
        self.rewire()

    def rewire(self) -> None:
        """A sensor was switched on or off: frames reach those before the first without power."""
        self._alive = []
        for sensor in self.sensors:
            if sensor.life is None:
                break
            self._alive.append(sensor.life)
        for life in self._alive:
            life.esc.set_ports(next_slave=life is not self._alive[-1])

    def set_time(self, now: int) -> None:
        """Let time pass up to `now`, with what is due meanwhile but the watchdogs: frames may be waiting."""
        while self._power_events and self._power_events[0][0] <= now:
            self.now, sensor = self._power_events.pop(0)
            sensor.power(True)
            self.rewire()
        self.now = now
        if self.deaf_until is not None and now >= self.deaf_until:
            self.deaf_until = None

    def power(self, sensor: VirtualSensor, on: bool, seconds: float | None = None) -> None:
        """Switch a sensor on or off; on again after `seconds` unless None."""
        self._power_events = [event for event in self._power_events if event[1] is not sensor]
        sensor.power(on)
        if seconds is not None:
            self._power_events.append((self.now + round(seconds * 1e9), sensor))
            self._power_events.sort(key=operator.itemgetter(0))
        self.rewire()

    def process(self, frame: bytearray, size: int, now: int) -> bool:
        """Pass the frame in the first `size` bytes of `frame`, in position; False if it does not come back.

        `now` is when it arrived.
        """
        datagrams = wire.parse(frame, size)
        if not datagrams:
            return False
        self.set_time(now)
        self.frames += 1
        if self.deaf_after is not None:
            self.deaf_after -= 1
            if self.deaf_after < 0:
                self.deaf_after, self.deaf_until = None, math.inf
        if self.deaf_until is not None or self.lose or not self._alive:
            self.lose = max(self.lose - 1, 0)
            self.frames_lost += 1
            return False
        position = self._damaged_at()
        for life in self._alive[:position]:
            for datagram in datagrams:
                execute(life.esc, frame, datagram)
        if position is not None:  # the network card of the master throws it away
            self.frames_lost += 1
            return False
        frame[wire.SOURCE_ADDRESS] |= wire.PROCESSED_BIT
        for sensor in self.sensors:
            while sensor.due:
                sensor.due.pop(0)()
        return True

    def exchange(self, frame: bytes, now: int) -> bytes | None:
        """The frame as it comes back from the bus; None if it is lost. Watchdogs expire before it arrives."""
        self.idle(now)
        answer = bytearray(frame)
        return bytes(answer) if self.process(answer, len(answer), now) else None

    def _damaged_at(self) -> int | None:
        """Count a corrupted frame in the error counters; how many sensors received it intact, None for all.

        The sensor that detects the error marks the frame; those it passes afterwards, on the way out at
        port 0 and on the way back at port 1, count it as forwarded.
        """
        damage = self.damage
        if damage is None or damage.sensor.life not in self._alive:
            return None
        damage.frames -= 1
        if damage.frames <= 0:
            self.damage = None
        position = self._alive.index(damage.sensor.life)
        self._alive[position].esc.count(reg.RX_ERRORS + 2 * damage.port)
        self._alive[position].esc.count(reg.RX_ERRORS + 2 * damage.port + 1)
        if damage.port == 1:
            back = self._alive[:position]
        else:
            for life in self._alive[position + 1 :]:
                life.esc.count(reg.FORWARDED_ERRORS)
            back = self._alive[:-1]
        for life in back:
            life.esc.count(reg.FORWARDED_ERRORS + 1)
        return len(self._alive) if damage.port == 1 else position

    def flap(self, sensor: VirtualSensor, port: int) -> None:
        """A link is lost and returns: the controllers at both ends count it."""
        position = self.sensors.index(sensor)
        ends = ((position, 0), (position - 1, 1)) if port == 0 else ((position, 1), (position + 1, 0))
        for end, its_port in ends:
            if 0 <= end < len(self._alive):
                self._alive[end].esc.count(reg.LOST_LINKS + its_port)

    def prepare(self) -> None:
        """All waiting frames are answered: check the watchdogs, and compute the next samples ahead.

        Those are the samples that the next frame will read if frames are periodic.
        """
        period = min(self.now - self._last_frame, _LONGEST_PERIOD_NS)
        expected = self.now + period
        self._last_frame = self.now
        for life in self._alive:
            life.check_watchdog(self.now)
            life.sampler.prepare(expected)

    def idle(self, now: int) -> None:
        """No frame is waiting: let time pass up to `now`, watchdogs included."""
        self.set_time(now)
        for life in self._alive:
            life.check_watchdog(now)

    def statistics(self) -> dict[str, Any]:
        """What the command `stats` reports."""
        return {
            "frames": self.frames,
            "frames_lost": self.frames_lost,
            "sensors": [sensor.statistics() for sensor in self.sensors],
        }
