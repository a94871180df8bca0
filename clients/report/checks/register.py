"""Checks of what the sensor itself reports: warnings, saturation, values that are numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clients.numbers import count, listing, seconds, share
from clients.report.checks.channels import CHANNELS, GROUPS, Channel
from clients.report.checks.check import Check, Level
from clients.report.checks.timing import too_few
from clients.report.subjects.series import Series
from protocol.sensor.warnings_register import Severity, WarningFlag, WarningMeaning, explain

_OF_SATURATION = (
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


def check_saturation(series: Series) -> Check:
    """Were all channels within their range?"""
    name = "Saturation"
    if not series.count:
        return too_few(name, 0)
    found = saturated(series)
    texts = [
        f"{each.channel.title} was saturated in {count(each.samples, 'sample')} "
        f"({share(each.samples, series.count)}), "
        f"first {seconds(each.first_s)} after the start"
        for each in found
    ]
    for flag, fields in zip(
        _OF_SATURATION, (("force", "torque"), ("acceleration",), ("angular_rate",)), strict=True
    ):
        if np.any(series.samples.warnings & flag) and not any(e.channel.group.name in fields for e in found):
            texts.append(
                f"the warnings register says that {fields[0].replace('_', ' ')} was, but names no axis"
            )
    if unknown_saturation_bits(series):
        texts.append("a saturation field has an undefined bit")
    if not texts:
        return Check(name, Level.OK, "No channel was saturated.")
    imu_only = all(each.channel.group.is_imu for each in found) and found
    return Check(
        name, Level.FAULT, f"{listing(texts)}.", "The measured values are less than the real ones.",
        "Use a wider range (acceleration_range_g, angular_rate_range_dps)." if imu_only
        else "Reduce the load, or use a larger sensor. If it is unloaded, it may have been damaged by "
        "overload: tare it and compare.",
    )  # fmt: skip


def check_warnings(series: Series) -> Check:
    """Did the sensor report a warning other than saturation?"""
    name = "Warnings"
    if not series.count:
        return too_few(name, 0)
    found = [each for each in raised(series) if not each.meaning.flag & _OF_SATURATION]
    if not found:
        only = " other than of saturation" if raised(series) else ""
        return Check(name, Level.OK, f"The sensor reported no warnings{only}.")
    texts = [
        f"{each.meaning.meaning} ({each.meaning.severity.value}) in {count(each.samples, 'sample')}, first "
        f"{seconds(each.first_s)} after the start"
        for each in found
    ]
    worst = all(each.meaning.severity is Severity.WARNING for each in found)
    return Check(
        name, Level.ATTENTION if worst else Level.FAULT, f"{listing(texts)}.", "The sensor reports it.",
        ". ".join(dict.fromkeys(each.meaning.remedy for each in found)) + ".",
    )  # fmt: skip


def check_numbers(series: Series) -> Check:
    """Is every value a finite number?"""
    name = "Numbers"
    if not series.count:
        return too_few(name, 0)
    wrong = ~series.finite.all(axis=1) | ~np.isfinite(series.samples.temperature)
    if not wrong.any():
        return Check(name, Level.OK, "Every value is a finite number.")
    channels = [c.title for index, c in enumerate(CHANNELS) if not series.finite[:, index].all()]
    if not np.isfinite(series.samples.temperature).all():
        channels.append("Temperature")
    return Check(
        name, Level.FAULT, f"{count(int(wrong.sum()), 'sample')} "
        f"({share(int(wrong.sum()), series.count)}) with values "
        f"that are not numbers or are infinite: {listing(channels)}.",
        "A single one of them corrupts every sum and filter.", "Power-cycle the sensor. If it "
        "persists, contact the manufacturer.",
    )  # fmt: skip
