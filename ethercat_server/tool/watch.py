"""`watch`: live values in SI units, block by block: a table on a terminal, else a line a block."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

from ethercat_server.errors import UsageError
from ethercat_server.tool.block import Block
from ethercat_server.tool.command import DONE, Command, add_link_arguments, link
from ethercat_server.tool.link import Found
from ethercat_server.tool.show import columns, say, say_json
from protocol.framing import DataMessage

_TERMINAL_INTERVAL_S: Final = 0.25
_LINE_INTERVAL_S: Final = 1.0
_VECTORS: Final = (
    ("force", "N", 3), ("torque", "Nm", 4), ("acceleration", "m/s²", 3), ("angular_rate", "rad/s", 4),
)  # fmt: skip


class _Watch:
    """What has come, and what is shown of it."""

    def __init__(self, sensors: Sequence[Found], args: argparse.Namespace) -> None:
        self.on_terminal = sys.stdout.isatty() and not args.json
        usual = _TERMINAL_INTERVAL_S if self.on_terminal else _LINE_INTERVAL_S
        self._interval_s = args.interval or usual
        self._sensors = {sensor.place: sensor for sensor in sensors}
        self._blocks = {place: Block() for place in self._sensors}
        self._taken = dict.fromkeys(self._sensors, 0)
        self._samples, self._json = args.samples, args.json
        now = time.monotonic()
        self._end_at = now + args.seconds if args.seconds else None
        self._show_at = now + self._interval_s
        self._height = 0

    def take(self, frame: DataMessage) -> bool:
        """A frame; whether more are wanted."""
        place = frame.sensor
        if self._samples is not None and self._taken[place] >= self._samples:
            return not self._enough()
        self._taken[place] += self._blocks[place].take(frame)
        return not self._enough()

    def _enough(self) -> bool:
        return self._samples is not None and min(self._taken.values()) >= self._samples

    def idle(self) -> bool:
        """Show what is due; whether to go on."""
        now = time.monotonic()
        if self._end_at is not None and now >= self._end_at:
            return False
        if now >= self._show_at:
            self._show_at = now + self._interval_s
            self.show()
        return True

    def show(self) -> None:
        """Show all blocks and begin new ones."""
        found = {place: block.finish() for place, block in self._blocks.items() if block}
        if self.on_terminal:
            self._show_table(found)
            return
        for place, row in found.items():
            if self._json:
                say_json({**self._sensors[place].as_json(), **row}, indent=None)
            else:
                say(f"sensor {place}  {_line(row)}")

    def _show_table(self, found: dict[int, dict[str, Any]]) -> None:
        text = "\n".join(f"{self._sensors[place]}\n{_table(row)}" for place, row in found.items())
        if not text:
            return
        # Up to the first line of what stands there, and clear from there on.
        sys.stdout.write((f"\x1b[{self._height}F" if self._height else "") + "\x1b[J")
        self._height = text.count("\n") + 1
        say(text)

    def summary(self) -> str:
        """How it went."""
        return ", ".join(f"sensor {place}: {count} samples" for place, count in self._taken.items())


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
    add_link_arguments(parser, all_if_none=True)
    parser.add_argument("--samples", type=int, metavar="N", help="end after N samples of each sensor")
    parser.add_argument("--seconds", type=_positive, metavar="S", help="end after S seconds")
    parser.add_argument(
        "--interval", type=_positive, metavar="S",
        help=f"length of a block (default {_LINE_INTERVAL_S:g}, on a terminal {_TERMINAL_INTERVAL_S:g})",
    )  # fmt: skip


def _watch(args: argparse.Namespace) -> int:
    if args.samples is not None and args.samples < 1:
        raise UsageError(f"--samples {args.samples}: it must be 1 or more")
    with link(args) as opened:
        sensors = opened.chosen(args.sensor)
        watch = _Watch(sensors, args)
        if not args.json and not watch.on_terminal:
            say("\n".join(f"{sensor} (mean of each block)" for sensor in sensors))
        try:
            opened.watch([sensor.place for sensor in sensors], watch.take, watch.idle)
        except KeyboardInterrupt:
            pass  # the usual end
        finally:
            watch.show()
        if not args.json:
            say(watch.summary())
    return DONE


COMMANDS = (Command("watch", "show live values until Ctrl-C", _arguments, _watch),)
