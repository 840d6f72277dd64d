r"""Points on and above an ellipsoid of revolution, and where a ray meets it.

Latitude :math:`\varphi` and height :math:`h` follow from a position by Bowring's iteration on
the reduced latitude :math:`\beta`,

.. math::
    \tan\varphi = \frac{z + e'^2 b \sin^3\beta}{p - e^2 a \cos^3\beta}, \qquad
    \tan\beta = (1 - f) \tan\varphi, \qquad
    h = p \cos\varphi + z \sin\varphi - a \sqrt{1 - e^2 \sin^2\varphi},

with :math:`p^2 = x^2 + y^2`, carried as sines and cosines so that the poles are not special.
The iteration contracts by about :math:`e^4`; three rounds reach the last bits from the deepest
ocean to beyond the geostationary orbit.

Functions take and return CasADi expressions; those named ``*_array`` take NumPy arrays with
leading member axes.

References
----------
.. [1] B. R. Bowring, "Transformation from spatial to geographical coordinates", Survey Review
       23(181), 1976.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH

_ROUNDS = 3
_E2 = EARTH.flattening * (2 - EARTH.flattening)
_TINY = 1e-300
"""Added under square roots so that their derivative exists at zero; below every rounding."""


def chart_scales(latitude: Any) -> tuple[Any, Any]:
    """Meters on the ellipsoid for a radian of latitude, and of longitude, at a latitude [rad]."""
    flatter = 1 - _E2 * ca.sin(latitude) ** 2
    normal = EARTH.radius / ca.sqrt(flatter)
    return normal * (1 - _E2) / flatter, normal * ca.cos(latitude)


def ecef_from_geodetic(
    latitude: Any,
    longitude: Any,
    height: Any,
    radius: Any = EARTH.radius,
    flattening: Any = EARTH.flattening,
) -> Any:
    """Earth-fixed position (3,) [m] of geodetic latitude, longitude [rad] and height [m]."""
    e2 = flattening * (2 - flattening)
    sin_lat, cos_lat = ca.sin(latitude), ca.cos(latitude)
    normal = radius / ca.sqrt(1 - e2 * sin_lat * sin_lat)
    equatorial = (normal + height) * cos_lat
    return ca.vertcat(
        equatorial * ca.cos(longitude),
        equatorial * ca.sin(longitude),
        (normal * (1 - e2) + height) * sin_lat,
    )


def geodetic_from_ecef(
    r_e: Any, radius: Any = EARTH.radius, flattening: Any = EARTH.flattening
) -> Any:
    """Geodetic latitude, longitude [rad] and height [m] of an Earth-fixed position (3,) [m].

    Three scalars. Holds for distances from the center above 100 km; on the polar axis the
    longitude is zero.
    """
    p, up, out, height = _bowring(r_e, radius, flattening)
    longitude = ca.atan2(r_e[1], ca.if_else(_on_axis(p), 1.0, r_e[0]))
    return ca.atan2(up, out), longitude, height


def north_east_down(
    r_e: Any, radius: Any = EARTH.radius, flattening: Any = EARTH.flattening
) -> Any:
    """Transformation (3, 3) from Earth-fixed to local level axes, sine of latitude, height [m].

    Of an Earth-fixed position (3,) [m], as `geodetic_from_ecef`, without trigonometry; rows are
    north, east and down.
    """
    p, up, out, height = _bowring(r_e, radius, flattening)
    length = ca.sqrt(up * up + out * out)
    sin, cos = up / length, out / length
    east_x, east_y = -r_e[1] / p, ca.if_else(_on_axis(p), 1.0, r_e[0] / p)
    axes = ca.vertcat(
        ca.horzcat(-sin * east_y, sin * east_x, cos),
        ca.horzcat(east_x, east_y, 0),
        ca.horzcat(-cos * east_y, cos * east_x, -sin),
    )
    return axes, sin, height


def _on_axis(p: Any) -> Any:
    return p <= ca.sqrt(_TINY)


def _bowring(r_e: Any, radius: Any, flattening: Any) -> Any:
    """Distance from the axis [m], direction of the vertical (up, out), any length, and height."""
    x, y, z = r_e[0], r_e[1], r_e[2]
    e2 = flattening * (2 - flattening)
    polar_radius = radius * (1 - flattening)
    p = ca.sqrt(x * x + y * y + _TINY)
    up, out = z, (1 - flattening) * p
    for _ in range(_ROUNDS):
        length = ca.sqrt(up * up + out * out)
        sin_b, cos_b = up / length, out / length
        up = (1 - flattening) * (z + e2 / (1 - e2) * polar_radius * sin_b**3)
        out = p - e2 * radius * cos_b**3
    up = up / (1 - flattening)
    length = ca.sqrt(up * up + out * out)
    sin_lat, cos_lat = up / length, out / length
    height = p * cos_lat + z * sin_lat - radius * ca.sqrt(1 - e2 * sin_lat * sin_lat)
    return p, up, out, height


def ellipsoid_intersection(
    r_e: Any,
    direction_e: Any,
    radius: Any = EARTH.radius,
    flattening: Any = EARTH.flattening,
) -> Any:
    r"""Where a ray from outside first meets the ellipsoid, and whether it does.

    In coordinates that make the ellipsoid a unit sphere the ray is :math:`p + s d`, and

    .. math::
        s = \frac{C}{-B + \sqrt{B^2 - A C}}, \qquad
        A = d \cdot d, \quad B = p \cdot d, \quad C = p \cdot p - 1,

    the near root in the form that does not subtract nearly equal numbers.

    Parameters
    ----------
    r_e : SX, shape (3,)
        Start of the ray [m], Earth-fixed.
    direction_e : SX, shape (3,)
        Direction of the ray, any length, Earth-fixed.
    radius, flattening : SX or float
        Equatorial radius [m] and flattening [-].

    Returns
    -------
    point : SX, shape (3,)
        The near intersection [m], Earth-fixed; where the ray misses, the point of its line
        nearest the center in the scaled coordinates (finite, and continuous at the limb).
    hit : SX
        1 where the ray meets the ellipsoid from outside, else 0.
    """
    scale = ca.vertcat(1 / radius, 1 / radius, 1 / (radius * (1 - flattening)))
    p, d = scale * r_e, scale * direction_e
    a, b, c = ca.dot(d, d), ca.dot(p, d), ca.dot(p, p) - 1
    discriminant = b * b - a * c
    hit = ca.logic_and(ca.logic_and(discriminant > 0, b < 0), c >= 0)
    root = ca.sqrt(ca.if_else(hit, discriminant, 1.0))
    denominator = ca.if_else(hit, root - b, 1.0)
    s = ca.if_else(hit, c / denominator, -b / a)
    return r_e + s * direction_e, hit


ecef_from_geodetic_array = over_members(ecef_from_geodetic, (), (), ())
geodetic_from_ecef_array = over_members(geodetic_from_ecef, (3,))
ellipsoid_intersection_array = over_members(ellipsoid_intersection, (3,), (3,))


def geodetic(p: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude [rad] and height [m] of points (..., 3) [m] near the ellipsoid.

    Bowring's formula once: exact to a nanometer below 20 km, for many points at once;
    `geodetic_from_ecef` is the one for all heights.
    """
    x, y, z = np.moveaxis(np.asarray(p, dtype=np.float64), -1, 0)
    out = np.hypot(x, y)
    beta = np.arctan2(z, (1 - EARTH.flattening) * out)
    up = z + _E2 / (1 - _E2) * EARTH.polar_radius * np.sin(beta) ** 3
    latitude = np.arctan2(up, out - _E2 * EARTH.radius * np.cos(beta) ** 3)
    sin, cos = np.sin(latitude), np.cos(latitude)
    height = out * cos + z * sin - EARTH.radius * np.sqrt(1 - _E2 * sin * sin)
    return latitude, np.arctan2(y, x), height


def ecef(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> FloatArray:
    """Points (..., 3) [m], Earth-fixed, at latitudes, longitudes [rad] and heights [m]."""
    latitude, longitude, height = np.broadcast_arrays(latitude, longitude, height)
    sin, cos = np.sin(latitude), np.cos(latitude)
    normal = EARTH.radius / np.sqrt(1 - _E2 * sin * sin)
    out = (normal + height) * cos
    up = (normal * (1 - _E2) + height) * sin
    return np.stack([out * np.cos(longitude), out * np.sin(longitude), up], axis=-1)


def local_axes(p: ArrayLike) -> FloatArray:
    """Rows east, north, up of points (..., 3): shape (..., 3, 3), Earth-fixed."""
    latitude, longitude, _ = geodetic(p)
    (sl, cl), (so, co) = ((np.sin(a), np.cos(a)) for a in (latitude, longitude))
    east = np.stack([-so, co, np.zeros_like(so)], axis=-1)
    north = np.stack([-sl * co, -sl * so, cl], axis=-1)
    up = np.stack([cl * co, cl * so, sl], axis=-1)
    return np.stack([east, north, up], axis=-2)
