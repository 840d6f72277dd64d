r"""Inertial and Earth-fixed frames, related by a uniform rotation about the polar axis.

.. math::
    \theta = \theta_0 + \omega t, \qquad r_e = C_{ei}(\theta)\, r_i, \qquad
    v_e = C_{ei}(\theta)\, (v_i - \omega \times r_i)

Precession, nutation, polar motion and the variation of the rotation rate are left out.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.batch import over_members


def earth_angle(angle0: Any, rotation_rate: Any, time: Any) -> Any:
    """Angle of the Earth [rad] from the inertial to the Earth-fixed x axis."""
    return angle0 + rotation_rate * time


def earth_rate_cross(rotation_rate: Any, vector: Any) -> Any:
    """Cross product of the Earth's angular velocity with a vector (3,), inertial or Earth-fixed."""
    return rotation_rate * ca.vertcat(-vector[1], vector[0], 0)


def rotate_about_pole(angle: Any, vector: Any) -> Any:
    """Components (3,) in axes turned by `angle` [rad] about the polar axis: C_ei r_i."""
    c, s = ca.cos(angle), ca.sin(angle)
    x, y, z = vector[0], vector[1], vector[2]
    return ca.vertcat(c * x + s * y, c * y - s * x, z)


def earth_fixed_from_inertial(r_i: Any, v_i: Any, angle: Any, rotation_rate: Any) -> Any:
    """Earth-fixed position [m] and velocity [m/s], two (3,), from inertial ones."""
    relative = v_i - earth_rate_cross(rotation_rate, r_i)
    return rotate_about_pole(angle, r_i), rotate_about_pole(angle, relative)


def inertial_from_earth_fixed(r_e: Any, v_e: Any, angle: Any, rotation_rate: Any) -> Any:
    """Inertial position [m] and velocity [m/s], two (3,), from Earth-fixed ones."""
    r_i = rotate_about_pole(-angle, r_e)
    return r_i, rotate_about_pole(-angle, v_e) + earth_rate_cross(rotation_rate, r_i)


earth_fixed_from_inertial_array = over_members(earth_fixed_from_inertial, (3,), (3,), (), ())
inertial_from_earth_fixed_array = over_members(inertial_from_earth_fixed, (3,), (3,), (), ())
