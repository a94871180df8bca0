"""`watch`: live values in SI units and a line per block of samples."""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from bota_ethercat.accounting import NOT_NEW, FrameKind, StreamAccounting, StreamCounts
from bota_ethercat.control import Event
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.judge import Observation, judge
from bota_ethercat.health.verdict import LIMITS
from bota_ethercat.pdo import Sample
from bota_ethercat.sensor.warnings_register import explain
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.access.sensors import Sensors, note
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.process.command_line import FAILED
from ethercat_server.tool.command import (
    DONE,
    Command,
    argument,
    chosen,
    say,
    say_json,
    sensor_arguments,
    sensors_of,
)

_INTERVAL_S: Final = 1.0
# Name, letter, unit, digits.
_VECTORS: Final = (
    ("force", "F", "N", 3), ("torque", "M", "Nm", 4), ("acceleration", "A", "m/s²", 3),
    ("angular_rate", "R", "rad/s", 4),
)  # fmt: skip
_FOREVER_S: Final = 1e9
_LEAST_INTERVALS: Final = 10  # for a rate
# What is told of a watched sensor, unless the event has a message of its own.
_TOLD: Final[Mapping[str, str]] = {
    Event.SENSOR_LOST: "sensor {sensor} is lost",
    Event.SENSOR_BACK: "sensor {sensor} is back after {lost_s} s",
    Event.EMERGENCY: "sensor {sensor} reports an emergency",
    Event.RECONFIGURED: "the settings of sensor {sensor} have changed",
}


class Block:
    """Statistics of a block of samples of one sensor: mean, standard deviation, rate, warnings, losses.

    Attributes:
        counts: of this block.
        total: what `finish` counted of the blocks before.
    """

    def __init__(self) -> None:
        self.total = Counter[str]()
        self._accounting, self._gap = StreamAccounting(), 0
        self._begin()

    def _begin(self) -> None:
        self.counts = self._accounting.counts = StreamCounts()
        self._first_ns, self._intervals, self._warnings = self._accounting.new_ns, 0, 0
        self._means, self._squares = [0.0] * 12, [0.0] * 12  # the squares are of the deviations, summed up
        self._newest: Sample | None = None

    @property
    def samples(self) -> int:
        """All so far."""
        return self.total["samples"] + self.counts.new

    def take(self, frame: DataMessage, sample: Sample, *, settled: bool) -> None:
        """Add a frame and what it holds; a sample that has not settled is left out, its GAP is the next's."""
        self._gap |= frame.flags & DataFlag.GAP
        if not settled and not frame.flags & NOT_NEW:
            return
        kind = self._accounting.take(frame.sequence, frame.monotonic_ns, frame.flags | self._gap)
        self._gap = 0
        # A stuck sensor has nothing newer than what it repeats.
        if kind is FrameKind.NEW or (kind is FrameKind.REPEATED and self._newest is None):
            self._newest = sample
        if kind is FrameKind.NEW:
            self._warnings |= sample.warnings
            for n, value in enumerate(sample.array):  # Welford's algorithm
                before = value - self._means[n]
                self._means[n] += before / self.counts.new
                self._squares[n] += before * (value - self._means[n])
            if self._first_ns < 0:
                self._first_ns = frame.monotonic_ns
            else:
                self._intervals += 1

    def finish(self) -> dict[str, Any] | None:
        """The statistics in SI units, ready for JSON, None without frames; then begin the next block."""
        counts, span_ns = self.counts, self._accounting.new_ns - self._first_ns
        if not counts.frames:
            return None
        found: dict[str, Any] = {
            "samples": counts.new,
            "rate_hz": self._intervals * 1e9 / span_ns if self._intervals >= _LEAST_INTERVALS else None,
            "invalid": counts.invalid,
            "repeated": counts.repeated,
            "gaps": counts.gaps,
        }
        self.total.update(samples=counts.new, invalid=counts.invalid, repeated=counts.repeated)
        if self._newest is not None:
            means = self._means if counts.new else self._newest.array
            deviations = [math.sqrt(squares / max(1, counts.new)) for squares in self._squares]
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


class _Watch:
    """Collects frames and shows them."""

    def __init__(self, opened: Sensors, args: argparse.Namespace) -> None:
        self._opened, self._args = opened, args
        self._sensors = {sensor.number: sensor for sensor in chosen(opened, args)}
        self._blocks = {number: Block() for number in self._sensors}
        self._began_ns = opened.clock.monotonic_ns()

    def run(self) -> None:
        """Until it is over, or KeyboardInterrupt."""
        if not self._args.json:
            say("\n".join(f"{sensor} (mean of each block)" for sensor in self._sensors.values()))
        opened, most = self._opened, self._args.samples or math.inf
        opened.wait_settled(self._sensors)
        self._began_ns = opened.clock.monotonic_ns()
        end = Deadline(opened.clock, self._args.seconds or _FOREVER_S)
        show = Deadline(opened.clock, self._args.interval)
        awaited = set[int]()
        for frames, events in opened.stream(sensors=list(self._sensors)):
            settling = {event["sensor"] for event in events if self._tell(event)}
            for frame in frames:
                block = self._blocks[frame.sensor]
                if block.samples < most:
                    settled = frame.sensor not in awaited | settling
                    block.take(frame, opened.client.decode(frame), settled=settled)
            if end.passed or all(block.samples >= most for block in self._blocks.values()):
                return
            opened.wait_settled(settling)
            awaited = settling  # their samples that came meanwhile are in the next batch
            if show.passed:
                show = Deadline(opened.clock, self._args.interval)
                self.show()

    def _tell(self, event: JsonObject) -> bool:
        """Say what happened to a watched sensor; whether its data has to settle."""
        kind, number = event["event"], event.get("sensor")
        if kind == Event.SHUTTING_DOWN:
            raise ServerError(f"{self._opened.used} is shutting down")
        if kind not in _TOLD or number not in self._sensors:
            return False
        note(str(event.get("message") or _TOLD[kind].format_map({"lost_s": None, **event})))
        return kind in (Event.SENSOR_BACK, Event.RECONFIGURED)

    def show(self) -> None:
        """Show all blocks and start new ones."""
        for number, block in self._blocks.items():
            if (row := block.finish()) is None:
                continue
            if self._args.json:
                say_json({**self._sensors[number].as_json(), **row}, indent=None)
            else:
                say(f"sensor {number}  {_line(row)}")

    def finish(self) -> int:
        """Say how many samples there were, and which sensor sent none; the exit code."""
        if not self._args.json:
            say(
                ", ".join(f"sensor {number}: {each.samples} samples" for number, each in self._blocks.items())
            )
        silent_s = (self._opened.clock.monotonic_ns() - self._began_ns) * 1e-9
        silent = {number: each.total for number, each in self._blocks.items() if not each.samples}
        if silent_s <= LIMITS.stale_after or not silent:
            return DONE
        for number, total in silent.items():
            seen = Observation(invalid=total["invalid"], repeated=total["repeated"], silent_s=silent_s)
            note(f"sensor {number}: {judge(seen).sentence}")
        return FAILED


def _line(row: dict[str, Any]) -> str:
    rate = f"{row['rate_hz']:7.1f} Hz" if row["rate_hz"] else "     -- Hz"
    parts = [f"{row['samples']:5d} samples {rate}"]
    parts += [f"{key} {row[key]}" for key in ("invalid", "repeated", "gaps") if row[key]]
    if "force" in row:
        for name, letter, unit, digits in _VECTORS:
            parts.append(f"{letter} " + " ".join(f"{v:+.{digits}f}" for v in row[name]) + f" {unit}")
        parts.append(f"{row['temperature']:.1f} °C")
    parts += [f"{warning['severity']}: {warning['meaning']}" for warning in row["warnings"]]
    return "  ".join(parts)


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
        watch = _Watch(opened, args)
        try:
            watch.run()
        except KeyboardInterrupt:
            pass  # the normal end
        finally:
            watch.show()
        return watch.finish()


COMMANDS: Final = (
    Command(
        "watch", "show live values until Ctrl-C",
        (
            *sensor_arguments(all_if_none=True),
            argument("--samples", "stop after N samples of each sensor", type=int, metavar="N"),
            argument("--seconds", "stop after S seconds", type=_positive, metavar="S"),
            argument(
                "--interval", "length of a block (default %(default)g)", type=_positive, metavar="S",
                default=_INTERVAL_S,
            ),
        ),
        _watch,
    ),
)  # fmt: skip
