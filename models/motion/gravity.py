r"""Accelerations: of a satellite central gravity, oblateness, drag; near the ground normal gravity.

Central gravity and the second zonal harmonic are symmetric about the polar axis, so the same
expressions hold for inertial and Earth-fixed components.

References
----------
.. [1] NIMA TR8350.2, "Department of Defense World Geodetic System 1984", 3rd edition, 2000,
       eqs. (4-1) and (4-3), tables 3.3 and 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_rate_cross

GRAVITY_MODELS = ("two-body", "j2")
"""Names taken by `gravity_acceleration`."""

STANDARD_GRAVITY = 9.80665
"""[m/s^2], CGPM 1901."""

GRAVITY_EQUATOR, GRAVITY_POLE = 9.7803253359, 9.8321849378
"""Normal gravity on the ellipsoid [m/s^2], table 3.4 of [1]_."""

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


def normal_gravity(sin_latitude: Any, height: Any) -> Any:
    r"""Normal gravity [m/s^2] of WGS-84, centrifugal acceleration included.

    Somigliana's formula on the ellipsoid, and its series to the second power of height,

    .. math::
        \gamma = \gamma_e \frac{1 + k \sin^2\varphi}{\sqrt{1 - e^2 \sin^2\varphi}}
            \left[ 1 - \frac{2}{a} (1 + f + m - 2 f \sin^2\varphi)\, h
                + \frac{3}{a^2} h^2 \right], \quad
        k = \frac{b \gamma_p}{a \gamma_e} - 1, \quad m = \frac{\omega^2 a^2 b}{\mu},

    eqs. (4-1) and (4-3) of [1]_. Its direction is taken as that of the ellipsoid's normal; true
    normal gravity turns north with height, by 8e-9 m/s^2 for each meter at 45 degrees.

    Parameters
    ----------
    sin_latitude : SX or float
        Of geodetic latitude.
    height : SX or float
        Above the ellipsoid [m]; the series holds to some 20 km.
    """
    a, b, f = EARTH.radius, EARTH.polar_radius, EARTH.flattening
    squared = sin_latitude * sin_latitude
    k = b * GRAVITY_POLE / (a * GRAVITY_EQUATOR) - 1
    m = EARTH.rotation_rate**2 * a * a * b / EARTH.mu
    on_ellipsoid = GRAVITY_EQUATOR * (1 + k * squared) / ca.sqrt(1 - f * (2 - f) * squared)
    linear = -2 / a * (1 + f + m - 2 * f * squared)
    return on_ellipsoid * (1 + height * (linear + 3 / (a * a) * height))
