r"""Effective velocity: what focuses an image, and what it says of the radar's own velocity.

The square of the distance to a ground point, expanded about closest approach,

.. math:: R(t)^2 \approx R_0^2 + V^2 (t - t_0)^2, \qquad V^2 = \lVert v \rVert^2 + (r - p)^T a,

has the effective velocity :math:`V` in place of the speed: half the second derivative of
:math:`R^2`. Position, velocity and acceleration are Earth-fixed, so that the point rests;
:math:`a` holds gravity, centrifugal and Coriolis acceleration. In low orbit :math:`V` is some 5 %
below the speed, by an amount that depends on where the radar is: an autofocused :math:`V` measures
velocity and, a little, position.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
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
