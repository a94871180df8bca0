"""The thresholds of every verdict on a stream: one table. docs/operations.md has it for people."""

from __future__ import annotations

from typing import Final, NamedTuple


class Limits(NamedTuple):
    """Limits of a stream; the node's parameters `diagnostics.*` replace those that have one."""

    stale_after: float = 0.5  # seconds without a new sample that are trouble
    rate_tolerance: float = 0.01  # relative deviation from the nominal rate that is worth a look
    rate_error: float = 0.2  # the same, as trouble: these are not the filters of the settings
    age_warn: float = 0.01  # age of the samples on arrival (p99), s, that is worth a look
    age_error: float = 0.1  # the same, as trouble
    lost_warn: int = 1  # lost samples, or invalid frames, that are worth a look
    lost_error: float = 0.005  # share of lost samples, or invalid frames, above which they are trouble
    # The time that they must amount to, too: one short stall is not trouble, however short the observation.
    lost_error_s: float = 0.05
    temperature_warn: float = 60.0  # °C
    temperature_error: float = 80.0
    coldest: float = -40.0  # °C that the electronics cannot have
    emergency_s: float = 60.0  # how long an emergency of the sensor is worth a look
    # Share of a period that 5 % of the intervals may deviate by: beyond it the clock is not followed.
    irregular: float = 0.2


LIMITS: Final = Limits()  # what holds unless somebody sets something else
