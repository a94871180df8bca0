"""`tare`: sets the sensor's own force/torque offset so that its mean reading becomes a given wrench."""

from __future__ import annotations

import argparse
import math
from typing import Any, Final

from ethercat_server.errors import UsageError
from ethercat_server.sensor import pack_offset
from ethercat_server.tare import LEAST_SAMPLES
from ethercat_server.tool.command import DONE, Command, add_link_arguments, link
from ethercat_server.tool.settings_commands import UNSAVED
from ethercat_server.tool.show import columns, note, say, say_json
from protocol.control import ACTIONS, MAX_TARE_SAMPLES

_AXES: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
_ALLOWED_N: Final = 0.3
_ALLOWED_NM: Final = 0.01
_BY_CHANCE: Final = 5.0
"""A residual of a sensor at rest is less than that, and so many standard errors."""
_DEFAULT_SAMPLES: Final = ACTIONS["tare"].parameters["samples"].default


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_link_arguments(parser)
    parser.add_argument(
        "--samples", type=int, default=_DEFAULT_SAMPLES, metavar="N",
        help=f"how many samples to average, 1 to {MAX_TARE_SAMPLES} (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--target", type=float, nargs=6, default=[0.0] * 6, metavar=_AXES,
        help="what the sensor is to read, in N and Nm (default: zeros)",
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
        tared = opened.tare(found.place, args.samples, args.target)
    keys = ("old_offset", "new_offset", "residual", "deviation")
    if moved := _moved(tared, max(args.samples, LEAST_SAMPLES)):
        note(f"{moved} is more than noise explains: the load changed meanwhile; hold it still and tare again")
    if args.json:
        say_json({"through": opened.used, **found.as_json(), **{key: tared[key] for key in keys}})
        return DONE
    rows: list[tuple[str, ...]] = [("", "old offset", "new offset", "residual", "deviation", "")]
    for n, axis in enumerate(_AXES):
        rows.append((axis, *(f"{tared[key][n]:.4f}" for key in keys), "N" if n < 3 else "Nm"))
    say(str(found))
    say(columns(rows, indent=2))
    say(UNSAVED.replace("--save, or the command save,", "the command save"))
    return DONE


def _moved(tared: dict[str, Any], samples: int) -> str | None:
    """The first residual that says that the sensor was not at rest after all."""
    for n, axis in enumerate(_AXES):
        residual, unit = tared["residual"][n], "N" if n < 3 else "Nm"
        allowed = _ALLOWED_N if n < 3 else _ALLOWED_NM
        # Of the difference of two means of so many samples.
        if abs(residual) > allowed + _BY_CHANCE * tared["deviation"][n] * math.sqrt(2 / samples):
            return f"the residual of {axis}, {residual:.3g} {unit},"
    return None


COMMANDS = (
    Command("tare", "set the force/torque offset so that the mean reading becomes zero", _arguments, _tare),
)
