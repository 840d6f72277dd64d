r"""Universal Transverse Mercator: places to meters east and north of a zone.

The series of Krueger in the third flattening n, to its fourth power,

.. math::
    E = E_0 + k_0 A \Bigl( \eta' + \sum_j \alpha_j \cos 2 j \xi' \sinh 2 j \eta' \Bigr), \qquad
    N = k_0 A \Bigl( \xi' + \sum_j \alpha_j \sin 2 j \xi' \cosh 2 j \eta' \Bigr),

exact to a millimeter within a zone. Northings are not made positive in the south.

References
----------
.. [1] C. F. F. Karney, "Transverse Mercator with an accuracy of a few nanometers", Journal of
       Geodesy 85(8), 2011.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.earth import EARTH

SCALE, FALSE_EASTING = 0.9996, 500e3
SOUTH = 10e6
"""What is added to northings of zones of the south [m]."""

_N = EARTH.flattening / (2 - EARTH.flattening)
_RADIUS = EARTH.radius / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64) * SCALE
_ALPHA = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440,
    61 * _N**3 / 240 - 103 * _N**4 / 140,
    49561 * _N**4 / 161280,
)
_E = np.sqrt(EARTH.flattening * (2 - EARTH.flattening))


def central_meridian(zone: int) -> float:
    """Longitude [rad] of the middle of a zone, 1 to 60.

    Raises
    ------
    ValueError
        If there is no such zone.
    """
    if not 1 <= zone <= 60:
        raise ValueError(f"zones of UTM are 1 to 60, got {zone}")
    return float(np.radians(6 * zone - 183))


def utm_from_geodetic(
    latitude: ArrayLike, longitude: ArrayLike, zone: int
) -> tuple[FloatArray, FloatArray]:
    """Easting and northing [m] of places [rad], two (...); northing is negative in the south."""
    latitude = np.asarray(latitude, np.float64)
    off = np.asarray(longitude, np.float64) - central_meridian(zone)
    sine = np.sin(latitude)
    t = np.sinh(np.arctanh(sine) - _E * np.arctanh(_E * sine))
    xi = np.arctan2(t, np.cos(off))
    eta = np.arcsinh(np.sin(off) / np.hypot(t, np.cos(off)))
    east, north = eta.copy(), xi.copy()
    for j, alpha in enumerate(_ALPHA, start=1):
        east = east + alpha * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
        north = north + alpha * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
    return np.asarray(FALSE_EASTING + _RADIUS * east), np.asarray(_RADIUS * north)
