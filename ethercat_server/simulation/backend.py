"""The backend in memory (see `ethercat.backend`): virtual sensors on a simulated wire.

Frames are processed by `virtual_sensor.bus.SlaveChain` as those of a network interface are.
"""

from __future__ import annotations

import heapq
import random

from ethercat_server.ethercat.nic import CHECK_CABLE
from ethercat_server.ethercat.wire import BYTE_NS
from ethercat_server.simulation.machine import Machine, SimulatedClock
from ethercat_server.virtual_sensor import bus as virtual
from ethercat_server.virtual_sensor.distributed_clock import HOP_NS
from ethercat_server.virtual_sensor.faults import obey
from ethercat_server.virtual_sensor.options import SensorOptions, SlaveOptions


class MemoryBackend:
    """See `Backend`: virtual sensors, and foreign slaves, in wire order on a simulated machine."""

    master = None

    def __init__(self, *slaves: SlaveOptions, machine: Machine | None = None) -> None:
        self._machine = machine = machine or Machine()
        self._chance = random.Random(machine.seed + 1)
        self.ifname = "memory"
        self.clock = SimulatedClock(machine)
        self.sensors = virtual.SlaveChain(
            slaves or (SensorOptions(),), self.clock.now_ns, self.clock.monotonic_at
        )
        self._on_the_wire: list[tuple[int, int, bytes]] = []
        self._sent = 0
        self._free_at_ns = 0
        self._arrived_ns = 0

    def command(self, line: str) -> str:
        """Do what a fault command of the virtual sensor says, now; returns its answer."""
        self.sensors.set_time(self.clock.now_ns)
        return obey(self.sensors, line)

    def become(self, machine: Machine) -> None:
        self._machine = machine
        self.clock.become(machine)

    def open(self) -> None: ...

    def close(self) -> None: ...

    def check_present(self) -> None: ...

    def why_silent(self) -> str:
        return CHECK_CABLE

    def send(self, frame: bytes | bytearray) -> None:
        if (times := self.carry()) is None:
            return
        outward_ns, round_trip_ns = times
        answer, now_ns = bytearray(frame), self.clock.now_ns
        # On their way out frames queue up: none overtakes another.
        arrives_ns, passes_ns = max(now_ns + outward_ns, self._free_at_ns), len(frame) * BYTE_NS
        self._free_at_ns = arrives_ns + passes_ns
        self.sensors.idle(arrives_ns)  # the watchdogs have run meanwhile
        if self.sensors.process(answer, len(answer), arrives_ns):
            self._sent += 1
            hops_ns = 2 * HOP_NS * (len(self.sensors.slaves) - 1)
            back_ns = arrives_ns + passes_ns + hops_ns + round_trip_ns - outward_ns
            heapq.heappush(self._on_the_wire, (back_ns, self._sent, bytes(answer)))

    def carry(self) -> tuple[int, int] | None:
        """The next frame's times in ns until the slaves see it and until it is back; None if it is lost."""
        machine, chance = self._machine, self._chance
        if machine.lost and chance.random() < machine.lost:
            return None
        late_ns = machine.late_ns if machine.late and chance.random() < machine.late else 0.0
        delay_ns = chance.expovariate(1) * machine.frame_jitter_ns + late_ns
        if machine.even_jitter_ns:
            delay_ns += chance.random() * machine.even_jitter_ns
        # It may be held up on its way out, on its way back, or by a slave in between.
        return (
            round(machine.frame_ns / 2 + chance.random() * delay_ns),
            round(machine.frame_ns + delay_ns),
        )

    def put_on_the_wire(self, frame: bytes) -> None:
        """Have a frame of somebody else arrive now."""
        self._sent += 1
        heapq.heappush(self._on_the_wire, (self.clock.now_ns, self._sent, frame))

    def receive(self, timeout_s: float) -> bytes | None:
        clock, until_ns = self.clock, self.clock.after(max(timeout_s, 0))
        if self._on_the_wire and self._on_the_wire[0][0] <= until_ns:
            arrives_ns, _, frame = heapq.heappop(self._on_the_wire)
            clock.advance(arrives_ns)
            self._arrived_ns = arrives_ns
            return frame
        if timeout_s > 0:  # a look does not go to sleep
            clock.wake_at(until_ns)
        return None

    def arrived_ns(self) -> int:
        waited_ns = self.clock.monotonic_at(self.clock.now_ns) - self.clock.monotonic_at(self._arrived_ns)
        return self.clock.now_ns - waited_ns
