"""Which sample an exchange brought, and how sure that is: pure functions of what is known and was seen."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

SILENT_PERIODS: Final = 3  # periods without a new sample after which a sensor is silent, not just late
ONE_SAMPLE_PERIODS: Final = 0.9  # time without a PDI read, in periods, in which only one sample can have come


class Expected(NamedTuple):
    """The sampling clock as estimated before an exchange. Times in ns."""

    phase_ns: float  # instant of the next sample, less the outward part of the shortest round trip
    period_ns: float
    doubt_ns: float  # uncertainty of the phase
    is_doubtful: bool  # whether the sample before may have been another one


class Read(NamedTuple):
    """When the slave read the process data in which the new sample is, and before. Times in ns."""

    before_ns: int  # when the exchange before was sent
    sent_ns: int
    back_ns: int
    least_ns: float  # the shortest round trip


class Association(NamedTuple):
    """Which sample an exchange brought."""

    number: int  # counted from the one before by the phase alone: 1 if it is the next
    late: float  # by how many periods later than the expected one it came
    uncertain: bool  # whether more samples may have passed than `number` says


def associate_by_polls(
    expected: Expected, read: Read, *, has_events: bool, lost_track: bool, was_silent: bool = False
) -> Association:
    """Which sample it is by when the process data was read with and without it.

    `has_events`: the phase is so exact that no sample can have come before it: it was held back.
    `was_silent`: a sensor that gave nothing for some periods gives something again.
    `lost_track`: samples may have been lost before it that nobody knows of.
    """
    phase_ns, period_ns, doubt_ns, is_doubtful = expected
    excess_ns = max(0.0, read.back_ns - read.sent_ns - read.least_ns)
    read_ns = read.sent_ns + read_delay_ns(excess_ns, period_ns)
    most = math.floor((read.sent_ns + excess_ns - phase_ns + doubt_ns) / period_ns)
    least = math.floor((read.sent_ns - phase_ns - doubt_ns) / period_ns)
    unread_ns = read.back_ns - read.before_ns
    if unread_ns - read.least_ns < ONE_SAMPLE_PERIODS * period_ns:
        # It came between two reads: it is the one expected nearest to them.
        late = ((read.before_ns + read_ns) / 2 - phase_ns) / period_ns
        passed = min(round(late), most) if has_events else round(late)
        # Read just when a later one came to be, it may still be the one before: nothing tells which.
        return Association(1 + passed, late, was_silent and 0 < passed > least)
    late = (read_ns - phase_ns) / period_ns
    lost_track = lost_track and unread_ns > period_ns
    return Association(1 + math.floor(late), late, is_doubtful or lost_track or (most > 0 and least < most))


def associate_by_event(late: float, *, uncertain: bool) -> Association:
    """Which sample it is by its event, which is `late` periods after the expected instant."""
    return Association(1 + round(late), late, uncertain)


def count_steps(
    found: Association, *, is_doubtful: bool, absent: int, unchanged_periods: float
) -> tuple[int, int]:
    """The number of the new sample by the phase, and how many samples it is after the one before.

    `is_doubtful`: the sample before may have been another one. `absent`: number of expected samples that were
    polled for since and did not come. `unchanged_periods`: time from the read of the sample before until the
    last exchange that brought nothing new. Samples that pass while the slave holds up the frames do exist,
    although no exchange brings them.
    """
    number = found.number
    if number < 1:  # too early for the next one: it is that, or one too many was counted before
        number = 0 if is_doubtful and found.late < -0.5 else 1
    if absent >= SILENT_PERIODS and unchanged_periods > SILENT_PERIODS - 1:
        return number, 1  # a silent sensor loses nothing
    return number, number + absent if found.late > -0.5 else number


def read_delay_ns(excess_ns: float, period_ns: float) -> float:
    """Time from sending a frame to the PDI read, by the excess of its round trip over the shortest one.

    A long exchange counts as a stall after the frame had left, so no sample is dated too late.
    """
    return excess_ns / 2 if excess_ns < period_ns / 2 else 0.0
