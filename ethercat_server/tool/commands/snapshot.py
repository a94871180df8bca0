"""The snapshot file: all readable objects of one sensor as JSON, with its identity."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from bota_ethercat.errors import SettingError
from bota_ethercat.program.new_file import NewFile
from bota_ethercat.settings import SettingValue, check_settings
from bota_ethercat.text.json_text import finite
from ethercat_server.access.sensors import Sensors, failed_change, note
from ethercat_server.errors import BusError, SdoAbortError, ServerError, UsageError
from ethercat_server.ethercat.slave.coe import Sdo, Steps, finish
from ethercat_server.process.signals import signals_held_back
from ethercat_server.sensor.objects.dictionary import OBJECTS, Access, ObjectEntry
from ethercat_server.sensor.objects.search import BY_ADDRESS, KNOWN_OBJECTS
from ethercat_server.sensor.sensor import Found, Identity, Sensor
from ethercat_server.tool.command import (
    DONE,
    Command,
    add_sensor_arguments,
    columns,
    report,
    sensors_of,
    value_text,
)
from ethercat_server.tool.commands.objects import read_object
from ethercat_server.tool.commands.settings import (
    add_save,
    change_lines,
    changes,
    save_now,
    saving_lines,
    verify,
)

_FORMAT: Final = "ethercat-sensor snapshot"
_VERSION: Final = 1
_CONFIGURATION: Final = range(0x8000, 0x8011)
"""Objects of the configuration: not the factory calibration, outputs or commands."""

RESTORABLE: Final[tuple[ObjectEntry, ...]] = tuple(
    row for row in OBJECTS if row.access is not Access.RO and row.index in _CONFIGURATION and not row.setting
)
"""Objects that are restored as they are; settings are restored as settings."""


class Snapshot(NamedTuple):
    """The content of a file, validated."""

    identity: Identity
    settings: dict[str, SettingValue]
    objects: dict[tuple[int, int], bytes]
    """Only those that can be restored."""


def text_of(content: Mapping[str, Any]) -> str:
    """The text of a file."""
    whole = finite({"format": _FORMAT, "version": _VERSION, **content})
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def read_snapshot(path: Path) -> Snapshot:
    """Read and validate a file; UsageError if it is no snapshot."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise UsageError(f"{path} is not a snapshot: it is not valid JSON") from None
    if not isinstance(content, dict) or (content.get("format"), content.get("version")) != (
        _FORMAT,
        _VERSION,
    ):
        raise UsageError(
            f"{path} is not a snapshot of version {_VERSION}: make one with ethercat-sensor snapshot"
        )
    try:
        identity = Identity(
            str(content["model"]), int(content["serial"]), str(content["hardware"]), str(content["firmware"])
        )
        settings = check_settings(dict(content["settings"]))
        rows = [(int(row["index"], 16), row["subindex"], row.get("hex")) for row in content["objects"]]
        held = {(index, sub): bytes.fromhex(text) for index, sub, text in rows if text is not None}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UsageError(f"the snapshot {path} is damaged ({error!r}): make a new one") from None
    except SettingError as error:
        raise UsageError(f"the snapshot {path}: {error}") from None
    wanted = {row.address: held[row.address] for row in RESTORABLE if row.address in held}
    for address, data in wanted.items():
        if len(data) != BY_ADDRESS[address].type.size:
            raise UsageError(
                f"the snapshot {path} is damaged: object 0x{address[0]:04X}:{address[1]} has the wrong size"
            )
    return Snapshot(identity, settings, wanted)


_TAKE_OVER: Final = "--take-over"
"""Not `--force`, which is for the file: replacing one must not stop a machine."""


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_sensor_arguments(parser, take_over=False)
    parser.add_argument("file", type=Path, metavar="FILE", help="JSON file")
    parser.add_argument(_TAKE_OVER, action="store_true", help="take over a bus in use, as --force elsewhere")


def _snapshot_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(parser)
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def _restore_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(parser)
    add_save(parser)
    parser.add_argument("--force", action="store_true", help="accept a file of another sensor")


@contextlib.contextmanager
def _opened(args: argparse.Namespace) -> Iterator[Sensors]:
    """As `sensors_of`; an error advises the option that these commands have."""
    try:
        with sensors_of(args) as opened:
            yield opened
    except BusError as error:
        if "; --force " not in str(error):
            raise
        raise BusError(str(error).replace("; --force ", f"; {_TAKE_OVER} ")) from None


def _snapshot(args: argparse.Namespace) -> int:
    with NewFile(args.file, force=args.force) as file:
        return _take(args, file)


def _take(args: argparse.Namespace, file: NewFile) -> int:
    with _opened(args) as opened:
        found = opened.choose(args.sensor)
        sensor, sdo = opened.in_force(found), opened.sdo(found.number)
        read = [(row, finish(read_object(sdo, row))) for row in KNOWN_OBJECTS]
    identity = found.identity
    content = {
        "taken": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "model": identity.name,
        "serial": identity.serial,
        "hardware": identity.hardware,
        "firmware": identity.firmware,
        "settings": sensor.settings,
        "objects": [_as_json(row.address, row.name, values) for row, values in read],
    }
    file.write(text_of(content))
    file.finish()
    readable = sum("hex" in values for _, values in read)
    line = f"  {readable} objects written to {args.file}, {len(read) - readable} could not be read"
    report(args.json, opened, found, {"file": str(args.file), "objects": readable}, line)
    return DONE


def _as_json(address: tuple[int, int], name: str, values: dict[str, Any]) -> dict[str, Any]:
    return {"index": f"0x{address[0]:04X}", "subindex": address[1], "name": name, **values}


def _restore(args: argparse.Namespace) -> int:
    snapshot = read_snapshot(args.file)
    with _opened(args) as opened:
        found = opened.choose(args.sensor)
        _check_whose(found.identity, snapshot.identity, args)
        sensor = opened.in_force(found, snapshot.settings)
        lacking = sorted(snapshot.settings.keys() - sensor.settings.keys())
        settings = {name: value for name, value in snapshot.settings.items() if name not in lacking}
        changed = changes(sensor, settings)
        differing, unreadable = finish(_differing(opened.sdo(found.number), snapshot))
        if changed or differing:
            with signals_held_back():
                _put_back(opened, found, sensor, settings, differing)
        if args.save:
            save_now(opened, found)
    missing = [*lacking, *(f"0x{index:04X}:{sub}" for index, sub in unreadable)]
    written = [
        _as_json(address, BY_ADDRESS[address].name, {"now": old.hex(), "then": new.hex()})
        for address, (old, new) in differing.items()
    ]
    lines = [change_lines(changed)] if changed else []
    if differing:
        lines.append(columns([_object_line(address, *pair) for address, pair in differing.items()], indent=2))
    if missing:
        lines.append(f"  skipped, this sensor does not have them: {', '.join(missing)}")
    if not changed and not differing:
        lines.append("  nothing to restore: the sensor already matches the file")
    values = {"changes": changed, "objects": written, "left_alone": missing, "saved": args.save}
    lines += saving_lines(opened, bool(changed or differing), args.save)
    report(args.json, opened, found, values, *lines)
    return DONE


def _check_whose(sensor: Identity, file: Identity, args: argparse.Namespace) -> None:
    if (sensor.name, sensor.serial) != (file.name, file.serial) and not args.force:
        raise ServerError(
            f"{args.file} belongs to the {file}, but this is the {sensor}: connect that one, or use --force"
        )
    if sensor.firmware != file.firmware:
        note(f"{args.file} was taken with firmware {file.firmware}, the sensor now has {sensor.firmware}")


def _differing(
    sdo: Sdo, snapshot: Snapshot
) -> Steps[tuple[dict[tuple[int, int], tuple[bytes, bytes]], list[tuple[int, int]]]]:
    """Present and saved value of the objects that differ; the objects that the sensor does not have."""
    differing, unreadable = {}, []
    for row in RESTORABLE:
        wanted = snapshot.objects.get(row.address)
        if wanted is None:
            continue
        try:
            held = yield from sdo.read(*row.address)
        except SdoAbortError:
            unreadable.append(row.address)
            continue
        if held != wanted:
            differing[row.address] = held, wanted
    return differing, unreadable


def _put_back(
    opened: Sensors,
    found: Found,
    sensor: Sensor,
    settings: Mapping[str, SettingValue],
    objects: Mapping[tuple[int, int], tuple[bytes, bytes]],
) -> None:
    """Write everything and verify it; on failure restore the former values."""
    sdo, before = opened.sdo(found.number), dict(sensor.settings)
    if any(before.get(name) != value for name, value in settings.items()):
        opened.configure(found.number, settings, save=False)
    written = []
    try:
        verify(opened.in_force(found, settings), settings)
        for address, (_, wanted) in objects.items():
            written.append(address)
            finish(_write(sdo, address, wanted))
    except BusError as error:
        try:
            for address in written:
                finish(_write(sdo, address, objects[address][0]))
            opened.configure(found.number, before, save=False)
        except BusError as again:
            raise BusError(
                f"{error}; the former values could not be restored ({again}): power the sensor off and on"
            ) from None
        raise failed_change(error) from None


def _write(sdo: Sdo, address: tuple[int, int], data: bytes) -> Steps[None]:
    yield from sdo.write(*address, data)
    held = yield from sdo.read(*address)
    if held != data:
        raise BusError(
            f"object 0x{address[0]:04X}:{address[1]} reads back {held.hex()} after writing {data.hex()}"
        )


def _object_line(address: tuple[int, int], held: bytes, wanted: bytes) -> tuple[str, ...]:
    row = BY_ADDRESS[address]
    now, then = (value_text(row.type.unpack(data)) for data in (held, wanted))
    return f"0x{address[0]:04X}:{address[1]}", row.name, now, then, row.unit


COMMANDS = (
    Command("snapshot", "write all readable objects to a file", _snapshot_arguments, _snapshot),
    Command("restore", "write back what differs from a snapshot", _restore_arguments, _restore),
)
