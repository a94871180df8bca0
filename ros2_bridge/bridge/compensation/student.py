"""The quantile of Student's t-distribution, for confidence intervals of few poses.

Source: Abramowitz and Stegun 26.7.1; the incomplete beta function by its continued fraction (26.5.8, as in
Numerical Recipes 6.4).
"""

from __future__ import annotations

import math

_TINY = 1e-300
_MOST_TERMS = 500


def two_sided(confidence: float, degrees: float) -> float:
    """The t with which |T| <= t has probability `confidence` (0 to 1) at `degrees` > 0 of freedom."""
    if not (0.0 < confidence < 1.0 and degrees > 0.0):
        raise ValueError(
            f"no quantile for a confidence of {confidence!r} with {degrees!r} degrees of freedom"
        )
    low, high = 0.0, 1.0
    while _inside(high, degrees) < confidence:
        low, high = high, 2.0 * high
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if _inside(middle, degrees) < confidence else (low, middle)
    return 0.5 * (low + high)


def _inside(t: float, degrees: float) -> float:
    """The probability of |T| <= t."""
    return 1.0 - _incomplete_beta(0.5 * degrees, 0.5, degrees / (degrees + t * t))


def _incomplete_beta(a: float, b: float, x: float) -> float:
    """I_x(a, b), regularised."""
    if x <= 0.0 or x >= 1.0:
        return 0.0 if x <= 0.0 else 1.0
    front = math.exp(
        math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    )
    if x < (a + 1.0) / (a + b + 2.0):
        return front * _fraction(a, b, x) / a
    return 1.0 - front * _fraction(b, a, 1.0 - x) / b


def _fraction(a: float, b: float, x: float) -> float:
    c, d = 1.0, 1.0 / _away_from_zero(1.0 - (a + b) * x / (a + 1.0))
    result = d
    for m in range(1, _MOST_TERMS):
        for term in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            d = 1.0 / _away_from_zero(1.0 + term * d)
            c = _away_from_zero(1.0 + term / c)
            result *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return result


def _away_from_zero(value: float) -> float:
    return value if abs(value) > _TINY else _TINY
