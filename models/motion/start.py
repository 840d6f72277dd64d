"""Where to start an orbit so that a side-looking antenna sees a given place.

The node and the anomaly of an orbit of given shape are solved so that the boresight of an antenna
on a level body meets the ellipsoid at the place. Inertial and Earth-fixed axes
coincide at that instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.antenna import boresight_direction_array, nominal_antenna_array
from terrafix.models.geometry.earth import EARTH, Earth
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.geometry.geodesy import (
    ellipsoid_intersection_array,
    geodetic_from_ecef_array,
)
from terrafix.models.motion.attitude import lvlh_quaternion_array
from terrafix.models.motion.kepler import KeplerianElements


@dataclass(frozen=True)
class OrbitShape:
    """An orbit but for its node and the place on it.

    Parameters
    ----------
    radius_at_node : float
        Distance from the center at the ascending node [m].
    eccentricity : float
        In [0, 1).
    inclination, argument_of_perigee : float
        [rad].
    """

    radius_at_node: float
    eccentricity: float
    inclination: float
    argument_of_perigee: float

    def elements(self, node: float, argument_of_latitude: float) -> KeplerianElements:
        """Elements at a node and an angle from it [rad]."""
        e, w = self.eccentricity, self.argument_of_perigee
        semi_major_axis = self.radius_at_node * (1 + e * np.cos(w)) / (1 - e * e)
        return KeplerianElements(
            semi_major_axis, e, self.inclination, node, w, argument_of_latitude - w
        )


def boresight_point(
    r_i: FloatArray,
    v_i: FloatArray,
    look: float,
    squint: float,
    earth: Earth = EARTH,
    velocity: str = "earth-fixed",
) -> FloatArray:
    """Where the boresight meets the ellipsoid, (3,) Earth-fixed [m]; NaN where it misses.

    Parameters
    ----------
    r_i, v_i : ndarray, shape (3,)
        State [m], [m/s] at the instant when inertial and Earth-fixed axes coincide.
    look, squint : float
        Angles of the nominal antenna [rad].
    earth : Earth
        Its rotation gives the Earth-fixed velocity.
    velocity : {"earth-fixed", "inertial"}
        Velocity that the body follows.
    """
    r_e, v_e = earth_fixed_from_inertial_array(r_i, v_i, 0.0, earth.rotation_rate)
    q_sb = nominal_antenna_array(look, squint)
    q_be = lvlh_quaternion_array(r_e, v_i if velocity == "inertial" else v_e)
    direction = boresight_direction_array(q_be, q_sb, [0, 0, 0, 1])
    point, hit = ellipsoid_intersection_array(r_e, direction)
    return np.where(hit > 0, point, np.nan)


def boresight_start(
    shape: OrbitShape,
    latitude: float,
    longitude: float,
    look: float,
    squint: float = 0.0,
    earth: Earth = EARTH,
    velocity: str = "earth-fixed",
) -> tuple[FloatArray, FloatArray]:
    """Inertial position [m] and velocity [m/s], (3,) each, ascending, looking at a place.

    Parameters
    ----------
    shape : OrbitShape
        The orbit.
    latitude, longitude : float
        Geodetic place on the ellipsoid [rad].
    look, squint : float
        Angles of the nominal antenna [rad].
    earth : Earth
        Gravitational parameter and rotation.
    velocity : {"earth-fixed", "inertial"}
        Velocity that the body follows.

    Raises
    ------
    ValueError
        If no such start was found: the place is out of the antenna's reach.
    """
    from scipy.optimize import root

    def miss(angles: FloatArray) -> FloatArray:
        state = shape.elements(float(angles[0]), float(angles[1])).state(earth.mu)
        hit_latitude, hit_longitude, _ = geodetic_from_ecef_array(
            boresight_point(*state, look, squint, earth, velocity)
        )
        turns = np.round((hit_longitude - longitude) / (2 * np.pi))
        return np.array([hit_latitude - latitude, hit_longitude - longitude - 2 * np.pi * turns])

    # start from the orbit through the place itself, on its ascending half
    ratio = np.sin(latitude) / np.sin(shape.inclination)
    along = float(np.arcsin(np.clip(ratio, -1, 1)))
    ahead = np.arctan2(np.cos(shape.inclination) * np.sin(along), np.cos(along))
    solution = root(miss, [longitude - ahead, along], tol=1e-15)
    if not np.max(np.abs(miss(solution.x))) < 1e-12:
        raise ValueError(
            f"found no start of this orbit whose boresight meets latitude "
            f"{np.degrees(latitude):.4f}, longitude {np.degrees(longitude):.4f} deg: it may be "
            f"out of reach at inclination {np.degrees(shape.inclination):.2f} deg"
        )
    return shape.elements(*solution.x).state(earth.mu)


ALOS = OrbitShape(
    radius_at_node=7_069_637.0,
    eccentricity=0.00118,
    inclination=float(np.radians(98.16)),
    argument_of_perigee=float(np.radians(90.0)),
)
"""Orbit of the radar satellite of the spacecraft papers; its perigee is a choice (frozen orbit)."""
