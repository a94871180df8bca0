"""What the sampling clocks make of the real traces in this folder: one line of figures for each."""

from __future__ import annotations

import gzip
import json
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from unittest import mock

from ethercat_server.sampling.observation import DistributedClock
from ethercat_server.sampling.replay import Decision, Trace
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock
from ethercat_server.sampling.slave_clock import EventTimes
from ethercat_server.sampling.trace import Clocks, RecordKind

FOLDER: Final = Path(__file__).parent
BEHIND_NS: Final = 200.0  # as if another slave were behind
NAMES: Final = ("quiet", "loops", "slow", "stalls", "lies", "unplugged")
DECISIONS: Final = FOLDER / "decisions.json"


def trace(name: str) -> Trace:
    return Trace(gzip.decompress((FOLDER / f"{name}.trace.gz").read_bytes()))


def begin_anew(trace: Trace, state: Any, before: Clocks | None) -> Clocks:
    """Not what a snapshot says, which is of older clocks, but such as know nothing, as a server starts.

    Of those `before` the ones that did not begin anew here.
    """
    round_trip = before.round_trip if before else RoundTrip(state["round_trip"]["_wire_ns"])
    clocks = list(before.sensors) if before else []
    for number, each in enumerate(state["sensors"]):
        if number < len(clocks) and each["_begun"]:
            continue
        events, offset_ns = each["events"], each["_data_offset_ns"]
        if events is not None:
            loop_ns = round(2 * events["_half_loop_ns"] + BEHIND_NS)
            slave = DistributedClock(events["_offset"], loop_ns, events["_reading_ns"])
            events = EventTimes(slave, round_trip, offset_ns)
        period_ns = 1e9 / trace.about["sensors"][number]["nominal_hz"]
        clocks[number : number + 1] = [SampleClock(period_ns, round_trip, events, offset_ns)]
    return Clocks(round_trip, clocks)


def decisions(name: str) -> dict[str, int]:
    """Counts of samples and exchanges; ages of samples in µs; means of what the clocks know, in ns."""
    given, made = trace(name), list[Clocks]()

    def begun(state: Any) -> Clocks:
        made.append(begin_anew(given, state, made[-1] if made else None))
        return made[-1]

    with mock.patch("ethercat_server.sampling.replay.clocks_of", begun):
        steps, known = [], [0.0] * len(KNOWN)
        for step in given.replay():
            steps.append(step)
            for place, value in enumerate(_known(made[-1], step)):
                known[place] += value
    kinds = Counter(step.record.kind for step in steps)
    new = [step for step in steps if step.record.kind is RecordKind.FRESH]
    ages = sorted(
        step.record.sent_ns + step.record.duration_ns - step.instant_ns for step in new if step.locked
    )
    return {
        "samples": len(new),
        "polls_without_sample": kinds[RecordKind.READ],
        "invalid": kinds[RecordKind.INVALID],
        "lost": sum(max(0, step.steps - 1) for step in new),
        "put_right": sum(step.steps < 1 for step in new),
        "uncertain": sum(step.uncertain for step in new),
        "not_followed": sum(not step.locked for step in new),
        "by_events": sum(step.by_events for step in new),
        "age_p50_us": round(ages[len(ages) // 2] / 1e3),
        "age_p99_us": round(ages[len(ages) * 99 // 100] / 1e3),
        "age_mean_ns": round(sum(ages) / len(ages)),
        **{name: round(value / len(steps)) for name, value in zip(KNOWN, known, strict=True)},
    }


KNOWN: Final = (
    "next_poll_ns", "next_in_flight_ns", "next_unanswered_ns", "uncertainty_ns", "period_error_ns",
    "phase_deviation_ns", "patience_ns", "taking_over_ns", "late_ns", "lacks_event_ppm", "local_doubt_ns",
    "local_moved_ns", "local_short_ns", "local_excess_ns", "local_rate_ppt",
)  # fmt: skip


def _known(clocks: Clocks, step: Decision) -> Iterator[float]:
    """Each of `KNOWN`, after a record; 0 for what is not known."""
    clock, round_trip, sent_ns = clocks.sensors[step.record.sensor], clocks.round_trip, step.record.sent_ns
    for unanswered, in_flight in (0, False), (0, True), (2, True):
        yield clock.next_poll_ns(sent_ns, unanswered, in_flight=in_flight) - sent_ns
    yield clock.uncertainty_ns if math.isfinite(clock.uncertainty_ns) else 0.0
    yield clock.period_ns - clock.phase._nominal_ns
    yield math.sqrt(clock.phase.variance)
    yield from (round_trip.patience_ns, round_trip.taking_over_ns, round_trip.late_ns)
    yield 1e6 * (clock.events is not None and clock.events.lacks_event)
    if local := clock.events and clock.events.local_clock:
        short_ns = local.short_ns if math.isfinite(local.short_ns) else 0.0
        yield from (local.doubt_ns, local.moved_ns, short_ns, local.excess_ns)
        yield 1e12 * (local.phase.period_ns - 1)
    else:
        yield from (0.0,) * 5


if __name__ == "__main__":
    DECISIONS.write_text(json.dumps({name: decisions(name) for name in NAMES}, indent=1) + "\n")
