"""Level attitude and its sensor."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.geometry.quaternion import (
    angle_between_array,
    from_rotation_vector_array,
    inverse_array,
    product_array,
    rotation_matrix_array,
    rotation_vector_array,
)
from terrafix.models.motion.attitude import (
    attitude_sensor_model,
    lvlh_attitude_model,
    lvlh_quaternion_array,
)
from terrafix.models.motion.kepler import circular_orbit
from terrafix.models.motion.orbit import orbit_model


def initial(model, **values):
    """Outputs at the start of a model."""
    result = model.initial_function()(**values)
    return {k: result[k.replace(".", "_") + "_"].full().ravel() for k in model.outputs}


@pytest.mark.parametrize("velocity", ["earth-fixed", "inertial"])
def test_axes_are_forward_right_and_nadir(start_e, velocity):
    r_e, v_e, _ = start_e
    model = lvlh_attitude_model(velocity)
    outputs = initial(model, r_e=r_e, v_e=v_e, rotation_rate=EARTH.rotation_rate)
    T = rotation_matrix_array(outputs["q_be"])
    turning = np.cross([0, 0, EARTH.rotation_rate], r_e) if velocity == "inertial" else 0
    followed = v_e + turning
    np.testing.assert_allclose(T @ r_e, [0, 0, -np.linalg.norm(r_e)], atol=1e-8)
    forward, right, _ = T @ followed
    assert forward > 7000
    assert abs(right) < 1e-10
    np.testing.assert_allclose(
        T[1], -np.cross(r_e, followed) / np.linalg.norm(np.cross(r_e, followed)), atol=1e-15
    )


def test_the_two_velocities_differ_by_the_crab_angle(start_e):
    """atan of the Earth's speed across the track: some degrees, and about the vertical."""
    r_e, v_e, _ = start_e
    v_inertial = v_e + np.cross([0, 0, EARTH.rotation_rate], r_e)
    q, p = lvlh_quaternion_array(r_e, v_e), lvlh_quaternion_array(r_e, v_inertial)
    turn = rotation_vector_array(product_array(q, inverse_array(p)))
    assert 2 < np.degrees(abs(turn[2])) < 4.5
    assert np.abs(turn[:2]).max() < 1e-14


def test_body_rate_in_a_circular_orbit(constants):
    """With the inertial velocity followed, the body turns at the orbital rate about -y."""
    r_i, v_i = circular_orbit(7e6, EARTH.mu, 1.2)
    orbit, attitude = orbit_model("two-body"), lvlh_attitude_model("inertial")
    dt, rate = 0.1, np.sqrt(EARTH.mu / 7e6**3)
    r_e, v_e = earth_fixed_from_inertial_array(r_i, v_i, 0.0, EARTH.rotation_rate)
    q = lvlh_quaternion_array(r_e, v_e + np.cross([0, 0, EARTH.rotation_rate], r_e))
    moved, _ = orbit.advance(r_i=r_i, v_i=v_i, step=dt, time=dt, **constants)
    outputs, _ = attitude.advance(
        q_be=q, r_e=moved["r_e"], v_e=moved["v_e"], step=dt, rotation_rate=EARTH.rotation_rate
    )
    # angles of 1e-4 rad between quaternions that round at 1e-16
    np.testing.assert_allclose(outputs["delta_theta_b"], [0, -rate * dt, 0], atol=4e-15)


def test_increments_add_up_to_the_inertial_rotation(constants, start_i, start_e):
    """The gyro increments, integrated, give the body's attitude relative to inertial space."""
    orbit, attitude = orbit_model(), lvlh_attitude_model()
    states, q_be = {"r_i": start_i[0], "v_i": start_i[1]}, start_e[2]
    q_bi, dt, n = q_be, 1.0, 590
    signs = []
    for k in range(n):
        moved, states = orbit.advance(**states, step=dt, time=(k + 1) * dt, **constants)
        outputs, following = attitude.advance(
            q_be=q_be,
            r_e=moved["r_e"],
            v_e=moved["v_e"],
            step=dt,
            rotation_rate=EARTH.rotation_rate,
        )
        signs.append(following["q_be"] @ q_be)
        q_be = following["q_be"]
        q_bi = product_array(from_rotation_vector_array(outputs["delta_theta_b"]), q_bi)
    assert min(signs) > 0.99  # no flip of sign
    q_ei = from_rotation_vector_array([0, 0, EARTH.rotation_rate * n * dt])
    assert angle_between_array(q_bi, product_array(q_be, q_ei)) < 1e-13  # 590 roundings
    assert np.degrees(angle_between_array(q_be, start_e[2])) > 20


def test_sign_is_kept_where_the_scalar_part_passes_zero():
    """A turn about the vertical, once around: the quaternion ends at minus where it began."""
    model = lvlh_attitude_model()
    r_e, angles = np.array([7e6, 0, 0]), np.linspace(0, 2 * np.pi, 61)
    q = first = lvlh_quaternion_array(r_e, [0.0, 1.0, 0.0])
    for angle in angles[1:]:
        _, states = model.advance(q_be=q, r_e=r_e, v_e=[0, np.cos(angle), np.sin(angle)], step=1.0)
        assert states["q_be"] @ q > 0.99
        q = states["q_be"]
    np.testing.assert_allclose(q, -first, atol=1e-14)


def test_velocity_increment_is_turned_into_the_body(start_e):
    r_e, v_e, q_be = start_e
    delta_v_e = np.array([1e-3, -2e-3, 3e-3])
    outputs, _ = lvlh_attitude_model().advance(
        q_be=q_be, r_e=r_e, v_e=v_e, delta_v_e=delta_v_e, step=0.01
    )
    expected = rotation_matrix_array(q_be) @ delta_v_e
    np.testing.assert_allclose(outputs["delta_v_b"], expected, atol=1e-17)


def test_sensor_adds_body_fixed_bias_and_noise():
    model = attitude_sensor_model()
    q = from_rotation_vector_array([1.0, -2.0, 0.5])  # large: pins the order of the product
    draw, white = np.array([1.0, 2.0, -1.0]), np.array([0.5, 0.0, 3.0])
    start = model.initial_function()(
        q_be_true=q, bias_draw=draw, white=white, bias_sigma=2e-4, noise_sigma=1e-5
    )
    bias = start["next_bias_b_"].full().ravel()
    np.testing.assert_array_equal(bias, 2e-4 * draw)
    outputs, states = model.advance(
        q_be_true=q, bias_b=bias, white=white, bias_draw=5 * draw, bias_sigma=2e-4, noise_sigma=1e-5
    )
    np.testing.assert_array_equal(states["bias_b"], bias)
    error = rotation_vector_array(product_array(outputs["q_be"], inverse_array(q)))
    # the third order of a small rotation, and the rounding of a quaternion
    np.testing.assert_allclose(error, bias + 1e-5 * white, atol=1e-11)


def test_bias_draw_is_used_at_the_start_alone():
    model = attitude_sensor_model()
    after = ca.vertcat(*(ca.vec(e) for e in model.step_outputs.values()))
    assert not ca.depends_on(after, model.noise["bias_draw"])


def test_unknown_velocity_is_refused():
    with pytest.raises(ValueError, match=r"velocity must be one of .*got 'air'"):
        lvlh_attitude_model("air")
