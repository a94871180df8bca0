"""`objects`: every object of the dictionary, read and decoded; what cannot be read, and why."""

from __future__ import annotations

import argparse
import struct
from typing import Any, Final

from ethercat_server.errors import OBJECT_MISSING, SdoAbortError
from ethercat_server.known_objects import KNOWN_OBJECTS
from ethercat_server.objects import FACTORY_CALIBRATION, ObjectEntry
from ethercat_server.sdo import Sdo, Steps, finish
from ethercat_server.tool.command import DONE, Command, add_link_arguments, link
from ethercat_server.tool.show import columns, say, say_json, value_text
from protocol.meaning import value_meaning

_HEAD: Final = ("object", "name", "value", "access", "meaning")


def read_object(sdo: Sdo, row: ObjectEntry) -> Steps[dict[str, Any]]:
    """One object: `hex`, `value` and `meaning`, or `error`."""
    try:
        data = yield from sdo.read(*row.address)
    except SdoAbortError as error:
        if error.abort_code in OBJECT_MISSING:
            return {"error": f"this firmware does not have it (abort 0x{error.abort_code:08X})"}
        return {"error": str(error)}
    try:
        value = row.type.unpack(data)
    except struct.error:
        return {"hex": data.hex(), "error": f"{len(data)} bytes are no {row.type.name}: {data.hex()}"}
    return {"hex": data.hex(), "value": value, "meaning": _meaning(row, value)}


def _meaning(row: ObjectEntry, value: float | str) -> str:
    if isinstance(row.allowed, range):
        return value_meaning(row.setting or "", int(value)) if value in row.allowed else "out of range"
    if row.index == FACTORY_CALIBRATION:
        return "factory calibration, never written"
    if row.allowed is None:
        return row.unit
    return row.allowed.get(int(value), "" if row.setting is None else "means nothing")


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_link_arguments(parser, all_if_none=True)


def _objects(args: argparse.Namespace) -> int:
    with link(args) as opened:
        found = [
            (sensor, [(row, finish(read_object(opened.sdo(sensor.place), row))) for row in KNOWN_OBJECTS])
            for sensor in opened.chosen(args.sensor)
        ]
    if args.json:
        sensors = [
            {**sensor.as_json(), "objects": [{**_row_as_json(row), **read} for row, read in objects]}
            for sensor, objects in found
        ]
        say_json({"through": opened.used, "sensors": sensors})
        return DONE
    for sensor, objects in found:
        say(str(sensor))
        say(columns([_HEAD, *(_line(row, read) for row, read in objects)], indent=2))
    return DONE


def _row_as_json(row: ObjectEntry) -> dict[str, Any]:
    allowed: Any = row.allowed
    if isinstance(allowed, range):
        allowed = {"from": allowed[0], "to": allowed[-1]}
    return {
        "index": f"0x{row.index:04X}",
        "subindex": row.subindex,
        "name": row.name,
        "type": row.type.name,
        "access": row.access.value,
        "write_states": row.access.write_states,
        "unit": row.unit,
        "allowed": allowed,
        "default": row.default,
    }


def _line(row: ObjectEntry, read: dict[str, Any]) -> tuple[str, ...]:
    value = value_text(read["value"]) if "value" in read else "--"
    rest = read.get("error") or read["meaning"]
    return (
        f"0x{row.index:04X}:{row.subindex:<2}",
        row.name,
        value,
        row.access.value.removesuffix(" only"),
        rest,
    )


COMMANDS = (Command("objects", "read and decode every object of the dictionary", _arguments, _objects),)
