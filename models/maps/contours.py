r"""Matching of a profile: where on an elevation model a row of clearances was flown.

Heights of the ground :math:`g_k = h_k - z_k`, from estimated heights and measured clearances, were
taken along an estimated track that is off by one shift :math:`s` and one height, common to all.
With :math:`d_k = g_k - h_g(r_k + s)`, noise :math:`\sigma` and a common height of sigma
:math:`\sigma_h`,

.. math::
    J(s) = \frac1{\sigma^2} \Bigl( \sum_k d_k^2
        - \frac{\sigma_h^2}{\sigma^2 + K \sigma_h^2} \bigl( \sum_k d_k \bigr)^2 \Bigr),
    \qquad L(s) \propto e^{-J(s) / 2}.

J is taken on a grid over a square, and once more, finer, about its least value, of which shift and
covariance are the moments of L. A match is refused where J is too large for K points (the profile
is of elsewhere), or where another place explains it nearly as well [1]_.

References
----------
.. [1] J. P. Golden, "Terrain contour matching (TERCOM): a cruise missile guidance aid", Proc. SPIE
       238, 1980.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.maps.charts import scales_of
from terrafix.models.maps.dem import Dem

REASONS = ("matched", "no place fits", "several places fit", "at the edge of the search")
"""What became of a profile, indexed by `Match.reason`."""

MOST_MISFIT = 2.0
"""Largest misfit of a profile that is of here."""
LEAST_MARGIN = 30.0
"""By how much J must be larger at every other place."""

_FINER = 5
"""Points of the second grid between two of the first."""
_APART = 3
"""Points of the first grid from the best beyond which a place is another."""


@dataclass(frozen=True)
class Match:
    """Outcome of matching a profile.

    Attributes
    ----------
    shift : ndarray, shape (2,)
        North and east, from the estimated track to the true one [m].
    covariance : ndarray, shape (2, 2)
    misfit : float
        J at its least value over the number of points.
    margin : float
        By how much J is larger at the best other place.
    reason : int
        Index into `REASONS`.
    """

    shift: FloatArray
    covariance: FloatArray
    misfit: float
    margin: float
    reason: int


def match_profile(
    dem: Dem,
    latitude: FloatArray,
    longitude: FloatArray,
    ground: FloatArray,
    *,
    sigma: float,
    height_sigma: float,
    reach: float,
    step: float,
) -> Match:
    """Find the shift of a profile.

    Parameters
    ----------
    dem : Dem
    latitude, longitude, ground : ndarray, shape (k,)
        Estimated track [rad], [rad], and heights of the ground [m].
    sigma, height_sigma : float
        Noise of a height, and of the height common to all [m].
    reach, step : float
        Half of the square that is searched, and the spacing of the first grid [m].
    """

    def misfit(north: FloatArray, east: FloatArray) -> FloatArray:
        meridian, parallel = scales_of(latitude)
        lat = latitude + north[:, None, None] / meridian
        lon = longitude + east[:, None] / parallel
        d = ground - dem.known_at(*np.broadcast_arrays(lat, lon))
        common = height_sigma**2 / (sigma**2 + len(ground) * height_sigma**2)
        J = ((d**2).sum(axis=2) - common * d.sum(axis=2) ** 2) / sigma**2
        return np.where(np.isfinite(J), J, np.inf)

    n = int(np.ceil(reach / step))
    axis: FloatArray = step * np.arange(-n, n + 1.0)
    J = misfit(axis, axis)
    i, j = np.unravel_index(int(np.argmin(J)), J.shape)
    near: FloatArray = step / _FINER * np.arange(-2 * _FINER, 2 * _FINER + 1.0)
    north, east = axis[i] + near, axis[j] + near
    fine = misfit(north, east)
    least = float(fine.min())
    if not np.isfinite(least):
        return Match(np.zeros(2), np.eye(2), np.inf, 0.0, REASONS.index("no place fits"))
    others = J.copy()
    others[max(i - _APART, 0) : i + _APART + 1, max(j - _APART, 0) : j + _APART + 1] = np.inf
    margin = float(others.min()) - least
    shift, covariance = _moments(north, east, np.exp(-(fine - least) / 2))
    covariance += (step / _FINER) ** 2 / 12 * np.eye(2)
    reason = "matched"
    if margin < LEAST_MARGIN:
        reason = "several places fit"
    elif max(abs(i - n), abs(j - n)) > n - 2:
        reason = "at the edge of the search"
    if least / len(ground) > MOST_MISFIT:
        reason = "no place fits"
    return Match(shift, covariance, least / len(ground), margin, REASONS.index(reason))


def _moments(north: FloatArray, east: FloatArray, L: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (2,) and covariance (2, 2) of a density on a grid."""
    L = L / L.sum()
    mean = np.array([(L.sum(axis=1) * north).sum(), (L.sum(axis=0) * east).sum()])
    a, b = north - mean[0], east - mean[1]
    cross = float((L * a[:, None] * b).sum())
    variance = (L.sum(axis=1) * a**2).sum(), (L.sum(axis=0) * b**2).sum()
    return mean, np.array([[variance[0], cross], [cross, variance[1]]])
