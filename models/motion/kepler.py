r"""Keplerian elements and Cartesian state of a two-body orbit.

.. math::
    r = \frac{a (1 - e^2)}{1 + e \cos\nu}, \qquad
    v = \sqrt{\frac{\mu}{a (1 - e^2)}}
        \left[ -\sin\nu\; \hat p + (e + \cos\nu)\, \hat q \right]

in the perifocal axes :math:`\hat p` (to perigee) and :math:`\hat q`, turned by the argument of
perigee, inclination and right ascension of the ascending node.

Motion over a time :math:`t` is Lagrange's :math:`r' = f r + g v`, :math:`v' = \dot f r + \dot g v`,
with the difference :math:`\Delta` of eccentric anomalies from Kepler's equation between two places
of an orbit,

.. math::
    n t = \Delta + \frac{r \cdot v}{\sqrt{\mu a}} (1 - \cos\Delta)
        - \Bigl(1 - \frac{\lVert r \rVert}{a}\Bigr) \sin\Delta .

References
----------
.. [1] D. A. Vallado, "Fundamentals of Astrodynamics and Applications", 4th ed., algorithms
       9 and 10.
.. [2] R. H. Battin, "An Introduction to the Mathematics and Methods of Astrodynamics", 1999,
       sections 4.3 and 4.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray


@dataclass(frozen=True)
class KeplerianElements:
    """An elliptic orbit and a place on it; lengths in meters, angles in radians.

    Parameters
    ----------
    semi_major_axis : float
        [m].
    eccentricity : float
        In [0, 1).
    inclination, node, argument_of_perigee, true_anomaly : float
        [rad]; `node` is the right ascension of the ascending node.
    """

    semi_major_axis: float
    eccentricity: float
    inclination: float
    node: float
    argument_of_perigee: float
    true_anomaly: float

    def __post_init__(self) -> None:
        if not 0 <= self.eccentricity < 1:
            raise ValueError(f"eccentricity must be in [0, 1), got {self.eccentricity}")
        if self.semi_major_axis <= 0:
            raise ValueError(f"semi-major axis must be positive, got {self.semi_major_axis} m")

    def period(self, mu: float) -> float:
        """Time of one revolution [s] at gravitational parameter `mu` [m^3/s^2]."""
        return 2 * np.pi * sqrt(self.semi_major_axis**3 / mu)

    def state(self, mu: float) -> tuple[FloatArray, FloatArray]:
        """Inertial position [m] and velocity [m/s], two (3,)."""
        e, nu = self.eccentricity, self.true_anomaly
        parameter = self.semi_major_axis * (1 - e * e)
        p, q = self._perifocal_axes()
        r = parameter / (1 + e * cos(nu)) * (cos(nu) * p + sin(nu) * q)
        v = sqrt(mu / parameter) * (-sin(nu) * p + (e + cos(nu)) * q)
        return r, v

    def _perifocal_axes(self) -> tuple[FloatArray, FloatArray]:
        c_n, s_n = cos(self.node), sin(self.node)
        c_i, s_i = cos(self.inclination), sin(self.inclination)
        c_w, s_w = cos(self.argument_of_perigee), sin(self.argument_of_perigee)
        to_node = np.array([c_n, s_n, 0.0])
        across = np.array([-s_n * c_i, c_n * c_i, s_i])
        return c_w * to_node + s_w * across, -s_w * to_node + c_w * across


def elements_of_state(r_i: ArrayLike, v_i: ArrayLike, mu: float) -> KeplerianElements:
    """Elements of the elliptic orbit through an inertial state.

    Angles are in [0, 2 pi). Where the node (equatorial orbit) or the perigee (circular orbit) is
    undefined, it is put on the x axis or on the node.

    Parameters
    ----------
    r_i, v_i : array_like, shape (3,)
        Inertial position [m] and velocity [m/s].
    mu : float
        Gravitational parameter [m^3/s^2].

    Raises
    ------
    ValueError
        If the orbit is not an ellipse.
    """
    r, v = np.asarray(r_i, dtype=np.float64), np.asarray(v_i, dtype=np.float64)
    distance = float(np.linalg.norm(r))
    h = np.cross(r, v)
    inverse_a = 2 / distance - float(v @ v) / mu
    to_perigee = np.cross(v, h) / mu - r / distance
    e = float(np.linalg.norm(to_perigee))
    if inverse_a <= 0 or e >= 1:
        raise ValueError(f"the state is not on an ellipse: its eccentricity is {e:.6g}")
    h_hat = h / np.linalg.norm(h)
    to_node = np.array([-h[1], h[0], 0.0])
    if np.linalg.norm(to_node) < 1e-12 * np.linalg.norm(h):
        to_node = np.array([1.0, 0.0, 0.0])
    to_node /= np.linalg.norm(to_node)
    if e < 1e-14:  # below the rounding of the state
        to_perigee, e = to_node, 0.0
    return KeplerianElements(
        semi_major_axis=1 / inverse_a,
        eccentricity=e,
        inclination=float(np.arctan2(np.hypot(h[0], h[1]), h[2])),
        node=float(np.arctan2(to_node[1], to_node[0]) % (2 * np.pi)),
        argument_of_perigee=_angle_about(h_hat, to_node, to_perigee),
        true_anomaly=_angle_about(h_hat, to_perigee, r),
    )


def circular_orbit(
    radius: float, mu: float, inclination: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Inertial state, two (3,), on a circular orbit at its ascending node on the x axis."""
    return KeplerianElements(radius, 0.0, inclination, 0.0, 0.0, 0.0).state(mu)


ITERATIONS = 6
"""Of Newton's method for Kepler's equation."""
LARGEST = 50.0
"""Semi-major axis over distance."""


def coasted(r: Any, v: Any, time: Any, mu: Any) -> tuple[Any, Any]:
    """Position [m] and velocity [m/s] after a time of two-body motion on an ellipse.

    To rounding up to an eccentricity of 0.5. A semi-major axis above `LARGEST` distances, or none,
    is taken for that: over a time that is short to a revolution it makes no difference.

    Parameters
    ----------
    r, v : SX, shape (3,)
        Inertial position [m] and velocity [m/s].
    time : SX
        Of either sign [s].
    mu : SX or float
        Gravitational parameter [m^3/s^2].
    """
    return _placed(r, v, time, mu, _turn(r, v, time, mu))


def coasting(r: Any, v: Any, time: Any, mu: Any) -> Any:
    """Derivative (6, 6) of `coasted` by position and velocity; parameters as there."""
    turn, r0, v0 = ca.SX.sym("turn"), ca.SX.sym("r", 3), ca.SX.sym("v", 3)
    # a step of Newton's method from where it has converged has the derivative of what it finds
    end = ca.vertcat(*_placed(r0, v0, time, mu, _nearer(r0, v0, time, mu, turn)))
    J = ca.jacobian(end, ca.vertcat(r0, v0))
    return ca.substitute(J, ca.vertcat(r0, v0, turn), ca.vertcat(r, v, _turn(r, v, time, mu)))


def _orbit(r: Any, v: Any, mu: Any) -> tuple[Any, ...]:
    """Distance, semi-major axis, mean motion; e sin E and e cos E of the eccentric anomaly E."""
    distance = ca.sqrt(ca.dot(r, r))
    a = 1 / ca.fmax(2 / distance - ca.dot(v, v) / mu, 1 / (LARGEST * distance))
    return distance, a, ca.sqrt(mu / a) / a, ca.dot(r, v) / ca.sqrt(mu * a), 1 - distance / a


def _turn(r: Any, v: Any, time: Any, mu: Any) -> Any:
    """Difference of eccentric anomalies over a time [rad]."""
    turn = _orbit(r, v, mu)[2] * time
    for _ in range(ITERATIONS):
        turn = _nearer(r, v, time, mu, turn)
    return turn


def _nearer(r: Any, v: Any, time: Any, mu: Any, turn: Any) -> Any:
    """A step of Newton's method."""
    _, _, motion, e_sin, e_cos = _orbit(r, v, mu)
    c, s = ca.cos(turn), ca.sin(turn)
    missing = motion * time - (turn + e_sin * (1 - c) - e_cos * s)
    return turn + missing / (1 + e_sin * s - e_cos * c)


def _placed(r: Any, v: Any, time: Any, mu: Any, turn: Any) -> tuple[Any, Any]:
    """Position and velocity where the eccentric anomaly has grown by a turn, after a time."""
    distance, a, motion, e_sin, e_cos = _orbit(r, v, mu)
    c, s = ca.cos(turn), ca.sin(turn)
    after = a * (1 + e_sin * s - e_cos * c)
    f, g = 1 - a / distance * (1 - c), time - (turn - s) / motion
    f_rate, g_rate = -motion * a * a / (after * distance) * s, 1 - a / after * (1 - c)
    return f * r + g * v, f_rate * r + g_rate * v


def _angle_about(axis: FloatArray, start: FloatArray, end: FloatArray) -> float:
    """Angle [rad], in [0, 2 pi), that turns `start` into `end` about a unit axis."""
    angle = np.arctan2(axis @ np.cross(start, end), start @ end)
    return float(angle % (2 * np.pi))
