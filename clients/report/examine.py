"""Everything that is measured of one subject, every check, and what they come to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from clients.report.checks import noise, register, spectrum, stuck, surroundings
from clients.report.checks.check import Check, Verdict, judged, verdict
from clients.report.checks.timing import Timing, check_losses, check_rate, check_silence, check_stamps
from clients.report.observe import observe
from clients.report.subjects.series import Series
from clients.report.subjects.subject import Subject
from protocol.health.judge import judge
from protocol.health.verdict import Finding
from protocol.health.verdict import Verdict as StreamVerdict


@dataclass(frozen=True)
class Examination:
    """One sensor, examined."""

    subject: Subject
    series: Series
    timing: Timing
    noise: noise.Noise
    spectrum: spectrum.Spectrum | None
    drift: surroundings.Drift
    stream: StreamVerdict
    """Of the judge of all programs; the checks beyond it are this report's own."""
    checks: tuple[Check, ...]
    verdict: Verdict


_AGE: Final = "Age of samples"
_SETTINGS: Final = "Settings"
"""Checks that are there only if something was found."""
_CHECKS: Final = {
    "lost": "lost", "silence": "silence", "invalid": "silence", "repeated": "silence",
    "not_finite": "numbers", "rate": "rate", "temperature": "temperature", "clock": "stamps",
    "age": _AGE, "calibration_matrix": _SETTINGS, "coordinate_system": _SETTINGS,
    **{f"warning {1 << bit}": "saturation" if 1 << bit & register.OF_SATURATION else "warnings"
       for bit in range(32)},
}  # fmt: skip
"""To which check each finding of the judge of streams belongs."""


def examine(subject: Subject) -> Examination:
    """Measure and judge."""
    series = Series(subject)
    timing, measured = Timing(series), noise.measure(series)
    verdict_on_stream = judge(observe(timing))
    of: dict[str, list[Finding]] = {check: [] for check in _CHECKS.values()}
    for finding in verdict_on_stream.findings:
        of[_CHECKS[finding.key]].append(finding)
    checks = (
        check_losses(timing, of["lost"]),
        check_silence(timing, of["silence"]),
        stuck.check(series),
        noise.check_force_torque(series, measured),
        noise.check_imu(series, measured),
        register.check_saturation(series, of["saturation"]),
        register.check_warnings(series, of["warnings"]),
        register.check_numbers(series, timing.not_finite, of["numbers"]),
        check_stamps(timing, of["stamps"]),
        check_rate(timing, of["rate"]),
        surroundings.check_gravity(series),
        surroundings.check_temperature(series, of["temperature"]),
        *(judged(name, of[name], "") for name in (_AGE, _SETTINGS) if of[name]),
    )
    return Examination(
        subject, series, timing, measured, spectrum.measure(series), surroundings.drift(series),
        verdict_on_stream, checks, verdict(checks),
    )  # fmt: skip
