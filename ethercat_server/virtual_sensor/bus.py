"""A chain of virtual sensors: a frame passes through all of them, first to last, and comes back.

No sockets: bytes in, bytes out, with the time handed in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ethercat_server.virtual_sensor import registers as reg
from ethercat_server.virtual_sensor import wire
from ethercat_server.virtual_sensor.commands import execute
from ethercat_server.virtual_sensor.firmware import Firmware
from ethercat_server.virtual_sensor.options import BusOptions
from ethercat_server.virtual_sensor.sensor import VirtualSensor

_LONGEST_PERIOD_NS = 50_000_000


@dataclass(slots=True)
class Damage:
    """Frames that arrive damaged at one port of one sensor."""

    sensor: VirtualSensor
    port: int
    """0: on the way out; 1: on the way back, from the sensor behind."""
    frames: int
    """How many more."""


class Bus:
    """Sensors in the order in which frames reach them.

    Attributes:
        lose: so many frames more will be lost.
        deaf_until: no frame comes back before this time (ns); None for not at all deaf.
        deaf_after: deaf for ever after so many frames more; None for never.
        damage: what is to happen to the next frames on the cable; None for nothing.
    """

    def __init__(self, options: BusOptions, now: int) -> None:
        self.now = now
        self.sensors = [VirtualSensor(each, now) for each in options.sensors]
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
        """Power or place of a sensor changed: see who is still reached."""
        self._alive = []
        for sensor in self.sensors:
            if sensor.life is None:
                break
            self._alive.append(sensor.life)
        for life in self._alive:
            life.esc.set_ports(next_slave=life is not self._alive[-1])

    def set_time(self, now: int) -> None:
        """It is `now`, CLOCK_MONOTONIC in ns."""
        self.now = now
        if self.deaf_until is not None and now >= self.deaf_until:
            self.deaf_until = None
        for due, sensor in list(self._power_events):
            if now >= due:
                self._power_events.remove((due, sensor))
                sensor.set_time(now)
                sensor.power(True)
                self.rewire()
        for sensor in self.sensors:
            sensor.set_time(now)

    def power(self, sensor: VirtualSensor, on: bool, seconds: float | None = None) -> None:
        """Switch a sensor off or on; if off, on again by itself after `seconds`."""
        self._power_events = [event for event in self._power_events if event[1] is not sensor]
        sensor.power(on)
        if seconds is not None:
            self._power_events.append((self.now + round(seconds * 1e9), sensor))
        self.rewire()

    def process(self, frame: bytearray, size: int, now: int) -> bool:
        """Let the frame in the first `size` bytes of `frame` pass; False if it does not come back.

        `now` is when it arrived, CLOCK_MONOTONIC in ns.
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
        place = self._damaged_at()
        for life in self._alive[:place]:
            for datagram in datagrams:
                execute(life.esc, frame, datagram)
        if place is not None:  # the network card of the master throws it away
            self.frames_lost += 1
            return False
        frame[wire.SOURCE_ADDRESS] |= wire.PROCESSED_BIT
        for sensor in self.sensors:
            while sensor.due:
                sensor.due.pop(0)()
        return True

    def _damaged_at(self) -> int | None:
        """Count what a damaged frame makes the controllers count; how many sensors got it whole, None: all.

        The one that finds it damaged marks it; those it then passes, on the way out at port 0 and on the way
        back at port 1, count it as forwarded.
        """
        damage = self.damage
        if damage is None or damage.sensor.life not in self._alive:
            return None
        damage.frames -= 1
        if damage.frames <= 0:
            self.damage = None
        place = self._alive.index(damage.sensor.life)
        self._alive[place].esc.count(reg.RX_ERRORS + 2 * damage.port)
        self._alive[place].esc.count(reg.RX_ERRORS + 2 * damage.port + 1)
        if damage.port == 1:
            back = self._alive[:place]
        else:
            for life in self._alive[place + 1 :]:
                life.esc.count(reg.FORWARDED_ERRORS)
            back = self._alive[:-1]
        for life in back:
            life.esc.count(reg.FORWARDED_ERRORS + 1)
        return len(self._alive) if damage.port == 1 else place

    def flap(self, sensor: VirtualSensor, port: int) -> None:
        """The link at a port goes away and comes back: the controllers at both its ends count it."""
        place = self.sensors.index(sensor)
        ends = ((place, 0), (place - 1, 1)) if port == 0 else ((place, 1), (place + 1, 0))
        for end, its_port in ends:
            if 0 <= end < len(self._alive):
                self._alive[end].esc.count(reg.LOST_LINKS + its_port)

    def prepare(self) -> None:
        """The frames that waited are answered: look at the watchdogs, and work ahead.

        Makes the samples that the next frame will want if frames keep their period.
        """
        period = min(self.now - self._last_frame, _LONGEST_PERIOD_NS)
        expected = self.now + period
        self._last_frame = self.now
        for life in self._alive:
            life.check_watchdog(self.now)
            life.sampler.prepare(expected)

    def idle(self, now: int) -> None:
        """No frame is waiting: let time pass for watchdogs and power."""
        self.set_time(now)
        for life in self._alive:
            life.check_watchdog(now)

    def statistics(self) -> dict[str, Any]:
        """What `stats` says."""
        return {
            "frames": self.frames,
            "frames_lost": self.frames_lost,
            "sensors": [sensor.statistics() for sensor in self.sensors],
        }
