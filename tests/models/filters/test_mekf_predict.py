"""Dead reckoning in Earth-fixed axes, and its covariance."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from terrafix.models.filters.process import propagate
from terrafix.models.filters.spacecraft import (
    STATE,
    mekf_predict_model,
    spacecraft_process,
    transition_matrix,
)
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import from_rotation_vector_array, product_array
from terrafix.models.motion.attitude import lvlh_attitude_model
from terrafix.models.motion.gravity import j2_acceleration
from terrafix.models.motion.gravity_field import shipped_field
from terrafix.models.motion.orbit import orbit_model
from terrafix.models.motion.satellite import Forces, satellite_model

MODEL = mekf_predict_model()
EYE9 = np.eye(9)


def coefficients(r_e):
    """G and A (6, 6) by CasADi's derivative of eqs. (8)-(9), typed separately."""
    r, v = ca.SX.sym("r", 3), ca.SX.sym("v", 3)
    omega = ca.SX([0, 0, EARTH.rotation_rate])
    a = (
        j2_acceleration(r, EARTH.mu, EARTH.radius, EARTH.j2)
        - ca.cross(omega, ca.cross(omega, r))
        - 2 * ca.cross(omega, v)
    )
    x = ca.vertcat(r, v)
    A = ca.Function("A", [x], [ca.jacobian(ca.vertcat(v, a), x)])(np.r_[r_e, 0, 0, 0]).full()
    return A[3:, :3], A


def transition(r_e, dt, kind="exact"):
    G = ca.SX.sym("G", 3, 3)
    f = ca.Function("f", [G], [transition_matrix(G, EARTH.rotation_rate, dt, kind)])
    return f(coefficients(r_e)[0]).full()


@pytest.mark.parametrize("dt", [0.01, 0.1, 1.0])
def test_transition_is_the_matrix_exponential(start_e, dt):
    """To 1e-12 in SI units up to a second, the size of the first terms left out."""
    _, A = coefficients(start_e[0])
    np.testing.assert_allclose(transition(start_e[0], dt), expm(A * dt), rtol=0, atol=1e-12)


def test_printed_transition_lacks_the_coriolis_block(start_e):
    difference = transition(start_e[0], 0.1, "printed") - expm(coefficients(start_e[0])[1] * 0.1)
    assert difference[3, 4] == pytest.approx(-2 * EARTH.rotation_rate * 0.1, rel=1e-3)


def advance(start_e, constants, dt=1.0, model=MODEL, **values):
    r_e, v_e, q_be = start_e
    defaults = {"r_e": r_e, "v_e": v_e, "q_mu": [0, 0, 0, 1], "P": EYE9, "q_be": q_be, "step": dt}
    outputs, states = model.advance(**defaults | constants | values)
    np.testing.assert_array_equal(outputs["prior.P"], states["P"])
    return outputs


def test_transition_is_the_derivative_of_the_step(start_e, constants):
    """Central differences of the whole step over 100 m and 100 m/s; they round at 5e-12.

    The gradient turns with the orbit, at a thousandth a second; taken at the middle of the step it
    leaves dt^3/12 of its rate, 2e-10 at 1 s, in the position rows and far less in the others.
    """
    r_e, v_e, _ = start_e
    columns = []
    for i in range(6):
        offset = np.zeros(6)
        offset[i] = 100.0
        ends = [
            advance(start_e, constants, r_e=r_e + s * offset[:3], v_e=v_e + s * offset[3:])
            for s in (1, -1)
        ]
        ahead, behind = (np.r_[o["prior.r_e"], o["prior.v_e"]] for o in ends)
        columns.append((ahead - behind) / 200)
    middle = r_e + v_e / 2
    difference = np.stack(columns, axis=1) - transition(middle, 1.0)
    assert np.abs(difference).max() < 3e-10
    assert np.abs(difference[3:, :3]).max() < 2e-11


@pytest.mark.parametrize("dt", [0.01, 1.0])
def test_covariance_is_propagated_with_white_acceleration(start_e, constants, dt):
    rng = np.random.default_rng(6)
    sigma = np.r_[np.full(3, 1e3), np.full(3, 10.0), np.full(3, 2e-3)]
    A = rng.normal(size=(9, 12)) * sigma[:, None]
    P, Qa, Qm = A @ A.T, 3.5e-3, 3.4e-9
    P = (P + P.T) / 2
    outputs = advance(start_e, constants, dt, P=P, accel_psd=Qa, misalignment_psd=Qm)
    end = outputs["prior.P"]
    phi = EYE9.copy()
    phi[:6, :6] = transition((start_e[0] + outputs["prior.r_e"]) / 2, dt)
    Q, eye = np.zeros((9, 9)), np.eye(3)
    Q[:3, :3], Q[3:6, 3:6], Q[6:, 6:] = Qa * dt**3 / 3 * eye, Qa * dt * eye, Qm * dt * eye
    Q[:3, 3:6] = Q[3:6, :3] = Qa * dt**2 / 2 * eye
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    assert np.all(np.abs(end - (phi @ P @ phi.T + Q)) <= 1e-13 * scale)
    assert np.array_equal(end, end.T)  # to the bit


def test_prediction_follows_the_inertial_orbit(start_e, start_i, constants):
    """Two mechanizations of the same motion agree: 600 s at 1 s, integrator and rounding."""
    orbit, truth = orbit_model(), {"r_i": start_i[0], "v_i": start_i[1]}
    own = {"r_e": start_e[0], "v_e": start_e[1]}
    for k in range(600):
        outputs, truth = orbit.advance(**truth, step=1.0, time=k + 1.0, **constants)
        prior = advance(start_e, constants, **own)
        own = {k: prior[f"prior.{k}"] for k in ("r_e", "v_e")}
    np.testing.assert_allclose(own["r_e"], outputs["r_e"], atol=1e-5)
    np.testing.assert_allclose(own["v_e"], outputs["v_e"], atol=1e-8)


def test_measured_drag_is_applied(start_e, start_i, constants):
    """Strong drag, 180 m in 300 s, through truth, attitude and increments to 1 mm."""
    orbit, attitude = orbit_model(drag=True), lvlh_attitude_model()
    truth, q_be = {"r_i": start_i[0], "v_i": start_i[1]}, start_e[2]
    air = {"density": 7e-9, "ballistic_coefficient": 0.02}
    own, blind = ({"r_e": start_e[0], "v_e": start_e[1]} for _ in range(2))
    for k in range(300):
        outputs, truth = orbit.advance(**truth, step=1.0, time=k + 1.0, **constants, **air)
        moved = {name: outputs[name] for name in ("r_e", "v_e", "delta_v_e")}
        level, states = attitude.advance(
            q_be=q_be, **moved, step=1.0, rotation_rate=EARTH.rotation_rate
        )
        q_be = states["q_be"]
        increments = {"delta_v_b": level["delta_v_b"], "q_be": level["q_be"]}
        prior = advance(start_e, constants, **own | increments)
        without = advance(start_e, constants, **blind)
        own = {k: prior[f"prior.{k}"] for k in ("r_e", "v_e")}
        blind = {k: without[f"prior.{k}"] for k in ("r_e", "v_e")}
    assert np.linalg.norm(blind["r_e"] - outputs["r_e"]) > 100
    # increments are turned with the attitude of the step's end, 5e-4 rad late on average
    assert np.linalg.norm(own["r_e"] - outputs["r_e"]) < 2e-2


def test_the_posterior_is_adopted_where_it_is_fresh(start_e, constants):
    r_e, v_e, _ = start_e
    q_mu = from_rotation_vector_array([0.001, 0.002, 0.003])
    posterior = {
        "posterior_r_e": r_e + 100,
        "posterior_v_e": v_e - 1,
        "posterior_q_mu": q_mu,
        "posterior_P": 4 * EYE9,
    }
    adopted = advance(start_e, constants, **posterior, posterior_fresh=1)
    direct = advance(start_e, constants, r_e=r_e + 100, v_e=v_e - 1, q_mu=q_mu, P=4 * EYE9)
    ignored = advance(start_e, constants, **posterior, posterior_fresh=0)
    own = advance(start_e, constants)
    for name in own:
        np.testing.assert_array_equal(adopted[name], direct[name])
        np.testing.assert_array_equal(ignored[name], own[name])


def test_start_is_the_last_known_state(start_e, constants):
    r_e, v_e, _ = start_e
    P6 = np.diag([1e6, 1e6, 1e6, 100, 100, 100]) + 1.0
    start = MODEL.initial_function()(
        start_r_e=r_e, start_v_e=v_e, start_P=P6.ravel(), misalignment_sigma0=2e-3
    )
    np.testing.assert_array_equal(start["prior_r_e_"].full().ravel(), r_e)
    np.testing.assert_array_equal(start["prior_q_mu_"].full().ravel(), [0, 0, 0, 1])
    P = start["prior_P_"].full().reshape(9, 9)
    np.testing.assert_array_equal(P[:6, :6], P6)
    np.testing.assert_allclose(P[6:, 6:], 4e-6 * np.eye(3))
    assert not P[:6, 6:].any()


def test_reported_error_is_estimate_minus_truth():
    truth, turn = from_rotation_vector_array([1.0, 2.0, -1.0]), np.array([0.01, -0.02, 0.03])
    estimate = product_array(from_rotation_vector_array(turn), truth)
    error = STATE.difference_of_arrays(
        [11.0, 2, 3], [4.0, 5, 5], estimate, [1.0, 2, 3], [4.0, 5, 6], truth
    )
    np.testing.assert_allclose(error, [10, 0, 0, 0, 0, -1, *turn], atol=1e-15)


def test_unknown_choices_are_refused():
    with pytest.raises(ValueError, match=r"transition must be one of .*got 'euler'"):
        mekf_predict_model(transition="euler")
    with pytest.raises(ValueError, match="gravity must be one of"):
        mekf_predict_model("egm96")


FIELD = shipped_field().cut(8)
POLE = [1.4e-6, -2e-6]
AROUND = {
    "time": 0.0,
    "omega_e": EARTH.rotation_rate * np.array([1.4e-6, 2e-6, 1.0]),
    "q_ei": np.array([0, 0, 0, 1.0]),
    "sun_e": np.array([1.2e11, 8e10, 3e10]),
    "sun_rate_e": np.array([-1e4, 2e4, 1e4]),
    "moon_e": np.array([-3e8, 2e8, 1e8]),
    "moon_rate_e": np.array([500.0, 800.0, 300.0]),
}


@pytest.mark.parametrize("bodies", [{}, dict.fromkeys(("sun", "moon", "tide"), True)])
def test_a_field_of_higher_degree_is_that_of_the_satellite(start_e, bodies):
    """Dead reckoning without sensed increments flies as the satellite's own model: 100 s at 1 Hz.

    They split their steps differently; the field beyond J2 alone makes 0.1 m of it, Sun and Moon
    several mm.
    """
    r_e, v_e, q_be = start_e
    forces = Forces(FIELD, **bodies)
    predict = mekf_predict_model(forces)
    truth = satellite_model(forces, surrounded=bool(bodies), told=True)
    around = {f"surroundings_{k}": v for k, v in AROUND.items()} if bodies else {"pole": POLE}
    turning = {} if bodies else {"rotation_rate": EARTH.rotation_rate, **around}
    given = around if bodies else turning
    own = {"r_e": r_e, "v_e": v_e, "q_mu": [0, 0, 0, 1], "P": EYE9}
    flown = {"r_e": r_e, "v_e": v_e} | ({"omega_e": AROUND["omega_e"]} if bodies else {})
    for k in range(1, 101):
        clock = {"step": 1.0, "time": float(k)}
        timed = clock if bodies else {"step": 1.0}
        _, own = predict.advance(**own, **given, **timed, q_be=q_be)
        _, flown = truth.advance(**flown, **given, **clock)
    np.testing.assert_allclose(own["r_e"], flown["r_e"], rtol=0, atol=2e-7)
    np.testing.assert_allclose(own["v_e"], flown["v_e"], rtol=0, atol=5e-9)


def test_its_transition_is_the_derived_one_but_for_the_gradient_beyond_j2(start_e):
    """Of 8e-11 / s^2, in a step of one second; the pole is not in it either, of 2e-6 of w."""
    r_e, v_e, q_be = start_e
    given = {"r_e": r_e, "v_e": v_e, "q_be": q_be, "rotation_rate": EARTH.rotation_rate}
    found = {}
    for kind in ("exact", "derived"):
        state = {name: ca.SX.sym(name, b) for name, b in (("r_e", 3), ("v_e", 3), ("q_mu", 4))}
        process = spacecraft_process(Forces(FIELD), kind)
        symbols = {n: ca.SX.sym(n, size) for n, size in (process.inputs | process.named()).items()}
        moved = propagate(STATE, process, state, symbols, ca.SX(1.0), ca.SX(1.0))
        values = {"q_mu": [0, 0, 0, 1], "pole": POLE, **given}
        function = ca.Function("phi", [*state.values(), *symbols.values()], [moved.transition])
        found[kind] = function(*(values.get(n, 0) for n in [*state, *symbols])).full()
    difference = np.abs(found["exact"] - found["derived"])
    assert difference[3:6, :3].max() < 8e-11
    assert difference.max() < 1e-9
    j2 = np.abs(found["derived"][3:6, :3]).max()
    assert j2 > 1e-6
