# SPDX-License-Identifier: Apache-2.0
"""What turning makes of places and tensors, as arrays of n instants."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bota_ft_compensation.quantities import ELEMENTS

Array = NDArray[np.float64]
PLACES: Final = [("xyz".index(row), "xyz".index(column)) for row, column in ELEMENTS]
TENSORS: Final = np.zeros((6, 3, 3))  # of which each element is 1
for _number, (_row, _column) in enumerate(PLACES):
    TENSORS[_number, _row, _column] = TENSORS[_number, _column, _row] = 1.0
_LEVI_CIVITA: Final = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 0, 1)


def on_places(spin: Array, products: Array) -> Array:
    """(n, 3, 3), times a place, m: its acceleration, by angular acceleration `spin` (n, 3) and `products` of
    angular rates (n, 3, 3).
    """
    trace = np.trace(products, axis1=1, axis2=2)[:, None, None]
    return np.asarray(crossing(spin) + products - trace * np.eye(3))


def on_tensors(spin: Array, products: Array) -> Array:
    """(n, 3, 6), times the elements of a tensor: J alpha + omega x J omega, likewise."""
    spun = np.einsum("eij,nj->nie", TENSORS, spin)
    return np.asarray(spun + np.einsum("ijk,njl,elk->nie", _LEVI_CIVITA, products, TENSORS, optimize=True))


def crossing(vectors: Array) -> Array:
    """(n, 3, 3): times another vector, this one's cross product with it."""
    x, y, z = vectors.T
    nothing = np.zeros_like(x)
    rows = ((nothing, -z, y), (z, nothing, -x), (-y, x, nothing))
    return np.moveaxis(np.array(rows), -1, 0)
