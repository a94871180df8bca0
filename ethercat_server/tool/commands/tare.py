"""`tare`: set the sensor's force/torque offset so that its mean reading becomes a given wrench."""

from __future__ import annotations

import argparse
import math
from typing import Final

from ethercat_server.errors import UsageError
from ethercat_server.sensor.set_up import pack_offset
from ethercat_server.tool.command import DONE, Command, add_link_arguments, link
from ethercat_server.tool.commands.settings import UNSAVED
from ethercat_server.tool.show import columns, report
from protocol.control import ACTIONS, MAX_TARE_SAMPLES

_AXES: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
_DEFAULT_SAMPLES: Final = ACTIONS["tare"].parameters["samples"].default


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_link_arguments(parser)
    parser.add_argument(
        "--samples", type=int, default=_DEFAULT_SAMPLES, metavar="N",
        help=f"number of samples to average, 1 to {MAX_TARE_SAMPLES} (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--target", type=float, nargs=6, default=[0.0] * 6, metavar=_AXES,
        help="wrench the sensor is to read, in N and Nm (default: zeros)",
    )  # fmt: skip


def _tare(args: argparse.Namespace) -> int:
    if not 1 <= args.samples <= MAX_TARE_SAMPLES:
        raise UsageError(f"--samples {args.samples}: it must be from 1 to {MAX_TARE_SAMPLES}")
    if not all(map(math.isfinite, args.target)):
        raise UsageError("--target must be six finite numbers: Fx Fy Fz in N, Mx My Mz in Nm")
    try:
        pack_offset(args.target)
    except ValueError as error:
        raise UsageError(f"--target: {error}") from None
    with link(args) as opened:
        found = opened.choose(args.sensor)
        tared = opened.tare(found.number, args.samples, args.target)
    keys = ("old_offset", "new_offset", "residual", "deviation")
    rows: list[tuple[str, ...]] = [("", "old offset", "new offset", "residual", "deviation", "")]
    for n, axis in enumerate(_AXES):
        rows.append((axis, *(f"{tared[key][n]:.4f}" for key in keys), "N" if n < 3 else "Nm"))
    unsaved = UNSAVED.replace("--save, or the command save,", "the command save")
    report(args.json, opened, found, {key: tared[key] for key in keys}, columns(rows, indent=2), unsaved)
    return DONE


COMMANDS = (
    Command("tare", "set the force/torque offset so that the mean reading becomes zero", _arguments, _tare),
)
