"""The backend in memory (see `ethercat.backend`): a master for virtual sensors, over a simulated wire.

Frames are processed by `virtual_sensor.bus.Bus` as those of a network interface are. The master does what
SOEM does, by datagrams, and no more than a bus of Bota sensors needs.
"""

from __future__ import annotations

import functools
import heapq
import struct
from collections.abc import Callable
from typing import Any, Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import CheckInterrupt, SlaveIdentity
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.nic.interface import CHECK_CABLE
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave import sii_content
from ethercat_server.ethercat.slave.al import AlState, AlStatus
from ethercat_server.ethercat.slave.coe import MailboxSdo, finish
from ethercat_server.ethercat.slave.sii import OF_FIRMWARE, ByPosition, read_sii
from ethercat_server.ethercat.wire import Command, build
from ethercat_server.simulation.machine import Machine, SimulatedClock, Wire
from ethercat_server.virtual_sensor import bus as virtual
from ethercat_server.virtual_sensor.faults.table import obey
from ethercat_server.virtual_sensor.options import BusOptions, SensorOptions

_FIRST_STATION: Final = 0x1001
_PROBES: Final = 5
_STATE_TIMEOUT_S: Final = 10.0
_PAUSE_S: Final = 0.001
_ACKNOWLEDGE: Final = 0x10
_FMMU: Final = struct.Struct("<IHBBHBBB3x")
_SYNC_MANAGER: Final = struct.Struct("<HHBBBB")
_WRITE, _READ = 2, 1


class MemoryBackend:
    """See `Backend`: a chain of virtual sensors on a simulated machine."""

    def __init__(self, *sensors: SensorOptions, machine: Machine | None = None) -> None:
        machine = machine or Machine()
        self.ifname = "memory"
        self.clock = SimulatedClock(machine)
        self.wire = Wire(machine)
        self.sensors = virtual.Bus(BusOptions(sensors or (SensorOptions(),)), self.clock.now_ns)
        self._on_the_wire: list[tuple[int, int, bytes]] = []
        self._sent = 0
        self._bus: Bus
        self._images: list[dict[str, Any]] = []
        self._sdos: list[MailboxSdo] = []

    def command(self, line: str) -> str:
        """Do what a fault command of the virtual sensor says, now; returns its answer."""
        self.sensors.set_time(self.clock.now_ns)
        return obey(self.sensors, line)

    def become(self, machine: Machine) -> None:
        """Run on this machine from now on."""
        self.clock.become(machine)
        self.wire.become(machine)

    def open(self) -> None:
        """See `Backend`."""

    def close(self) -> None:
        """See `Backend`."""
        for position in range(len(self._images)):
            self._bus.write_register(position, reg.AL_CONTROL, AlState.INIT.request())
        self._images = []

    def check_present(self) -> None:
        """See `Backend`."""

    def why_silent(self) -> str:
        """See `Backend`."""
        return CHECK_CABLE

    def send(self, frame: bytes | bytearray) -> None:
        """See `Backend`."""
        if (times := self.wire.carry()) is None:
            return
        outward_ns, round_trip_ns = times
        answer, now_ns = bytearray(frame), self.clock.now_ns
        arrives_ns = now_ns + outward_ns
        self.sensors.idle(arrives_ns)  # the watchdogs have run meanwhile
        if self.sensors.process(answer, len(answer), arrives_ns):
            self._sent += 1
            heapq.heappush(self._on_the_wire, (now_ns + round_trip_ns, self._sent, bytes(answer)))

    def receive(self, timeout_s: float) -> bytes | None:
        """See `Backend`."""
        clock, until_ns = self.clock, self.clock.now_ns + round(max(timeout_s, 0) * 1e9)
        if self._on_the_wire and self._on_the_wire[0][0] <= until_ns:
            arrives_ns, _, frame = heapq.heappop(self._on_the_wire)
            clock.advance(arrives_ns)
            return frame
        clock.wake_at(until_ns)
        return None

    # -- the master

    def scan(self, check_interrupt: CheckInterrupt) -> list[SlaveIdentity]:
        """See `Backend`."""
        check_interrupt()
        self._bus = bus = Bus(self)
        slaves = max(bus.count_slaves(2, _PAUSE_S) for _ in range(_PROBES))
        if slaves <= 0:
            raise BusError(f"no EtherCAT slave answers on {self.ifname}")
        bus.stations = [_FIRST_STATION + position for position in range(slaves)]
        self._images, self._sdos, found = [], [], []
        for position, station in enumerate(bus.stations):
            self._surely(functools.partial(bus.write_at, position, reg.STATION_ADDRESS, _u16(station)))
            self._write(position, reg.AL_CONTROL, _u16(AlState.INIT | _ACKNOWLEDGE))
            image = sii_content.decode(self._read_image(position))
            out, back = (tuple(image["mailboxes"][way]) for way in ("out", "in"))
            managers = _SYNC_MANAGER.pack(*out, 0x26, 0, 1, 0) + _SYNC_MANAGER.pack(*back, 0x22, 0, 1, 0)
            self._write(position, reg.SYNC_MANAGER, managers)
            self._write(position, reg.SII_OWNER, OF_FIRMWARE)
            self._write(position, reg.AL_CONTROL, AlState.PREOP.request())
            self._images.append(image)
            self._sdos.append(MailboxSdo(bus, position, (out, back)))
            found.append(SlaveIdentity(*(image[key] for key in ("vendor", "product", "revision", "name"))))
        return found

    def check_preop(self, check_interrupt: CheckInterrupt) -> None:
        """See `Backend`."""
        self._wait_state(AlState.PREOP, check_interrupt)

    def sdo_read(self, slave: int, index: int, subindex: int) -> bytes:
        """See `Backend`."""
        return finish(self._sdos[slave].read(index, subindex), clock=self.clock)

    def sdo_write(self, slave: int, index: int, subindex: int, data: bytes) -> None:
        """See `Backend`."""
        finish(self._sdos[slave].write(index, subindex, data), clock=self.clock)

    def map_process_data(self) -> list[int]:
        """See `Backend`. All outputs first, then all inputs, as SOEM has them."""
        sizes, outputs, inputs = [], 0, len(self._images)
        for position, image in enumerate(self._images):
            rows = [row for row in image["sync_managers"] if row["kind"] in ("outputs", "inputs")]
            managers = b"".join(
                _SYNC_MANAGER.pack(row["start"], row["size"], row["control"], 0, 1, 0) for row in rows
            )
            out, back = rows
            units = _fmmu(outputs, out, _WRITE) + _fmmu(inputs, back, _READ)
            self._write(position, reg.SYNC_MANAGER + 2 * reg.SYNC_MANAGER_SIZE, managers)
            self._write(position, reg.FMMU, units)
            self._write(position, reg.AL_CONTROL, AlState.SAFEOP.request())
            outputs, inputs = outputs + out["size"], inputs + back["size"]
            sizes.append(back["size"])
        self._image_size = inputs
        return sizes

    def go_operational(self, check_interrupt: CheckInterrupt) -> None:
        """See `Backend`."""
        self._wait_state(AlState.SAFEOP, check_interrupt)
        for position in range(len(self._images)):
            self._write(position, reg.AL_CONTROL, AlState.OP.request())
        self._wait_state(AlState.OP, check_interrupt)

    def _wait_state(self, state: AlState, check_interrupt: CheckInterrupt) -> None:
        deadline = Deadline(self.clock, _STATE_TIMEOUT_S)
        for position in range(len(self._images)):
            while True:
                check_interrupt()
                if state is AlState.OP:  # a slave goes there only while it gets process data
                    self.send(build((Command.LRW, 0, 0, bytes(self._image_size))))
                status = AlStatus.parse(self._bus.read_surely(position, reg.AL_STATUS, reg.AL_STATUS_SIZE))
                if status.raw_state >= state and not status.error:
                    break
                if status.error or deadline.passed:
                    raise BusError(f"sensor {position} does not reach {state.name}: it stays in {status}")
                self.clock.sleep(_PAUSE_S)

    def _write(self, position: int, address: int, data: bytes) -> None:
        self._surely(functools.partial(self._bus.write_register, position, address, data))

    def _surely(self, write: Callable[[], bool]) -> None:
        if not any(write() for _ in range(_PROBES)):
            raise BusError("a slave stopped answering: check cable and power")

    def _read_image(self, position: int) -> bytes:
        registers = ByPosition(self._bus)

        def read(word: int, words: int) -> bytes:
            return finish(read_sii(registers, position, word, words), clock=self.clock)

        return sii_content.read_image(read)


def _u16(value: int) -> bytes:
    return value.to_bytes(2, "little")


def _fmmu(logical: int, sync_manager: dict[str, Any], kind: int) -> bytes:
    return _FMMU.pack(logical, sync_manager["size"], 0, 7, sync_manager["start"], 0, kind, 1)
