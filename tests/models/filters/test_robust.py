"""Robust weights: the plain rule where nothing is off, closed forms where one element is."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

from terrafix.models.filters.consistency import gate_thresholds
from terrafix.models.filters.error_state import ErrorState, considered, vector
from terrafix.models.filters.measurement import REASONS, Observation
from terrafix.models.filters.models import correct_model
from terrafix.models.filters.robust import HUBER, THRESHOLDS, WEIGHTS, robust_rule
from terrafix.models.filters.updates import UPDATES, update_rule

RULES = pytest.mark.parametrize("rule", UPDATES)
ROBUST = pytest.mark.parametrize("weights", WEIGHTS[1:])
TWO = ErrorState(vector("a", 3), vector("b", 2))
SCHMIDT = ErrorState(vector("a", 3), considered(vector("b", 2)))


def linear(H, **options):
    """What is measured is H times the blocks, one under the other."""

    def predict(values, _):
        return ca.mtimes(ca.DM(H), ca.vertcat(*values.values()))

    return Observation(predict, {f"y{k}": "rad" for k in range(len(H))}, **options)


def case(seed=1, off=0.0):
    """Five states, three elements, the second of which is off by so many sigma of its noise."""
    rng = np.random.default_rng(seed)
    L, N = rng.normal(size=(5, 5)), rng.normal(size=(3, 3))
    given = {
        "x": rng.normal(size=5),
        "P": L @ L.T,
        "H": rng.normal(size=(3, 5)),
        "R": N @ N.T + np.eye(3),
    }
    given["y"] = given["H"] @ given["x"] + rng.normal(size=3)
    given["y"][1] += off * np.sqrt(given["R"][1, 1])
    return given


def kalman(x, P, y, H, R, *, kept=(), beta=0.0):
    """The textbook: gain, underweighted, and the covariance by Joseph's form."""
    P_yy = H @ P @ H.T
    R = R + beta * P_yy
    K = P @ H.T @ np.linalg.inv(P_yy + R)
    K[list(kept)] = 0.0
    left = np.eye(len(P)) - K @ H
    return x + K @ (y - H @ x), left @ P @ left.T + K @ R @ K.T


def corrected(state, observation, rule, given, weights="none", threshold=None, **more):
    """Estimate of all blocks, covariance and the rest of a correction."""
    model = correct_model("c", state, observation, rule, weights=weights)
    values, at = {}, 0
    for block in state:
        values[f"prior_{block.name}"] = given["x"][at : at + block.size]
        at += block.size
    if threshold is not None:
        values[THRESHOLDS[weights]] = threshold
    settings = {"fix_fresh": 1, "fix_present": 1.0, "gate": np.inf} | more
    values |= {"prior_P": given["P"], "fix_y": given["y"], "fix_R": given["R"]}
    out, _ = model.advance(**values, **settings)
    x = np.concatenate([out[f"estimate.{b.name}"] for b in state])
    return x, out["estimate.P"], out


VARIANTS = {
    "as it is": (TWO, {}),
    "considered": (SCHMIDT, {}),
    "underweighted": (TWO, {"underweighting": 0.3, "underweighted_updates": 1}),
    "some absent": (TWO, {"fix_present": [1, 1, 0]}),
}


@RULES
@ROBUST
@pytest.mark.parametrize("variant", VARIANTS)
def test_with_a_threshold_of_infinity_it_is_the_plain_rule(rule, weights, variant):
    state, more = VARIANTS[variant]
    given = case(off=20)
    observation = linear(given["H"], angles=["y0"])
    plain = corrected(state, observation, rule, given, **more)
    robust = corrected(state, observation, rule, given, weights, np.inf, **more)
    for one, other in zip(plain[:2], robust[:2], strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)
    for name in plain[2]:
        np.testing.assert_allclose(robust[2][name], plain[2][name], rtol=1e-12, atol=1e-12)


@RULES
def test_no_weights_are_the_rule_itself(rule):
    assert robust_rule(update_rule(rule), "none") is update_rule(rule)


@RULES
@pytest.mark.parametrize("a", [0.5, 1.3, 1.4, 10.0, 1e6])
def test_one_element_has_hubers_weight_in_closed_form(rule, a):
    """P = 4, R = 1: gain 4 / (4 + max(1, a / k)); it saturates at k P sqrt(S) / R."""
    state, observation = ErrorState(vector("a", 1)), linear(np.eye(1))
    S = 5.0
    given = {"x": [2.0], "P": [[4.0]], "y": [2.0 - a * np.sqrt(S)], "R": [[1.0]]}
    x, P, out = corrected(state, observation, rule, given, "huber", HUBER)
    R = max(1.0, a / HUBER)
    assert x[0] == pytest.approx(2.0 - 4 / (4 + R) * a * np.sqrt(S), rel=1e-12)
    assert P.item() == pytest.approx(4 * R / (4 + R), rel=1e-12)
    assert abs(x[0] - 2.0) < HUBER * 4 * np.sqrt(S)
    assert out["innovation.nis"] == pytest.approx(a**2, rel=1e-12)
    assert out["innovation.sigma"] == pytest.approx(np.sqrt(S), rel=1e-12)
    assert out["innovation.residual"] == pytest.approx(-a * np.sqrt(S), rel=1e-12)


@RULES
@pytest.mark.parametrize("a", [2.0, 3.0, 50.0])
def test_one_element_has_its_nis_at_the_threshold_in_closed_form(rule, a):
    """P = 4, R = 1, threshold 6: S' = nu^2 / 6 where nu^2 is more than 6 S, else S."""
    state, observation = ErrorState(vector("a", 1)), linear(np.eye(1))
    nu = a * np.sqrt(5.0)
    given = {"x": [0.0], "P": [[4.0]], "y": [nu], "R": [[1.0]]}
    x, P, out = corrected(state, observation, rule, given, "nis", 6.0)
    S = max(5.0, nu**2 / 6)
    assert x[0] == pytest.approx(4 * nu / S, rel=1e-12)
    assert P.item() == pytest.approx(4 * (S - 4) / S, rel=1e-12)
    assert out["innovation.nis"] == pytest.approx(a**2, rel=1e-12)


def enlarged(given, weights, present, threshold):
    """The noise by the definitions, of what is present alone, and the others' arrays."""
    at = np.flatnonzero(present)
    H, R, y = given["H"][at], given["R"][np.ix_(at, at)], given["y"][at]
    nu, P_yy = y - H @ given["x"], H @ given["P"] @ H.T
    if weights == "huber":
        z = np.abs(nu) / np.sqrt(np.diag(P_yy + R))
        w = np.minimum(1, threshold / z)
        return H, R / np.sqrt(np.outer(w, w)), y
    limit = threshold[len(at) - 1]

    def above(scale):
        return nu @ np.linalg.solve(P_yy + scale * R, nu) - limit

    scale = 1.0 if above(1.0) <= 0 else brentq(above, 1.0, 1e6, xtol=1e-13, rtol=1e-15)
    return H, scale * R, y


@RULES
@ROBUST
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_several_elements_have_the_noise_that_is_defined(rule, weights, variant, seed):
    """Against the textbook with that noise; what is absent has no part in it, whatever it holds."""
    state, more = VARIANTS[variant]
    given = case(seed, off=(20, -30, 0)[seed - 1])
    present = np.broadcast_to(more.get("fix_present", 1), 3)
    threshold = HUBER if weights == "huber" else gate_thresholds(0.99, 3)
    H, R, y = enlarged(given, weights, present, threshold)
    holed = given | {"y": np.where(present, given["y"], 1e9)}
    x, P, out = corrected(state, linear(given["H"]), rule, holed, weights, threshold, **more)
    kept = (3, 4) if state is SCHMIDT else ()
    beta = more.get("underweighting", 0.0)
    expected = kalman(given["x"], given["P"], y, H, R, kept=kept, beta=beta)
    np.testing.assert_allclose(x, expected[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P, expected[1], rtol=1e-9, atol=1e-9)
    assert out["innovation.dof"] == present.sum()


def test_the_scale_brings_the_nis_to_its_threshold_where_elements_differ_by_decades():
    """Noise and prior of 1e-3 to 1e3: eight steps leave the NIS within 1e-9 of its threshold."""
    rng, limit = np.random.default_rng(5), gate_thresholds(0.99, 5)
    model = correct_model("c", ErrorState(vector("a", 5)), linear(np.eye(5)), weights="nis")
    fixed = {"fix_fresh": 1, "fix_present": 1.0, "gate": np.inf, "nis_threshold": limit}
    for _ in range(50):
        P, R = (np.diag(10.0 ** rng.uniform(-3, 3, 5)) for _ in range(2))
        nu = rng.normal(size=5) * 10 ** rng.uniform(0, 2) * np.sqrt(np.diag(P + R))
        out = model(prior_P=P, fix_R=R, fix_y=nu, **fixed)
        after = nu @ np.linalg.solve(P, out["estimate.a"])  # a = P S'^-1 nu
        assert after <= limit[4] * (1 + 1e-9)
        if nu @ np.linalg.solve(P + R, nu) > limit[4]:
            assert after == pytest.approx(limit[4], rel=1e-9)


@ROBUST
@RULES
def test_an_angle_across_the_cut_is_not_far_off(rule, weights):
    """A bearing of -pi + 0.05 of one predicted at pi - 0.1: 0.15 ahead, 0.67 sigma, weight 1."""
    state, observation = ErrorState(vector("a", 1)), linear(np.eye(1), angles=["y0"])
    given = {"x": [np.pi - 0.1], "P": [[0.04]], "y": [-np.pi + 0.05], "R": [[0.01]]}
    x, P, _ = corrected(state, observation, rule, given, weights, 1.0)
    assert x[0] == pytest.approx(np.pi - 0.1 + 0.8 * 0.15, abs=1e-12)
    assert pytest.approx(0.04 * 0.2) == P


@ROBUST
def test_a_prior_that_is_exact_and_noise_of_zero_are_no_trouble(weights):
    for P, R, expected in ((0.0, 1.0, 0.0), (1.0, 0.0, 30.0)):
        given = {"x": [0.0], "P": [[P]], "y": [30.0], "R": [[R]]}
        state, observation = ErrorState(vector("a", 1)), linear(np.eye(1))
        x, _, out = corrected(state, observation, "ekf", given, weights, 1.0)
        assert x[0] == pytest.approx(expected, abs=1e-9)
        assert REASONS[int(out["innovation.reason"].item())] == "accepted"


@ROBUST
def test_without_a_fix_and_with_a_broken_one_the_prior_stands(weights):
    given = case()
    for more, said in (
        ({"fix_fresh": 0}, "nothing measured"),
        ({"fix_R": -1e6 * np.eye(3)}, "innovation covariance not positive definite"),
    ):
        broken = given | {"R": more.pop("fix_R", given["R"])}
        limit = np.full(3, 2.0) if weights == "nis" else 2.0
        x, P, out = corrected(TWO, linear(given["H"]), "ekf", broken, weights, limit, **more)
        assert REASONS[int(out["innovation.reason"].item())] == said
        assert x.tolist() == given["x"].tolist()
        np.testing.assert_allclose(P, given["P"], rtol=1e-15)


def test_noise_that_makes_the_covariance_none_is_not_mended_by_its_weights():
    """S = [[0.9, -1], [-1, 1.05]] is indefinite; with four times the second's noise it is not."""
    given = {
        "x": np.zeros(2),
        "P": np.array([[1.0, -1.0], [-1.0, 1.0]]),
        "R": np.diag([-0.1, 0.05]),
    }
    given["y"] = np.array([0.0, 4 * HUBER * np.sqrt(1.05)])
    state = ErrorState(vector("a", 2))
    _, _, out = corrected(state, linear(np.eye(2)), "ekf", given, "huber", HUBER)
    assert REASONS[int(out["innovation.reason"].item())].startswith("innovation covariance not")
    given = {"x": [0.0], "P": [[1.0]], "R": [[-0.5]], "y": [10.0]}  # S = 0.5: no scale helps
    x, _, _ = corrected(ErrorState(vector("a", 1)), linear(np.eye(1)), "ekf", given, "nis", 1.0)
    assert x[0] == pytest.approx(20.0)  # the plain gain, 1 / 0.5


@ROBUST
def test_the_gate_goes_by_the_noise_as_it_was_reported(weights):
    given = case(off=20)
    nis = corrected(TWO, linear(given["H"]), "ekf", given)[2]["innovation.nis"].item()
    limit = gate_thresholds(0.99, 3) if weights == "nis" else HUBER
    for share, accepted in ((1.001, 1), (0.999, 0)):
        out = corrected(
            TWO, linear(given["H"]), "ekf", given, weights, limit, gate=np.full(3, share * nis)
        )[2]
        assert out["innovation.accepted"] == accepted
        assert out["innovation.nis"] == pytest.approx(nis, rel=1e-12)


def test_weights_that_nobody_knows_are_refused():
    with pytest.raises(ValueError, match=r"weights must be one of \('none', 'huber', 'nis'\), got"):
        correct_model("c", TWO, linear(np.eye(5)), weights="tukey")


# ------------------------------------------------------------------------- over an ensemble

WALK, STEPS, MEMBERS = 0.3, 150, 2000
"""A random walk of this sigma per step, measured with unit noise; the first 50 steps left out."""


def rms(weights, outliers, seed=11):
    """RMS error of the posterior; a tenth of the fixes is off by ten sigma, of either sign."""
    rng = np.random.default_rng(seed)
    model = correct_model(
        "c", ErrorState(vector("a", 1)), linear(np.eye(1)), weights=weights, underweighting=False
    )
    function = model.step_function().map(MEMBERS)
    names = model.step_function().name_in()
    limit = HUBER if weights == "huber" else gate_thresholds(0.99, 1).item()
    fixed = {"fix_R": 1.0, "fix_present": 1.0, "fix_fresh": 1.0, "gate": np.inf}
    fixed |= {THRESHOLDS[weights]: limit} if weights != "none" else {}
    results = [k.replace(".", "_") + "_" for k in model.outputs]
    error, P, squares = rng.normal(size=MEMBERS), np.ones(MEMBERS), []
    for step in range(STEPS):
        error, P = error + WALK * rng.normal(size=MEMBERS), P + WALK**2  # estimate minus truth
        hit = rng.random(MEMBERS) < 0.1
        sign = np.where(rng.random(MEMBERS) < 0.5, -1, 1)
        y = rng.normal(size=MEMBERS) + outliers * 10 * hit * sign
        values = {**fixed, "prior_a": error, "prior_P": P, "fix_y": y}
        rows = [np.broadcast_to(values.get(n, 0.0), (1, MEMBERS)) for n in names]
        out = dict(zip(results, function.call(rows), strict=True))
        error, P = (np.asarray(out[f"estimate_{k}_"]).ravel() for k in ("a", "P"))
        if step >= 50:
            squares.append(np.mean(error**2))
    return np.sqrt(np.mean(squares))


def steady():
    """Gain of the plain filter, its prior's variance P; then P = (P + 1) K, K P = WALK^2."""
    P = (WALK**2 + np.sqrt(WALK**4 + 4 * WALK**2)) / 2
    return P / (P + 1), P


def test_outliers_pull_a_robust_filter_less():
    """Plain: e' = (1 - K)(e + w) + K n, with noise of variance 1 + 0.1 * 100 = 11.

    The gain with Huber's weights at an outlier is P / (P + a / k), a = 10 / sqrt(P + 1): with it in
    one case of ten, and K else, the same sum predicts the robust filter.
    """
    K, P = steady()
    a = 10 / np.sqrt(P + 1)

    def predicted(outlying):
        gains, noise, share = np.array([K, outlying]), np.array([1, 101]), np.array([0.9, 0.1])
        kept = share @ (1 - gains) ** 2
        return np.sqrt((kept * WALK**2 + share @ (gains**2 * noise)) / (1 - kept))

    plain, huber, nis = (rms(w, outliers=True) for w in WEIGHTS)
    # squares of 2000 members, independent after some 1 / K = 4 of 100 steps: 0.5 % of the root
    assert plain == pytest.approx(predicted(K), rel=0.02)
    # less than a tenth above the two gains: P is larger after an outlier, and with it the gain,
    # and a sound fix in five is beyond 1.345 sigma (one in a hundred beyond the other threshold)
    scale = 100 / gate_thresholds(0.99, 1).item() - P
    for found, outlying in ((huber, P / (P + a / HUBER)), (nis, P / (P + scale))):
        assert 0.98 < found / predicted(outlying) < 1.1
    assert huber < 0.5 * plain  # 0.44 by the two sums
    assert nis < 0.45 * plain  # 0.41


def test_where_nothing_is_off_robust_weights_cost_little():
    """Huber's cost a twentieth of the variance of a mean, 2.6 % of the RMS error; here, where the
    prior has its part, less; one threshold of 0.99 costs less than the other of 0.82. Same draws.
    """
    K, P = steady()
    plain, huber, nis = (rms(w, outliers=False) for w in WEIGHTS)
    assert plain == pytest.approx(np.sqrt((1 - K) * P), rel=0.01)
    assert plain < nis < huber < plain / np.sqrt(0.95)
