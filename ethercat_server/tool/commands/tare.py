"""`tare`: set the sensor's force/torque offset so that its mean reading becomes a given wrench."""

from __future__ import annotations

import argparse
import math
from typing import Any, Final

from ethercat_server.errors import UsageError
from ethercat_server.links.link import note
from ethercat_server.sensor.set_up import pack_offset
from ethercat_server.sensor.tare import LEAST_SAMPLES
from ethercat_server.tool.command import DONE, Command, add_link_arguments, link
from ethercat_server.tool.commands.settings import UNSAVED
from ethercat_server.tool.show import columns, report
from protocol.control import ACTIONS, MAX_TARE_SAMPLES

_AXES: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
_ALLOWED_N: Final = 0.3
_ALLOWED_NM: Final = 0.01
_BY_CHANCE: Final = 5.0
"""Standard errors that the residual of a stationary sensor may have on top of that."""
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
    if moved := _moved(tared, max(args.samples, LEAST_SAMPLES)):
        note(f"tare inaccurate: {moved}; the load changed while taring: keep it still and tare again")
    rows: list[tuple[str, ...]] = [("", "old offset", "new offset", "residual", "deviation", "")]
    for n, axis in enumerate(_AXES):
        rows.append((axis, *(f"{tared[key][n]:.4f}" for key in keys), "N" if n < 3 else "Nm"))
    unsaved = UNSAVED.replace("--save, or the command save,", "the command save")
    report(args.json, opened, found, {key: tared[key] for key in keys}, columns(rows, indent=2), unsaved)
    return DONE


def _moved(tared: dict[str, Any], samples: int) -> str | None:
    """The first residual that noise does not explain: the sensor was not stationary."""
    for n, axis in enumerate(_AXES):
        residual, unit = tared["residual"][n], "N" if n < 3 else "Nm"
        allowed = _ALLOWED_N if n < 3 else _ALLOWED_NM
        # Of the difference of two means of so many samples.
        if abs(residual) > allowed + _BY_CHANCE * tared["deviation"][n] * math.sqrt(2 / samples):
            return f"{axis} is still {residual:.3g} {unit} off target"
    return None


COMMANDS = (
    Command("tare", "set the force/torque offset so that the mean reading becomes zero", _arguments, _tare),
)
