"""`plan`, `apply` and `save`: what a change of settings would do, the change itself, the sensor's flash."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ethercat_server import objects
from ethercat_server.config_file import EMPTY, read_config
from ethercat_server.configuration import Change, save
from ethercat_server.errors import BusError, UsageError
from ethercat_server.options import ServerOptions, parse_assignments
from ethercat_server.sdo import finish
from ethercat_server.sensor import Sensor
from ethercat_server.tool.command import CHANGES, DONE, Command, add_link_arguments, link
from ethercat_server.tool.link import Found, Link, signals_held_back
from ethercat_server.tool.show import columns, say, say_json, value_text
from protocol.errors import SettingError
from protocol.meaning import meaning, value_meaning
from protocol.settings import SETTINGS, SettingValue

UNSAVED = "in force until the sensor's power goes: --save, or the command save, keeps it"


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
            index, subindex = objects.BY_SETTING[name].address
            raise BusError(
                f"sensor {sensor.place} has no setting {name}: object 0x{index:04X}:{subindex} of its "
                "firmware cannot be read, or holds what means nothing"
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
    """The changes for people."""
    rows = [("setting", "now", "then", "meaning")]
    rows += [(row["name"], value_text(row["now"]), value_text(row["then"]), row["meaning"]) for row in found]
    return columns(rows, indent=2)


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_link_arguments(parser)
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
    parser.add_argument("--save", action="store_true", help="have the sensor keep it in its flash")


def _asked(args: argparse.Namespace) -> ServerOptions:
    """What is asked for, read as the server reads it."""
    if not args.assignments and args.config is None:
        raise UsageError("nothing is asked for: give --set NAME=VALUE or --config FILE.toml")
    config = read_config(args.config) if args.config else EMPTY
    assigned = parse_assignments(args.assignments)
    return ServerOptions(
        args.iface or "", 0,
        common_settings=config.common, sensor_settings=config.by_sensor, assigned_settings=assigned,
    )  # fmt: skip


def _look(
    args: argparse.Namespace, opened: Link, options: ServerOptions
) -> tuple[Found, dict[str, SettingValue], Sensor]:
    """The chosen sensor, what is asked of it, and what it holds."""
    found = opened.choose(args.sensor)
    options.check_sensors({sensor.place: sensor.identity for sensor in opened.sensors})
    asked = options.asked_settings(found.place, found.identity.name, found.identity.serial)
    if not asked:
        raise UsageError(f"{args.config} asks for nothing of {found}: correct its tables, or give --set")
    return found, asked, opened.in_force(found)


def _plan(args: argparse.Namespace) -> int:
    asked = _asked(args)
    with link(args) as opened:
        found, settings, sensor = _look(args, opened, asked)
    changed = changes(sensor, settings)
    now = meaning(sensor.settings)
    then = meaning({**sensor.settings, **{row["name"]: row["then"] for row in changed}})
    if args.json:
        say_json(
            {
                "through": opened.used, **found.as_json(), "changes": changed,
                "now": now.as_json(), "then": then.as_json(),
            }
        )  # fmt: skip
        return CHANGES if changed else DONE
    say(str(found))
    if not changed:
        say("  nothing to change: all that is asked for is in force")
        return DONE
    say(change_lines(changed))
    say("then in force:\n  " + "\n  ".join(then.lines()))
    if any(row["preop_only"] for row in changed):
        say("the sensor takes it in PREOP only: a stream through a server pauses for some 50 ms")
    return CHANGES


def _apply(args: argparse.Namespace) -> int:
    asked = _asked(args)
    with link(args) as opened:
        found, settings, before = _look(args, opened, asked)
        changed = changes(before, settings)
        if changed or args.save:
            opened.configure(found.place, settings, args.save)
        after = opened.in_force(found) if changed else before
    verify(after, settings)
    if args.json:
        say_json(
            {
                "through": opened.used, **found.as_json(), "changes": changed, "saved": args.save,
                "settings": after.settings, "rate_hz": after.rate_hz,
                "meaning": meaning(after.settings).as_json(),
            }
        )  # fmt: skip
        return DONE
    say(str(found))
    say(change_lines(changed) if changed else "  nothing to change: all that is asked for is in force")
    say("in force:\n  " + "\n  ".join(meaning(after.settings).lines()))
    if args.save:
        say("saved to the sensor's flash")
    elif changed:
        say(UNSAVED)
    return DONE


def verify(sensor: Sensor, settings: Mapping[str, SettingValue]) -> None:
    """BusError unless the sensor holds `settings`."""
    wrong = [name for name, value in settings.items() if sensor.settings.get(name) != value]
    if wrong:
        held, took = value_text(sensor.settings.get(wrong[0])), value_text(settings[wrong[0]])
        raise BusError(
            f"sensor {sensor.place} holds {wrong[0]} = {held} although it took {took}: power it off and on, "
            "then try again"
        )


def save_now(opened: Link, found: Found) -> None:
    """Have the sensor keep what it holds."""
    sensor = Sensor(found.place, found.identity, {})
    with signals_held_back():
        finish(save(opened.sdo(found.place), sensor))


def _save(args: argparse.Namespace) -> int:
    with link(args) as opened:
        found = opened.choose(args.sensor)
        save_now(opened, found)
    if args.json:
        say_json({"through": opened.used, **found.as_json(), "saved": True})
    else:
        say(f"{found}\n  what it holds is saved to its flash")
    return DONE


COMMANDS = (
    Command("plan", "say what a change of settings would do, and do nothing", _arguments, _plan),
    Command("apply", "change settings, all or none, and verify them", _apply_arguments, _apply),
    Command("save", "have the sensor keep what it holds in its flash", add_link_arguments, _save),
)
