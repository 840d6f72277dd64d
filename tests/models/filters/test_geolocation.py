"""The filters of system D: what they start with, how they move, what they measure."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.geolocation import (
    MATCHED,
    MISPRINTED,
    OFFSET,
    PRINTED,
    TRACKING,
    known_pointing_model,
    pointing_fix_model,
    printed_process,
    tracking_process,
)
from terrafix.models.filters.process import propagate
from terrafix.models.geometry.quaternion import from_small_rotation_vector
from terrafix.models.motion.elements import LOW_ORBIT
from terrafix.models.sensors.staring import nadir, target_offset

MU, RADIUS = 3.986e14, 6.378e6
R, V = LOW_ORBIT.state(MU)
AIM = nadir(ca.DM(R), "sphere", RADIUS).full().ravel()
TOLD = {"r_nominal": R, "v_nominal": V, "aim": AIM}
SIGMA = {"position_sigma": [500.0] * 3, "velocity_sigma": [0.8333] * 3, "attitude_sigma": 5e-4}
LOOK = {"pixel": 100.0, "radius": RADIUS}
GIVEN = {"mu": MU, "radius": RADIUS, "j2": 0.0, "attitude_time": 600.0, "attitude_sigma": 5e-4}
GIVEN |= {"pixel": 100.0, "accel_psd": 2.3148e-3, "target_psd": 0.16667, "aim": AIM}
T = slice(6, 8)  # of the target
GIVEN |= {"mismatch_sigma": 0.1, "mismatch_time": 2.0, "r_nominal": R}


def flat(value):
    return ca.DM(value).full().ravel()


def start(state, **options):
    model = known_pointing_model(state, "sphere", **options)
    extra = {"georeference_sigma": 0.2} if "first_frame" in options else {}
    return model(**TOLD, **SIGMA, **LOOK, **extra)


def test_the_printed_start_is_what_the_target_is_by_the_others():
    """P0* of the thesis: rank 8, 5.47 px per axis of the target."""
    P = start(PRINTED)["start.P"]
    assert np.linalg.matrix_rank(P / np.sqrt(np.outer(np.diag(P), np.diag(P))), tol=1e-9) == 8
    np.testing.assert_allclose(np.sqrt(np.diag(P)[8:]), 5.47, atol=0.01)
    np.testing.assert_allclose(start(PRINTED)["start.target"], 0.0, atol=1e-9)  # of 5.47


def test_what_the_first_frame_does_not_tell_is_minus_the_target():
    """A match of the first frame with itself is known beforehand: t + b has no variance."""
    P = start(TRACKING)["start.P"]
    H = np.zeros((2, 14))
    H[:, T], H[:, 10:12], H[:, 12:] = np.eye(2), np.eye(2), np.eye(2)
    np.testing.assert_allclose(H @ P @ H.T, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(P)[T]), 5.47, atol=0.01)
    P = start(TRACKING, first_frame="georeferenced")["start.P"]
    np.testing.assert_allclose(np.sqrt(np.diag(P)[10:12]), 0.2)
    np.testing.assert_array_equal(P[10:, :10], 0.0)
    np.testing.assert_array_equal(P[12:], 0.0)


def moved(state: ErrorState, process, values, P, steps=1, given=None):
    """Values and covariance after steps of a second."""
    symbols = {b.name: ca.SX.sym(b.name, b.size) for b in state}
    p = ca.SX.sym("P", state.size, state.size)
    told = {k: ca.DM(v) for k, v in {**GIVEN, **(given or {})}.items()}
    end = propagate(state, process, symbols, told, 1.0, 1.0)
    f = ca.Function(
        "f", [*symbols.values(), p], [*(end.values[n] for n in symbols), end.covariance(p)]
    )
    x = [np.reshape(values[n], (-1, 1)) for n in symbols]
    for _ in range(steps):
        *x, P = (np.asarray(a) for a in f(*x, P))
    return dict(zip(symbols, x, strict=True)), P


def test_the_target_follows_from_the_others_and_so_does_its_covariance():
    """After 20 steps as at the start: no information but what position and attitude give."""
    rng = np.random.default_rng(5)
    values = {"r": R + rng.normal(0, 300, 3), "v": V, "pitch": 1e-4, "roll": -2e-4}
    values |= {"target": [0, 0], "bias": [0, 0], "mismatch": [0, 0]}
    P = start(TRACKING)["start.P"]
    end, P = moved(TRACKING, tracking_process("sphere"), values, P, steps=20)
    x = {n: ca.SX.sym(n, 3 if n == "r" else 1) for n in ("r", "pitch", "roll")}
    look = {k: ca.DM(v) for k, v in GIVEN.items()}
    offset = target_offset(x, look, "sphere")
    slope = ca.jacobian(offset, ca.vertcat(*x.values()))
    at = ca.Function("at", list(x.values()), [offset, slope])
    t, G = (np.asarray(a) for a in at(*(end[n] for n in x)))
    np.testing.assert_allclose(end["target"], t, atol=1e-9)
    keep = [0, 1, 2, 8, 9]
    np.testing.assert_allclose(P[T, T], G @ P[np.ix_(keep, keep)] @ G.T, rtol=1e-6)
    np.testing.assert_allclose(P[T, :6], G @ P[keep, :6], rtol=1e-6, atol=1e-9)


def test_noise_of_a_step_is_that_of_a_double_integrator_and_of_gauss_and_markov():
    P = np.zeros((14, 14))
    values = {"r": R, "v": V, "pitch": 0, "roll": 0, "target": [0, 0]}
    values |= {"bias": [0, 0], "mismatch": [0, 0]}
    _, Q = moved(TRACKING, tracking_process("sphere"), values, P)
    q = GIVEN["accel_psd"]
    np.testing.assert_allclose(np.diag(Q)[:6], [q / 3] * 3 + [q] * 3, rtol=1e-9)
    np.testing.assert_allclose(Q[0, 3], q / 2, rtol=1e-9)
    np.testing.assert_allclose(np.diag(Q)[8:10], 25e-8 * (1 - np.exp(-2 / 600)), rtol=1e-9)
    np.testing.assert_allclose(np.diag(Q)[12:], 0.01 * (1 - np.exp(-1.0)), rtol=1e-9)
    np.testing.assert_array_equal(np.diag(Q)[10:12], 0.0)


def test_with_a_gyro_pitch_and_roll_follow_its_increments():
    """Nothing decays, and the noise is its angle random walk; the star tracker sees both."""
    values = {"r": R, "v": V, "pitch": 1e-4, "roll": 0, "target": [0, 0]}
    values |= {"bias": [0, 0], "mismatch": [0, 0]}
    given = {"delta_theta_b": [1e-5, -2e-5, 0.0], "angle_random_walk": 2e-6}
    process = tracking_process("sphere", "gyro")
    end, Q = moved(TRACKING, process, values, np.zeros((14, 14)), given=given)
    np.testing.assert_allclose([end["pitch"], end["roll"]], [[[1.1e-4]], [[-2e-5]]], rtol=1e-12)
    np.testing.assert_allclose(np.diag(Q)[8:10], 4e-12, rtol=1e-12)
    turned = from_small_rotation_vector(ca.DM([3e-4, -1e-4, 0]))
    fix = pointing_fix_model()(q_be=flat(turned), noise_sigma=2e-5)
    np.testing.assert_allclose(fix["fix.y"], [3e-4, -1e-4], rtol=1e-6)
    np.testing.assert_allclose(fix["fix.R"], 4e-10 * np.eye(2))


def test_the_printed_target_is_a_random_walk():
    P = np.zeros((10, 10))
    values = {"r": R, "v": V, "pitch": 1e-4, "roll": 0, "target": [3.0, 1.0]}
    end, P = moved(PRINTED, printed_process(), values, P, steps=60)
    np.testing.assert_array_equal(end["target"].ravel(), [3.0, 1.0])
    np.testing.assert_allclose(np.diag(P)[8:], 10.0, rtol=1e-4)  # 10 px^2/min, as printed


def test_what_is_printed_takes_the_attitude_off_twice():
    """d_o phi / PX: 6 px for a milliradian from 600 km, which the target has in it already."""
    x = {"target": ca.DM([5.0, 1.0]), "r": ca.DM(R), "pitch": 1e-3, "roll": 0.0}
    given = {"aim": ca.DM(AIM), "pixel": 100.0}
    np.testing.assert_array_equal(flat(OFFSET.predict(x, given)), [5.0, 1.0])
    height = np.linalg.norm(R - AIM)
    np.testing.assert_allclose(
        flat(MISPRINTED.predict(x, given)), [5.0 - height * 1e-5, 1.0], rtol=1e-12
    )


def test_a_match_is_the_target_less_where_it_was_in_pixels_of_now():
    x = {"target": ca.DM([5.0, 1.0]), "bias": ca.DM([1.0, 2.0]), "mismatch": ca.DM([0.1, 0.2])}
    y = flat(MATCHED.predict(x, {"from_first": ca.DM([1.0, 0.5, -0.5, 2.0])}))
    np.testing.assert_allclose(y, [5.0 + 2.0 + 0.1, 1.0 + 3.5 + 0.2])


@pytest.mark.parametrize("option", [{"geometry": "flat"}, {"first_frame": "lost"}])
def test_a_name_that_is_none_is_refused(option):
    given = {"state": TRACKING, "geometry": "sphere", **option}
    with pytest.raises(ValueError, match="must be one of"):
        known_pointing_model(**given)
