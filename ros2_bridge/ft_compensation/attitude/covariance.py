"""Two by two parts of covariances, which are symmetric."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def largest(a: Array) -> float:
    """Largest eigenvalue of the first two rows and columns: the variance along the worst known direction."""
    half = 0.5 * (a[0, 0] - a[1, 1])
    return float(0.5 * (a[0, 0] + a[1, 1]) + math.hypot(half, a[0, 1]))


def inverse(a: Array) -> Array:
    """Of a 2 by 2 matrix."""
    (xx, xy), (_, yy) = a.tolist()
    found: Array = np.array(((yy, -xy), (-xy, xx))) / (xx * yy - xy * xy)
    return found
