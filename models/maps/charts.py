"""Where on the ellipsoid a motion is, on the real Earth or a flat one: what maps are read at."""

from __future__ import annotations

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.geodesy import chart_scales, geodetic_from_ecef_array
from terrafix.models.motion.strapdown import EARTHS, level_axes, rotation_rate

ORIGIN = ("latitude0", "longitude0")
"""Where on the ellipsoid a flat Earth has its origin [rad]."""

scales_of = over_members(lambda latitude: tuple(chart_scales(latitude)), ())
_level_axes = {
    earth: over_members(lambda r_e, earth=earth: level_axes(r_e, earth), (3,)) for earth in EARTHS
}


def geodetic_of(
    r_e: FloatArray, earth: str, origin: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude [rad] and height [m], (k,), of positions (k, 3) on an Earth.

    The origin (k,), (k,) is that of the flat Earth, in the scales of whose place north and east are
    drawn.
    """
    if rotation_rate(earth):
        latitude, longitude, height = geodetic_from_ecef_array(r_e)
        return latitude, longitude, height
    north, east = scales_of(origin[0])
    return origin[0] + r_e[:, 0] / north, origin[1] + r_e[:, 1] / east, -r_e[:, 2]


def level_axes_of(r_e: FloatArray, earth: str) -> FloatArray:
    """Transformations (k, 3, 3) from e to north, east, down at positions (k, 3)."""
    found: FloatArray = _level_axes[earth](r_e)
    return np.broadcast_to(found, (len(r_e), 3, 3))
