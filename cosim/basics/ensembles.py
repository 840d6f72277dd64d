"""Statistics over members, members without a value left out."""

from __future__ import annotations

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray


def chi_square_interval(dof: float, n: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds of the mean of `n` independent chi-square values of `dof` degrees each."""
    from scipy.special import gammaincinv

    tail = (1.0 - probability) / 2
    half = dof * n / 2
    return (
        float(2 * gammaincinv(half, tail) / n),
        float(2 * gammaincinv(half, 1 - tail) / n),
    )


def sample_sigma(errors: FloatArray) -> FloatArray:
    """Standard deviation over members (axis 1), NaN members left out; NaN for fewer than two.

    Sums over members in index order, so that a result does not depend on array layout.
    """
    valid = np.isfinite(errors)
    n = valid.sum(axis=1)
    filled = np.where(valid, errors, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = filled.sum(axis=1) / n
        deviation = np.where(valid, errors - mean[:, None], 0.0)
        variance = (deviation**2).sum(axis=1) / (n - 1)
        sigma: FloatArray = np.where(n > 1, np.sqrt(variance), np.nan)
        return sigma


def member_mean(values: FloatArray) -> FloatArray:
    """Mean over members (axis 1), NaN members left out; NaN where none is left."""
    valid = np.isfinite(values)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: FloatArray = np.where(valid, values, 0.0).sum(axis=1) / valid.sum(axis=1)
        return mean


def root_mean_square(values: FloatArray) -> FloatArray:
    """Root mean square over members (axis 1), NaN members left out."""
    return np.sqrt(member_mean(values**2))
