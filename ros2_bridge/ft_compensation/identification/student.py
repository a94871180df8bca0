"""Quantiles of Student's t-distribution, for confidence intervals from a few poses; without SciPy."""

from __future__ import annotations

import math


def two_sided(confidence: float, degrees: int) -> float:
    """The t with which |T| <= t has probability `confidence` (0 to 1) at `degrees` >= 1 of freedom."""
    if not (0.0 < confidence < 1.0 and degrees >= 1):
        raise ValueError(
            f"no quantile for a confidence of {confidence!r} with {degrees!r} degrees of freedom"
        )
    low, high = 0.0, math.pi / 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _inside(middle, degrees) < confidence else (low, middle)
    return math.sqrt(degrees) * math.tan(low)


def _inside(angle: float, degrees: int) -> float:
    """The probability of |T| <= t for t = sqrt(degrees) tan(angle): Abramowitz and Stegun 26.7.3, 26.7.4."""
    odd = degrees % 2
    term = math.cos(angle) if odd else 1.0
    total = term if degrees > 1 else 0.0
    for k in range(2 + odd, degrees - 1, 2):
        term *= (k - 1) / k * math.cos(angle) ** 2
        total += term
    total *= math.sin(angle)
    return 2.0 / math.pi * (angle + total) if odd else total
