r"""Effective velocity: what focuses an image, and what it says of the radar's own velocity.

The square of the distance to a ground point, expanded about closest approach,

.. math:: R(t)^2 \approx R_0^2 + V^2 (t - t_0)^2, \qquad V^2 = \lVert v \rVert^2 + (r - p)^T a,

has the effective velocity :math:`V` in place of the speed: half the second derivative of
:math:`R^2`. Position, velocity and acceleration are Earth-fixed, so that the point rests;
:math:`a` holds gravity, centrifugal and Coriolis acceleration. In low orbit :math:`V` is some 5 %
below the speed, by an amount that depends on where the radar is: an autofocused :math:`V` measures
velocity and, a little, position.

It differs over a scene. In low orbit it falls by 0.1 to 0.2 m/s for each kilometer of range, grows
by 0.4 to 0.5 mm/s for each meter of height, and changes by some 0.05 m/s in a second of flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geolocation import ground_point
from terrafix.models.motion.gravity import earth_fixed_acceleration


def effective_velocity(
    r: Any, v: Any, p: Any, mu: Any, radius: Any, j2: Any, rotation_rate: Any
) -> Any:
    """Effective velocity [m/s] of a radar at closest approach to a ground point.

    Undefined where the bracket above is not positive, far above any orbit that images.

    Parameters
    ----------
    r, v : SX, shape (3,)
        Radar position [m] and velocity [m/s], Earth-fixed.
    p : SX, shape (3,)
        Ground point [m], Earth-fixed.
    mu, radius, j2, rotation_rate : SX or float
        Of the Earth.
    """
    a = earth_fixed_acceleration(r, v, mu, radius, j2, rotation_rate)
    return ca.sqrt(ca.dot(v, v) + ca.dot(r - p, a))


def _on_earth(r: Any, v: Any, p: Any) -> Any:
    return effective_velocity(r, v, p, EARTH.mu, EARTH.radius, EARTH.j2, EARTH.rotation_rate)


effective_velocity_array = over_members(_on_earth, (3,), (3,), (3,))
"""Effective velocity of arrays of radars and points, shape (...), with the Earth's constants."""


def _acceleration(r: Any, v: Any) -> Any:
    return earth_fixed_acceleration(r, v, EARTH.mu, EARTH.radius, EARTH.j2, EARTH.rotation_rate)


_acceleration_array = over_members(_acceleration, (3,), (3,))
_RANGE, _TIME, _HEIGHT = 3000.0, 1.0, 300.0
"""Steps of differences [m], [s], [m]."""


@dataclass(frozen=True)
class VelocityField:
    """The effective velocity over a scene.

    Parameters
    ----------
    velocity : float
        At its middle [m/s].
    by_range : float
        Growth with slant range [m/s per m].
    by_time : float
        Growth with the time of flight, at one range [m/s^2].
    by_height : float
        Growth with the height of what is seen, at one range [m/s per m].
    """

    velocity: float
    by_range: float
    by_time: float
    by_height: float


def velocity_field(
    r: FloatArray, v: FloatArray, slant_range: float, sine: float, side: int = 1
) -> VelocityField:
    """Effective velocity about a point on the ellipsoid, by differences.

    Parameters
    ----------
    r, v : ndarray, shape (3,)
        Radar position [m] and velocity [m/s], Earth-fixed, when the point is seen.
    slant_range : float
        To the point [m].
    sine : float
        Of the angle at which it is seen ahead of broadside.
    side : {1, -1}
        To the right of the track, or to the left.

    Raises
    ------
    ValueError
        If the range does not reach the ground.
    """
    a = _acceleration_array(r, v)
    t = np.array([0.0, 0.0, 0.0, -_TIME, _TIME, 0.0])[:, None]
    r, v = r + v * t + a * t * t / 2, v + a * t
    R = slant_range + np.array([0.0, -_RANGE, _RANGE, 0.0, 0.0, 0.0])
    h = np.array([0.0, 0.0, 0.0, 0.0, 0.0, _HEIGHT])
    V = effective_velocity_array(r, v, ground_point(r, v, R, sine, h, side))
    own, near, far, before, after, high = (float(x) for x in V)
    return VelocityField(
        own, (far - near) / (2 * _RANGE), (after - before) / (2 * _TIME), (high - own) / _HEIGHT
    )
