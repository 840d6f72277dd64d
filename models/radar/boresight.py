"""Where an antenna's boresight meets the terrain, and with what Doppler frequency it is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.antenna import boresight_direction_array, nominal_antenna_array
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ellipsoid_intersection, geodetic
from terrafix.models.maps.dem import Dem

_ROUNDS = 50
_ACROSS = float(np.sin(np.radians(2.0)))
"""Sine of the least angle between a boresight and the vertical plane of the track."""


def _above(r_e: object, direction: object, height: object) -> object:
    """Where a ray meets an ellipsoid that is larger by a height."""
    radius = EARTH.radius + height  # type: ignore[operator]
    polar = EARTH.polar_radius + height  # type: ignore[operator]
    return ellipsoid_intersection(r_e, direction, radius, 1 - polar / radius)


_above_array = over_members(_above, (3,), (3,), ())


@dataclass(frozen=True)
class Boresight:
    """Where a boresight meets the ground.

    Parameters
    ----------
    point : ndarray, shape (3,)
        Earth-fixed [m].
    slant_range : float
        Distance to it [m].
    closing : float
        Speed toward it [m/s].
    side : {1, -1}
        To the right of the track, or to the left.
    """

    point: FloatArray
    slant_range: float
    closing: float
    side: int = 1

    def doppler(self, wavelength: float) -> float:
        """Doppler frequency with which it is seen [Hz], positive when closing."""
        return 2 * self.closing / wavelength


def boresight_on_terrain(
    r_e: FloatArray,
    v_e: FloatArray,
    q_be: FloatArray,
    q_mu: FloatArray,
    look: float,
    squint: float,
    dem: Dem,
) -> Boresight:
    """Follow a boresight to the terrain.

    Parameters
    ----------
    r_e, v_e : ndarray, shape (3,)
        Position [m] and velocity [m/s], Earth-fixed.
    q_be, q_mu : ndarray, shape (4,)
        Attitude, and misalignment of the antenna.
    look, squint : float
        Angles of the nominal antenna [rad].
    dem : Dem
        Terrain.

    Raises
    ------
    ValueError
        If the boresight misses the Earth or lies along the track, or the terrain is not known
        where it meets it.
    """
    direction = boresight_direction_array(q_be, nominal_antenna_array(look, squint), q_mu)
    height = 0.0
    for _ in range(_ROUNDS):
        point, hit = _above_array(r_e, direction, height)
        if not hit > 0:
            raise ValueError("it misses the Earth")
        latitude, longitude, own = geodetic(point)
        rise = float(dem.at(latitude, longitude)) - float(own)
        if abs(rise) < 1e-4:
            break
        height += 0.7 * rise
    line = point - r_e
    distance = float(np.linalg.norm(line))
    right = np.cross(v_e, r_e)
    across = float(line @ right) / float(np.linalg.norm(right)) / distance
    if abs(across) < _ACROSS:
        raise ValueError(
            f"it lies {np.degrees(abs(across)):.2f} deg off the track, ahead of it or below: what "
            "is to its right and to its left has the same ranges\n"
            "  set a look angle, positive to the right or negative to the left"
        )
    side = 1 if across > 0 else -1
    return Boresight(point, distance, float(v_e @ line) / distance, side)
