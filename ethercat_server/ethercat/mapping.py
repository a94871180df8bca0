"""Numbers and maps sensors by single datagrams, on a wire that they share with other devices.

SOEM configures every slave that it finds. Here only the sensors are written to: of the others is read which
station and logical addresses they answer to, so that the sensors get none of these.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

from ethercat_server.errors import BusError, SdoAbortError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.datagrams import Datagrams
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.coe import finish
from ethercat_server.ethercat.slave.controller import SlaveController
from ethercat_server.ethercat.slave.sii import Sii

_FIRST_STATION: Final = 0x1001
_LOGICAL_BYTES: Final = 0x10000  # of the logical address space for the sensors' process data
# Kind of the sync manager, the object with its PDOs, kind of the FMMU.
_ASSIGNMENTS: Final = (("outputs", 0x1C12, reg.FMMU_WRITE), ("inputs", 0x1C13, reg.FMMU_READ))
_MOST_BYTES: Final = 1486
_MOST_SUBINDEX, _MOST_INDEX, _MOST_ENTRY = 0xFF, 0xFFFF, 0xFFFFFFFF


def assign_stations(bus: Datagrams, sensors: Sequence[int], others: Sequence[int]) -> None:
    """Give the sensors at these positions station addresses that nobody answers to: no slave's, no alias."""
    taken: set[int] = set()
    for position in others:
        taken.update(struct.unpack("<HH", bus.read_surely_at(position, reg.STATION_ADDRESS, 4)))
    for position in sensors:
        taken.update(struct.unpack("<H", bus.read_surely_at(position, reg.STATION_ALIAS, 2)))
    free = (station for station in range(_FIRST_STATION, 0xFFFF) if station not in taken)
    for position, station in zip(sensors, free, strict=False):
        bus.write_surely_at(position, reg.STATION_ADDRESS, station.to_bytes(2, "little"))


def map_process_data(
    sensors: Sequence[SlaveController], sii: Sequence[Sii], logical: int, check_interrupt: CheckInterrupt
) -> None:
    """Map the process data of the sensors from a logical address on, as their PDO mapping says."""
    for sensor, content in zip(sensors, sii, strict=True):
        managers = units = b""
        for kind, assignment, direction in _ASSIGNMENTS:
            row = next((row for row in content["sync_managers"] if row["kind"] == kind), None)
            size = 0
            if row is not None:
                size = _mapped_size(sensor, assignment, row["size"], check_interrupt)
            if row is None or not size:
                managers += bytes(reg.SYNC_MANAGER_SIZE)
                continue
            managers += reg.pack_sync_manager(row["start"], size, row["control"])
            units += reg.FMMU_LAYOUT.pack(logical, size, 0, 7, row["start"], 0, direction, 1)
            logical += size
        sensor.map(managers, units.ljust(len(_ASSIGNMENTS) * reg.FMMU_SIZE, b"\0"))


def _mapped_size(
    sensor: SlaveController, assignment: int, in_sii: int, check_interrupt: CheckInterrupt
) -> int:
    """Bytes of process data by the PDO mapping; by the SII if there are no such objects."""

    def read(index: int, subindex: int, most: int) -> int:
        data = finish(
            sensor.sdo.read(index, subindex), clock=sensor.sdo.clock, check_interrupt=check_interrupt
        )
        if (value := int.from_bytes(data, "little")) > most:
            raise BusError(
                f"sensor {sensor.number} has {value:#x} in object 0x{index:04X}:{subindex}, which cannot be: "
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
                        f"sensor {sensor.number} maps more than {_MOST_BYTES} bytes of process data, which "
                        "fit no frame: power it off and on"
                    )
    except SdoAbortError:
        return in_sii
    return (bits + 7) // 8


def free_logical(bus: Datagrams, others: Sequence[int]) -> int:
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
