"""Checks of what the sensor itself reports: warnings, saturation, values that are numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from clients.numbers import count, listing, seconds, share
from clients.report.checks.channels import CHANNELS, GROUPS, Channel
from clients.report.checks.check import Check, judged
from clients.report.checks.timing import too_few
from clients.report.subjects.series import Bools, Series
from protocol.health.verdict import Finding
from protocol.sensor.warnings_register import WarningFlag, WarningMeaning, explain

OF_SATURATION = (
    WarningFlag.FORCE_TORQUE_SATURATED
    | WarningFlag.ACCELERATION_SATURATED
    | WarningFlag.ANGULAR_RATE_SATURATED
)


class Raised(NamedTuple):
    """One bit of the warnings register that was set."""

    meaning: WarningMeaning
    samples: int
    first_s: float


def raised(series: Series) -> list[Raised]:
    """The warnings that were set in some sample, lowest bit first."""
    register = series.samples.warnings
    every = int(np.bitwise_or.reduce(register)) if len(register) else 0
    found = []
    for meaning in explain(every):
        indices = np.flatnonzero(register & meaning.flag)
        found.append(Raised(meaning, len(indices), float(series.time[indices[0]])))
    return found


class Saturated(NamedTuple):
    """One channel that was saturated."""

    channel: Channel
    samples: int
    first_s: float


def saturated(series: Series) -> list[Saturated]:
    """The channels that the sensor says were saturated."""
    found = []
    for index, channel in enumerate(CHANNELS):
        indices = np.flatnonzero(series.saturated[:, index])
        if len(indices):
            found.append(Saturated(channel, len(indices), float(series.time[indices[0]])))
    return found


def unknown_saturation_bits(series: Series) -> bool:
    """Whether a saturation field has an undefined bit."""
    return any(
        bool(np.any(getattr(series.samples, group.saturation) & ~_known_bits(group.saturation)))
        for group in GROUPS
    )


def _known_bits(field: str) -> int:
    return sum(channel.bit for channel in CHANNELS if channel.group.saturation == field)


def check_saturation(series: Series, findings: Sequence[Finding]) -> Check:
    """Were all channels within their range?"""
    name = "Saturation"
    if not series.count:
        return too_few(name, 0)
    texts = [
        f"{each.channel.title} was saturated in {count(each.samples, 'sample')} "
        f"({share(each.samples, series.count)}), first {seconds(each.first_s)} after the start"
        for each in saturated(series)
    ]
    if unknown_saturation_bits(series):
        texts.append("a saturation field has an undefined bit")
    details = f"{listing(texts)}." if texts else ""
    return judged(
        name, findings, "No channel was saturated.", details=details,
        matters="The measured values are less than the real ones.",
        remedy="If it is unloaded, it may have been damaged by overload: tare it and compare.",
    )  # fmt: skip


def check_warnings(series: Series, findings: Sequence[Finding]) -> Check:
    """Did the sensor report a warning other than saturation?"""
    name = "Warnings"
    if not series.count:
        return too_few(name, 0)
    found = [each for each in raised(series) if not each.meaning.flag & OF_SATURATION]
    only = " other than of saturation" if raised(series) else ""
    texts = [
        f"{each.meaning.meaning} ({each.meaning.severity.value}) in {count(each.samples, 'sample')}, first "
        f"{seconds(each.first_s)} after the start"
        for each in found
    ]
    return judged(
        name, findings, f"The sensor reported no warnings{only}.",
        details=f"{listing(texts)}." if texts else "", matters="The sensor reports it.",
    )  # fmt: skip


def check_numbers(series: Series, not_finite: Bools, findings: Sequence[Finding]) -> Check:
    """Is every value a finite number?"""
    name = "Numbers"
    if not series.count:
        return too_few(name, 0)
    channels = [c.title for index, c in enumerate(CHANNELS) if not series.finite[:, index].all()]
    if not np.isfinite(series.samples.temperature).all():
        channels.append("Temperature")
    wrong = int(not_finite.sum())
    return judged(
        name, findings, "Every value is a finite number.",
        details=f"{count(wrong, 'sample')} ({share(wrong, series.count)}): {listing(channels)}.",
        matters="A single one of them corrupts every sum and filter.",
    )  # fmt: skip
