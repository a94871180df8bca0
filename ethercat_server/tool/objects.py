"""`objects` and `read`: read and decode all objects of the dictionary, or some by name."""

from __future__ import annotations

import argparse
import struct
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.pdo import INPUT_OBJECT
from bota_ethercat.sensor.meaning import value_meaning
from ethercat_server.access.sensors import note
from ethercat_server.errors import OBJECT_MISSING, BusError, SdoAbortError, UsageError
from ethercat_server.ethercat.datagrams import Steps, finish
from ethercat_server.ethercat.slave.coe import Sdo
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.objects.dictionary import (
    FACTORY_CALIBRATION,
    KNOWN_OBJECTS,
    ObjectEntry,
    find_objects,
    similar_names,
)
from ethercat_server.sensor.sensor import FoundSensor
from ethercat_server.sensor.set_up import read_sinc
from ethercat_server.tool.command import (
    DONE,
    Subcommand,
    argument,
    chosen,
    columns,
    say,
    say_json,
    sensor_arguments,
    sensors_of,
    value_text,
)

_MOST_SILENT: Final = 3  # number of consecutive timeouts after which the other objects are skipped
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
        why = f"{len(data)} bytes do not fit type {row.type.name}: {data.hex()}"
        return {"hex": data.hex(), "error": why}
    meaning = _meaning(row, value)
    if row.setting == "sinc_length":
        _, rate_hz, chop = yield from read_sinc(sdo)
        if rate_hz:  # what it reads back may not be what is in force, nor what it may be set to
            meaning = value_meaning(row.setting, int(value), rate_hz, chop)
    return {"hex": data.hex(), "value": value, "meaning": meaning}


def _meaning(row: ObjectEntry, value: float | str) -> str:
    if isinstance(row.allowed, range):
        return value_meaning(row.setting or "", int(value)) if value in row.allowed else "out of range"
    if row.index == FACTORY_CALIBRATION:
        return "factory calibration, never written"
    if row.allowed is None:
        return row.unit
    return row.allowed.get(int(value), "" if row.setting is None else "undefined value")


def _read_objects(sdo: Sdo, found: FoundSensor, rows: Sequence[ObjectEntry]) -> dict[str, Any]:
    """The objects of a sensor, ready for JSON, and the `error` that ended reading if one did."""
    objects: list[dict[str, Any]] = []
    silent = 0
    for row in rows:
        try:
            read, silent = finish(read_object(sdo, row)), 0
        except BusError as error:
            read, silent = {"error": str(error)}, silent + 1
            if silent == _MOST_SILENT:
                return {**found.as_json(), "objects": objects, **read}
        objects.append({**_row_as_json(row), **read})
    return {**found.as_json(), "objects": objects}


def _read(args: argparse.Namespace) -> int:
    names: list[str] = args.names
    if args.server is None and args.iface is None and not find_objects(names[0]):
        raise UsageError(
            f"a NAME is missing, or the interface beside {names[0]!r}: for example read ens5 'Sampling rate'"
        )
    if args.iface is not None and (args.server is not None or find_objects(args.iface)):
        # No interface, but the first name: of the server that was given, or the default one.
        names, args.iface = [args.iface, *names], None
    rows: dict[tuple[int, int], ObjectEntry] = {}
    for name in names:
        found = find_objects(name)
        if not found:
            near = " or ".join(similar_names(name))
            hint = f"did you mean {near}?" if near else "the command objects lists all"
            raise UsageError(f"no object is called {name!r}: {hint}")
        rows |= {row.address: row for row in found}
    return _show(args, list(rows.values()), all_wanted=True)


def _objects(args: argparse.Namespace) -> int:
    # Calibration last: 87 rows that nobody sets.
    rows = sorted(KNOWN_OBJECTS, key=lambda row: row.index == FACTORY_CALIBRATION)
    return _show(args, rows)


def _show(args: argparse.Namespace, rows: Sequence[ObjectEntry], *, all_wanted: bool = False) -> int:
    """`all_wanted`: an object that cannot be read is a failure, also where the firmware does not have it."""
    with sensors_of(args) as opened:
        used, found = opened.used, chosen(opened, args)
        if any(row.index == INPUT_OBJECT for row in rows):
            opened.wait_settled([each.number for each in found])
        sensors = [_read_objects(opened.sdo(each.number), each, rows) for each in found]
    failed = [sensor["error"] for sensor in sensors if "error" in sensor]
    if len(failed) == len(sensors):
        raise BusError(failed[0])
    if args.json:
        say_json({"through": used, "sensors": sensors})
    for each, sensor in zip(found, sensors, strict=True):
        if not args.json:
            table = [columns([_HEAD, *map(_line, sensor["objects"])], indent=2)] if sensor["objects"] else []
            say("\n".join([str(each), *table, *(f"  {sensor[key]}" for key in ("error",) if key in sensor)]))
        unread = [f"{row['name']}: {row['error']}" for row in sensor["objects"] if "error" in row]
        if unread and all_wanted:
            more = f"; and {len(unread) - 1} more" if len(unread) > 1 else ""
            failed.append(f"sensor {each.number} gave no value of {unread[0]}{more}")
    for sentence in failed:
        note(sentence)
    return FAILED if failed else DONE


def _row_as_json(row: ObjectEntry) -> dict[str, Any]:
    allowed: Any = row.allowed
    if isinstance(allowed, range):
        allowed = {"from": allowed[0], "to": allowed[-1]}
    return {
        "index": f"0x{row.index:04X}", "subindex": row.subindex, "name": row.name, "type": row.type.name,
        "access": row.access.value, "write_states": row.access.write_states, "unit": row.unit,
        "allowed": allowed, "default": row.default,
    }  # fmt: skip


def _line(row: dict[str, Any]) -> tuple[str, ...]:
    value = value_text(row["value"]) if "value" in row else "--"
    where, access = f"{row['index']}:{row['subindex']:<2}", row["access"].removesuffix(" only")
    return where, row["name"], value, access, row.get("error") or row["meaning"]


_SENSORS: Final = sensor_arguments(all_if_none=True)
_NAME: Final = "object: a name such as 'Sampling rate' or 'Force/Torque Offset', a setting, or 0x8006:1"
COMMANDS: Final = {
    "objects": Subcommand(_SENSORS, _objects),
    "read": Subcommand((*_SENSORS, argument("names", _NAME, nargs="+", metavar="NAME")), _read),
}
