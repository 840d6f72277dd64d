r"""Orbits from their elements, symbolically: where a satellite is, given its six numbers.

.. math::
    r = C\, \frac{a (1 - e^2)}{1 + e \cos\nu} (\cos\nu, \sin\nu, 0)^T, \qquad
    v = C \sqrt{\frac{\mu}{a (1 - e^2)}} (-\sin\nu, e + \cos\nu, 0)^T,

with :math:`C = R_z(-\Omega) R_x(-i) R_z(-\omega)` from perifocal to inertial axes, a rotation: its
determinant is one.

References
----------
.. [1] D. A. Vallado, "Fundamentals of Astrodynamics and Applications", 4th ed., algorithm 10.
.. [2] "Satellite-Based Fusion of Image/Inertial Sensors for Precise Geolocation", AFIT thesis,
       eqs. (2.37) to (2.44). It prints the element of C in the second row and first column as
       :math:`\sin\Omega\cos\omega - \cos\Omega\sin\omega\cos i`, with the wrong sign: the
       determinant is then 1.022 for its low orbit and 0.756 for its high one.
"""

from __future__ import annotations

from dataclasses import fields
from math import pi
from typing import Any

import casadi as ca

from terrafix.models.motion.kepler import KeplerianElements

ELEMENTS = tuple(field.name for field in fields(KeplerianElements))
"""Names of the elements in their order: [m], [-], and four angles [rad]."""

LOW_ORBIT = KeplerianElements(6.760e6, 0.0323, 1.71, 5.97, 5.46, pi)
"""Low orbit of the thesis at its apogee, 600 km up (printed: a true anomaly of 3.12 rad)."""

MOLNIYA_ORBIT = KeplerianElements(2.660e7, 0.704, 1.10, 3.60, 4.92, pi)
"""High orbit of the thesis at its apogee, 38 950 km up (printed: a true anomaly of 1.36 rad, with
which it would be 5 300 km up; its table of states is that of the apogee)."""


def perifocal_axes(inclination: Any, node: Any, argument_of_perigee: Any) -> Any:
    """Rotation (3, 3) from perifocal to inertial axes: to perigee, along the motion there, normal.

    Angles are in radians.
    """
    c_n, s_n = ca.cos(node), ca.sin(node)
    c_i, s_i = ca.cos(inclination), ca.sin(inclination)
    c_w, s_w = ca.cos(argument_of_perigee), ca.sin(argument_of_perigee)
    to_node = ca.vertcat(c_n, s_n, 0)
    across = ca.vertcat(-s_n * c_i, c_n * c_i, s_i)
    normal = ca.vertcat(s_n * s_i, -c_n * s_i, c_i)
    return ca.horzcat(c_w * to_node + s_w * across, -s_w * to_node + c_w * across, normal)


def state_of_elements(elements: Any, mu: Any) -> tuple[Any, Any]:
    """Inertial position [m] and velocity [m/s], two (3,), of elements (6,) as in `ELEMENTS`."""
    a, e, inclination, node, argument, anomaly = (elements[k] for k in range(6))
    C = perifocal_axes(inclination, node, argument)
    parameter = a * (1 - e * e)
    cosine, sine = ca.cos(anomaly), ca.sin(anomaly)
    radius, speed = parameter / (1 + e * cosine), ca.sqrt(mu / parameter)
    r = ca.mtimes(C, radius * ca.vertcat(cosine, sine, 0))
    return r, ca.mtimes(C, speed * ca.vertcat(-sine, e + cosine, 0))


def check_orbit(elements: KeplerianElements, radius: float) -> None:
    """Raise ValueError if an orbit comes within `radius` [m] of the center of the Earth."""
    lowest = elements.semi_major_axis * (1 - elements.eccentricity)
    if lowest <= radius:
        raise ValueError(
            f"the orbit meets the Earth: its perigee lies {(lowest - radius) / 1e3:.0f} km above "
            "the surface\n  make the semi-major axis larger, or the eccentricity smaller"
        )
