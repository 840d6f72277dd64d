"""Inertial and Earth-fixed frames."""

import casadi as ca
import numpy as np

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import (
    earth_fixed_from_inertial,
    earth_fixed_from_inertial_array,
    inertial_from_earth_fixed_array,
)


def test_there_and_back(start_i):
    r_e, v_e = earth_fixed_from_inertial_array(*start_i, 2.1, EARTH.rotation_rate)
    r_i, v_i = inertial_from_earth_fixed_array(r_e, v_e, 2.1, EARTH.rotation_rate)
    np.testing.assert_allclose(r_i, start_i[0], atol=4e-9)  # spacing of floats at 7e6
    np.testing.assert_allclose(v_i, start_i[1], atol=4e-12)


def test_earth_fixed_velocity_is_the_derivative_of_earth_fixed_position(start_i):
    r0, v0 = (ca.SX(x) for x in start_i)
    t = ca.SX.sym("t")
    r_e, v_e = earth_fixed_from_inertial(
        r0 + v0 * t, v0, 0.3 + EARTH.rotation_rate * t, EARTH.rotation_rate
    )
    f = ca.Function("f", [t], [ca.jacobian(r_e, t), v_e])
    derivative, velocity = (x.full().ravel() for x in f(100.0))
    np.testing.assert_allclose(velocity, derivative, atol=1e-11)  # roundings of 7.6 km/s


def test_a_point_at_rest_on_the_earth_moves_eastward():
    """omega R at the equator, 465.1 m/s, toward +y for a point on +x."""
    r_i, v_i = inertial_from_earth_fixed_array(
        [EARTH.radius, 0, 0], np.zeros(3), 0.0, EARTH.rotation_rate
    )
    np.testing.assert_allclose(v_i, [0, 465.1011, 0], atol=1e-4)
    np.testing.assert_array_equal(r_i, [EARTH.radius, 0, 0])


def test_the_earth_turns_east():
    """After a quarter of a turn an inertially fixed point is 90 degrees further west."""
    r_e, _ = earth_fixed_from_inertial_array([1.0, 0, 0], np.zeros(3), np.pi / 2, 0.0)
    np.testing.assert_allclose(r_e, [0, -1, 0], atol=1e-16)
