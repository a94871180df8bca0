# SPDX-License-Identifier: Apache-2.0
"""Least squares with a variance of its own for every group of equations, estimated from the residuals.

The variances are those of the restricted maximum likelihood (REML), since a few poses leave few degrees of
freedom. The covariance takes into account that the weights are estimates too, and every unknown has its own
degrees of freedom for Student's t (Kenward and Roger 1997), whose quantiles are here too, without SciPy.
Leading axes of the arrays, shown as `...`, are independent problems.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

CONFIDENCE: Final = 0.95  # of all intervals
Array = NDArray[np.float64]
_ROUNDS: Final = 60
_CONVERGED: Final = 1e-4
_MOST_DEGREES: Final = 1e6
_LEAST_DEGREES: Final = 0.5
_LEAST_RATIO: Final = 1e-9  # of two variances: beyond it the arithmetic fails
# Six poses need more than Kenward and Roger's correction of the covariance, which is of first order. With its
# square taken so often, 95 % intervals cover 93 to 97 % for 6 to 24 poses and axes whose noise differs
# tenfold (`tests/compensation/test_payload.py`).
_SECOND_ORDER: Final = 5.0

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_HALVINGS: Final = 44
_NORMAL: Final = 2000.0  # degrees of freedom beyond which the quantile changes no more within four digits


class Known(NamedTuple):
    """What is known before anything is measured."""

    # (p, p): inverse of the covariance of the unknowns, about zero; zeros where nothing is known.
    information: Array
    floor: Array  # (..., k): the variances are at least this, so that perfect data divide by no zero
    degrees: Array | float = 0.0  # (k,): how many residuals the assumed variances are worth; 0 = not assumed
    variance: Array | float = 0.0  # (..., k): the assumed variances


class Solution(NamedTuple):
    """p unknowns from k groups of n equations."""

    answer: Array  # (..., p)
    covariance: Array  # (..., p, p)
    variances: Array  # (..., k): of a single equation of each group
    residuals: Array  # (..., k, n)
    degrees: Array  # (..., k): residual degrees of freedom of each group
    plain: Array  # (..., p, p): the covariance if the weights were exact
    parts: Array  # (..., k, p, p): the contribution of each group to it
    uncertainty: Array  # (..., k, k): covariance of the logarithms of the variances

    def student(self, directions: Array) -> tuple[Array, Array]:
        """Standard deviation and degrees of freedom of linear combinations `directions` (..., q, p)."""

        def along(matrix: Array) -> Array:
            found: Array = np.einsum("...qi,...ij,...qj->...q", directions, matrix, directions)
            return found

        plain = along(self.plain)
        slope = np.stack([along(self.parts[..., k, :, :]) for k in range(self.parts.shape[-3])], axis=-1)
        spread = np.einsum("...qi,...ij,...qj->...q", slope, self.uncertainty, slope)
        degrees = 2.0 * plain**2 / np.maximum(spread, 2.0 * plain**2 / _MOST_DEGREES)
        return np.sqrt(along(self.covariance)), np.maximum(degrees, 1.0)


def solve(design: Array, measured: Array, known: Known, variances: Array | None = None) -> Solution:
    """The unknowns of `design` (..., k, n, p) times unknowns = `measured` (..., k, n).

    `variances` (..., k) are where to start. LinAlgError if the equations leave an unknown open.
    """
    count = design.shape[-2]
    turned = np.swapaxes(design, -1, -2)
    square = turned @ design
    right = (turned @ measured[..., np.newaxis])[..., 0]
    if variances is None:
        variances = np.ones(measured.shape[:-1])
    for _ in range(_ROUNDS):
        before = variances
        plain = np.linalg.inv((square / before[..., np.newaxis, np.newaxis]).sum(-3) + known.information)
        answer = (plain @ (right / before[..., np.newaxis]).sum(-2)[..., np.newaxis])[..., 0]
        residuals = measured - (design @ answer[..., np.newaxis, :, np.newaxis])[..., 0]
        degrees = count - np.einsum("...ij,...kji->...k", plain, square) / before
        variances = np.maximum(
            ((residuals**2).sum(-1) + known.degrees * known.variance)
            / np.maximum(degrees + known.degrees, _LEAST_DEGREES),
            known.floor,
        )
        variances = np.maximum(variances, _LEAST_RATIO * variances.max(axis=-1, keepdims=True))
        if (np.abs(variances - before) <= _CONVERGED * before).all():
            break
    information = square / before[..., np.newaxis, np.newaxis]
    shares = plain[..., np.newaxis, :, :] @ information
    flat = shares.reshape(*shares.shape[:-2], -1)
    crossed = flat @ np.swapaxes(np.swapaxes(shares, -1, -2).reshape(flat.shape), -1, -2)
    own = np.einsum("...kaa->...k", shares)
    fisher = crossed + np.eye(design.shape[-3]) * (count - 2.0 * own + known.degrees)[..., np.newaxis, :]
    uncertainty = 2.0 * np.linalg.inv(fisher)
    mixed = (uncertainty @ flat).reshape(shares.shape)
    inner = np.einsum("...kk,...kab->...ab", uncertainty, information) - (information @ mixed).sum(axis=-3)
    growth = 2.0 * inner @ plain
    return Solution(
        answer,
        plain @ (np.eye(plain.shape[-1]) + growth + _SECOND_ORDER * growth @ growth),
        before,
        residuals,
        degrees,
        plain,
        shares @ plain[..., np.newaxis, :, :],
        uncertainty,
    )


def students_t(degrees: ArrayLike) -> Array:
    """The t with which |T| <= t has probability CONFIDENCE, for each number of `degrees` >= 1 of freedom,
    which need not be whole.
    """
    nu = np.minimum(np.asarray(degrees, dtype=np.float64), _NORMAL)
    # T = sqrt(nu) tan(angle), whose density is a power of the cosine.
    most = np.full(nu.shape, np.pi / 2.0)
    low, high, whole = np.zeros(nu.shape), most, _inside(most, nu)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        below = _inside(middle, nu) < CONFIDENCE * whole
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.sqrt(nu) * np.tan(low)


def _inside(angle: Array, nu: Array) -> Array:
    """The integral of cos^(nu - 1) from 0 to `angle`; beyond where it is zero it adds nothing."""
    end = np.minimum(angle, 9.0 / np.sqrt(nu))[..., np.newaxis]
    powers = np.cos(0.5 * end * (1.0 + _NODES)) ** (nu[..., np.newaxis] - 1.0)
    return 0.5 * end[..., 0] * (powers @ _WEIGHTS)
