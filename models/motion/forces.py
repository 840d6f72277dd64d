r"""Forces on a satellite besides the Earth's own gravity, in Earth-fixed axes.

A third body of parameter :math:`\mu_b` at :math:`s` pulls the satellite and the Earth [1]_,

.. math::
    a = -\frac{\mu_b}{d^3} \left( r + f(q)\, s \right), \quad d = \lVert r - s \rVert, \quad
    q = \frac{r \cdot (r - 2 s)}{s \cdot s}, \quad
    f(q) = q\, \frac{3 + 3 q + q^2}{1 + (1 + q)^{3/2}},

which subtracts no two nearly equal numbers. The solid Earth yields to it by the changes of
coefficients of step 1 of [2]_, eqs. (6.6) and (6.7), of degrees two to four,

.. math::
    \Delta \bar C_{nm} - i \Delta \bar S_{nm} = \frac{k_{nm}}{2 n + 1} \sum_b \frac{\mu_b}{\mu}
        \left( \frac{a}{r_b} \right)^{n+1} \bar P_{nm}(\sin \varphi_b)\, e^{-i m \lambda_b}.

Radiation pressure falls with the square of the distance from the Sun, in the share :math:`\nu` of
its disk that the Earth leaves free [3]_, and drag is that of air of density :math:`\varrho`, which
turns with the Earth or not,

.. math::
    a = \nu\, P \frac{C_R A}{m} \mathrm{AU}^2 \frac{r - \odot}{\lVert r - \odot \rVert^3}, \qquad
    a = -\tfrac12\, \varrho\, \frac{C_D A}{m} \lVert u \rVert u, \qquad
    u = v \;\text{ or }\; v + \omega \times r.

References
----------
.. [1] R. H. Battin, "An Introduction to the Mathematics and Methods of Astrodynamics", revised
       edition, AIAA, 1999, section 8.4.
.. [2] G. Petit and B. Luzum (eds.), "IERS Conventions (2010)", IERS Technical Note 36, section
       6.2.1, table 6.3 (anelastic Earth).
.. [3] O. Montenbruck and E. Gill, "Satellite Orbits", Springer, 2000, sections 3.4.2, 3.5 and
       3.7.2.
"""

from __future__ import annotations

from math import pi
from typing import Any

import casadi as ca

from terrafix.models.geometry.geodesy import north_east_down
from terrafix.models.motion.harmonics import harmonic_sum, solid_harmonics

SUN_MU, MOON_MU = 1.3271244004193938e20, 4.902800066e12
"""Gravitational parameters [m^3/s^2], of the ephemeris DE440."""

ASTRONOMICAL_UNIT = 149597870700.0
"""[m], by definition."""

SUN_RADIUS, EARTH_RADIUS = 6.957e8, 6378136.3
"""Of the two disks of an eclipse [m]."""

SOLAR_PRESSURE = 4.56e-6
"""On a black surface at one astronomical unit [N/m^2]."""

WINDS = ("corotating", "none")
"""How the air moves: with the Earth, or not at all."""

_LOVE = {
    (2, 0): (0.30190, 0.0),
    (2, 1): (0.29830, -0.00144),
    (2, 2): (0.30102, -0.00130),
    (3, 0): (0.093, 0.0),
    (3, 1): (0.093, 0.0),
    (3, 2): (0.093, 0.0),
    (3, 3): (0.094, 0.0),
}
"""Real and imaginary parts."""
_LOVE_FOUR = (-0.00089, -0.00080, -0.00057)
"""What a tide of degree two does to coefficients of degree four, by order."""


def third_body_acceleration(r: Any, body: Any, mu: Any) -> Any:
    """Pull of a distant body, less its pull on the Earth, (3,) [m/s^2].

    Parameters
    ----------
    r, body : SX, shape (3,)
        Of the satellite and of the body, from the center of the Earth [m].
    mu : SX or float
        Gravitational parameter of the body [m^3/s^2].
    """
    apart = r - body
    squared = ca.dot(apart, apart)
    q = ca.dot(r, r - 2 * body) / ca.dot(body, body)
    f = q * (3 + q * (3 + q)) / (1 + (1 + q) * ca.sqrt(1 + q))
    return -mu / (squared * ca.sqrt(squared)) * (r + f * body)


def solid_tide_acceleration(r: Any, sun: Any, moon: Any, mu: Any, radius: Any) -> Any:
    """Pull of the tide of the solid Earth, (3,) [m/s^2], beside a tide-free gravity field.

    Parameters
    ----------
    r, sun, moon : SX, shape (3,)
        From the center of the Earth [m], Earth-fixed.
    mu, radius : SX or float
        Of the gravity field [m^3/s^2], [m].
    """
    C, S = ca.SX(5, 5), ca.SX(5, 5)
    for body, parameter in ((sun, SUN_MU), (moon, MOON_MU)):
        share = parameter / mu
        cosines, sines = solid_harmonics(body, radius, 3)
        for (n, m), (real, imaginary) in _LOVE.items():
            c, s = (share / (2 * n + 1) * part[n, m] for part in (cosines, sines))
            C[n, m] += real * c + imaginary * s
            S[n, m] += real * s - imaginary * c
        for m, plus in enumerate(_LOVE_FOUR):
            C[4, m] += share * plus / 5 * cosines[2, m]
            S[4, m] += share * plus / 5 * sines[2, m]
    return harmonic_sum(r, mu, radius, C, S)


def sunlight(r: Any, sun: Any) -> Any:
    """Share of the disk of the Sun that the Earth, a sphere, does not hide.

    Parameters
    ----------
    r, sun : SX, shape (3,)
        From the center of the Earth [m].
    """
    line = sun - r
    to_sun, to_earth = ca.sqrt(ca.dot(line, line)), ca.sqrt(ca.dot(r, r))
    a = ca.asin(ca.fmin(SUN_RADIUS / to_sun, 1))
    b = ca.asin(ca.fmin(EARTH_RADIUS / to_earth, 1))
    c = ca.acos(_within(-ca.dot(r, line) / (to_earth * to_sun)))
    # where both disks overlap in part, c is positive; elsewhere what follows is not looked at
    apart = ca.fmax(c, 1e-9)
    x = (apart * apart + a * a - b * b) / (2 * apart)
    y = ca.sqrt(ca.fmax(a * a - x * x, 0))
    hidden = (
        a * a * ca.acos(_within(x / a)) + b * b * ca.acos(_within((apart - x) / b)) - apart * y
    ) / (pi * a * a)
    covered = ca.if_else(c <= ca.fabs(a - b), 1.0, hidden)
    return 1 - ca.if_else(c < a + b, covered, 0.0)


def _within(cosine: Any) -> Any:
    return ca.fmax(ca.fmin(cosine, 1), -1)


def radiation_pressure_acceleration(r: Any, sun: Any, coefficient: Any) -> Any:
    """Pressure of sunlight on a sphere, where the Earth lets it pass, (3,) [m/s^2].

    Parameters
    ----------
    r, sun : SX, shape (3,)
        From the center of the Earth [m].
    coefficient : SX or float
        Coefficient of radiation pressure (1: absorbed) times area over mass [m^2/kg].
    """
    away = r - sun
    squared = ca.dot(away, away)
    pressure = SOLAR_PRESSURE * ASTRONOMICAL_UNIT**2 * sunlight(r, sun)
    return pressure * coefficient / (squared * ca.sqrt(squared)) * away


def air_drag_acceleration(
    r: Any, v: Any, omega: Any, density: Any, coefficient: Any, wind: str = "corotating"
) -> Any:
    """Drag, (3,) [m/s^2], of air that turns with the Earth, or does not.

    Parameters
    ----------
    r, v : SX, shape (3,)
        Position [m], and velocity relative to the Earth [m/s].
    omega : SX, shape (3,)
        Rotation of the Earth [rad/s].
    density : SX or float
        [kg/m^3]
    coefficient : SX or float
        Drag coefficient times area over mass [m^2/kg].
    wind : {"corotating", "none"}
        How the air moves.

    Raises
    ------
    ValueError
        If `wind` is neither.
    """
    if wind not in WINDS:
        raise ValueError(f"wind must be one of {WINDS}, got '{wind}'")
    through = v if wind == "corotating" else v + ca.cross(omega, r)
    speed = ca.sqrt(ca.dot(through, through))
    return -0.5 * density * coefficient * speed * through


def exponential_density(r: Any, density: Any, height: Any, scale: Any) -> Any:
    r"""Density of an atmosphere that thins by e in a scale height [kg/m^3].

    Parameters
    ----------
    r : SX, shape (3,)
        Position [m], Earth-fixed.
    density : SX or float
        At the reference height [kg/m^3].
    height, scale : SX or float
        Reference height above the ellipsoid, and scale height [m].
    """
    _, _, above = north_east_down(r)
    return density * ca.exp((height - above) / scale)


def density_near(r: Any, place: Any, log_density: Any, gradient: Any) -> Any:
    r"""Density not far from where it is known, with its logarithm linear in radius and direction.

    .. math::
        \ln \varrho = \ln \varrho_0 + (g \cdot \hat r_0) (\lVert r \rVert - \lVert r_0 \rVert)
            + g_\perp \cdot (r - r_0),

    where :math:`g_\perp` is the part of the gradient across :math:`r_0`: a satellite that flies on
    at one height stays at one density, which a gradient in straight lines would not say. Known at
    the center of the Earth means known nowhere: there is no air then.

    Parameters
    ----------
    r, place : SX, shape (3,)
        Here, and where density is known [m], Earth-fixed.
    log_density : SX
        Natural logarithm of the density there [kg/m^3].
    gradient : SX, shape (3,)
        Of the logarithm [1/m].
    """
    far, here = ca.sqrt(ca.dot(place, place)), ca.sqrt(ca.dot(r, r))
    up = place / ca.fmax(far, 1.0)
    upward = ca.dot(gradient, up)
    across = gradient - upward * up
    density = ca.exp(log_density + upward * (here - far) + ca.dot(across, r - place))
    return ca.if_else(far > 0, density, 0.0)
