"""Density of the upper atmosphere by MSIS, and how its logarithm changes about a place.

References
----------
.. [1] J. T. Emmert et al., "NRLMSIS 2.0: A whole-atmosphere empirical model of temperature and
       neutral species densities", Earth and Space Science 8(3), 2021.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.extras import optional
from terrafix.models.geometry.geodesy import geodetic_from_ecef_array

_REACH = 1e3
"""Over which a gradient is taken, to both sides [m]."""


def air_about(
    r_e: ArrayLike, utc: np.datetime64, f107: ArrayLike, f107a: ArrayLike, ap: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Logarithm of the density, and its gradient.

    Parameters
    ----------
    r_e : array_like, shape (n, 3)
        Places [m], Earth-fixed.
    utc : datetime64
        When.
    f107, f107a : array_like, shape (n,)
        Solar flux at 10.7 cm of the day before, and its mean over 81 days [1e-22 W/m^2/Hz].
    ap : array_like, shape (n,)
        Daily index of geomagnetic activity.

    Returns
    -------
    tuple of ndarray
        Natural logarithm of the density in kg/m^3, (n,), and its gradient [1/m], (n, 3); not finite
        where MSIS has none.

    Raises
    ------
    ImportError
        If pymsis is not installed; the message says what to install.
    """
    msis = optional("pymsis", "a density by MSIS")
    r = np.atleast_2d(np.asarray(r_e, np.float64))
    n = len(r)
    steps = _REACH * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    places = (r[None] + steps[:, None]).reshape(-1, 3)
    seven = [np.tile(np.broadcast_to(np.asarray(x, np.float64), n), 7) for x in (f107, f107a, ap)]
    density = np.full(7 * n, np.nan)
    known = np.isfinite(places).all(axis=1)
    if known.any():
        latitude, longitude, height = geodetic_from_ecef_array(places[known])
        found = msis.calculate(
            np.full(known.sum(), utc),
            np.degrees(longitude),
            np.degrees(latitude),
            height / 1e3,
            seven[0][known],
            seven[1][known],
            np.repeat(seven[2][known, None], 7, axis=1),
        )
        density[known] = np.asarray(found, np.float64)[:, msis.Variable.MASS_DENSITY]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(density).reshape(7, n)
        return logs[0], (logs[1:4] - logs[4:]).T / (2 * _REACH)
