"""`apply`, `save`, `tare`, `snapshot` and `restore`: everything that is written to a sensor, and the
file that has all readable objects of one.

What cannot be done as a whole is taken back: the former settings and offsets are in force then.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from bota_ethercat.control import ACTIONS, MAX_TARE_SAMPLES
from bota_ethercat.errors import SettingError
from bota_ethercat.pdo import AXES
from bota_ethercat.program.arguments import whole
from bota_ethercat.program.command import command
from bota_ethercat.program.new_file import NewFile
from bota_ethercat.program.signals import signals_held_back
from bota_ethercat.program.tare_memory import former, remember
from bota_ethercat.sensor.meaning import meaning, value_meaning
from bota_ethercat.settings import SETTINGS, SettingValue, check_settings
from bota_ethercat.text.json_text import finite
from ethercat_server.access.sensors import Sensors, note
from ethercat_server.daemon.options import EMPTY, ServerOptions, parse_assignments, read_config
from ethercat_server.errors import BusError, SdoAbortError, ServerError, UsageError
from ethercat_server.ethercat.datagrams import Steps, finish
from ethercat_server.ethercat.slave.coe import Sdo
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.objects.dictionary import BY_ADDRESS, KNOWN_OBJECTS, OBJECTS, Access, ObjectEntry
from ethercat_server.sensor.sensor import FoundSensor, Identity, Sensor
from ethercat_server.sensor.set_up import FORMER, Change, pack_offset, read_offset, save, write_offset
from ethercat_server.sensor.tare import OLD
from ethercat_server.sensor.undo import or_undone
from ethercat_server.tool.command import (
    CHANGES,
    DONE,
    Subcommand,
    argument,
    columns,
    report,
    sensor_arguments,
    sensor_of,
    value_text,
)
from ethercat_server.tool.objects import read_object

_SAVED: Final = (
    "saved to the sensor's flash; a server writes its own settings at start: set the same there, or "
    "--unset-settings keep"
)
_UNSAVED: Final = "in force until the sensor is powered off: use the command save to keep it"
_UNSAVED_IN_SERVER: Final = (
    "in force until the server is started again, also after the sensor was powered off: set the same in the "
    "server's configuration to keep it"
)
_TARE_IN_SERVER: Final = (
    "in force while the server runs, then until the sensor is powered off: use the command save to keep it"
)


# -- apply, save


def _changes(sensor: Sensor, settings: Mapping[str, SettingValue]) -> list[dict[str, Any]]:
    """What `settings` would change: `name`, `now`, `then`, `meaning`, `preop_only`, in the order of writing.

    UsageError if they contradict others, BusError if the sensor lacks one.
    """
    try:
        names = Change(sensor, settings).names
    except SettingError as error:
        raise UsageError(str(error)) from None
    for name in names:
        if name not in sensor.settings:
            index, subindex = dictionary.BY_SETTING[name].address
            raise BusError(
                f"sensor {sensor.number} has no setting {name}: object 0x{index:04X}:{subindex} cannot be "
                "read or has an undefined value"
            )
    return [
        {
            "name": name, "now": sensor.settings[name], "then": settings[name],
            "meaning": value_meaning(name, settings[name]), "preop_only": SETTINGS[name].preop_only,
        }
        for name in names
    ]  # fmt: skip


def _change_lines(found: list[dict[str, Any]]) -> str:
    if not found:
        return "  nothing to change: all requested settings are in force"
    rows = [("setting", "now", "then", "meaning")]
    rows += [(row["name"], value_text(row["now"]), value_text(row["then"]), row["meaning"]) for row in found]
    return columns(rows, indent=2)


def _lasts(opened: Sensors, saved: bool = False, in_server: str = _UNSAVED_IN_SERVER) -> str:
    """How long a change lasts."""
    return _SAVED if saved else in_server if opened.private is None else _UNSAVED


def _apply(args: argparse.Namespace) -> int:
    if not args.assignments and args.config is None:
        raise UsageError("no settings given: use --set NAME=VALUE or --config FILE.toml")
    config = read_config(args.config) if args.config else EMPTY
    # Parsed as the server does.
    options = ServerOptions(args.iface or "", 0, file=config, assigned=parse_assignments(args.assignments))
    with sensor_of(args) as (opened, found):
        options.check_sensors({sensor.number: sensor.identity for sensor in opened.sensors})
        asked = options.asked_settings(found.number, found.identity.name, found.identity.serial)
        if not asked:
            raise UsageError(f"{args.config} has no settings for {found}: correct its tables, or use --set")
        sensor = opened.read_settings(found, asked)
        changed = _changes(sensor, asked)
        settings, rate_hz = sensor.settings, sensor.rate_hz
        if args.dry_run:
            changes = {row["name"]: row["then"] for row in changed}
            settings = {**settings, **changes}
            rate_hz = 0 if changes.keys() & {"sinc_length", "chop"} else rate_hz
        elif changed or args.save:
            opened.configure(found.number, asked, args.save)
            if changed:
                after = opened.read_settings(found, asked)
                settings, rate_hz = after.settings, after.rate_hz
    means = meaning(settings, rate_hz)
    what, lines = "settings afterwards" if args.dry_run else "in force", [_change_lines(changed)]
    if changed or not args.dry_run:
        lines.append(f"{what}:\n  " + "\n  ".join(means.lines()))
    if args.dry_run and any(row["preop_only"] for row in changed):
        lines.append("written in PREOP only: a stream through a server pauses for about 50 ms")
    if (changed or args.save) and not args.dry_run:
        lines.append(_lasts(opened, args.save))
    values = {"changes": changed, "saved": args.save and not args.dry_run, "settings": settings}
    values |= {"rate_hz": rate_hz or means.rate_hz, "meaning": means.as_json()}
    report(args.json, opened, found, values, *lines)
    return CHANGES if args.dry_run and changed else DONE


def _save_now(opened: Sensors, found: FoundSensor) -> None:
    """Store the sensor's parameters in its flash."""
    with signals_held_back():
        finish(save(opened.sdo(found.number), Sensor(found.number, found.identity, {})), clock=opened.clock)


def _save(args: argparse.Namespace) -> int:
    with sensor_of(args) as (opened, found):
        _save_now(opened, found)
    report(args.json, opened, found, {"saved": True}, f"  {_SAVED}")
    return DONE


# -- tare


def _tare(args: argparse.Namespace) -> int:
    if args.undo and args.clear:
        raise UsageError("--undo and --clear exclude each other: give one of them")
    if not all(map(math.isfinite, args.target)):
        raise UsageError("--target must be six finite numbers: Fx Fy Fz in N, Mx My Mz in Nm")
    try:
        pack_offset(args.target)
    except ValueError as error:
        raise UsageError(f"--target: {error}") from None
    keys = ["old_offset", "new_offset"]
    with sensor_of(args) as (opened, found):
        if args.undo or args.clear:
            tared: Mapping[str, Sequence[float]] = _taken_back(opened, found, undo=args.undo)
        else:
            tared = opened.tare(found.number, args.samples, args.target)
            keys += ["residual", "deviation"]
    try:
        remember(found.identity.serial, tared["old_offset"], tared["new_offset"])
    except OSError as error:
        note(f"--undo will not know this tare: {error.strerror or error}")
    rows: list[tuple[str, ...]] = [("axis", *(key.replace("_", " ") for key in keys), "unit")]
    for n, axis in enumerate(AXES):
        rows.append((axis, *(f"{tared[key][n]:.4f}" for key in keys), "N" if n < 3 else "Nm"))
    lines = columns(rows, indent=2), _lasts(opened, in_server=_TARE_IN_SERVER)
    report(args.json, opened, found, {key: tared[key] for key in keys}, *lines)
    return DONE


def _taken_back(opened: Sensors, found: FoundSensor, *, undo: bool) -> dict[str, Sequence[float]]:
    """Write the offset of before the last tare, or zeros, and verify it.

    BusError unless what is in force is of that tare.
    """
    sdo = opened.sdo(found.number)
    before, after = finish(read_offset(sdo), clock=opened.clock), [0.0] * 6
    if undo:
        try:
            after = former(found.identity.serial, before, str(found))
        except ValueError as error:
            raise BusError(str(error)) from None
    with signals_held_back():
        steps = or_undone(write_offset(sdo, after), lambda: write_offset(sdo, before), OLD)
        finish(steps, clock=opened.clock)
    return {"old_offset": list(before), "new_offset": list(after)}


# -- snapshot, restore

_FORMAT: Final = "ethercat-sensor snapshot"
_VERSION: Final = 1
# Objects of the configuration: not the factory calibration, outputs or commands.
_CONFIGURATION: Final = range(0x8000, 0x8011)
# Objects that are restored as they are; settings are restored as settings.
RESTORABLE: Final[tuple[ObjectEntry, ...]] = tuple(
    row for row in OBJECTS if row.access is not Access.RO and row.index in _CONFIGURATION and not row.setting
)

Address = tuple[int, int]


class Snapshot(NamedTuple):
    """The content of a file, validated."""

    identity: Identity
    settings: dict[str, SettingValue]
    objects: dict[Address, bytes]  # only those that can be restored


def read_snapshot(path: Path) -> Snapshot:
    """Read and validate a file; UsageError if it is no snapshot."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise UsageError(f"{path} is not a snapshot: it is not valid JSON") from None
    kind = (content.get("format"), content.get("version")) if isinstance(content, dict) else None
    if kind != (_FORMAT, _VERSION):
        make = command("ethercat-sensor snapshot")
        raise UsageError(f"{path} is not a snapshot of version {_VERSION}: make one with '{make}'")
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
    for (index, sub), data in wanted.items():
        if len(data) != BY_ADDRESS[index, sub].type.size:
            raise UsageError(f"the snapshot {path} is damaged: object 0x{index:04X}:{sub} has the wrong size")
    return Snapshot(identity, settings, wanted)


def _snapshot(args: argparse.Namespace) -> int:
    with NewFile(args.file, force=args.force) as file, sensor_of(args) as (opened, found):
        sensor, sdo = opened.read_settings(found), opened.sdo(found.number)
        read = [(row, finish(read_object(sdo, row))) for row in KNOWN_OBJECTS]
        who = found.identity._asdict()
        content = {
            "format": _FORMAT,
            "version": _VERSION,
            "taken": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "model": who.pop("name"),
            **who,
            "settings": sensor.settings,
            "objects": [_as_json(row.address, values) for row, values in read],
        }
        file.write(json.dumps(finite(content), indent=1, allow_nan=False) + "\n")
        file.finish()
    readable = sum("hex" in values for _, values in read)
    line = f"  {readable} objects written to {args.file}, {len(read) - readable} could not be read"
    report(args.json, opened, found, {"file": str(args.file), "objects": readable}, line)
    return DONE


def _as_json(address: Address, values: dict[str, Any]) -> dict[str, Any]:
    name = BY_ADDRESS[address].name
    return {"index": f"0x{address[0]:04X}", "subindex": address[1], "name": name, **values}


def _restore(args: argparse.Namespace) -> int:
    snapshot = read_snapshot(args.file)
    with sensor_of(args) as (opened, found):
        sensor_is, file_is = found.identity, snapshot.identity
        if (sensor_is.name, sensor_is.serial) != (file_is.name, file_is.serial) and not args.force:
            raise ServerError(
                f"{args.file} belongs to the {file_is}, but this is the {sensor_is}: connect that one, or "
                "use --force"
            )
        if sensor_is.firmware != file_is.firmware:
            note(f"{args.file} is of firmware {file_is.firmware}, the sensor now has {sensor_is.firmware}")
        sensor, sdo = opened.read_settings(found, snapshot.settings), opened.sdo(found.number)
        settings = {name: value for name, value in snapshot.settings.items() if name in sensor.settings}
        missing = sorted(snapshot.settings.keys() - settings.keys())
        changed, differing = _changes(sensor, settings), dict[Address, tuple[bytes, bytes]]()
        for address, wanted in snapshot.objects.items():
            try:
                if (held := finish(sdo.read(*address))) != wanted:
                    differing[address] = held, wanted
            except SdoAbortError:
                missing.append(f"0x{address[0]:04X}:{address[1]}")
        if changed or differing:
            with signals_held_back():
                _put_back(opened, found, sensor, settings, differing)
        if args.save:
            _save_now(opened, found)
    lines = [_change_lines(changed)] if changed else []
    if differing:
        lines.append(columns([_object_line(address, *pair) for address, pair in differing.items()], indent=2))
    if missing:
        lines.append(f"  skipped, this sensor does not have them: {', '.join(missing)}")
    if not changed and not differing:
        lines.append("  nothing to restore: the sensor already matches the file")
    if changed or differing or args.save:
        lines.append(_lasts(opened, args.save))
    written = [
        _as_json(address, {"now": old.hex(), "then": new.hex()}) for address, (old, new) in differing.items()
    ]
    values = {"changes": changed, "objects": written, "left_alone": missing, "saved": args.save}
    report(args.json, opened, found, values, *lines)
    return DONE


def _put_back(
    opened: Sensors,
    found: FoundSensor,
    sensor: Sensor,
    settings: Mapping[str, SettingValue],
    objects: Mapping[Address, tuple[bytes, bytes]],
) -> None:
    """Write everything and verify it; on failure restore the former values."""
    sdo, before = opened.sdo(found.number), dict(sensor.settings)
    if any(before.get(name) != value for name, value in settings.items()):
        opened.configure(found.number, settings, save=False)
    written = []

    def write() -> Steps[None]:
        for address, (_, wanted) in objects.items():
            written.append(address)
            yield from _write(sdo, address, wanted)

    def undo() -> Steps[None]:
        for address in written:
            yield from _write(sdo, address, objects[address][0])
        opened.configure(found.number, before, save=False)

    finish(or_undone(write(), undo, FORMER), clock=opened.clock)


def _write(sdo: Sdo, address: Address, data: bytes) -> Steps[None]:
    yield from sdo.write(*address, data)
    if (held := (yield from sdo.read(*address))) != data:
        raise BusError(
            f"object 0x{address[0]:04X}:{address[1]} reads back {held.hex()} after writing {data.hex()}"
        )


def _object_line(address: Address, held: bytes, wanted: bytes) -> tuple[str, ...]:
    row = BY_ADDRESS[address]
    now, then = (value_text(row.type.unpack(data)) for data in (held, wanted))
    return f"0x{address[0]:04X}:{address[1]}", row.name, now, then, row.unit


_SENSOR: Final = sensor_arguments()
_SET: Final = "a setting; may be given more than once: " + "; ".join(
    f"{row.name} ({row.meaning})" for row in SETTINGS.values()
)
_SAVE: Final = argument("--save", "store it in the sensor's flash")
_SETTINGS: Final = (
    *_SENSOR,
    argument("--set", _SET, action="append", default=[], metavar="NAME=VALUE", dest="assignments"),
    argument("--config", "settings from [sensor] or [sensor.0] of a file", type=Path, metavar="FILE.toml"),
    _SAVE,
    argument("--dry-run", "only show what it would do; exit code 3 if there is something to change"),
)
# Here `--force` is for the file: replacing one must not stop a machine.
_FILE: Final = (
    *sensor_arguments(take_over="--take-over"),
    argument("file", "JSON file", type=Path, metavar="FILE"),
)
_SAMPLES: Final = "number of samples to average (default %(default)s)"
_DEFAULT_SAMPLES: Final = ACTIONS["tare"].parameters["samples"].default
_TARGET: Final = "wrench the sensor is to read, in N and Nm (default: zeros)"

_TARE: Final = (
    *_SENSOR,
    argument("--samples", _SAMPLES, type=whole(1, MAX_TARE_SAMPLES), default=_DEFAULT_SAMPLES, metavar="N"),
    argument("--target", _TARGET, type=float, nargs=6, default=[0.0] * 6, metavar=AXES),
    argument("--undo", "restore the offset of before the last tare"),
    argument("--clear", "set the offset to zero"),
)

COMMANDS: Final = {
    "apply": Subcommand(_SETTINGS, _apply),
    "save": Subcommand(_SENSOR, _save),
    "tare": Subcommand(_TARE, _tare),
    "snapshot": Subcommand((*_FILE, argument("--force", "replace an existing file")), _snapshot),
    "restore": Subcommand((*_FILE, _SAVE, argument("--force", "accept a file of another sensor")), _restore),
}
