"""`watch`: live values in SI units per block of samples: a table on a terminal, else one line per block."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.judge import Observation, judge
from bota_ethercat.health.verdict import LIMITS
from ethercat_server.access.sensors import note
from ethercat_server.errors import UsageError
from ethercat_server.ethercat.clock import Clock, Deadline
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.sensor import Found
from ethercat_server.tool.command import (
    DONE,
    Command,
    add_sensor_arguments,
    columns,
    say,
    say_json,
    sensors_of,
)
from ethercat_server.tool.commands.block import Block

_TERMINAL_INTERVAL_S: Final = 0.25
_LINE_INTERVAL_S: Final = 1.0
_VECTORS: Final = (
    ("force", "N", 3), ("torque", "Nm", 4), ("acceleration", "m/s²", 3), ("angular_rate", "rad/s", 4),
)  # fmt: skip


class _Watch:
    """Collects frames and shows them."""

    def __init__(self, sensors: Sequence[Found], args: argparse.Namespace, clock: Clock) -> None:
        self.on_terminal = sys.stdout.isatty() and not args.json
        usual = _TERMINAL_INTERVAL_S if self.on_terminal else _LINE_INTERVAL_S
        self._interval_s = args.interval or usual
        self._sensors = {sensor.number: sensor for sensor in sensors}
        self._blocks = {number: Block() for number in self._sensors}
        self._taken = dict.fromkeys(self._sensors, 0)
        self._silent = {number: Observation() for number in self._sensors}
        """What came instead of samples."""
        self._began_ns = clock.monotonic_ns()
        self._samples, self._json = args.samples, args.json
        self._clock, self._seconds = clock, args.seconds
        self._end: Deadline | None = None
        self._show: Deadline | None = None
        self._height = 0

    def take(self, frame: DataMessage) -> bool:
        """Add a frame; returns whether to continue."""
        number = frame.sensor
        if self._samples is not None and self._taken[number] >= self._samples:
            return not self._enough()
        if self._blocks[number].take(frame):
            self._taken[number] += 1
        else:
            invalid, seen = bool(frame.flags & DataFlag.INVALID), self._silent[number]
            self._silent[number] = seen._replace(
                invalid=seen.invalid + invalid, repeated=seen.repeated + (not invalid)
            )
        return not self._enough()

    def _enough(self) -> bool:
        return self._samples is not None and min(self._taken.values()) >= self._samples

    def idle(self) -> bool:
        """Show what is due; returns whether to continue."""
        if self._show is None:  # it begins: the sensors have settled
            self._began_ns = self._clock.monotonic_ns()
            self._show = Deadline(self._clock, self._interval_s)
            self._end = Deadline(self._clock, self._seconds) if self._seconds else None
        if self._end is not None and self._end.passed:
            return False
        if self._show.passed:
            self._show = Deadline(self._clock, self._interval_s)
            self.show()
        return True

    def show(self) -> None:
        """Show all blocks and start new ones."""
        found = {number: block.finish() for number, block in self._blocks.items() if block}
        if self.on_terminal:
            self._show_table(found)
            return
        for number, row in found.items():
            if self._json:
                say_json({**self._sensors[number].as_json(), **row}, indent=None)
            else:
                say(f"sensor {number}  {_line(row)}")

    def _show_table(self, found: dict[int, dict[str, Any]]) -> None:
        text = "\n".join(f"{self._sensors[number]}\n{_table(row)}" for number, row in found.items())
        if not text:
            return
        # Cursor to the first line of the previous table, then clear from there.
        sys.stdout.write((f"\x1b[{self._height}F" if self._height else "") + "\x1b[J")
        self._height = text.count("\n") + 1
        say(text)

    def summary(self) -> str:
        """Number of samples per sensor."""
        return ", ".join(f"sensor {number}: {count} samples" for number, count in self._taken.items())

    def problems(self) -> list[str]:
        """A sentence for each sensor that sent nothing."""
        if self._show is None:  # it ended before it began
            return []
        silent_s = (self._clock.monotonic_ns() - self._began_ns) * 1e-9
        return [
            f"sensor {number}: {judge(seen._replace(silent_s=silent_s)).sentence}"
            for number, seen in self._silent.items()
            if not self._taken[number] and silent_s > LIMITS.stale_after
        ]


def _counts(row: dict[str, Any]) -> str:
    rate = f"{row['rate_hz']:7.1f} Hz" if row["rate_hz"] else "     -- Hz"
    text = f"{row['samples']:5d} samples {rate}"
    for key in ("invalid", "repeated", "gaps"):
        if row[key]:
            text += f"  {key} {row[key]}"
    return text


def _warnings(row: dict[str, Any]) -> list[str]:
    return [f"{warning['severity']}: {warning['meaning']}" for warning in row["warnings"]]


def _line(row: dict[str, Any]) -> str:
    parts = [_counts(row)]
    if "force" in row:
        for (name, unit, digits), letter in zip(_VECTORS, "FMAR", strict=True):
            parts.append(f"{letter} " + " ".join(f"{v:+.{digits}f}" for v in row[name]) + f" {unit}")
        parts.append(f"{row['temperature']:.1f} °C")
    return "  ".join([*parts, *_warnings(row)])


def _table(row: dict[str, Any]) -> str:
    rows: list[tuple[str, ...]] = [("", "x", "y", "z", "", "standard deviation")]
    for name, unit, digits in _VECTORS if "force" in row else ():
        means = [f"{v:+{digits + 6}.{digits}f}" for v in row[name]]
        rows.append(
            (
                name.replace("_", " "),
                *means,
                unit,
                " ".join(f"{v:.{digits}f}" for v in row["deviation"][name]),
            )
        )
    lines = [f"  {_counts(row)}", columns(rows, indent=2)]
    if "force" in row:
        lines.append(f"  temperature {row['temperature']:.1f} °C")
    return "\n".join([*lines, *(f"  {text}" for text in _warnings(row) or ["no warnings"])])


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e9:
        raise ValueError(text)
    return value


_positive.__name__ = "positive number"


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_sensor_arguments(parser, all_if_none=True)
    parser.add_argument("--samples", type=int, metavar="N", help="stop after N samples of each sensor")
    parser.add_argument("--seconds", type=_positive, metavar="S", help="stop after S seconds")
    parser.add_argument(
        "--interval", type=_positive, metavar="S",
        help=f"length of a block (default {_LINE_INTERVAL_S:g}, on a terminal {_TERMINAL_INTERVAL_S:g})",
    )  # fmt: skip


def _watch(args: argparse.Namespace) -> int:
    if args.samples is not None and args.samples < 1:
        raise UsageError(f"--samples {args.samples}: it must be 1 or more")
    with sensors_of(args) as opened:
        sensors = opened.chosen(args.sensor)
        watch = _Watch(sensors, args, opened.clock)
        if not args.json and not watch.on_terminal:
            say("\n".join(f"{sensor} (mean of each block)" for sensor in sensors))
        try:
            opened.watch([sensor.number for sensor in sensors], watch.take, watch.idle)
        except KeyboardInterrupt:
            pass  # the normal end
        finally:
            watch.show()
        if not args.json:
            say(watch.summary())
        problems = watch.problems()
    for problem in problems:
        note(problem)
    return FAILED if problems else DONE


COMMANDS = (Command("watch", "show live values until Ctrl-C", _arguments, _watch),)
