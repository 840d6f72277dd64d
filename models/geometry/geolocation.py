r"""From a place in a radar image to a place on Earth, and back.

A pixel is what was seen at time :math:`t` and slant range :math:`R` with Doppler frequency
:math:`f`. On a surface of given height that is one point :math:`p` on each side of the track,

.. math::
    \lVert p - r(t) \rVert = R, \qquad
    \frac{2\, v(t)^T (p - r(t))}{\lambda R} = f, \qquad h(p) = h,

with Earth-fixed :math:`r, v`, and :math:`h(p)` the height above the ellipsoid. Terrain makes the
last equation implicit: the height is looked up where the point is, until it stays.

Broadside is :math:`f = 0`, the "zero-Doppler" coordinates of most products. In squinted images
:math:`f` is that of the beam's center, so that :math:`t` is when the point was in fact seen.

References
----------
.. [1] J. C. Curlander, "Location of Spaceborne SAR Imagery", IEEE Trans. Geoscience and Remote
       Sensing GE-20(3), 1982.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import geodetic, local_axes

Height = Callable[[FloatArray, FloatArray], FloatArray]
"""Height [m] at latitudes and longitudes [rad]."""

_STEPS = 50


def track_axes(p: ArrayLike, v: ArrayLike) -> FloatArray:
    """Rows along the track, across it, and up at points (..., 3): shape (..., 3, 3), Earth-fixed.

    Parameters
    ----------
    p : array_like, shape (..., 3)
        Points [m].
    v : array_like, shape (..., 3)
        Velocity of who passes by [m/s]; the horizontal part at the point is "along".
    """
    up = local_axes(p)[..., 2, :]
    v = np.asarray(v, np.float64)
    along = v - np.sum(v * up, axis=-1, keepdims=True) * up
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([along, np.cross(along, up), up], axis=-2)


def ground_point(
    r: ArrayLike,
    v: ArrayLike,
    slant_range: ArrayLike,
    sine: ArrayLike,
    height: ArrayLike = 0.0,
    side: int = 1,
) -> FloatArray:
    r"""Point at a height that is seen at a range and a Doppler frequency.

    Parameters
    ----------
    r, v : array_like, shape (..., 3)
        Radar position [m] and velocity [m/s], Earth-fixed.
    slant_range : array_like, shape (...)
        [m]
    sine : array_like, shape (...)
        Sine of the angle ahead of broadside: :math:`\lambda f / (2 \lVert v \rVert)`.
    height : array_like, shape (...)
        Above the ellipsoid [m].
    side : {1, -1}
        To the right of the track, or to the left.

    Returns
    -------
    ndarray, shape (..., 3)
        Earth-fixed [m].

    Raises
    ------
    ValueError
        If a range does not reach the ground.
    """
    r, v = np.asarray(r, np.float64), np.asarray(v, np.float64)
    shape = np.broadcast_shapes(r.shape[:-1], v.shape[:-1], *map(np.shape, (slant_range, sine)))
    shape = np.broadcast_shapes(shape, np.shape(height))
    R, s, h = (
        np.broadcast_to(np.asarray(a, np.float64), shape) for a in (slant_range, sine, height)
    )
    r, v = (np.broadcast_to(a, (*shape, 3)) for a in (r, v))
    ahead = v / np.linalg.norm(v, axis=-1, keepdims=True)
    down = -r + ahead * np.sum(r * ahead, axis=-1, keepdims=True)
    down /= np.linalg.norm(down, axis=-1, keepdims=True)
    right = side * np.cross(down, ahead)
    across = R * np.sqrt(1 - s * s)
    base = r + (R * s)[..., None] * ahead
    # rotate about the track until the height is right: Newton on the look angle
    sphere = np.linalg.norm(base, axis=-1)
    radius = EARTH.radius * (1 - EARTH.flattening * (base[..., 2] / sphere) ** 2) + h
    cosine = (sphere**2 + across**2 - radius**2) / (2 * sphere * across)
    if not np.all(np.abs(cosine) < 1):
        raise ValueError(
            f"slant ranges of {R.min():.0f} to {R.max():.0f} m do not all reach the ground"
        )
    look = np.arccos(cosine)
    for _ in range(_STEPS):
        cl, sl = np.cos(look)[..., None], np.sin(look)[..., None]
        p = base + across[..., None] * (cl * down + sl * right)
        miss = geodetic(p)[2] - h
        if np.abs(miss).max(initial=0.0) < 1e-6:
            return np.asarray(p)
        climb = across * np.sum(local_axes(p)[..., 2, :] * (cl * right - sl * down), axis=-1)
        look = look - miss / climb
    raise ValueError("a slant range grazes the ground: its point is not defined")


def ground_point_on_terrain(
    r: ArrayLike,
    v: ArrayLike,
    slant_range: ArrayLike,
    sine: ArrayLike,
    terrain: Height,
    start: ArrayLike = 0.0,
    side: int = 1,
) -> FloatArray:
    """Point on a terrain that is seen at a range and a Doppler frequency.

    Where slopes facing the radar are steeper than its view (layover) several points share a
    pixel, and one of them is found.

    Parameters
    ----------
    r, v, slant_range, sine
        As in `ground_point`.
    terrain : callable
        Height [m] at latitudes and longitudes [rad].
    start : array_like
        Height to begin with [m].
    side : {1, -1}
        To the right of the track, or to the left.
    """
    h = np.asarray(start, dtype=np.float64)
    for _ in range(_STEPS):
        p = ground_point(r, v, slant_range, sine, h, side)
        latitude, longitude, _ = geodetic(p)
        found = terrain(latitude, longitude)
        if np.abs(found - h).max(initial=0.0) < 1e-3:
            return p
        h = h + 0.7 * (found - h)
    return p
