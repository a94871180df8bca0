"""Single objects for clients: found by name, read, written, with the values that JSON can have."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Final

from bota_ethercat.control import MAX_SDO_BYTES, ErrorCode
from bota_ethercat.errors import RequestError
from bota_ethercat.sensor.sdo_types import SDO_TYPES, SdoType
from ethercat_server.errors import BusError, CutOffError, extended
from ethercat_server.ethercat.datagrams import Steps
from ethercat_server.ethercat.slave.coe import Sdo
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.objects.dictionary import ObjectEntry, find_objects, full_name
from ethercat_server.sensor.sensor import Sensor
from ethercat_server.sensor.set_up import read_offset

_MOST_NAMES: Final = 8


def read(sdo: Sdo, index: int, subindex: int, kind: SdoType | None) -> Steps[Mapping[str, Any]]:
    """An entry's bytes, and its value if it is of the type `kind`; RequestError if it cannot be."""
    data = yield from sdo.read(index, subindex)
    values: dict[str, Any] = {"index": index, "subindex": subindex, "hex": data.hex()}
    if kind is not None:
        try:
            values |= {"type": kind.name, "value": kind.unpack(data)}
        except ValueError as error:
            raise RequestError(
                ErrorCode.BAD_REQUEST, f"the key 'type' does not fit object 0x{index:04X}:{subindex}: {error}"
            ) from None
    return values


def entry_named(name: str) -> ObjectEntry:
    """The one entry that `name` names; RequestError if there is none, or more than one."""
    found = find_objects(name)
    if len(found) == 1:
        return found[0]
    parts = ", ".join(full_name(row) for row in found[:_MOST_NAMES])
    more = ", ..." if len(found) > _MOST_NAMES else ""
    many = f"{len(found)} objects: {parts}{more}" if found else "no object's"
    raise RequestError(ErrorCode.BAD_REQUEST, f"the key 'name' is {name!r}, which is {many}")


def read_named(sdo: Sdo, entry: ObjectEntry, kind: SdoType | None) -> Steps[Mapping[str, Any]]:
    """As `read`, for an entry of the dictionary, whose type is known."""
    if kind is None:
        kind = SDO_TYPES.get(entry.type.name.lower())
    found = yield from read(sdo, *entry.address, kind)
    return {"name": full_name(entry), **found}


def bytes_to_write(values: Mapping[str, Any]) -> bytes:
    """The bytes that a request `sdo_write` writes; RequestError if it is ambiguous or wrong."""
    kind: SdoType | None = values["type"]
    data: bytes | None = values["hex"]
    if (kind is None) == (data is None) or (kind is None) != (values["value"] is None):
        raise RequestError(
            ErrorCode.BAD_REQUEST, "sdo_write needs either the keys 'type' and 'value' or the key 'hex'"
        )
    if data is not None:
        return data
    assert kind is not None
    try:
        data = kind.pack(values["value"])
        if not 0 < len(data) <= MAX_SDO_BYTES:
            raise ValueError(f"1 to {MAX_SDO_BYTES} bytes")
    except ValueError as error:
        raise RequestError(ErrorCode.BAD_REQUEST, f"the key 'value' must be {error}") from None
    return data


def write(
    sdo: Sdo,
    sensor: Sensor,
    index: int,
    subindex: int,
    data: bytes,
    on_offset: Callable[[Sensor], object] = lambda _: None,
) -> Steps[Mapping[str, Any]]:
    """Write an entry; a setting or the offset is restored from now on when the sensor has lost it.

    `on_offset` is called before the offset is written, and after it.
    """
    is_offset = index == dictionary.FORCE_TORQUE_OFFSET
    if is_offset:
        sensor.offset_is_certain = False
        on_offset(sensor)
    try:
        yield from sdo.write(index, subindex, data)
    except CutOffError as error:
        sensor.change_interrupted = True
        raise extended(error, "; whether it took the value is not known") from None
    except BusError:
        if is_offset:
            with contextlib.suppress(BusError):  # the first error is the one to be told
                yield from _read_offset(sdo, sensor, on_offset)
        raise
    entry = dictionary.BY_ADDRESS.get((index, subindex))
    if entry is not None and entry.setting is not None:
        try:
            value = entry.decode_setting(data)
        except ValueError:
            value = None
        if value is not None:
            sensor.wanted = {**sensor.wanted, entry.setting: value}
            sensor.set_in_force({**sensor.settings, entry.setting: value})
    if is_offset:
        yield from _read_offset(sdo, sensor, on_offset)
    return {"index": index, "subindex": subindex, "hex": data.hex()}


def _read_offset(sdo: Sdo, sensor: Sensor, on_offset: Callable[[Sensor], object]) -> Steps[None]:
    sensor.offset, sensor.offset_is_certain = (yield from read_offset(sdo)), True
    on_offset(sensor)
