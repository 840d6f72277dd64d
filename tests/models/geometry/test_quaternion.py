"""Shuster's convention, held at large angles and against SciPy's Hamilton quaternions."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from terrafix.models.geometry import quaternion as qt

components = st.floats(-1, 1).filter(lambda x: x == 0 or abs(x) > 1e-100)
quaternions = (
    st.tuples(components, components, components, components)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@given(quaternions, quaternions)
def test_matrix_of_product_is_product_of_matrices(p, q):
    """The convention itself, at any angle; 1e-14 is some tens of roundings of numbers below 1."""
    T = qt.rotation_matrix_array
    np.testing.assert_allclose(T(qt.product_array(p, q)), T(p) @ T(q), atol=1e-14)


@given(quaternions, quaternions)
def test_scipy_has_the_factors_reversed_and_the_matrix_transposed(p, q):
    """Independent implementation: Hamilton, active."""
    np.testing.assert_allclose(
        qt.rotation_matrix_array(p), Rotation.from_quat(p).as_matrix().T, atol=1e-14
    )
    hamilton = (Rotation.from_quat(q) * Rotation.from_quat(p)).as_quat()
    ours = qt.product_array(p, q)
    np.testing.assert_allclose(ours * np.sign(ours @ hamilton), hamilton, atol=1e-14)


def test_product_does_not_commute():
    p = qt.from_rotation_vector_array([2.0, 0.0, 0.0])
    q = qt.from_rotation_vector_array([0.0, 2.0, 0.0])
    assert np.linalg.norm(qt.product_array(p, q) - qt.product_array(q, p)) > 1


def test_quarter_turn_about_z_turns_the_frame_not_the_vector():
    T = qt.rotation_matrix_array(qt.from_rotation_vector_array([0, 0, np.pi / 2]))
    np.testing.assert_allclose(T @ [1, 0, 0], [0, -1, 0], atol=4e-16)


angles = st.one_of(st.floats(0, 3.14), st.sampled_from([0.0, 1e-300, 1e-9, 9.9e-3, 1.01e-2, 3.141]))


@given(quaternions, angles)
def test_rotation_vector_is_the_exponential_map_and_its_inverse(axis, angle):
    direction = axis[:3] if np.linalg.norm(axis[:3]) > 0.1 else np.array([0.0, 0.0, 1.0])
    theta = angle * direction / np.linalg.norm(direction)
    q = qt.from_rotation_vector_array(theta)
    assert abs(q @ q - 1) < 1e-15
    # expm is good to some 1e-14 at norms of a few
    np.testing.assert_allclose(qt.rotation_matrix_array(q), expm(-cross_matrix(theta)), atol=1e-13)
    np.testing.assert_allclose(qt.rotation_vector_array(q), theta, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(qt.rotation_vector_array(-q), theta, rtol=1e-14, atol=1e-15)


def test_exponential_and_logarithm_have_derivatives_at_zero():
    theta, q = ca.SX.sym("theta", 3), ca.SX.sym("q", 4)
    forward = ca.Function("f", [theta], [ca.jacobian(qt.from_rotation_vector(theta), theta)])
    back = ca.Function("g", [q], [ca.jacobian(qt.rotation_vector(q), q)])
    np.testing.assert_array_equal(
        forward(np.zeros(3)).full(), np.vstack([np.eye(3) / 2, np.zeros(3)])
    )
    np.testing.assert_array_equal(back(np.array(qt.IDENTITY)).full()[:, :3], 2 * np.eye(3))


def test_small_rotations_are_short_by_a_twelfth_of_the_cube():
    f = ca.Function("f", [t := ca.SX.sym("t", 3)], [qt.from_small_rotation_vector(t)])
    theta = np.array([0.0, 0.03, 0.0])
    error = qt.rotation_vector_array(f(theta).full().ravel())[1] - 0.03
    assert error == pytest.approx(-(0.03**3) / 12, rel=1e-3)  # next term is of order theta^2


@given(quaternions)
def test_quaternion_of_a_matrix_at_any_angle(q):
    back = qt.from_matrix_array(qt.rotation_matrix_array(q))
    assert back[3] >= 0
    sign = 1 if back @ q >= 0 else -1
    np.testing.assert_allclose(sign * back, q, atol=1e-15)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), [[0.6, 0.8, 0]], [[0.6, 0, -0.8]]]))
def test_quaternion_of_half_a_turn(axis):
    """Where the scalar part vanishes and the usual formula divides by it."""
    back = qt.from_matrix_array(2 * np.outer(axis, axis) - np.eye(3))
    assert abs(abs(back[:3] @ axis) - 1) < 1e-15
    assert abs(back[3]) < 1e-15


@given(quaternions)
def test_sign_follows_the_reference(q):
    matrix, reference = ca.SX.sym("m", 3, 3), ca.SX.sym("r", 4)
    near = ca.Function("near", [matrix, reference], [qt.from_matrix_near(matrix, reference)])
    T = qt.rotation_matrix_array(q)
    small = qt.from_rotation_vector_array([0.3, -0.2, 0.1])
    for sign in (1, -1):
        result = near(T, sign * qt.product_array(small, q)).full().ravel()
        np.testing.assert_allclose(result, sign * q, atol=1e-15)


@given(quaternions, angles)
def test_angle_between_two_attitudes(q, angle):
    turned = qt.product_array(qt.from_rotation_vector_array([0, angle, 0]), q)
    # a quaternion's rounding is worth 1e-15 rad
    assert qt.angle_between_array(turned, q) == pytest.approx(angle, abs=4e-15)
    assert qt.angle_between_array(-turned, q) == pytest.approx(angle, abs=4e-15)


def test_scalar_first_is_another_order_of_the_same_numbers():
    q = np.arange(8.0).reshape(2, 4)
    np.testing.assert_array_equal(qt.to_scalar_first(q)[0], [3, 0, 1, 2])
    np.testing.assert_array_equal(qt.from_scalar_first(qt.to_scalar_first(q)), q)
