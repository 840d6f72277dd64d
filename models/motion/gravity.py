r"""Accelerations of a satellite: central gravity, oblateness, drag.

Central gravity and the second zonal harmonic are symmetric about the polar axis, so the same
expressions hold for inertial and Earth-fixed components.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca

from terrafix.models.geometry.frames import earth_rate_cross

GRAVITY_MODELS = ("two-body", "j2")
"""Names taken by `gravity_acceleration`."""

_TINY = 1e-300


def two_body_acceleration(r: Any, mu: Any) -> Any:
    r"""Central gravity, (3,) [m/s^2]: :math:`-\mu\, r / \lVert r \rVert^3`."""
    squared = ca.dot(r, r)
    return -mu / (squared * ca.sqrt(squared)) * r


def j2_acceleration(r: Any, mu: Any, radius: Any, j2: Any) -> Any:
    r"""Central gravity and the second zonal harmonic, (3,) [m/s^2].

    .. math::
        a = -\frac{\mu}{\rho^3}\left\{ r + \frac{3}{2} J_2 \frac{R^2}{\rho^2}
            \left[ \left(1 - 5\frac{z^2}{\rho^2}\right) r + 2 z\, \hat e_z \right] \right\},
        \qquad \rho = \lVert r \rVert.

    Parameters
    ----------
    r : SX, shape (3,)
        Position [m], inertial or Earth-fixed.
    mu, radius, j2 : SX or float
        Gravitational parameter [m^3/s^2], equatorial radius [m], coefficient [-].
    """
    inverse_distance = 1 / ca.sqrt(ca.dot(r, r))
    inverse = inverse_distance * inverse_distance
    oblate = 1.5 * j2 * radius * radius * inverse
    radial = 1 + oblate * (1 - 5 * r[2] * r[2] * inverse)
    central = -mu * inverse * inverse_distance
    return central * ca.vertcat(radial * r[0], radial * r[1], (radial + 2 * oblate) * r[2])


def gravity_acceleration(model: str) -> Callable[[Any, Any, Any, Any], Any]:
    """Choose a gravity model by name: a function of (r, mu, radius, j2).

    Raises
    ------
    ValueError
        If `model` is none of `GRAVITY_MODELS`.
    """
    if model == "two-body":
        return lambda r, mu, radius, j2: two_body_acceleration(r, mu)  # noqa: ARG005
    if model == "j2":
        return j2_acceleration
    raise ValueError(f"gravity must be one of {GRAVITY_MODELS}, got '{model}'")


def drag_acceleration(
    r_i: Any, v_i: Any, density: Any, ballistic_coefficient: Any, rotation_rate: Any
) -> Any:
    r"""Drag of an atmosphere that turns with the Earth, (3,) [m/s^2].

    .. math::
        a = -\tfrac{1}{2}\, \varrho\, \frac{C_d A}{m}\, \lVert u \rVert\, u, \qquad
        u = v_i - \omega \times r_i

    Parameters
    ----------
    r_i, v_i : SX, shape (3,)
        Inertial position [m] and velocity [m/s].
    density : SX or float
        Density of the air [kg/m^3].
    ballistic_coefficient : SX or float
        Drag coefficient times area over mass [m^2/kg].
    rotation_rate : SX or float
        Rotation of the Earth [rad/s].
    """
    relative = v_i - earth_rate_cross(rotation_rate, r_i)
    speed = ca.sqrt(ca.dot(relative, relative) + _TINY)
    return -0.5 * density * ballistic_coefficient * speed * relative


def earth_fixed_acceleration(
    r: Any, v: Any, mu: Any, radius: Any, j2: Any, rotation_rate: Any, gravity: str = "j2"
) -> Any:
    r"""Acceleration of a free body seen from the rotating Earth.

    .. math:: a = g - 2 \omega \times v - \omega \times (\omega \times r)

    Parameters
    ----------
    r, v : SX, shape (3,)
        Position [m] and velocity [m/s], Earth-fixed.
    mu, radius, j2, rotation_rate : SX or float
        [m^3/s^2], [m], [-], [rad/s].
    gravity : {"j2", "two-body"}
        Gravity field.
    """
    g = gravity_acceleration(gravity)(r, mu, radius, j2)
    turned = earth_rate_cross(rotation_rate, r)
    return g - 2 * earth_rate_cross(rotation_rate, v) - earth_rate_cross(rotation_rate, turned)
