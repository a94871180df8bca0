"""A master by single datagrams, for the sensors on a wire that they share with other devices.

SOEM configures every slave that it finds. This one writes to the sensors only: of the others it reads which
station and logical addresses they answer to, so that the sensors get none of these.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Final, TypeVar

from ethercat_server.errors import BusError, SdoAbortError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.mailbox.mailbox import Mailbox
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import MailboxSdo, Steps, finish
from ethercat_server.ethercat.slave.sii import OF_FIRMWARE
from ethercat_server.ethercat.slave.sii_content import Sii
from ethercat_server.ethercat.slave.states import StateMachine

T = TypeVar("T")
_FIRST_STATION: Final = 0x1001
_ATTEMPTS: Final = 20
_PAUSE_S: Final = 0.001
_LOGICAL_BYTES: Final = 0x10000
"""Of the logical address space for the sensors' process data."""
_MAILBOXES: Final = ((reg.SM_CONTROL_MAILBOX_OUT, "out"), (reg.SM_CONTROL_MAILBOX_IN, "in"))
_ASSIGNMENTS: Final = (("outputs", 0x1C12, reg.FMMU_WRITE), ("inputs", 0x1C13, reg.FMMU_READ))
"""Kind of the sync manager, the object with its PDOs, kind of the FMMU."""
_MOST_BYTES: Final = 1486
_MOST_SUBINDEX, _MOST_INDEX, _MOST_ENTRY = 0xFF, 0xFFFF, 0xFFFFFFFF


class DatagramMaster:
    """See `Master`. `sii`: the content of the SII of every slave on the wire, by position."""

    def __init__(self, bus: Bus, sii: Sequence[Sii | None]) -> None:
        self._bus = bus
        self._all = sii
        self._sii: list[Sii] = []
        """Of the sensors, by number."""
        self._states: list[StateMachine] = []
        self._sdos: list[MailboxSdo | None] = []
        self._logical = 0

    def scan(self, positions: Sequence[int], check_interrupt: CheckInterrupt) -> None:
        """See `Master`."""
        others = [position for position in range(len(self._all)) if position not in positions]
        self._logical = _free_logical(self._bus, others)
        free = _free_stations(self._bus, others, positions)
        self._sii, self._states, self._sdos = [], [], []
        for position, station in zip(positions, free, strict=False):
            check_interrupt()
            content = self._all[position]
            assert content is not None, "a sensor is known by its SII"
            self._bus.write_surely_at(position, reg.STATION_ADDRESS, station.to_bytes(2, "little"))
            self._sii.append(content)

    def enter_preop(self, check_interrupt: CheckInterrupt) -> None:
        """See `Master`."""
        for number, content in enumerate(self._sii):
            states = StateMachine(self._bus, number, _ATTEMPTS)
            self._states.append(states)
            self._run(states.go(AlState.INIT), check_interrupt)
            self._clear(states, number)
            rows = [(*content["mailboxes"][way], control) for control, way in _MAILBOXES]
            out, back = (row[:2] for row in rows)
            has_mailbox = out[1] > 0
            self._sdos.append(MailboxSdo(Mailbox(self._bus, number, (out, back))) if has_mailbox else None)
            managers = b"".join(reg.pack_sync_manager(*row) for row in rows)
            states.write(reg.SYNC_MANAGER, managers)
            states.write(reg.SII_OWNER, OF_FIRMWARE)  # a slave reads its SII on the way to PREOP
            self._run(states.go(AlState.PREOP), check_interrupt)

    def _clear(self, states: StateMachine, number: int) -> None:
        """Clear what the master before may have used and this one does not: FMMUs, sync managers, SYNC0."""
        units, managers = self._bus.read_surely(number, reg.FMMU_AND_SM_COUNT, 2)
        if units:
            states.write(reg.FMMU, bytes(min(units, reg.MOST_FMMUS) * reg.FMMU_SIZE))
        if managers:
            count = min(managers, reg.MOST_SYNC_MANAGERS)
            states.write(reg.SYNC_MANAGER, bytes(count * reg.SYNC_MANAGER_SIZE))
        self._bus.write_register(number, reg.DC_ACTIVATION, b"\0\0")  # a controller without DC refuses

    def sdo_read(self, number: int, index: int, subindex: int) -> bytes:
        """See `Master`."""
        return self._run(self._sdo(number).read(index, subindex))

    def sdo_write(self, number: int, index: int, subindex: int, data: bytes) -> None:
        """See `Master`."""
        self._run(self._sdo(number).write(index, subindex, data))

    def map_process_data(self, check_interrupt: CheckInterrupt) -> list[int]:
        """See `Master`."""
        sizes, logical = [], self._logical
        for number, states in enumerate(self._states):
            check_interrupt()
            managers = units = b""
            found = dict.fromkeys((kind for kind, _, _ in _ASSIGNMENTS), 0)
            for kind, assignment, direction in _ASSIGNMENTS:
                row = next((row for row in self._sii[number]["sync_managers"] if row["kind"] == kind), None)
                size = 0
                if row is not None:
                    size = self._mapped_size(number, assignment, row["size"], check_interrupt)
                if row is None or not size:
                    managers += bytes(reg.SYNC_MANAGER_SIZE)
                    continue
                managers += reg.pack_sync_manager(row["start"], size, row["control"])
                units += reg.FMMU_LAYOUT.pack(logical, size, 0, 7, row["start"], 0, direction, 1)
                logical, found[kind] = logical + size, size
            states.write(reg.SYNC_MANAGER + 2 * reg.SYNC_MANAGER_SIZE, managers)
            states.write(reg.FMMU, units.ljust(len(_ASSIGNMENTS) * reg.FMMU_SIZE, b"\0"))
            sizes.append(found["inputs"])
        for states in self._states:
            self._run(states.go(AlState.SAFEOP), check_interrupt)
        return sizes

    def go_operational(self, check_interrupt: CheckInterrupt) -> None:
        """See `Master`. A slave goes there only while it gets process data."""
        bus = self._bus
        waiting = [states.go(AlState.OP) for states in self._states]
        while waiting:
            check_interrupt()
            bus.process_data.send()
            waiting = [steps for steps in waiting if not _is_done(steps)]
            bus.clock.sleep(_PAUSE_S)

    def release(self) -> None:
        """See `Master`."""
        for number in range(len(self._bus.stations)):
            any(
                self._bus.write_register(number, reg.AL_CONTROL, AlState.INIT.request())
                for _ in range(_ATTEMPTS)
            )

    def _sdo(self, number: int) -> MailboxSdo:
        sdo = self._sdos[number]
        if sdo is None:
            raise BusError(f"sensor {number} has no mailbox, and so no objects")
        return sdo

    def _mapped_size(self, number: int, assignment: int, in_sii: int, check_interrupt: CheckInterrupt) -> int:
        """Bytes of process data according to the PDO mapping; to the SII if there are no such objects."""

        def read(index: int, subindex: int, most: int) -> int:
            data = self._run(self._sdo(number).read(index, subindex), check_interrupt)
            if (value := int.from_bytes(data, "little")) > most:
                raise BusError(
                    f"sensor {number} has {value:#x} in object 0x{index:04X}:{subindex}, which cannot be: "
                    "power it off and on"
                )
            return value

        bits = 0
        try:
            for at in range(1, 1 + read(assignment, 0, _MOST_SUBINDEX)):
                pdo = read(assignment, at, _MOST_INDEX)
                for entry in range(1, 1 + read(pdo, 0, _MOST_SUBINDEX)):
                    bits += read(pdo, entry, _MOST_ENTRY) & 0xFF
                    if bits > 8 * _MOST_BYTES:
                        raise BusError(
                            f"sensor {number} maps more than {_MOST_BYTES} bytes of process data, which fit "
                            "no frame: power it off and on"
                        )
        except SdoAbortError:
            return in_sii
        return (bits + 7) // 8

    def _run(self, steps: Steps[T], check_interrupt: CheckInterrupt = lambda: None) -> T:
        return finish(steps, _PAUSE_S, self._bus.clock, check_interrupt)


def _is_done(steps: Steps[None]) -> bool:
    try:
        next(steps)
    except StopIteration:
        return True
    return False


def _free_stations(bus: Bus, others: Sequence[int], sensors: Sequence[int]) -> Iterator[int]:
    """Station addresses that nobody answers to: another slave's configured address, or any alias."""
    taken: set[int] = set()
    for position in others:
        taken.update(struct.unpack("<HH", bus.read_surely_at(position, reg.STATION_ADDRESS, 4)))
    for position in sensors:
        taken.update(struct.unpack("<H", bus.read_surely_at(position, reg.STATION_ALIAS, 2)))
    return (station for station in range(_FIRST_STATION, 0xFFFF) if station not in taken)


def _free_logical(bus: Bus, others: Sequence[int]) -> int:
    """The first logical address from which on no FMMU of the others is active."""
    taken: list[tuple[int, int]] = []
    for position in others:
        count = bus.read_surely_at(position, reg.FMMU_AND_SM_COUNT, 1)[0]
        for at in range(min(count, reg.MOST_FMMUS)):
            unit = bus.read_surely_at(position, reg.FMMU + at * reg.FMMU_SIZE, reg.FMMU_SIZE)
            row: tuple[int, ...] = reg.FMMU_LAYOUT.unpack(unit)
            if row[-1] & 1:
                taken.append((row[0], row[0] + row[1]))
    for base in sorted([0, *(end for _, end in taken)]):
        if all(end <= base or base + _LOGICAL_BYTES <= start for start, end in taken):
            return base
    raise BusError(f"the other devices on {bus.ifname} map all logical addresses: power them off and on")
