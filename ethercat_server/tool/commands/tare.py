"""`tare`: set the sensor's force/torque offset so that its mean reading becomes a wrench, or back."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import Final

from bota_ethercat.control import ACTIONS, MAX_TARE_SAMPLES
from bota_ethercat.program.tare_memory import former, remember
from ethercat_server.access.sensors import Sensors, note
from ethercat_server.errors import BusError, UsageError
from ethercat_server.ethercat.slave.coe import finish
from ethercat_server.process.signals import signals_held_back
from ethercat_server.sensor.sensor import Found
from ethercat_server.sensor.set_up import pack_offset, read_offset, write_offset
from ethercat_server.tool.command import DONE, Command, add_sensor_arguments, columns, report, sensors_of
from ethercat_server.tool.commands.settings import UNSAVED

_AXES: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
_UNSAVED: Final = UNSAVED.replace("--save, or the command save,", "the command save")
_UNSAVED_IN_SERVER: Final = (
    "in force while the server runs, then until the sensor is powered off: use the command save to keep it"
)
_DEFAULT_SAMPLES: Final = ACTIONS["tare"].parameters["samples"].default


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_sensor_arguments(parser)
    parser.add_argument(
        "--samples", type=int, default=_DEFAULT_SAMPLES, metavar="N",
        help=f"number of samples to average, 1 to {MAX_TARE_SAMPLES} (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--target", type=float, nargs=6, default=[0.0] * 6, metavar=_AXES,
        help="wrench the sensor is to read, in N and Nm (default: zeros)",
    )  # fmt: skip
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument("--undo", action="store_true", help="restore the offset of before the last tare")
    instead.add_argument("--clear", action="store_true", help="set the offset to zero")


def _tare(args: argparse.Namespace) -> int:
    if not 1 <= args.samples <= MAX_TARE_SAMPLES:
        raise UsageError(f"--samples {args.samples}: it must be from 1 to {MAX_TARE_SAMPLES}")
    if not all(map(math.isfinite, args.target)):
        raise UsageError("--target must be six finite numbers: Fx Fy Fz in N, Mx My Mz in Nm")
    try:
        pack_offset(args.target)
    except ValueError as error:
        raise UsageError(f"--target: {error}") from None
    if args.undo or args.clear:
        return _take_back(args)
    with sensors_of(args) as opened:
        found = opened.choose(args.sensor)
        tared = opened.tare(found.number, args.samples, args.target)
    _remember(found, tared["old_offset"], tared["new_offset"])
    keys = ("old_offset", "new_offset", "residual", "deviation")
    rows: list[tuple[str, ...]] = [("", "old offset", "new offset", "residual", "deviation", "")]
    for n, axis in enumerate(_AXES):
        rows.append((axis, *(f"{tared[key][n]:.4f}" for key in keys), "N" if n < 3 else "Nm"))
    report(
        args.json, opened, found, {key: tared[key] for key in keys}, columns(rows, indent=2), _lasts(opened)
    )
    return DONE


def _lasts(opened: Sensors) -> str:
    return _UNSAVED_IN_SERVER if opened.restores else _UNSAVED


def _take_back(args: argparse.Namespace) -> int:
    """Write the offset of before the last tare, or zeros, and verify it."""
    with sensors_of(args) as opened:
        found = opened.choose(args.sensor)
        sdo = opened.sdo(found.number)
        before = finish(read_offset(sdo), clock=opened.clock)
        after = _former(found, before) if args.undo else [0.0] * 6
        with signals_held_back():
            try:
                finish(write_offset(sdo, after), clock=opened.clock)
            except BusError as error:
                finish(write_offset(sdo, before), clock=opened.clock)
                raise BusError(f"{error}; the old offset is in force") from None
    _remember(found, before, after)
    rows: list[tuple[str, ...]] = [("", "old offset", "new offset", "")]
    for n, axis in enumerate(_AXES):
        rows.append((axis, f"{before[n]:.4f}", f"{after[n]:.4f}", "N" if n < 3 else "Nm"))
    values = {"old_offset": list(before), "new_offset": list(after)}
    report(args.json, opened, found, values, columns(rows, indent=2), _lasts(opened))
    return DONE


def _former(found: Found, now: Sequence[float]) -> list[float]:
    """The offset of before the last tare; BusError unless what is in force is of that tare."""
    try:
        return former(found.identity.serial, now, str(found))
    except ValueError as error:
        raise BusError(f"{error}: use --clear, or tare again") from None


def _remember(found: Found, before: Sequence[float], after: Sequence[float]) -> None:
    try:
        remember(found.identity.serial, before, after)
    except OSError as error:
        note(f"--undo will not know this tare: {error.strerror or error}")


COMMANDS = (
    Command("tare", "set the force/torque offset so that the mean reading becomes zero", _arguments, _tare),
)
