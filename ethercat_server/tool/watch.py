"""`watch`: live values in SI units per block of samples: a table on a terminal, else one line per block."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.judge import Observation, judge
from bota_ethercat.health.verdict import LIMITS
from bota_ethercat.pdo import Sample, SampleDecoder
from bota_ethercat.sensor.warnings_register import explain
from ethercat_server.access.sensors import note
from ethercat_server.errors import UsageError
from ethercat_server.ethercat.clock import Clock, Deadline
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.sensor import Found
from ethercat_server.tool.command import (
    DONE,
    Command,
    argument,
    columns,
    say,
    say_json,
    sensor_arguments,
    sensors_of,
)

_TERMINAL_INTERVAL_S: Final = 0.25
_LINE_INTERVAL_S: Final = 1.0
# Name, letter, unit, digits.
_VECTORS: Final = (
    ("force", "F", "N", 3), ("torque", "M", "Nm", 4), ("acceleration", "A", "m/s²", 3),
    ("angular_rate", "R", "rad/s", 4),
)  # fmt: skip
_LEAST_INTERVALS: Final = 10  # for a rate


class Block:
    """Statistics of a block of samples of one sensor: mean, standard deviation, rate, warnings, losses.

    Attributes:
        samples, invalid, repeated: since the first block.
    """

    def __init__(self) -> None:
        self.samples = self.invalid = self.repeated = 0
        self._decoders: dict[int, SampleDecoder] = {}
        self._last_ns: int | None = None
        self._begin()

    def _begin(self) -> None:
        self._before = self.samples, self.invalid, self.repeated
        self._gaps = self._warnings = 0
        self._first_ns = self._last_ns
        self._origin: list[float] = []  # what the sums are relative to, so that they stay exact
        self._sums, self._squares = [0.0] * 12, [0.0] * 12
        self._newest: Sample | None = None

    def __bool__(self) -> bool:
        """Whether it has any frames."""
        return self._before != (self.samples, self.invalid, self.repeated)

    def take(self, frame: DataMessage) -> None:
        """Add a frame."""
        self._gaps += bool(frame.flags & DataFlag.GAP)
        if frame.flags & DataFlag.INVALID:
            self.invalid += 1
        elif frame.flags & DataFlag.REPEATED:
            self.repeated += 1
            self._newest = self._newest or self._decode(frame)  # a stuck sensor has nothing newer
        else:
            self.samples += 1
            sample = self._newest = self._decode(frame)
            self._warnings |= sample.warnings
            self._origin = self._origin or sample.array
            for n, (value, origin) in enumerate(zip(sample.array, self._origin, strict=True)):
                self._sums[n] += value - origin
                self._squares[n] += (value - origin) ** 2
            self._last_ns = frame.monotonic_ns
            if self._first_ns is None:
                self._first_ns = frame.monotonic_ns

    def _decode(self, frame: DataMessage) -> Sample:
        size = len(frame.process_data)
        return self._decoders.setdefault(size, SampleDecoder(size)).decode(frame.process_data)

    def finish(self) -> dict[str, Any]:
        """The statistics in SI units, ready for JSON; what comes then is the next block."""
        samples, invalid, repeated = self._before
        count = self.samples - samples
        found: dict[str, Any] = {
            "samples": count,
            "rate_hz": self._rate_hz(count if samples else count - 1),
            "invalid": self.invalid - invalid,
            "repeated": self.repeated - repeated,
            "gaps": self._gaps,
        }
        if self._newest is not None:
            origin, count = self._origin or self._newest.array, max(1, count)
            means = [s / count for s in self._sums]
            deviations = [
                math.sqrt(max(0.0, q / count - m * m)) for q, m in zip(self._squares, means, strict=True)
            ]
            means = [m + o for m, o in zip(means, origin, strict=True)]
            at = {name: slice(3 * n, 3 * n + 3) for n, (name, *_) in enumerate(_VECTORS)}
            found |= {name: means[where] for name, where in at.items()}
            found["deviation"] = {name: deviations[where] for name, where in at.items()}
            found["temperature"] = self._newest.temperature
            found["orientation"] = self._newest.orientation
        found["warnings"] = [
            {"severity": row.severity.value, "meaning": row.meaning, "remedy": row.remedy}
            for row in explain(self._warnings)
        ]
        self._begin()
        return found

    def _rate_hz(self, intervals: int) -> float | None:
        if self._first_ns is None or self._last_ns is None or intervals < _LEAST_INTERVALS:
            return None
        return intervals * 1e9 / (self._last_ns - self._first_ns)


class _Watch:
    """Collects frames and shows them."""

    def __init__(self, sensors: Sequence[Found], args: argparse.Namespace, clock: Clock) -> None:
        self.on_terminal = sys.stdout.isatty() and not args.json
        usual = _TERMINAL_INTERVAL_S if self.on_terminal else _LINE_INTERVAL_S
        self._interval_s = args.interval or usual
        self._sensors = {sensor.number: sensor for sensor in sensors}
        self._blocks = {number: Block() for number in self._sensors}
        self._samples, self._seconds, self._json = args.samples, args.seconds, args.json
        self._clock = clock
        self._began_ns = 0
        self._end: Deadline | None = None
        self._show: Deadline | None = None
        self._height = 0

    def take(self, frame: DataMessage) -> bool:
        """Add a frame; returns whether to continue."""
        block = self._blocks[frame.sensor]
        if self._samples is None or block.samples < self._samples:
            block.take(frame)
        return self._samples is None or min(each.samples for each in self._blocks.values()) < self._samples

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
        if not self.on_terminal:
            for number, row in found.items():
                if self._json:
                    say_json({**self._sensors[number].as_json(), **row}, indent=None)
                else:
                    say(f"sensor {number}  {_line(row)}")
        elif found:
            text = "\n".join(f"{self._sensors[number]}\n{_table(row)}" for number, row in found.items())
            # Cursor to the first line of the previous table, then clear from there.
            sys.stdout.write((f"\x1b[{self._height}F" if self._height else "") + "\x1b[J")
            self._height = text.count("\n") + 1
            say(text)

    def summary(self) -> str:
        """Number of samples per sensor."""
        return ", ".join(f"sensor {number}: {each.samples} samples" for number, each in self._blocks.items())

    def problems(self) -> list[str]:
        """A sentence for each sensor that sent nothing."""
        if self._show is None:  # it ended before it began
            return []
        silent_s = (self._clock.monotonic_ns() - self._began_ns) * 1e-9
        seen = {
            number: Observation(invalid=each.invalid, repeated=each.repeated, silent_s=silent_s)
            for number, each in self._blocks.items() if not each.samples and silent_s > LIMITS.stale_after
        }  # fmt: skip
        return [f"sensor {number}: {judge(each).sentence}" for number, each in seen.items()]


def _counts(row: dict[str, Any]) -> str:
    rate = f"{row['rate_hz']:7.1f} Hz" if row["rate_hz"] else "     -- Hz"
    text = f"{row['samples']:5d} samples {rate}"
    return text + "".join(f"  {key} {row[key]}" for key in ("invalid", "repeated", "gaps") if row[key])


def _warnings(row: dict[str, Any]) -> list[str]:
    return [f"{warning['severity']}: {warning['meaning']}" for warning in row["warnings"]]


def _line(row: dict[str, Any]) -> str:
    parts = [_counts(row)]
    if "force" in row:
        for name, letter, unit, digits in _VECTORS:
            parts.append(f"{letter} " + " ".join(f"{v:+.{digits}f}" for v in row[name]) + f" {unit}")
        parts.append(f"{row['temperature']:.1f} °C")
    return "  ".join([*parts, *_warnings(row)])


def _table(row: dict[str, Any]) -> str:
    rows: list[tuple[str, ...]] = [("", "x", "y", "z", "", "standard deviation")]
    for name, _, unit, digits in _VECTORS if "force" in row else ():
        means = [f"{v:+{digits + 6}.{digits}f}" for v in row[name]]
        deviations = " ".join(f"{v:.{digits}f}" for v in row["deviation"][name])
        rows.append((name.replace("_", " "), *means, unit, deviations))
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


_LENGTH: Final = f"length of a block (default {_LINE_INTERVAL_S:g}, on a terminal {_TERMINAL_INTERVAL_S:g})"
COMMANDS: Final = (
    Command(
        "watch", "show live values until Ctrl-C",
        (
            *sensor_arguments(all_if_none=True),
            argument("--samples", "stop after N samples of each sensor", type=int, metavar="N"),
            argument("--seconds", "stop after S seconds", type=_positive, metavar="S"),
            argument("--interval", _LENGTH, type=_positive, metavar="S"),
        ),
        _watch,
    ),
)  # fmt: skip
