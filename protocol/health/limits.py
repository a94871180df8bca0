"""The thresholds of every verdict on a stream: one table. docs/operations.md has it for people."""

from __future__ import annotations

from typing import Final, NamedTuple


class Limits(NamedTuple):
    """Limits of a stream; the node's parameters `diagnostics.*` replace those that have one."""

    stale_after: float = 0.5
    """Seconds without a new sample that are trouble."""
    rate_tolerance: float = 0.01
    """Relative deviation from the nominal rate that is worth a look."""
    rate_error: float = 0.2
    """The same, as trouble: these are not the filters of the settings."""
    age_warn: float = 0.01
    """Age of the samples on arrival (p99), s, that is worth a look."""
    age_error: float = 0.1
    """The same, as trouble."""
    lost_warn: int = 1
    """Lost samples, or invalid frames, that are worth a look."""
    lost_error: float = 0.005
    """Share of lost samples, or invalid frames, above which they are trouble, ..."""
    lost_error_s: float = 0.05
    """... if they amount to this time: one short stall is not trouble, however short the observation."""
    temperature_warn: float = 60.0
    """°C"""
    temperature_error: float = 80.0
    coldest: float = -40.0
    """°C that the electronics cannot have."""
    emergency_s: float = 60.0
    """How long an emergency of the sensor is worth a look."""
    irregular: float = 0.2
    """Share of a period that 5 % of the intervals may deviate by: beyond it the clock is not followed."""


LIMITS: Final = Limits()
"""What holds unless somebody sets something else."""
