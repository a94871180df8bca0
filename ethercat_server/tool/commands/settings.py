"""`plan`, `apply` and `save`: preview a change of settings, make it, store it in the sensor's flash."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bota_ethercat.errors import SettingError
from bota_ethercat.sensor.meaning import meaning, value_meaning
from bota_ethercat.settings import SETTINGS, SettingValue
from ethercat_server.access.sensors import Sensors
from ethercat_server.daemon.options import EMPTY, ServerOptions, parse_assignments, read_config
from ethercat_server.errors import BusError, UsageError
from ethercat_server.ethercat.slave.coe import finish
from ethercat_server.process.signals import signals_held_back
from ethercat_server.sensor.configuration import Change, save
from ethercat_server.sensor.objects import dictionary
from ethercat_server.sensor.sensor import Found, Sensor
from ethercat_server.tool.command import (
    CHANGES,
    DONE,
    Command,
    add_sensor_arguments,
    columns,
    report,
    sensors_of,
    value_text,
)

UNSAVED = "in force until the sensor is powered off: use --save, or the command save, to keep it"
UNSAVED_IN_SERVER = (
    "in force until the server is started again, also after the sensor was powered off: set the same in the "
    "server's configuration to keep it"
)
SAVED = (
    "saved to the sensor's flash; a server writes its own settings at start: set the same there, or "
    "--unset-settings keep"
)


def changes(sensor: Sensor, settings: Mapping[str, SettingValue]) -> list[dict[str, Any]]:
    """What `settings` would change: `name`, `now`, `then`, `meaning`, `preop_only`, in the order of writing.

    UsageError if they contradict others, BusError if the sensor lacks one.
    """
    try:
        change = Change(sensor, settings)
    except SettingError as error:
        raise UsageError(str(error)) from None
    for name in change.names:
        if name not in sensor.settings:
            index, subindex = dictionary.BY_SETTING[name].address
            raise BusError(
                f"sensor {sensor.number} has no setting {name}: object 0x{index:04X}:{subindex} cannot be "
                "read or has an undefined value"
            )
    return [
        {
            "name": name,
            "now": sensor.settings[name],
            "then": settings[name],
            "meaning": value_meaning(name, settings[name]),
            "preop_only": SETTINGS[name].preop_only,
        }
        for name in change.names
    ]


def change_lines(found: list[dict[str, Any]]) -> str:
    """The changes as a table."""
    if not found:
        return "  nothing to change: all requested settings are in force"
    rows = [("setting", "now", "then", "meaning")]
    rows += [(row["name"], value_text(row["now"]), value_text(row["then"]), row["meaning"]) for row in found]
    return columns(rows, indent=2)


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_sensor_arguments(parser)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="assignments",
        help="a setting; may be given more than once: "
        + "; ".join(f"{row.name} ({row.meaning})" for row in SETTINGS.values()),
    )  # fmt: skip
    parser.add_argument(
        "--config", type=Path, metavar="FILE.toml", help="settings from [sensor] or [sensor.0] of a file"
    )


def _apply_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(parser)
    add_save(parser)


def add_save(parser: argparse.ArgumentParser) -> None:
    """The option `--save`."""
    parser.add_argument("--save", action="store_true", help="store it in the sensor's flash")


def _asked(args: argparse.Namespace) -> ServerOptions:
    """The requested settings, parsed as the server does."""
    if not args.assignments and args.config is None:
        raise UsageError("no settings given: use --set NAME=VALUE or --config FILE.toml")
    config = read_config(args.config) if args.config else EMPTY
    assigned = parse_assignments(args.assignments)
    return ServerOptions(
        args.iface or "", 0,
        common_settings=config.common, sensor_settings=config.by_sensor, assigned_settings=assigned,
    )  # fmt: skip


def _look(
    args: argparse.Namespace, opened: Sensors, options: ServerOptions
) -> tuple[Found, dict[str, SettingValue], Sensor]:
    """The chosen sensor, the settings requested for it, and those in force."""
    found = opened.choose(args.sensor)
    options.check_sensors({sensor.number: sensor.identity for sensor in opened.sensors})
    asked = options.asked_settings(found.number, found.identity.name, found.identity.serial)
    if not asked:
        raise UsageError(f"{args.config} has no settings for {found}: correct its tables, or use --set")
    return found, asked, opened.in_force(found, asked)


def _plan(args: argparse.Namespace) -> int:
    asked = _asked(args)
    with sensors_of(args) as opened:
        found, settings, sensor = _look(args, opened, asked)
    changed = changes(sensor, settings)
    now = meaning(sensor.settings, sensor.rate_hz)
    names = {row["name"] for row in changed}
    rate_hz = None if names & {"sinc_length", "chop"} else sensor.rate_hz
    then = meaning({**sensor.settings, **{row["name"]: row["then"] for row in changed}}, rate_hz)
    lines = [change_lines(changed)]
    if changed:
        lines.append("settings afterwards:\n  " + "\n  ".join(then.lines()))
    if any(row["preop_only"] for row in changed):
        lines.append("written in PREOP only: a stream through a server pauses for about 50 ms")
    values = {"changes": changed, "now": now.as_json(), "then": then.as_json()}
    report(args.json, opened, found, values, *lines)
    return CHANGES if changed else DONE


def _apply(args: argparse.Namespace) -> int:
    asked = _asked(args)
    with sensors_of(args) as opened:
        found, settings, before = _look(args, opened, asked)
        changed = changes(before, settings)
        if changed or args.save:
            opened.configure(found.number, settings, args.save)
        after = opened.in_force(found, settings) if changed else before
    verify(after, settings)
    in_force = meaning(after.settings, after.rate_hz)
    values = {
        "changes": changed, "saved": args.save, "settings": after.settings, "rate_hz": after.rate_hz,
        "meaning": in_force.as_json(),
    }  # fmt: skip
    lines = [change_lines(changed), "in force:\n  " + "\n  ".join(in_force.lines())]
    report(args.json, opened, found, values, *lines, *saving_lines(opened, bool(changed), args.save))
    return DONE


def saving_lines(opened: Sensors, changed: bool, saved: bool) -> list[str]:
    """How long a change lasts."""
    unsaved = UNSAVED_IN_SERVER if opened.restores else UNSAVED
    return [SAVED] if saved else [unsaved] if changed else []


def verify(sensor: Sensor, settings: Mapping[str, SettingValue]) -> None:
    """BusError unless `settings` are in force."""
    wrong = [name for name, value in settings.items() if sensor.settings.get(name) != value]
    if wrong:
        held, took = value_text(sensor.settings.get(wrong[0])), value_text(settings[wrong[0]])
        raise BusError(
            f"sensor {sensor.number} reads back {wrong[0]} = {held} although it accepted {took}: "
            "power it off and on, then try again"
        )


def save_now(opened: Sensors, found: Found) -> None:
    """Store the sensor's parameters in its flash."""
    sensor = Sensor(found.number, found.identity, {})
    with signals_held_back():
        finish(save(opened.sdo(found.number), sensor), clock=opened.clock)


def _save(args: argparse.Namespace) -> int:
    with sensors_of(args) as opened:
        found = opened.choose(args.sensor)
        save_now(opened, found)
    report(args.json, opened, found, {"saved": True}, f"  {SAVED}")
    return DONE


COMMANDS = (
    Command("plan", "show what a change of settings would do, without doing it", _arguments, _plan),
    Command("apply", "change settings, all or none, and verify them", _apply_arguments, _apply),
    Command("save", "store the sensor's parameters in its flash", add_sensor_arguments, _save),
)
