"""`objects` and `read`: read and decode all objects of the dictionary, or some by name."""

from __future__ import annotations

import argparse
import struct
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.pdo import INPUT_OBJECT
from bota_ethercat.sensor.meaning import value_meaning
from ethercat_server.access.raw import open_interface, open_slave
from ethercat_server.access.sensors import find_server, note
from ethercat_server.errors import OBJECT_MISSING, BusError, SdoAbortError, UsageError
from ethercat_server.ethercat.slave.coe import Sdo, Steps, finish
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.objects.dictionary import FACTORY_CALIBRATION, ObjectEntry
from ethercat_server.sensor.objects.search import KNOWN_OBJECTS, find_objects, similar_names
from ethercat_server.sensor.sensor import Found
from ethercat_server.sensor.set_up import read_sinc
from ethercat_server.tool.command import (
    DONE,
    Command,
    add_sensor_arguments,
    columns,
    say,
    say_json,
    sensors_of,
    value_text,
)

_MOST_SILENT: Final = 3
"""Number of consecutive timeouts after which the other objects are skipped."""
_STANDARD: Final = range(0x1000, 0x1019)
"""Objects that a slave of any vendor may have."""
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
        return {
            "hex": data.hex(),
            "error": f"{len(data)} bytes do not fit type {row.type.name}: {data.hex()}",
        }
    if row.setting == "sinc_length":
        _, rate_hz, chop = yield from read_sinc(sdo)
        if rate_hz:  # what it reads back may not be what is in force, nor what it may be set to
            return {
                "hex": data.hex(),
                "value": value,
                "meaning": value_meaning(row.setting, int(value), rate_hz, chop),
            }
    return {"hex": data.hex(), "value": value, "meaning": _meaning(row, value)}


def _meaning(row: ObjectEntry, value: float | str) -> str:
    if isinstance(row.allowed, range):
        return value_meaning(row.setting or "", int(value)) if value in row.allowed else "out of range"
    if row.index == FACTORY_CALIBRATION:
        return "factory calibration, never written"
    if row.allowed is None:
        return row.unit
    return row.allowed.get(int(value), "" if row.setting is None else "undefined value")


class _Sensor(NamedTuple):
    """The objects that could be read, and the error that ended reading."""

    found: Found
    objects: list[tuple[ObjectEntry, dict[str, Any]]]
    error: BusError | None

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        objects = [{**_row_as_json(row), **read} for row, read in self.objects]
        error = {"error": str(self.error)} if self.error else {}
        return {**self.found.as_json(), "objects": objects, **error}


def _read_sensor(sdo: Sdo, found: Found, rows: Sequence[ObjectEntry]) -> _Sensor:
    objects: list[tuple[ObjectEntry, dict[str, Any]]] = []
    try:
        objects.extend(_read_rows(sdo, rows))
    except BusError as error:
        return _Sensor(found, objects, error)
    return _Sensor(found, objects, None)


def _read_rows(sdo: Sdo, rows: Sequence[ObjectEntry]) -> Iterator[tuple[ObjectEntry, dict[str, Any]]]:
    """Each of `rows` with the result of reading it; BusError when the sensor no longer answers."""
    silent = 0
    for row in rows:
        try:
            yield row, finish(read_object(sdo, row))
            silent = 0
        except BusError as error:
            silent += 1
            if silent == _MOST_SILENT:
                raise
            yield row, {"error": str(error)}


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_sensor_arguments(parser, all_if_none=True)
    parser.add_argument(
        "--slave", metavar="POSITION:NAME",
        help="the standard objects of a slave that is no sensor, such as 1:EL3102, in the state it is in",
    )  # fmt: skip


def _read_arguments(parser: argparse.ArgumentParser) -> None:
    add_sensor_arguments(parser, all_if_none=True)
    parser.add_argument(
        "names", nargs="+", metavar="NAME",
        help="object: a name such as 'Sampling rate' or 'Force/Torque Offset', a setting, or 0x8006:1",
    )  # fmt: skip


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
    if args.slave is not None:
        rows = [row for row in rows if row.index in _STANDARD]
    return _show(args, rows, slave=args.slave)


def _show(
    args: argparse.Namespace,
    rows: Sequence[ObjectEntry],
    *,
    all_wanted: bool = False,
    slave: str | None = None,
) -> int:
    """`all_wanted`: an object that cannot be read is a failure, also where the firmware does not have it."""
    if slave is not None:
        if find_server(args.iface, args.server) is not None:
            raise UsageError("a server reads the objects of sensors only: stop it to read those of a slave")
        used = f"the interface {args.iface}"
        with open_interface(args.iface, allow_ip=args.allow_ip) as bus:
            found, sdo = open_slave(bus, slave)
            sensors = [_read_sensor(sdo, found, rows)]
    else:
        with sensors_of(args) as opened:
            used, chosen = opened.used, opened.chosen(args.sensor)
            if any(row.index == INPUT_OBJECT for row in rows):
                opened.wait_settled([found.number for found in chosen])
            sensors = [_read_sensor(opened.sdo(found.number), found, rows) for found in chosen]
    errors = [sensor.error for sensor in sensors if sensor.error]
    if len(errors) == len(sensors):
        raise errors[0]
    if args.json:
        say_json({"through": used, "sensors": [sensor.as_json() for sensor in sensors]})
    else:
        for sensor in sensors:
            _say_sensor(sensor)
    failed = [str(error) for error in errors]
    if all_wanted:
        failed += [text for sensor in sensors if (text := _unread(sensor))]
    for sentence in failed:
        note(sentence)
    return FAILED if failed else DONE


def _unread(sensor: _Sensor) -> str:
    """Which objects were not read, and why, a sentence; empty if all were."""
    rows = [f"{row.name}: {read['error']}" for row, read in sensor.objects if "error" in read]
    more = f"; and {len(rows) - 1} more" if len(rows) > 1 else ""
    return f"sensor {sensor.found.number} gave no value of {rows[0]}{more}" if rows else ""


def _say_sensor(sensor: _Sensor) -> None:
    say(str(sensor.found))
    if sensor.objects:
        say(columns([_HEAD, *(_line(row, read) for row, read in sensor.objects)], indent=2))
    if sensor.error:
        say(f"  {sensor.error}")


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


COMMANDS = (
    Command("objects", "read and decode every object of the dictionary", _arguments, _objects),
    Command("read", "read and decode some objects by name", _read_arguments, _read),
)
