"""Strapdown mechanization against an independent integrator, closed forms and pyins."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import j1

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef, geodetic, local_axes
from terrafix.models.geometry.quaternion import (
    angle_between_array,
    from_rotation_vector_array,
    product_array,
    rotation_matrix_array,
)
from terrafix.models.motion.gravity import (
    STANDARD_GRAVITY,
    earth_fixed_acceleration,
    normal_gravity,
)
from terrafix.models.motion.strapdown import (
    EARTHS,
    Motion,
    angles_from_matrix,
    from_level,
    gravity,
    increments_between,
    level_axes,
    level_view,
    quaternion_from_angles_array,
    rotation_rate,
    strapdown_model,
)

normal_gravity_array = over_members(normal_gravity, (), ())
gravity_array = {e: over_members(lambda r, e=e: gravity(r, e), (3,)) for e in EARTHS}
from_level_array = {
    e: over_members(
        lambda a, b, h, v, rph, e=e: tuple(from_level(a, b, h, v, rph, e)), (), (), (), (3,), (3,)
    )
    for e in EARTHS
}
level_view_array = {
    e: over_members(
        lambda r, v, q, e=e: tuple(level_view(Motion(r, v, q), e).values()), (3,), (3,), (4,)
    )
    for e in EARTHS
}
between_array = {
    e: over_members(
        lambda r, v, q, v1, q1, dt, e=e: increments_between(Motion(r, v, q), v1, q1, dt, e),
        *((3,), (3,), (4,), (3,), (4,), ()),
    )
    for e in EARTHS
}
SPIN = np.array([0.0, 0.0, EARTH.rotation_rate])


def mechanize(start, dv, dtheta, dt, earth="wgs84", increments="held"):
    """Fly increments (n, 3) from a start: arrays (n + 1, .) of position, velocity, attitude."""
    step = strapdown_model(earth, increments).step_function()
    keys = ("r_e", "v_e", "q_be")
    state = dict(zip(keys, start, strict=True))
    told = {name: [np.asarray(value)] for name, value in state.items()}
    two = increments == "two-sample"
    kept = {f"earlier_{k}": np.zeros(3) for k in ("delta_v_b", "delta_theta_b")} if two else {}
    for v, theta in zip(dv, dtheta, strict=True):
        out = step(delta_v_b=v, delta_theta_b=theta, **state, **kept, step=dt)
        state = {k: out[f"next_{k}_"].full().ravel() for k in keys}
        kept = {k: out[f"next_{k}_"].full().ravel() for k in kept}
        for k in keys:
            told[k].append(state[k])
    return tuple(np.array(told[k]) for k in keys)


# ------------------------------------------------------------------ gravity and axes


@pytest.mark.parametrize(
    ("latitude", "expected"),
    [
        (0.0, 9.7803253359),  # TR8350.2, table 3.4
        (90.0, 9.8321849378),
    ],
)
def test_normal_gravity_on_the_ellipsoid(latitude, expected):
    assert normal_gravity_array(np.sin(np.radians(latitude)), 0.0) == pytest.approx(
        expected, abs=1e-9
    )


def test_normal_gravity_is_standard_near_45_and_a_half_degrees():
    assert normal_gravity_array(np.sin(np.radians(45.5)), 0.0) == pytest.approx(9.80665, abs=1e-6)


def test_gradient_of_normal_gravity_is_that_of_the_free_air_correction():
    """-3.086e-6 1/s^2 at middle latitudes."""
    above, below = (normal_gravity_array(np.sqrt(0.5), h) for h in (50.0, -50.0))
    assert (above - below) / 100 == pytest.approx(-3.086e-6, abs=2e-9)


def test_normal_gravity_is_that_of_j2_and_the_centrifugal_force(constants):
    """An independent field, without the ellipsoid's J4 of -2.4e-6: 5 J4 g = 1.2e-4 m/s^2."""
    free = over_members(
        lambda r: earth_fixed_acceleration(r, ca.SX.zeros(3), *constants.values()), (3,)
    )
    for latitude in (-80.0, -30.0, 0.0, 20.0, 60.0, 90.0):
        p = ecef(np.radians(latitude), 0.7, 3000.0)
        np.testing.assert_allclose(gravity_array["wgs84"](p), free(p), atol=1.5e-4)


@pytest.mark.parametrize("latitude", [-90.0, -42.0, 0.0, 67.0, 90.0])
def test_level_axes_are_north_east_down(latitude):
    p = ecef(np.radians(latitude), 0.0 if abs(latitude) == 90 else -2.1, 800.0)
    axes = over_members(lambda r: level_axes(r, "wgs84"), (3,))(p)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    if abs(latitude) < 90:
        east, north, up = local_axes(p)
        np.testing.assert_allclose(axes, [north, east, -up], atol=1e-12)
    else:
        np.testing.assert_allclose(axes[2], [0, 0, -np.sign(latitude)], atol=1e-15)


def test_angles_are_those_of_pyins():
    """pyins.transform.mat_from_rph is scipy's Rotation.from_euler('xyz'), body to level axes."""
    rng = np.random.default_rng(1)
    rph = rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (50, 3))
    C_bn = rotation_matrix_array(quaternion_from_angles_array(rph))
    np.testing.assert_allclose(
        C_bn.transpose(0, 2, 1), Rotation.from_euler("xyz", rph).as_matrix(), atol=1e-15
    )
    back = over_members(angles_from_matrix, (3, 3))(C_bn)
    np.testing.assert_allclose(back, rph, atol=1e-13)


@pytest.mark.parametrize("earth", EARTHS)
def test_the_level_view_is_what_a_motion_was_made_of(earth):
    level = (0.02, -0.03, 1500.0, [60.0, -20.0, 3.0], [0.3, -0.1, 2.5])
    place, told = level[:3], level_view_array[earth](*from_level_array[earth](*level))
    np.testing.assert_allclose(told[:2], place[:2], rtol=1e-14)
    assert told[2] == pytest.approx(1500.0, abs=2e-9)
    np.testing.assert_allclose(told[3], level[3], atol=1e-13)
    np.testing.assert_allclose(told[4], level[4], atol=1e-13)


# ------------------------------------------------------------------ integration


def held_inertial(start, rates, forces, dt):
    """Fly held rates and forces by an integrator of its own: inertial, matrices, order 8."""
    r0, v0, q0 = start
    spin = np.cross(SPIN, np.eye(3)).T  # [omega x]
    C_ib = rotation_matrix_array(q0).T
    y = np.concatenate([r0, v0 + spin @ r0, C_ib.ravel()])

    def earth_turn(t):
        c, s = np.cos(EARTH.rotation_rate * t), np.sin(EARTH.rotation_rate * t)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])

    def rate(t, y, w, f):
        r, v, C = y[:3], y[3:6], y[6:].reshape(3, 3)
        C_ei = earth_turn(t)
        r_e = C_ei @ r
        pull = C_ei.T @ (gravity_array["wgs84"](r_e) + spin @ (spin @ r_e))
        return np.concatenate([v, pull + C @ f, (C @ np.cross(w, np.eye(3)).T).ravel()])

    for k, (w, f) in enumerate(zip(rates, forces, strict=True)):
        span = (k * dt, (k + 1) * dt)
        y = solve_ivp(rate, span, y, "DOP853", args=(w, f), rtol=1e-13, atol=1e-9).y[:, -1]
    T = len(rates) * dt
    C_ei = earth_turn(T)
    r_e = C_ei @ y[:3]
    return r_e, C_ei @ y[3:6] - spin @ r_e, (C_ei @ y[6:].reshape(3, 3)).T


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_held_rates_and_forces_are_integrated_as_an_integrator_of_order_8_does(dt):
    """20 steps of up to 3 rad/s and 30 m/s^2: only the change of gravitation in a step is left."""
    rng = np.random.default_rng(5)
    rates, forces = rng.normal(0, 1.5, (20, 3)), rng.normal(0, 15.0, (20, 3))
    start = from_level_array["wgs84"](0.8, 0.2, 1000.0, [50.0, 40.0, -3.0], [0.3, 0.1, 1.0])
    r, v, C_be = held_inertial(start, rates, forces, dt)
    told = mechanize(start, forces * dt, rates * dt, dt)
    np.testing.assert_allclose(told[0][-1], r, atol=20 * 1e-4 * dt**3 + 1e-8)
    np.testing.assert_allclose(told[1][-1], v, atol=20 * 1e-4 * dt**3 + 1e-11)
    np.testing.assert_allclose(rotation_matrix_array(told[2][-1]), C_be, atol=1e-12)


def test_flat_earth_is_a_parabola():
    """Thrown, without rotation: standard gravity down, attitude kept, to rounding."""
    start = (np.array([0.0, 0.0, -1000.0]), np.array([70.0, 5.0, -10.0]), np.array([0, 0, 0, 1.0]))
    r, v, q = mechanize(start, np.zeros((500, 3)), np.zeros((500, 3)), 0.01, "flat")
    fall = np.array([0, 0, STANDARD_GRAVITY])
    np.testing.assert_allclose(r[-1], start[0] + 5 * start[1] + 12.5 * fall, atol=1e-10)
    np.testing.assert_allclose(v[-1], start[1] + 5 * fall, atol=1e-11)
    np.testing.assert_array_equal(q[-1], start[2])


def test_coriolis_of_an_aircraft_flying_north():
    """In Earth-fixed axes 2 omega v sin(latitude), to the east; normal gravity holds the height."""
    latitude, speed = np.radians(50.0), 70.0
    start = from_level_array["wgs84"](latitude, 0.0, 1000.0, [speed, 0, 0], np.zeros(3))
    dt = 0.01
    held = gravity_array["wgs84"](start[0]) @ rotation_matrix_array(start[2]).T
    axes = rotation_matrix_array(start[2])
    _, v, _ = mechanize(start, [-held * dt], [axes @ SPIN * dt], dt)
    east = (axes @ (v[-1] - v[0]))[1] / dt
    # the middle of the step lies v dt / 2 farther north: 1e-7 of it
    assert east == pytest.approx(2 * EARTH.rotation_rate * speed * np.sin(latitude), rel=1e-6)


def test_schuler_period_of_a_tilt():
    """A still navigator tilted to the east on the equator swings: R theta (1 - cos(sqrt(g/R) t)).

    Period 84.4 minutes. The tilt's axis is the Earth's, so the Earth's turning leaves it, and there
    is no Foucault turning on the equator. An altimeter holds the height: alone the vertical channel
    runs away.
    """
    tilt, dt, n = 1e-4, 1.0, 5100
    r0, v0, q0 = from_level_array["wgs84"](0.0, 0.0, 0.0, np.zeros(3), np.zeros(3))
    C = rotation_matrix_array(q0)
    force_b, spin_b = -C @ gravity_array["wgs84"](r0), C @ SPIN
    step = strapdown_model().step_function()
    r, v, q = r0, v0, product_array(from_rotation_vector_array([tilt, 0.0, 0.0]), q0)
    east = [0.0]
    for _ in range(n):
        out = step(delta_v_b=force_b * dt, delta_theta_b=spin_b * dt, r_e=r, v_e=v, q_be=q, step=dt)
        r, v, q = (out[f"next_{k}_"].full().ravel() for k in ("r_e", "v_e", "q_be"))
        up = local_axes(r)[2]
        r, v = r - geodetic(r)[2] * up, v - (v @ up) * up
        east.append(r[1])
    schuler = np.sqrt(np.linalg.norm(force_b) / EARTH.radius)
    assert 2 * np.pi / schuler / 60 == pytest.approx(84.4, abs=0.2)  # 84.4 on the mean sphere
    t = np.arange(n + 1) * dt
    expected = EARTH.radius * tilt * (1 - np.cos(schuler * t))
    np.testing.assert_allclose(east, expected, atol=1e-3 * EARTH.radius * tilt)


# ------------------------------------------------------------------ coning and sculling

AMPLITUDE, BEAT = 0.01, 2 * np.pi * 5  # [rad], [rad/s]
H = 0.01  # [s]
TIMES = np.arange(1001) * H  # 50 beats
LAMBDA = BEAT * H
HELD = 1 - np.sin(LAMBDA) / LAMBDA
TAKEN = 2 * np.sin(LAMBDA / 2) ** 2 * np.sin(LAMBDA) / (3 * LAMBDA)  # not by the first step
LEFT = {"held": HELD, "two-sample": HELD - TAKEN * (1 - H / TIMES[-1])}
"""Of the effect, as a share, that the algorithm does not see."""


@pytest.mark.parametrize("increments", ["held", "two-sample"])
def test_coning_drifts_by_what_the_algorithm_leaves(increments):
    """Savage part 1: an axis goes round a cone of half angle a: a^2 W/2 (1 - sin(l) / l), l = W h.

    Two samples take away a^2 sin^2(l/2) sin(l) / (3 h): the cross product of successive increments.
    """
    swing = np.stack([np.cos(BEAT * TIMES), np.sin(BEAT * TIMES), 0 * TIMES], axis=-1)
    truth = from_rotation_vector_array(AMPLITUDE * swing)
    # body rate W (-sin a sin, sin a cos, cos a - 1): its integral between the samples
    dtheta = np.sin(AMPLITUDE) * np.diff(swing, axis=0)
    dtheta[:, 2] = H * BEAT * (np.cos(AMPLITUDE) - 1)
    start = (np.zeros(3), np.zeros(3), truth[0])
    _, _, q = mechanize(start, np.zeros_like(dtheta), dtheta, H, "flat", increments)
    drift = angle_between_array(q[-1], truth[-1]) / TIMES[-1]
    assert drift == pytest.approx(AMPLITUDE**2 * BEAT / 2 * LEFT[increments], rel=3e-3)


@pytest.mark.parametrize("increments", ["held", "two-sample"])
def test_sculling_accelerates_by_what_the_algorithm_leaves(increments):
    """Savage part 2: roll a sin(W t) and force c sin(W t) to the right make c J1(a) down."""
    force = 10.0
    dtheta, dv = np.zeros((2, len(TIMES) - 1, 3))
    dtheta[:, 0] = AMPLITUDE * np.diff(np.sin(BEAT * TIMES))
    dv[:, 1] = -force / BEAT * np.diff(np.cos(BEAT * TIMES))
    start = (np.zeros(3), np.zeros(3), np.array([0, 0, 0, 1.0]))
    _, v, _ = mechanize(start, dv, dtheta, H, "flat", increments)
    gained = v[-1, 2] / TIMES[-1] - STANDARD_GRAVITY
    truth = force * j1(AMPLITUDE)
    assert truth - gained == pytest.approx(truth * LEFT[increments], rel=3e-3)


# ------------------------------------------------------------------ the way back


@given(st.integers(0, 10**6))
def test_increments_between_motions_lead_from_one_to_the_other(seed):
    """Attitude to rounding; velocity to omega a h^2 / 2, 2e-8 m/s at 100 Hz and 5 m/s^2."""
    rng = np.random.default_rng(seed)
    earth, dt = EARTHS[seed % 2], 0.01
    level = (rng.uniform(-1.5, 1.5), rng.uniform(-3, 3), 1000.0, rng.normal(0, 50, 3))
    start = from_level_array[earth](*level, rng.uniform(-1.5, 1.5, 3))
    turn = from_rotation_vector_array(rng.normal(0, 0.05, 3))
    v_e, q_be = start[1] + rng.normal(0, 0.05, 3), product_array(turn, start[2])
    dv, dtheta = between_array[earth](*start, v_e, q_be, dt)
    _, v, q = mechanize(start, [dv], [dtheta], dt, earth)
    np.testing.assert_allclose(v[-1], v_e, atol=2e-8 if rotation_rate(earth) else 1e-13)
    assert angle_between_array(q[-1], q_be) < 2e-15
