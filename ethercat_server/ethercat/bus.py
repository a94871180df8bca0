"""The EtherCAT bus: who is on it, from the scan to OP, and how its process data is laid out.

Exchanges are `ProcessData`'s; single datagrams go between them (`Datagrams`). pysoem configures every slave
that it finds, so it is the master of a bus with sensors only. Beside other slaves only the sensors are
written to, and terminals: of the others is read which station and logical addresses they answer to, which
nobody else gets.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Sequence
from typing import Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import Backend, CheckInterrupt, Master
from ethercat_server.ethercat.datagrams import Answer, Datagrams, RegisterAccess, Steps, repeat
from ethercat_server.ethercat.exchange import Area, ProcessData, fit_a_frame, read_clock
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import Emergencies
from ethercat_server.ethercat.slave.controller import SlaveController
from ethercat_server.ethercat.slave.sii import Sii
from ethercat_server.sampling.observation import DistributedClock

_MOST_EMERGENCIES: Final = 16
_INIT_ATTEMPTS: Final = 5
_FIRST_STATION: Final = 0x1001
_LOGICAL_BYTES: Final = 0x10000  # of the logical address space for the sensors' process data
# Kind of the sync manager, the object with its PDOs, kind of the FMMU.
_ASSIGNMENTS: Final = (("outputs", 0x1C12, reg.FMMU_WRITE), ("inputs", 0x1C13, reg.FMMU_READ))


class Bus(Datagrams):
    """An EtherCAT bus through `backend`. Its sensors are numbered from 0. Used by one thread.

    Attributes:
        positions: where the sensors are on the wire, by number.
        slaves: their slave controllers.
        input_sizes: bytes of the inputs of each terminal, by position; to be set before the scan. As slaves
            terminals are numbered after the sensors.
        terminal_areas: these inputs in the logical address space.
        terminals: their slave controllers, and the AL states in which they are left.
        emergencies: their CoE emergency messages.
        process_data: the exchange, once they are mapped.
    """

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.emergencies = Emergencies(backend.clock)
        self.positions: list[int] = []
        self.slaves: list[SlaveController] = []
        self.input_sizes: dict[int, int] = {}
        self.terminal_areas: list[Area] = []
        self.terminals: list[tuple[SlaveController, AlState]] = []
        self.process_data = ProcessData((), backend)
        self._sii: Sequence[Sii | None] = ()  # of all slaves on the wire
        self._soem: Master | None = None

    def match(self, frame: bytes) -> Answer | None:
        """See `Datagrams`; it may answer an exchange."""
        return super().match(frame) if self.process_data.match(frame, 0) is None else None

    def scan(
        self,
        positions: Sequence[int],
        sii: Sequence[Sii | None],
        check_interrupt: CheckInterrupt,
        *,
        again: bool = False,
    ) -> None:
        """Number the sensors at these positions and take them to PREOP. `sii`: of every slave, theirs known.

        pysoem is the master where there are sensors only; other slaves are not written to. `again`: after a
        failure, without pysoem, which does not repeat lost frames.
        """
        shared = len(positions) < len(sii)
        self._soem = None if shared or again else self.backend.master
        self.positions, self._sii, self.slaves = list(positions), sii, []
        ours = [*positions, *self.input_sizes]
        if self._soem is not None:
            self._soem.scan(positions, check_interrupt)
        else:
            self.assign_stations(ours)
        self.stations = [
            int.from_bytes(self.read_surely_at(position, reg.STATION_ADDRESS, 2), "little")
            for position in ours
        ]
        for number, content in enumerate(self._sensors_sii()):
            mailboxes = content["mailboxes"]["out"], content["mailboxes"]["in"]
            slave = SlaveController(self, number, mailboxes, self.emergencies)
            self.slaves.append(slave)
            # SOEM has cleared it, and set its mailboxes up.
            steps = slave.enter_preop() if self._soem is None else slave.go(AlState.PREOP)
            self.finish(steps, check_interrupt)

    def scan_again(self, check_interrupt: CheckInterrupt) -> None:
        self.scan(self.positions, self._sii, check_interrupt, again=True)

    def map_process_data(self, check_interrupt: CheckInterrupt) -> list[int]:
        """Map the process data of all sensors, which are in PREOP; returns the bytes of each one's inputs."""
        for slave in self.slaves:  # pysoem takes an emergency that it meets in the mapping for a failure
            self.finish(slave.sdo.drain(_MOST_EMERGENCIES), check_interrupt)
        if self._soem is not None:
            self._soem.map_process_data(check_interrupt)
            for slave in self.slaves:
                slave.sdo.fall_out_of_step()
        else:
            logical = self._free_logical()
            for slave, content in zip(self.slaves, self._sensors_sii(), strict=True):
                logical = self.map(slave, content, logical, check_interrupt)
            ends = [*itertools.accumulate(self.input_sizes.values(), initial=logical)]
            self.terminal_areas = [Area(*span, reg.FMMU_READ) for span in itertools.pairwise(ends)]
        return [self.finish(slave.read_mapping()) for slave in self.slaves]

    def enter_op(self, check_interrupt: CheckInterrupt) -> None:
        """Take all sensors to OP, exchanging process data, without which they do not go there."""
        lrw = not any(slave.features & reg.NO_LRW for slave in self.slaves)
        for slave in self.slaves:
            if not fit_a_frame(slave.areas, lrw=lrw):
                raise slave.unmapped()
        stations = [
            self.stations[slave.number] if self.finish(slave.latch_events()) else None
            for slave in self.slaves
        ]
        areas = [slave.areas for slave in self.slaves]
        self.process_data = ProcessData(
            areas, self.backend, lrw=lrw, stations=stations, terminals=self.terminal_areas
        )
        self.finish(self._enter_op(), check_interrupt)
        for slave in self.slaves:
            slave.attempts = 1

    def _enter_op(self) -> Steps[None]:
        waiting = [slave.enter_op() for slave in self.slaves]
        while waiting:
            self.process_data.send()
            for steps in tuple(waiting):
                if (yield from _take_turn(steps)):
                    waiting.remove(steps)
            yield None

    def read_clock(self, number: int) -> Steps[DistributedClock | None]:
        """The clock of a sensor's controller, from now on read with its process data; None if it has none."""
        if (at := self.process_data.read_latched(number, reads=True)) is None:
            return None
        return (yield from read_clock(self, number, at))

    def close(self) -> None:
        """Take the sensors to INIT if they were scanned, and close the wire."""
        for number in range(len(self.stations)):
            init = AlState.INIT.request()
            self.finish(repeat(_INIT_ATTEMPTS, self.write_register, number, reg.AL_CONTROL, init))
        for slave, state in self.terminals:
            with contextlib.suppress(BusError):  # it has gone
                self.finish(slave.leave(state))
        self.stations, self.terminals = [], []
        self.backend.close()

    def assign_stations(self, positions: Sequence[int]) -> None:
        """Give the slaves at these positions station addresses that no slave answers to, nor by an alias."""
        taken: set[int] = set()
        for position in self._others():
            taken.update(struct.unpack("<HH", self.read_surely_at(position, reg.STATION_ADDRESS, 4)))
        for position in positions:
            taken.update(struct.unpack("<H", self.read_surely_at(position, reg.STATION_ALIAS, 2)))
        free = (station for station in range(_FIRST_STATION, 0xFFFF) if station not in taken)
        for position, station in zip(positions, free, strict=False):
            self.write_surely_at(position, reg.STATION_ADDRESS, station.to_bytes(2, "little"))

    def map(self, slave: SlaveController, content: Sii, logical: int, check_interrupt: CheckInterrupt) -> int:
        """Map a sensor's process data from a logical address on, as its PDO mapping says; returns its end."""
        managers = units = b""
        for kind, assignment, direction in _ASSIGNMENTS:
            row = next((row for row in content["sync_managers"] if row["kind"] == kind), None)
            size = row and self.finish(slave.mapped_size(assignment, row["size"]), check_interrupt)
            if not row or not size:
                managers += bytes(reg.SYNC_MANAGER_SIZE)
                continue
            managers += reg.pack_sync_manager(row["start"], size, row["control"])
            units += reg.FMMU_LAYOUT.pack(logical, size, 0, 7, row["start"], 0, direction, 1)
            logical += size
        self.finish(slave.map(managers, units.ljust(len(_ASSIGNMENTS) * reg.FMMU_SIZE, b"\0")))
        return logical

    def _free_logical(self) -> int:
        """The first logical address from which on no FMMU of the others is active."""
        taken: list[tuple[int, int]] = []
        for position in self._others():
            count = self.read_surely_at(position, reg.FMMU_AND_SM_COUNT, 1)[0]
            for at in range(min(count, reg.MOST_FMMUS)):
                unit = self.read_surely_at(position, reg.FMMU + at * reg.FMMU_SIZE, reg.FMMU_SIZE)
                start, length, *_, active = reg.FMMU_LAYOUT.unpack(unit)
                if active & 1:
                    taken.append((start, start + length))
        for base in sorted([0, *(end for _, end in taken)]):
            if all(end <= base or base + _LOGICAL_BYTES <= start for start, end in taken):
                return base
        raise BusError(f"the other devices on {self.ifname} map all logical addresses: power them off and on")

    def _others(self) -> list[int]:
        return [position for position in range(len(self._sii)) if position not in self.positions]

    def _sensors_sii(self) -> list[Sii]:
        return [content for at, content in enumerate(self._sii) if at in self.positions and content]


def _take_turn(steps: Steps[None]) -> Steps[bool]:
    """Let `steps` go on until they wait; whether they are at their end."""
    answer = None
    try:
        while isinstance(wanted := steps.send(answer), RegisterAccess):
            answer = yield wanted
    except StopIteration:
        return True
    return False
