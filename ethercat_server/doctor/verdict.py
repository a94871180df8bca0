"""Findings from the latencies that a server has measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

from ethercat_server.acquisition.health.round_trip import SLOW_US, cost
from ethercat_server.doctor.finding import Finding, bad, note, ok, warning
from protocol.health.limits import LIMITS
from protocol.health.verdict import Level

_PERIOD_US: Final = 1250.0
"""The sample period at the factory setting, 800 Hz."""
_WAKE_NOTE_US: Final = 100
_WAKE_WARNING_US: Final = 250
_EXCHANGE_NOTE_US: Final = 250
_MANY: Final = 0.001
"""Fraction of all cycles above which late or lost ones are `bad`."""
_STEADIER: Final = "see 'A steadier cycle' in docs/operations.md"


def points(summary: Mapping[str, Any]) -> str:
    """Quantiles as text."""
    names = {"p50": "p50", "p99": "p99", "p999": "p99.9", "max": "max"}
    return ", ".join(f"{text} {float(summary[name]):.0f}" for name, text in names.items()) + " µs"


def scheduling(priority: int, *, real_time: bool) -> Iterator[Finding]:
    """Scheduling of the loop."""
    if real_time:
        yield ok(f"SCHED_FIFO {priority}", real_time=True)
    elif not priority:
        yield note("ordinary scheduling, as requested", "other programs preempt it", real_time=False)
    else:
        why = (
            "real-time priority was not granted, so other programs preempt it: run with sudo, or as a service"
        )
        yield note("ordinary scheduling", why, real_time=False)


def wake_finding(summary: Mapping[str, Any], late: int, count: int) -> Finding:
    """The finding for a summary: `late` of `count` wake-ups were late by more than a sample period."""
    text = f"late by {points(summary)}"
    values: dict[str, Any] = {**summary, "wake_ups": count, "later_than_a_period": late}
    if late:
        text += f"; {late} of {count} by more than a sample period"
        make = bad if late > _MANY * count else warning
        why = f"each loses samples; other work, or a hypervisor, used the CPU: {_STEADIER}"
        return make(text, why, **values)
    if summary["p99"] > _WAKE_WARNING_US:
        return warning(text, f"increases the age of samples: {_STEADIER}", **values)
    if summary["p99"] > _WAKE_NOTE_US:
        return note(
            text,
            f"usual without a real-time kernel; occasionally increases the age of samples: {_STEADIER}",
            **values,
        )
    return ok(text, **values)


def exchange_finding(when: str, summary: Mapping[str, Any], lost: int, count: int) -> Finding:
    """The finding for a summary: `lost` of `count` exchanges did not come back."""
    text = f"{points(summary)}{when}"
    values: dict[str, Any] = {**summary, "exchanges": count, "lost": lost}
    if lost:
        make = bad if lost > _MANY * count else warning
        why = "each may cost a sample: check the cable; a busy virtual machine loses frames, too"
        return make(f"{text}; {lost} frames lost of {count}", why, **values)
    if summary["p50"] > SLOW_US:
        why = f"slow network card or driver: {cost(summary['p50'])}; see coalescing, interrupts"
        return warning(text, why, **values)
    if summary["p99"] > _EXCHANGE_NOTE_US:
        return note(text, "network card, driver or load: see coalescing, interrupts", **values)
    return ok(text, **values)


def age_finding(what: str, summary: Mapping[str, Any], how: str) -> Finding:
    """The finding for a summary of ages; `how` it was obtained."""
    text = f"{what}: {points(summary)}"
    if summary["p99"] > _PERIOD_US:
        make = _by_age(summary["p99"])
        return make(text, f"occasionally more than a sample period ({how})", **summary)
    return ok(text, how, **summary)


def _by_age(p99_us: float) -> Callable[..., Finding]:
    """What the judge of streams would say of samples that are so late or old."""
    if p99_us >= LIMITS.age_error * 1e6:
        return bad
    return warning if p99_us >= LIMITS.age_warn * 1e6 else note


def as_cause(finding: Finding) -> Finding:
    """The same about a server that streams: its stream has a verdict, this may be the cause."""
    return replace(finding, level=min(finding.level, Level.LOOK))
