"""Checks of what the sensor itself says: its warnings, its saturation fields, values that are numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clients.report.channels import CHANNELS, GROUPS, Channel
from clients.report.check import Check, Level
from clients.report.series import Series
from clients.report.timing import too_few
from clients.report.words import count, listing, seconds, share
from protocol.warnings_register import Severity, WarningFlag, WarningMeaning, explain

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
        places = np.flatnonzero(register & meaning.flag)
        found.append(Raised(meaning, len(places), float(series.time[places[0]])))
    return found


class Saturated(NamedTuple):
    """One channel that was saturated."""

    channel: Channel
    samples: int
    first_s: float


def saturated(series: Series) -> list[Saturated]:
    """The channels that the sensor says were saturated."""
    found = []
    for place, channel in enumerate(CHANNELS):
        places = np.flatnonzero(series.saturated[:, place])
        if len(places):
            found.append(Saturated(channel, len(places), float(series.time[places[0]])))
    return found


def unknown_saturation_bits(series: Series) -> bool:
    """Whether a saturation field has a bit that belongs to no axis."""
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
        texts.append("a saturation field has a bit that belongs to no axis")
    if not texts:
        return Check(name, Level.OK, "No channel was saturated.")
    imu_only = all(each.channel.group.is_imu for each in found) and found
    return Check(
        name, Level.FAULT, f"{listing(texts)}.", "What was measured then is less than what was there.",
        "Use a wider range (acceleration_range_g, angular_rate_range_dps)." if imu_only
        else "Reduce the load, or the sensor is too small for it. At rest and unloaded: has it been "
        "overloaded? "
        "Compare with a tare.",
    )  # fmt: skip


def check_warnings(series: Series) -> Check:
    """Did the sensor warn of something other than saturation?"""
    name = "Warnings"
    if not series.count:
        return too_few(name, 0)
    found = [each for each in raised(series) if not each.meaning.flag & _OF_SATURATION]
    if not found:
        only = " other than of saturation" if raised(series) else ""
        return Check(name, Level.OK, f"The sensor gave no warnings{only}.")
    texts = [
        f"{each.meaning.meaning} ({each.meaning.severity.value}) in {count(each.samples, 'sample')}, first "
        f"{seconds(each.first_s)} after the start"
        for each in found
    ]
    worst = all(each.meaning.severity is Severity.WARNING for each in found)
    return Check(
        name, Level.ATTENTION if worst else Level.FAULT, f"{listing(texts)}.", "The sensor itself says so.",
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
    channels = [c.title for place, c in enumerate(CHANNELS) if not series.finite[:, place].all()]
    if not np.isfinite(series.samples.temperature).all():
        channels.append("Temperature")
    return Check(
        name, Level.FAULT, f"{count(int(wrong.sum()), 'sample')} "
        f"({share(int(wrong.sum()), series.count)}) with values "
        f"that are not numbers or are infinite: {listing(channels)}.",
        "A sum or a filter that takes one of them is lost.", "Switch the sensor off and on; if it is "
        "the same, ask the "
        "manufacturer.",
    )  # fmt: skip
