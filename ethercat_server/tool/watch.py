"""`watch`: mean force and torque of each sensor, and what its stream is like, once an interval."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Mapping
from typing import Any, Final

from bota_ethercat.control import Event
from bota_ethercat.framing import DataMessage
from bota_ethercat.health.judge import Observation, judge
from bota_ethercat.health.observer import COMMON, StreamObserver, by_sensor
from bota_ethercat.health.sentences import event_sentence
from bota_ethercat.health.verdict import LIMITS
from bota_ethercat.program.arguments import seconds
from bota_ethercat.replies import SensorInfo, position_of
from bota_ethercat.sensor.warnings_register import explain
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.access.sensors import Sensors, note
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.process.command_line import FAILED
from ethercat_server.sensor.sensor import Found
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

_FOREVER_S: Final = 1e9
_FORCE: Final = COMMON.index("force.x")  # torque follows
_COUNTS: Final = ("lost", "repeated", "invalid")


class _Watched:
    """One sensor: what came in this interval, and how many samples were used in all."""

    def __init__(self, found: Found, info: SensorInfo, now_ns: int) -> None:
        self.found, self.info, self.samples = found, info, 0
        self.observer = StreamObserver(info.rate_hz, now_ns)
        self._sums, self._summed = [0.0] * 6, 0

    def take(self, frames: list[DataMessage], now_ns: int, most: int) -> None:
        """Take frames, and at most so many samples of them into the mean."""
        for row in self.observer.take(frames, now_ns)[:most]:
            self._sums = [a + b for a, b in zip(self._sums, row[_FORCE : _FORCE + 6], strict=True)]
            self._summed += 1
            self.samples += 1

    def finish(self, now_ns: int) -> dict[str, Any]:
        """The interval in SI units, ready for JSON, without force and torque if it has no sample."""
        seen, count = self.observer.observation(now_ns), self._summed
        found = {"samples": count, "rate_hz": seen.rate_hz, **{key: getattr(seen, key) for key in _COUNTS}}
        if count:
            means = [value / count for value in self._sums]
            found |= {"force": means[:3], "torque": means[3:]}
        found["warnings"] = [
            {"severity": row.severity.value, "meaning": row.meaning, "remedy": row.remedy}
            for row in explain(seen.warnings)
        ]
        self.observer.begin(self.info.rate_hz, now_ns)
        self._sums, self._summed = [0.0] * 6, 0
        return found


def _tell(opened: Sensors, event: JsonObject, watched: Mapping[int, _Watched]) -> bool:
    """Say what happened to a watched sensor; whether its data has to settle."""
    kind, of = event["event"], position_of(event)
    if kind == Event.SHUTTING_DOWN:
        raise ServerError(f"{opened.used} is shutting down")
    if of is None or of not in watched:
        return False
    note(event_sentence(event))
    watched[of].info = watched[of].info.changed_by(event)
    return kind in (Event.SENSOR_BACK, Event.RECONFIGURED)


def _follow(opened: Sensors, args: argparse.Namespace, watched: Mapping[int, _Watched]) -> None:
    """Until it is over, or KeyboardInterrupt."""
    most = args.samples or sys.maxsize
    end, show = (Deadline(opened.clock, s) for s in (args.seconds or _FOREVER_S, args.interval))
    awaited = set[int]()
    for frames, events in opened.stream(sensors=list(watched), fresh_only=False):
        settling = {event["sensor"] for event in events if _tell(opened, event, watched)}
        came = by_sensor(frames)
        for sensor, each in watched.items():
            left = 0 if sensor in awaited | settling else most - each.samples
            each.take(came.get(sensor, []), opened.clock.monotonic_ns(), left)
        if end.passed or all(each.samples >= most for each in watched.values()):
            return
        opened.wait_settled(settling)
        awaited = settling  # their samples that came meanwhile are in the next batch
        if show.passed:
            show = Deadline(opened.clock, args.interval)
            _show(opened, args, watched)


def _show(opened: Sensors, args: argparse.Namespace, watched: Mapping[int, _Watched]) -> None:
    for sensor, each in watched.items():
        row = each.finish(opened.clock.monotonic_ns())
        if args.json:
            say_json({**each.found.as_json(), **row}, indent=None)
        else:
            say(f"sensor {sensor}  {_line(row)}")


def _line(row: dict[str, Any]) -> str:
    rate = f"{row['rate_hz']:7.1f} Hz" if row["rate_hz"] else "     -- Hz"
    parts = [f"{row['samples']:5d} samples {rate}", *(f"{key} {row[key]}" for key in _COUNTS if row[key])]
    if "force" in row:
        parts.append("F {:+.3f} {:+.3f} {:+.3f} N".format(*row["force"]))
        parts.append("M {:+.4f} {:+.4f} {:+.4f} Nm".format(*row["torque"]))
    return "  ".join([*parts, *(f"{each['severity']}: {each['meaning']}" for each in row["warnings"])])


def _watch(args: argparse.Namespace) -> int:
    if args.samples is not None and args.samples < 1:
        raise UsageError(f"--samples {args.samples}: it must be 1 or more")
    with sensors_of(args) as opened:
        sensors = chosen(opened, args)
        if not args.json:
            say("\n".join(map(str, sensors)))
        watched, began_ns = dict[int, _Watched](), opened.clock.monotonic_ns()
        try:
            with contextlib.suppress(KeyboardInterrupt):  # the normal end
                opened.wait_settled([found.number for found in sensors])
                known, began_ns = opened.describe(), opened.clock.monotonic_ns()
                for found in sensors:
                    info = known.find(found.number) or SensorInfo(found.number)
                    watched[found.number] = _Watched(found, info, began_ns)
                _follow(opened, args, watched)
        finally:
            _show(opened, args, watched)
        silent_s = (opened.clock.monotonic_ns() - began_ns) * 1e-9
        unread_s, _ = opened.client.take_unread()
    silent = {sensor: each.observer.counts for sensor, each in watched.items() if not each.samples}
    if silent_s <= LIMITS.stale_after or not silent:
        return DONE
    for sensor, counts in silent.items():
        seen = Observation(
            invalid=counts.invalid, repeated=counts.repeated, silent_s=silent_s, unread_s=unread_s
        )
        note(f"sensor {sensor}: {judge(seen).sentence}")
    return FAILED


COMMANDS: Final = (
    Command(
        "watch", "show force, torque and the state of the stream until Ctrl-C",
        (
            *sensor_arguments(all_if_none=True),
            argument("--samples", "stop after N samples of each sensor", type=int, metavar="N"),
            argument("--seconds", "stop after S seconds", type=seconds, metavar="S"),
            argument("--interval", "time between two lines (%(default)s)", type=seconds, metavar="S",
                     default=1.0),
        ),
        _watch,
    ),
)  # fmt: skip
