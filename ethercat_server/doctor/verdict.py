"""Judges what was measured, by the doctor or by a running server: what does it cost in samples and in age?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from ethercat_server.doctor.finding import Finding, bad, cannot_look, note, ok, skipped, warning
from ethercat_server.doctor.measurement import PERIOD_NS, Measured, summary_us
from ethercat_server.sample_clock import AIM_NS

_PERIOD_US: Final = PERIOD_NS / 1000
_WAKE_NOTE_US: Final = 100
_WAKE_WARNING_US: Final = 250
_EXCHANGE_NOTE_US: Final = 250
_EXCHANGE_WARNING_US: Final = 500
_MESSAGE_NOTE_US: Final = 500
_TIMEOUT_NS: Final = 0.75 * PERIOD_NS
"""How long the server waits for a frame."""
_MANY: Final = 0.001
"""A part of all cycles: more than so many late or lost make it bad."""
FORMULA: Final = (
    f"age = max(0, {AIM_NS / 1000:.0f} µs + lateness - its median + (exchange - its mean) / 2) + exchange / 2"
)
_STEADIER: Final = "see 'A steadier cycle' in docs/operations.md"


def points(summary: Mapping[str, Any]) -> str:
    """A distribution in words."""
    names = {"p50": "p50", "p99": "p99", "p999": "p99.9", "max": "max"}
    return ", ".join(f"{text} {float(summary[name]):.0f}" for name, text in names.items()) + " µs"


def scheduling(measured: Measured) -> Iterator[Finding]:
    """What the loop was given."""
    if measured.real_time:
        yield ok(f"SCHED_FIFO {measured.priority}", real_time=True)
    elif not measured.priority:
        yield note("ordinary scheduling, as asked for", "other programs come in between", real_time=False)
    else:
        why = (
            "real-time priority was not granted, and other programs come in between: run with sudo, "
            "or use the service"
        )
        yield note("ordinary scheduling", why, real_time=False)


def wake_ups(measured: Measured) -> Iterator[Finding]:
    """How late the loop woke."""
    if not measured.late:
        cannot_look("nothing was measured")
    summary = summary_us(measured.late)
    late = sum(value > PERIOD_NS for value in measured.late)
    yield wake_finding(summary, late, len(measured.late))


def wake_finding(summary: Mapping[str, Any], late: int, count: int) -> Finding:
    """The same for figures of any origin: `late` of `count` wake-ups missed a whole sample period."""
    text = f"late by {points(summary)}"
    values: dict[str, Any] = {**summary, "wake_ups": count, "later_than_a_period": late}
    if late:
        text += f"; {late} of {count} by more than a sample period"
        make = bad if late > _MANY * count else warning
        why = (
            "each loses samples; other work, or the host of a virtual machine, took the processor: "
            f"{_STEADIER}"
        )
        return make(text, why, **values)
    if summary["p99"] > _WAKE_WARNING_US:
        return warning(text, f"makes the samples that much older: {_STEADIER}", **values)
    if summary["p99"] > _WAKE_NOTE_US:
        return note(
            text,
            f"usual without a real-time kernel; samples are older by that now and then: {_STEADIER}",
            **values,
        )
    return ok(text, **values)


def exchanges(measured: Measured, size: int) -> Iterator[Finding]:
    """How long frames took."""
    whole = [value for value in measured.exchanges if value >= 0]
    if not whole:
        if not measured.exchanges:
            cannot_look("the bus was not looked at")
        yield bad(
            f"none of {len(measured.exchanges)} frames came back whole",
            "the slaves stopped answering: check cable and power",
            lost=measured.lost,
        )
        return
    summary = summary_us(whole)
    text = f"{points(summary)} for frames with {size} bytes of data"
    late = sum(value > _TIMEOUT_NS for value in whole)
    yield exchange_finding(text, summary, measured.lost, late, len(measured.exchanges))


def exchange_finding(text: str, summary: Mapping[str, Any], lost: int, late: int, count: int) -> Finding:
    """The same for figures of any origin: `late` came back when the server would not wait any more."""
    values: dict[str, Any] = {**summary, "exchanges": count, "lost": lost, "late": late}
    if lost or late:
        make = bad if lost + late > _MANY * count else warning
        why = (
            "each may lose a sample: check the cable; on a virtual machine or under load it may have "
            "been late"
        )
        missing = ([f"{lost} did not come back"] if lost else []) + (
            [f"{late} came too late"] if late else []
        )
        return make(f"{text}; {' and '.join(missing)} of {count}", why, **values)
    if summary["p99"] > _EXCHANGE_WARNING_US:
        return warning(
            text, "the network card or its driver takes its time: see coalescing, interrupts", **values
        )
    if summary["p99"] > _EXCHANGE_NOTE_US:
        return note(text, "the network card, its driver or the load: see coalescing, interrupts", **values)
    return ok(text, **values)


def messages(measured: Measured) -> Iterator[Finding]:
    """How long a message takes to a client that has no real-time scheduling."""
    if not measured.messages:
        cannot_look("no message came through: is the loopback interface up?")
    summary = summary_us(list(measured.messages.values()))
    text = f"{points(summary)} to a client on this machine"
    missing = len(measured.late) - len(measured.messages)
    if summary["p99"] > _MESSAGE_NOTE_US or missing:
        why = (
            "clients have ordinary scheduling, and other programs come in between: see the load of "
            "this machine"
        )
        yield note(text, why, missing=missing, **summary)
    else:
        yield ok(text, missing=missing, **summary)


def age(measured: Measured) -> Iterator[Finding]:
    """How old samples would be when the server hands them out, and at a client."""
    handed_out, arrived = measured.ages()
    if not handed_out:
        yield skipped("it follows from exchanges on the bus")
        return
    yield age_finding("expected when handed out", summary_us(handed_out), FORMULA)
    if arrived:
        yield age_finding("expected at a client here", summary_us(arrived), "the same + message")


def age_finding(what: str, summary: Mapping[str, Any], how: str) -> Finding:
    """Ages of any origin; `how` they were found."""
    text = f"{what}: {points(summary)}"
    if summary["p99"] > _PERIOD_US:
        return note(text, f"more than a sample period now and then ({how})", **summary)
    return ok(text, how, **summary)
