"""Quantiles of Student's t-distribution, for confidence intervals from a few poses; without SciPy."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_HALVINGS: Final = 44
_NORMAL: Final = 2000.0
"""Degrees of freedom beyond which the quantile changes no more within four digits."""


def two_sided(confidence: float, degrees: ArrayLike) -> NDArray[np.float64]:
    """The t with which |T| <= t has probability `confidence` (0 to 1), for each number of `degrees` >= 1 of
    freedom, which need not be whole.
    """
    nu = np.minimum(np.asarray(degrees, dtype=np.float64), _NORMAL)
    if not (0.0 < confidence < 1.0 and (nu >= 1.0).all()):
        raise ValueError(
            f"no quantile for a confidence of {confidence!r} with {degrees!r} degrees of freedom"
        )
    # T = sqrt(nu) tan(angle), whose density is a power of the cosine.
    most = np.full(nu.shape, np.pi / 2.0)
    low, high, whole = np.zeros(nu.shape), most, _inside(most, nu)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        below = _inside(middle, nu) < confidence * whole
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.sqrt(nu) * np.tan(low)


def _inside(angle: NDArray[np.float64], nu: NDArray[np.float64]) -> NDArray[np.float64]:
    """The integral of cos^(nu - 1) from 0 to `angle`; beyond where it is zero it adds nothing."""
    end = np.minimum(angle, 9.0 / np.sqrt(nu))[..., np.newaxis]
    powers = np.cos(0.5 * end * (1.0 + _NODES)) ** (nu[..., np.newaxis] - 1.0)
    return 0.5 * end[..., 0] * (powers @ _WEIGHTS)
