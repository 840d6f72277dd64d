r"""Is a filter's covariance that of its errors? Normalized squares and gates.

.. math::
    \epsilon = e^T P^{-1} e

is chi-square with :math:`n` degrees of freedom where the filter is consistent.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
       Navigation", Wiley, 2001, section 5.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray


def normalized_square(error: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Square of each member's error, normalized: NEES of an estimate, NIS of an innovation.

    Solved by a Cholesky factorization that runs over all members at once, element by element: a
    member's value does not depend on the others, and a member whose covariance is not positive
    definite gets NaN instead of stopping them.

    Parameters
    ----------
    error : array_like, shape (..., n)
        Errors or innovations; the sign does not matter.
    covariance : array_like, shape (..., n, n)
        Their covariances; the lower triangle is read.

    Returns
    -------
    ndarray, shape (...)
        NaN where the covariance is not positive definite or anything is not finite.

    Raises
    ------
    ValueError
        If the shapes disagree.
    """
    e, P = np.asarray(error, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    n = e.shape[-1]
    if P.shape != (*e.shape, n):
        raise ValueError(f"errors of shape {e.shape} do not fit covariances of shape {P.shape}")
    leading = e.shape[:-1]
    # axes first: the members of an element side by side
    e, P = e.reshape(-1, n).T, P.reshape(-1, n, n).transpose(1, 2, 0)
    diagonal = P.diagonal().T
    valid = (
        np.isfinite(e).all(axis=0) & np.isfinite(P).all(axis=(0, 1)) & (diagonal > 0).all(axis=0)
    )
    if not valid.all():
        e, P = np.where(valid, e, 0.0), np.where(valid, P, np.eye(n)[..., None])
        diagonal = P.diagonal().T
    # scale to unit diagonal: the elements have different units
    sigma = np.sqrt(diagonal)
    e, P = e / sigma, P / (sigma[:, None] * sigma)
    L = np.zeros(P.shape)
    whitened = np.zeros(e.shape)
    total = np.zeros(e.shape[1:])
    for j in range(n):
        below = P[j:, j].copy()  # of the pivot and all rows under it
        remaining = e[j].copy()
        for k in range(j):
            below -= L[j:, k] * L[j, k]
            remaining -= L[j, k] * whitened[k]
        pivot = below[0]
        valid &= pivot > 0
        root = np.sqrt(np.where(pivot > 0, pivot, 1.0))
        L[j, j] = root
        L[j + 1 :, j] = below[1:] / root
        whitened[j] = remaining / root
        total += whitened[j] * whitened[j]
    return np.where(valid, total, np.nan).reshape(leading)


def gate_thresholds(probability: float, max_dof: int = 4) -> FloatArray:
    """Chi-square values below which a fraction of good innovations lies, (max_dof,).

    Element k - 1 is for k degrees of freedom; `probability` 1 gives infinity, no gate.

    Raises
    ------
    ValueError
        If `probability` is not above 0 and at most 1.
    """
    if not 0 < probability <= 1:
        raise ValueError(f"probability must be in (0, 1], got {probability}")
    from scipy.special import chdtri  # the quantiles of scipy.stats, a third of its import

    return np.asarray(chdtri(np.arange(1, max_dof + 1), 1 - probability), dtype=np.float64)
