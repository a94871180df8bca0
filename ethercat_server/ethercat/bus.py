"""The EtherCAT bus: who is on it, from the scan to OP, and how its process data is laid out.

Exchanges are `ProcessData`'s; single datagrams go between them (`Datagrams`).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

from ethercat_server.errors import SetUpError
from ethercat_server.ethercat.backend import Backend, CheckInterrupt, Master
from ethercat_server.ethercat.datagrams import Datagrams
from ethercat_server.ethercat.exchange.distributed_clock import DistributedClock, latch_events, read_clock
from ethercat_server.ethercat.exchange.frames import Area, fit_a_frame
from ethercat_server.ethercat.exchange.process_data import ProcessData
from ethercat_server.ethercat.mailbox.emergencies import Emergencies
from ethercat_server.ethercat.slave import registers as reg

_U16: Final = struct.Struct("<H")
_SYNC_MANAGER: Final = struct.Struct("<2xHBxBx")
"""Length, control, activation."""


class Bus(Datagrams):
    """An EtherCAT bus through `backend`. Its sensors are numbered from 0. Used by one thread."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.master: Master
        """Whoever scanned it."""
        self.spare: Master
        """Who scans it again if that went wrong: one that repeats what lost frames spoil."""
        self._is_scanned = False
        self.emergencies = Emergencies(backend.clock)
        """What the sensors report unasked."""
        self.positions: list[int] = []
        """Where the sensors are on the wire: by number, as everything below."""
        self.fmmus: list[bytes] = []
        """FMMU registers as they must be in OP."""
        self.process_data = ProcessData((), backend)
        """The exchange, once the sensors are mapped."""

    def next_on_wire(self, until_ns: int) -> bytes | None:
        """The next frame that arrives before `until_ns` and carries no process data; None if none does."""
        while (frame := super().next_on_wire(until_ns)) is not None:
            if self.process_data.take(frame, 0) is None:
                return frame
        return None

    # -- until OP

    def scan(self, master: Master, positions: Sequence[int], check_interrupt: CheckInterrupt) -> None:
        """Number the sensors at these positions and have `master` take them to PREOP."""
        self.master, self._is_scanned = master, True
        master.scan(positions, check_interrupt)
        self.positions = list(positions)
        self.stations = [
            _U16.unpack(self.read_surely_at(position, reg.STATION_ADDRESS, 2))[0] for position in positions
        ]
        master.enter_preop(check_interrupt)

    def go_operational(self, check_interrupt: CheckInterrupt) -> None:
        """Take every sensor from SAFEOP to OP; BusError names one that refuses."""
        self._lay_out_exchange()
        self.master.go_operational(check_interrupt)

    def close(self) -> None:
        """Take the sensors to INIT if they were scanned, and close the wire."""
        if self._is_scanned:
            self._is_scanned = False
            self.master.release()
        self.backend.close()

    def read_clock(self, number: int) -> DistributedClock | None:
        """The clock of a sensor's controller, from now on read with its process data; None if it has none."""
        if (at := self.process_data.read_latched(number, reads=True)) is None:
            return None
        return read_clock(self, number, at)

    def _lay_out_exchange(self) -> None:
        """Read from the FMMUs which logical addresses are whose process data."""
        areas: list[list[Area]] = []
        self.fmmus = []
        features = [self._features(number) for number in range(len(self.stations))]
        lrw = not any(each & reg.NO_LRW for each in features)
        latching: list[int | None] = []
        for number in range(len(self.stations)):
            count = min(self.read_surely(number, reg.FMMU_AND_SM_COUNT, 2)[0], reg.MOST_FMMUS)
            self.fmmus.append(self.read_surely(number, reg.FMMU, count * reg.FMMU_SIZE))
            rows = (reg.FMMU_LAYOUT.unpack_from(self.fmmus[-1], at * reg.FMMU_SIZE) for at in range(count))
            areas.append([Area(row[0], row[0] + row[1], row[6]) for row in rows if row[7] & 1])
            kinds, managers = {area.kind for area in areas[-1]}, self._sync_managers(number)
            if kinds != managers.keys() or reg.FMMU_READ not in kinds or not fit_a_frame(areas[-1], lrw=lrw):
                # SOEM writes them once, and does not look whether that worked.
                raise SetUpError(f"sensor {number} did not answer when it was mapped: check cable and power")
            latches = features[number] & reg.DC_AVAILABLE and latch_events(
                self, number, managers[reg.FMMU_READ]
            )
            latching.append(self.stations[number] if latches else None)
        self.process_data = ProcessData(areas, self.backend, lrw=lrw, stations=latching)

    def _features(self, number: int) -> int:
        """What the slave controller of a sensor can do."""
        return int(_U16.unpack(self.read_surely(number, reg.FEATURES, 2))[0])

    def _sync_managers(self, number: int) -> dict[int, int]:
        """Which sync manager of a sensor has its inputs, its outputs: by the kind of their FMMUs."""
        count = min(self.read_surely(number, reg.FMMU_AND_SM_COUNT, 2)[1], reg.MOST_SYNC_MANAGERS)
        data = self.read_surely(number, reg.SYNC_MANAGER, count * reg.SYNC_MANAGER_SIZE)
        rows = [_SYNC_MANAGER.unpack_from(data, at * reg.SYNC_MANAGER_SIZE) for at in range(count)]
        return {
            reg.FMMU_WRITE if control & reg.SM_WRITE else reg.FMMU_READ: at
            for at, (length, control, active) in enumerate(rows)
            if length and active & 1 and not control & reg.SM_MAILBOX
        }
