r"""A radar altimeter over an elevation model: the nearest return within its beam.

The beam is a cone of a half-angle about an axis, straight down or fixed to the body. Of all points
of the ground in it the nearest answers first, and its distance is what is measured: over a plain
the height, over relief a hilltop at the side, or the near wall of a valley. Ground points lie at
(north, east) from below the antenna, lower by :math:`(n^2 + e^2) / 2 R` on a round Earth.

The nearest point is sought on a grid over the footprint, as fine as that of the elevation model up
to some hundred of its steps, then three times on a finer one about it.
"""

from __future__ import annotations

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.earth import EARTH
from terrafix.models.maps.charts import scales_of
from terrafix.models.maps.dem import Dem

WIDEST = float(np.radians(80.0))
"""Angle off the vertical up to which ground is looked for."""

_FEWEST, _MOST, _FINER = 24, 96, 4
"""Points of a grid to each side: over the footprint, and about a point."""
_ROUNDS, _BATCH = 4, 32
_ROUNDING = 1e-9


def nearest_return(
    dem: Dem,
    where: tuple[FloatArray, FloatArray, FloatArray],
    half_angle: FloatArray,
    axis_n: FloatArray,
    *,
    flat: bool = False,
) -> FloatArray:
    """Distance to the nearest ground within a beam, (k,) [m].

    Parameters
    ----------
    dem : Dem
    where : (ndarray, ndarray, ndarray), shape (k,) each
        Latitude, longitude [rad] and height [m] of the antenna.
    half_angle : ndarray, shape (k,)
        Of the beam [rad].
    axis_n : ndarray, shape (k, 3)
        Its axis: north, east, down, unit length.
    flat : bool
        Whether the Earth is flat.

    Returns
    -------
    ndarray, shape (k,)
        NaN where some of the ground in the beam is not known; infinite where there is none in it.
    """
    found = np.empty(len(half_angle))
    for first in range(0, len(found), _BATCH):
        part = slice(first, first + _BATCH)
        places = tuple(a[part] for a in where)
        found[part] = _nearest(dem, places, half_angle[part], axis_n[part], flat)
    return found


def _nearest(
    dem: Dem, where: tuple[FloatArray, ...], half_angle: FloatArray, axis_n: FloatArray, flat: bool
) -> FloatArray:
    latitude, longitude, height = where
    clearance = height - dem.known_at(latitude, longitude)
    off_vertical = np.arccos(np.clip(axis_n[:, 2], -1.0, 1.0))
    reach = clearance * np.tan(np.minimum(off_vertical + half_angle, WIDEST))
    reach = np.nan_to_num(reach)
    meters = EARTH.radius * min(dem.latitude_step, dem.longitude_step)
    n_points = int(np.clip(np.ceil(reach.max(initial=0.0) / meters), _FEWEST, _MOST))
    spacing = reach / n_points
    rows = np.arange(len(height))
    middle = np.zeros((len(height), 2))
    steps = np.arange(-n_points, n_points + 1.0)
    best = np.full(len(height), np.inf)
    unknown = np.isnan(clearance)
    for _ in range(_ROUNDS):
        north, east = np.meshgrid(steps, steps, indexing="ij")
        offsets = np.stack([north.ravel(), east.ravel()], axis=1)
        points = middle[:, None] + spacing[:, None, None] * offsets
        distance = _distances(dem, where, points, half_angle, axis_n, flat)
        unknown |= np.isnan(distance).any(axis=1)
        k = np.argmin(np.where(np.isnan(distance), np.inf, distance), axis=1)
        best = np.fmin(best, distance[rows, k])
        middle = points[rows, k]
        steps = np.arange(-_FINER, _FINER + 1.0)
        spacing = spacing / _FINER
    return np.where(unknown, np.nan, best)


def _distances(
    dem: Dem,
    where: tuple[FloatArray, ...],
    points: FloatArray,
    half_angle: FloatArray,
    axis_n: FloatArray,
    flat: bool,
) -> FloatArray:
    """Distances to ground at (north, east) offsets (k, m, 2); infinite outside the beam."""
    latitude, longitude, height = (a[:, None] for a in where)
    north, east = scales_of(where[0])
    ground = dem.known_at(
        latitude + points[..., 0] / north[:, None], longitude + points[..., 1] / east[:, None]
    )
    lower = 0.0 if flat else (points**2).sum(axis=-1) / (2 * EARTH.radius)
    # ground that is not known counts as in the beam where a plain would be
    down = height - np.where(np.isnan(ground), ground[:, ground.shape[1] // 2, None], ground)
    line = np.concatenate([points, (down + lower)[..., None]], axis=-1)
    across = np.linalg.norm(np.cross(line, axis_n[:, None]), axis=-1)
    angle = np.arctan2(across, np.einsum("kmi,ki->km", line, axis_n))
    distance = np.where(np.isnan(ground), np.nan, np.linalg.norm(line, axis=-1))
    return np.where(angle <= half_angle[:, None] + _ROUNDING, distance, np.inf)
