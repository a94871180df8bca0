"""Everything that is measured of one subject, every check, and what they come to."""

from __future__ import annotations

from dataclasses import dataclass

from clients.report.checks import noise, register, spectrum, stuck, surroundings, timing
from clients.report.checks.check import Check, Verdict, verdict
from clients.report.subjects.series import Series
from clients.report.subjects.subject import Subject


@dataclass(frozen=True)
class Examination:
    """One sensor, examined."""

    subject: Subject
    series: Series
    timing: timing.Timing
    noise: noise.Noise
    spectrum: spectrum.Spectrum | None
    drift: surroundings.Drift
    checks: tuple[Check, ...]
    verdict: Verdict


def examine(subject: Subject) -> Examination:
    """Measure and judge."""
    series = Series(subject)
    stream, measured = timing.Timing(series), noise.measure(series)
    checks = (
        timing.check_losses(stream),
        timing.check_silence(stream),
        stuck.check(series),
        noise.check_force_torque(series, measured),
        noise.check_imu(series, measured),
        register.check_saturation(series),
        register.check_warnings(series),
        register.check_numbers(series),
        timing.check_stamps(stream),
        timing.check_rate(stream),
        surroundings.check_gravity(series),
        surroundings.check_temperature(series),
    )
    return Examination(
        subject, series, stream, measured, spectrum.measure(series), surroundings.drift(series), checks,
        verdict(checks),
    )  # fmt: skip
