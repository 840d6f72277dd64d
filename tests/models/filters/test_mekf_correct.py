"""The correction against NumPy implementations typed from the papers' equations."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from terrafix.models.filters.measurement import REASONS
from terrafix.models.filters.spacecraft import mekf_correct_model
from terrafix.models.geometry.antenna import nominal_antenna
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import (
    angle_between_array,
    from_rotation_vector_array,
    inverse_array,
    product_array,
    rotation_matrix_array,
    rotation_vector_array,
)
from terrafix.models.sensors.sar import sar_measurement_model, synthetic_fix_model

LOOK = np.radians(34.3)
Q_SB = ca.DM(nominal_antenna(LOOK, 0.0)).full().ravel()
MEASURED = sar_measurement_model()
MODELS = {name: mekf_correct_model(name) for name in ("ekf", "iterated", "unscented")}
EVERY = pytest.mark.parametrize("update", MODELS)


@pytest.fixture(scope="module")
def case(start_e):
    """A prior off by about one sigma, a correlated covariance, a large misalignment, a fix."""
    r_e, v_e, q_be = start_e
    rng = np.random.default_rng(7)
    sigma = np.r_[np.full(3, 100.0), np.full(3, 1.0), np.full(3, np.radians(0.01))]
    A = rng.normal(size=(9, 12)) / 3 * sigma[:, None]
    P = A @ A.T
    P = (P + P.T) / 2
    error = np.linalg.cholesky(P) @ rng.normal(size=9)  # truth minus prior
    q_prior = from_rotation_vector_array([0.02, -0.03, 2.5])  # large: pins the product order
    q_true = product_array(from_rotation_vector_array(error[6:]), q_prior)
    made = synthetic_fix_model()(
        r_e=r_e,
        v_e=v_e,
        q_be=q_be,
        q_mu=q_true,
        look=LOOK,
        radius=EARTH.radius,
        flattening=EARTH.flattening,
        range_sigma=1.0,
        speed_sigma=0.54,
        geolocation_sigma=[8, 5, 2],
        range_noise=0.3,
        speed_noise=-0.7,
        geolocation_noise=[0.2, -1.0, 0.5],
    )
    made.pop("fix.valid")
    values = {
        "prior_r_e": r_e - error[:3],
        "prior_v_e": v_e - error[3:6],
        "prior_q_mu": q_prior,
        "prior_P": P,
        "q_be": q_be,
        "look": LOOK,
        "gate": np.full(4, np.inf),
        "fix_fresh": 1,
        **{k.replace(".", "_"): v for k, v in made.items()},
    }
    return values, error


def correct(update, values, **changes):
    outputs, states = MODELS[update].advance(**values | changes)
    return outputs | {"n_updates": states["n_updates"]}


def reason(outputs):
    return REASONS[int(outputs["innovation.reason"].item())]


def prediction(values, error):
    """Prediction and derivatives at prior plus an error, by the measurement model."""
    q_mu = product_array(from_rotation_vector_array(error[6:]), values["prior_q_mu"])
    at = {
        "r_e": values["prior_r_e"] + error[:3],
        "v_e": values["prior_v_e"] + error[3:6],
        "q_mu": q_mu,
        "dmu": np.zeros(3),
        "q_be": values["q_be"],
        "q_sb": Q_SB,
        "r_f_e": values["fix_r_f_e"],
    }
    H = np.hstack([MEASURED.jacobian("y", k, **at) for k in ("r_e", "v_e", "dmu")])
    return MEASURED(**at)["y"], H, MEASURED.jacobian("y", "r_f_e", **at)


def textbook(values, beta=0.0, rows=(0, 1, 2, 3)):
    """EKF update of eqs. (33)-(43), elements `rows` alone."""
    rows = list(rows)
    y_hat, H, H_f = prediction(values, np.zeros(9))
    H, H_f, P = H[rows], H_f[rows], values["prior_P"]
    noise = values["fix_R"][np.ix_(rows, rows)] + H_f @ values["fix_D"] @ H_f.T
    residual = (values["fix_y"] - y_hat)[rows]
    S = H @ P @ H.T + noise
    K = np.linalg.solve(S + beta * H @ P @ H.T, H @ P).T
    kept = np.eye(9) - K @ H
    P_end = kept @ P @ kept.T + K @ (beta * H @ P @ H.T + noise) @ K.T
    return K @ residual, P_end, residual, S, residual @ np.linalg.solve(S, residual)


def correction_of(values, outputs):
    turn = product_array(outputs["posterior.q_mu"], inverse_array(values["prior_q_mu"]))
    return np.r_[
        outputs["posterior.r_e"] - values["prior_r_e"],
        outputs["posterior.v_e"] - values["prior_v_e"],
        rotation_vector_array(turn),
    ]


def close(values, outputs, correction, P, rtol):
    sigma = np.sqrt(np.diag(values["prior_P"]))
    assert np.all(np.abs(correction_of(values, outputs) - correction) <= rtol * sigma)
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    assert np.all(np.abs(outputs["posterior.P"] - P) <= rtol * scale)
    assert np.array_equal(outputs["posterior.P"], outputs["posterior.P"].T)


@pytest.mark.parametrize("beta", [0.0, 0.2])
def test_ekf_is_the_papers_update(case, beta):
    """1e-8 of a sigma: conditions of 1e6 between measured and unmeasured directions."""
    values, _ = case
    outputs = correct("ekf", values, underweighting=beta, underweighted_updates=1)
    correction, P, residual, S, nis = textbook(values, beta)
    close(values, outputs, correction, P, 1e-8)
    np.testing.assert_allclose(outputs["innovation.residual"], residual, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(outputs["innovation.sigma"], np.sqrt(np.diag(S)), rtol=1e-11)
    assert outputs["innovation.nis"] == pytest.approx(nis, rel=1e-9)
    assert outputs["innovation.dof"] == 4
    assert (outputs["innovation.accepted"], outputs["innovation.reason"]) == (1, 0)
    assert np.linalg.eigvalsh(outputs["posterior.P"]).min() > 0


def test_misalignment_is_corrected_from_the_left(case):
    """With the rest known, the update finds the true misalignment of a large quaternion."""
    values, error = case
    truth = product_array(from_rotation_vector_array(error[6:]), values["prior_q_mu"])
    P = np.diag(np.r_[np.full(6, 1e-6), np.full(3, 1e-8)])
    outputs = correct(
        "ekf",
        values,
        prior_P=P,
        prior_r_e=values["prior_r_e"] + error[:3],
        prior_v_e=values["prior_v_e"] + error[3:6],
        fix_D=1e-6 * np.eye(3),
    )

    def boresight(q):
        return rotation_matrix_array(product_array(q, Q_SB))[2]

    before = np.linalg.norm(boresight(values["prior_q_mu"]) - boresight(truth))
    after = np.linalg.norm(boresight(outputs["posterior.q_mu"]) - boresight(truth))
    assert before > 5e-5
    assert after < 0.1 * before  # what is left is the pixel's error, 10 m of 861 km


@EVERY
def test_absent_elements_contribute_nothing(case, update):
    """Without the speed, whatever it holds: the reduced update of three elements."""
    values, _ = case
    y = values["fix_y"].copy()
    y[3] = np.nan
    R = values["fix_R"].copy()
    R[3, :] = R[:, 3] = np.nan
    outputs = correct(update, values, fix_present=[1, 1, 1, 0], fix_y=y, fix_R=R)
    assert outputs["innovation.dof"] == 3
    assert outputs["innovation.residual"][3] == 0
    assert outputs["innovation.sigma"][3] == 1
    absent = correct(update, values, fix_present=[1, 1, 1, 0])
    for name, value in absent.items():
        np.testing.assert_array_equal(outputs[name], value)
    if update == "ekf":
        correction, P, _, _, nis = textbook(values, rows=(0, 1, 2))
        close(values, outputs, correction, P, 1e-8)
        assert outputs["innovation.nis"] == pytest.approx(nis, rel=1e-9)


@EVERY
def test_without_a_fix_the_estimate_is_the_prior(case, update):
    """Even where the message was never written and holds zeros."""
    values, _ = case
    never = {k: 0 * np.asarray(v) for k, v in values.items() if k.startswith("fix_")}
    outputs = correct(update, values, **never, q_be=np.zeros(4), n_updates=3)
    for name in ("r_e", "v_e", "q_mu", "P"):
        np.testing.assert_array_equal(outputs[f"estimate.{name}"], values[f"prior_{name}"])
    assert outputs["posterior.valid"] == outputs["innovation.valid"] == 0
    assert reason(outputs) == "nothing measured"
    assert all(np.isfinite(v).all() for v in outputs.values())
    assert outputs["n_updates"] == 3


@EVERY
def test_gate_by_degrees_of_freedom(case, update):
    values, _ = case
    gate = [1.0, 2.0, 3.0, 4.0]
    far = {"fix_y": values["fix_y"] + [0, 0, 5e3, 0]}
    outputs = correct(update, values, **far, gate=gate)
    assert outputs["innovation.nis"] > 4
    assert outputs["posterior.valid"] == 0
    assert reason(outputs) == "gate"
    np.testing.assert_array_equal(outputs["estimate.r_e"], values["prior_r_e"])
    assert outputs["n_updates"] == 1  # attempted
    nis = outputs["innovation.nis"].item()
    for gate, valid in (([0, 0, 0, nis * 1.001], 1), ([np.inf, np.inf, np.inf, nis * 0.999], 0)):
        assert correct(update, values, **far, gate=gate)["posterior.valid"] == valid
    three = correct(update, values, fix_present=[0, 1, 1, 1], gate=[0, 0, np.inf, 0])
    assert three["posterior.valid"] == 1
    none = correct(update, values, fix_present=np.zeros(4))
    assert reason(none) == "nothing measured"


@EVERY
def test_singular_innovation_is_refused_not_solved(case, update):
    """No pixel error, no angle noise and nothing uncertain: S has no inverse."""
    values, _ = case
    P = np.zeros((9, 9))
    P[3:6, 3:6] = np.eye(3)
    outputs = correct(update, values, fix_D=np.zeros((3, 3)), prior_P=P)
    assert reason(outputs).endswith("not positive definite")
    assert outputs["posterior.valid"] == 0
    for name in ("r_e", "v_e", "q_mu", "P"):
        np.testing.assert_array_equal(
            outputs[f"estimate.{name}"], {**values, "prior_P": P}[f"prior_{name}"]
        )


def test_no_pixel_error_is_fine_while_the_state_is_uncertain(case):
    values, _ = case
    outputs = correct("ekf", values, fix_D=np.zeros((3, 3)))
    assert outputs["posterior.valid"] == 1


@EVERY
def test_underweighting_lasts_for_the_first_fixes(case, update):
    values, _ = case
    settings = {"underweighting": 0.2, "underweighted_updates": 10}
    plain = correct(update, values)
    active = [correct(update, values, **settings, n_updates=n) for n in (0, 9)]
    after = correct(update, values, **settings, n_updates=10)
    np.testing.assert_array_equal(active[0]["posterior.P"], active[1]["posterior.P"])
    assert np.trace(active[0]["posterior.P"]) > np.trace(plain["posterior.P"])
    assert active[0]["innovation.nis"] == plain["innovation.nis"]  # S is not inflated
    for name in ("posterior.P", "posterior.r_e"):
        np.testing.assert_array_equal(after[name], plain[name])
    assert active[1]["n_updates"] == 10


def test_a_fix_at_the_start_counts(case):
    values, _ = case
    function = MODELS["ekf"].initial_function()
    flat = {k: np.ravel(v) for k, v in values.items()}
    start = function(**flat, underweighting=0.2, underweighted_updates=1)
    assert start["next_n_updates_"] == 1
    expected = correct("ekf", values, underweighting=0.2, underweighted_updates=1)
    scale = np.sqrt(np.diag(expected["posterior.P"]))
    difference = start["posterior_P_"].full().reshape(9, 9) - expected["posterior.P"]
    assert np.abs(difference / np.outer(scale, scale)).max() < 1e-12


@pytest.mark.parametrize("update", ["iterated", "unscented"])
def test_all_updates_agree_where_the_measurement_is_linear(case, update):
    """Sigmas of a thousandth: what remains of second order is a thousandth of a thousandth."""
    values, error = case
    P = values["prior_P"] * 1e-6
    near = {
        "prior_P": P,
        "prior_r_e": values["prior_r_e"] + error[:3],
        "prior_v_e": values["prior_v_e"] + error[3:6],
        "prior_q_mu": product_array(from_rotation_vector_array(error[6:]), values["prior_q_mu"]),
        "fix_D": values["fix_D"] * 1e-6,
        "fix_R": values["fix_R"] * 1e-6,
    }
    linear, other = (correct(name, values, **near) for name in ("ekf", update))
    # the pixel is 5 m off its reported place, 50 of these sigmas: the gain scales that up
    sigma = np.sqrt(np.diag(P))
    difference = correction_of(values | near, other) - correction_of(values | near, linear)
    assert np.all(np.abs(difference) < 1e-2 * sigma)
    np.testing.assert_allclose(
        np.diag(other["posterior.P"]), np.diag(linear["posterior.P"]), rtol=1e-3
    )


def recentering(dmu):
    """Derivative (9, 9) of the error about the estimate by that about the prior, numerically."""
    back, step, J = inverse_array(from_rotation_vector_array(dmu)), 1e-4, np.eye(9)
    for i in range(3):
        turns = [
            rotation_vector_array(
                product_array(from_rotation_vector_array(dmu + s * step * np.eye(3)[i]), back)
            )
            for s in (1, -1)
        ]
        J[6:, 6 + i] = (turns[0] - turns[1]) / (2 * step)
    return J


def wide(case):
    """The case with the wide prior of test case 1: a misalignment of 0.1 deg, 1 km."""
    values, error = case
    sigma = np.r_[np.full(3, 1e3), np.full(3, 10.0), np.full(3, np.radians(0.1))]
    shift = np.array([900.0, -700, 1100, 8, -12, 9, 1.5e-3, -2e-3, 1e-3])
    return values | {
        "prior_P": np.diag(sigma**2),
        "prior_r_e": values["prior_r_e"] + error[:3] - shift[:3],
        "prior_v_e": values["prior_v_e"] + error[3:6] - shift[3:6],
        "prior_q_mu": product_array(
            from_rotation_vector_array(error[6:] - shift[6:]), values["prior_q_mu"]
        ),
    }


def test_iterated_update_finds_the_most_probable_state(case):
    """Against a general minimizer of the posterior's exponent, at the noise of the last iterate."""
    values = wide(case)
    outputs = correct("iterated", values)
    found = correction_of(values, outputs)
    sigma = np.sqrt(np.diag(values["prior_P"]))
    H_f = prediction(values, found)[2]
    noise = values["fix_R"] + H_f @ values["fix_D"] @ H_f.T
    weight = np.linalg.inv(np.linalg.cholesky(noise))

    def exponent(scaled):
        residual = weight @ (values["fix_y"] - prediction(values, scaled * sigma)[0])
        return (scaled @ scaled + residual @ residual) / 2

    def gradient(scaled):
        y_hat, H, _ = prediction(values, scaled * sigma)
        H = H @ recentering((scaled * sigma)[6:])
        return scaled - sigma * (H.T @ weight.T @ weight @ (values["fix_y"] - y_hat))

    best = exponent(found / sigma)
    rng = np.random.default_rng(8)
    # a minimum: every small move raises the exponent; the linear update does not have it
    moves = 1e-3 * rng.normal(size=(50, 9))
    assert all(exponent(found / sigma + m) > best - 1e-9 for m in moves)
    once = correction_of(values, correct("ekf", values))
    assert exponent(once / sigma) > best + 1e-3
    refined = minimize(exponent, found / sigma, jac=gradient, method="BFGS").fun
    assert best - refined < 1e-4
    # its covariance is the inverse of the information there, about the estimate
    J = recentering(found[6:])
    H = prediction(values, found)[1] @ J * sigma
    P = np.linalg.inv(np.eye(9) + H.T @ weight.T @ weight @ H) * np.outer(sigma, sigma)
    close(values, outputs, found, J @ P @ J.T, 1e-6)


def test_unscented_update_is_the_textbook_transform(case):
    """Moments over the 18 points and P - K S K', forms the model does not use."""
    values = wide(case)
    values = values | {
        "prior_P": values["prior_P"] + 1e-3 * np.outer(v := np.sqrt(np.diag(values["prior_P"])), v)
    }
    P, beta = values["prior_P"], 0.2
    points = np.linalg.cholesky(P) * 3.0
    errors = np.hstack([points, -points]).T
    ys = np.array([prediction(values, e)[0] for e in errors])
    y_hat = ys.mean(axis=0)
    H_f = prediction(values, np.zeros(9))[2]
    P_yy = (ys - y_hat).T @ (ys - y_hat) / 18
    P_xy = errors.T @ (ys - y_hat) / 18
    S = P_yy + values["fix_R"] + H_f @ values["fix_D"] @ H_f.T
    S_u = S + beta * P_yy
    residual = values["fix_y"] - y_hat
    outputs = correct("unscented", values, underweighting=beta, underweighted_updates=1)
    K = np.linalg.solve(S_u, P_xy.T).T
    J = recentering((K @ residual)[6:])
    close(values, outputs, K @ residual, J @ (P - K @ S_u @ K.T) @ J.T, 1e-6)
    np.testing.assert_allclose(outputs["innovation.residual"], residual, rtol=1e-10, atol=1e-13)
    nis = residual @ np.linalg.solve(S, residual)
    assert outputs["innovation.nis"] == pytest.approx(nis, rel=1e-7)


@EVERY
def test_a_known_misalignment_stays_known(case, update):
    """Zero variances are allowed in the prior."""
    values, _ = case
    P = values["prior_P"].copy()
    P[6:, :] = P[:, 6:] = 0
    outputs = correct(update, values, prior_P=P)
    assert outputs["posterior.valid"] == 1
    assert not outputs["posterior.P"][6:].any()
    assert angle_between_array(outputs["posterior.q_mu"], values["prior_q_mu"]) < 1e-15


def test_unknown_update_is_refused():
    with pytest.raises(ValueError, match=r"update must be one of .*got 'ukf'"):
        mekf_correct_model("ukf")


def test_a_fix_of_another_instant_is_refused(case):
    """Ten milliseconds are seventy meters."""
    values, _ = case
    late = correct("ekf", values, fix_t=8.2, time=8.21)
    assert late["posterior.valid"] == 0
    assert reason(late) == "not of this instant"
    np.testing.assert_array_equal(late["estimate.r_e"], values["prior_r_e"])
    timely = correct("ekf", values, fix_t=8.2, time=8.2)
    assert reason(timely) == "accepted"


@EVERY
def test_a_fix_may_measure_the_effective_velocity(case, update):
    """The same truth, prior and errors: both kinds are accepted and know the speed alike."""
    values, _ = case
    effective = synthetic_fix_model(in_track="effective")
    assert effective.name == synthetic_fix_model().name
    by_speed = correct(update, values)
    wrong, _ = mekf_correct_model(update, "effective").advance(**values)
    assert wrong["innovation.nis"] > 1e4  # a speed that is taken for an effective velocity
    assert by_speed["innovation.nis"] < 30


def test_what_passes_between_the_parts_follows_from_the_filter():
    """The declared fields of estimate, fix and innovation are those of its error state."""
    from terrafix.components.fields import ESTIMATE, FIX, INNOVATION, LAKE_FIX
    from terrafix.components.filters.family import (
        estimate_fields,
        fix_fields,
        innovation_fields,
    )
    from terrafix.models.filters.lake import ORBIT, lake_observation
    from terrafix.models.filters.spacecraft import STATE, sar_observation

    seen = sar_observation()
    for declared, derived in (
        (ESTIMATE, estimate_fields(STATE)),
        (FIX, fix_fields(seen)),
        (INNOVATION, innovation_fields(seen)),
        (LAKE_FIX, fix_fields(lake_observation(ORBIT))),
    ):
        assert list(declared) == list(derived)
        for name, field in declared.items():
            assert (field.shape, field.frame) == (derived[name].shape, derived[name].frame)
            assert name in ("P", "R") or field.unit == derived[name].unit
