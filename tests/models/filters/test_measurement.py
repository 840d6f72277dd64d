"""Corrections on linear systems: every rule is the textbook's Kalman filter, to the last digits."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.filters.error_state import ErrorState, considered, rotation, vector
from terrafix.models.filters.measurement import REASONS, Observation
from terrafix.models.filters.models import correct_model, predict_model
from terrafix.models.filters.process import Process
from terrafix.models.filters.updates import UPDATES

RULES = pytest.mark.parametrize("rule", UPDATES)
NO_GATE = np.full(3, np.inf)


def linear(H, **options):
    """What is measured is H times the blocks, one under the other."""

    def predict(values, _):
        return ca.mtimes(ca.DM(H), ca.vertcat(*values.values()))

    return Observation(predict, {f"y{k}": "rad" for k in range(len(H))}, **options)


def kalman(x, P, y, H, R, kept=()):
    """The textbook: gain, state, covariance by Joseph's form, NIS."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    K[list(kept)] = 0.0
    left = np.eye(len(P)) - K @ H
    nu = y - H @ x
    return x + K @ nu, left @ P @ left.T + K @ R @ K.T, nu @ np.linalg.solve(S, nu)


def case(seed=1, n=(3, 2), m=3):
    rng = np.random.default_rng(seed)
    size = sum(n)
    L, N = rng.normal(size=(size, size)), rng.normal(size=(m, m))
    return {
        "x": rng.normal(size=size),
        "P": L @ L.T,
        "H": rng.normal(size=(m, size)),
        "R": N @ N.T + np.eye(m),
        "y": rng.normal(size=m),
    }


def corrected(state, observation, rule, given, **more):
    """Estimate of all blocks, covariance, NIS and the rest of a correction."""
    model = correct_model("c", state, observation, rule, underweighting=False)
    values, at = {}, 0
    for block in state:
        values[f"prior_{block.name}"] = given["x"][at : at + block.size]
        at += block.size
    more = {"fix_fresh": 1, "fix_present": 1.0, "gate": NO_GATE[: observation.size], **more}
    out = model(**values, prior_P=given["P"], fix_y=given["y"], fix_R=given["R"], **more)
    x = np.concatenate([out[f"estimate.{b.name}"] for b in state])
    return x, out["estimate.P"], out


TWO = ErrorState(vector("a", 3), vector("b", 2))


@RULES
@pytest.mark.parametrize("what", ["plain", "singular P", "R = 0", "P = 0"])
def test_every_rule_is_the_kalman_filter(rule, what):
    given = case()
    if what == "singular P":
        L = np.random.default_rng(3).normal(size=(5, 4))
        given["P"] = L @ L.T
    elif what == "P = 0":
        given["P"] = np.zeros((5, 5))
    elif what == "R = 0":
        given["R"] = np.zeros((3, 3))
    x, P, out = corrected(TWO, linear(given["H"]), rule, given)
    expected = kalman(given["x"], given["P"], given["y"], given["H"], given["R"])
    np.testing.assert_allclose(x, expected[0], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(P, expected[1], atol=1e-11)
    assert out["innovation.nis"] == pytest.approx(expected[2], rel=1e-11)
    assert (out["innovation.accepted"], out["innovation.dof"]) == (1, 3)


@RULES
def test_absent_elements_are_as_if_they_were_none(rule):
    given = case()
    some, holed = [0, 2], np.where([1, 0, 1], given["y"], 1e9)
    holes = given | {"y": holed}
    x, P, out = corrected(TWO, linear(given["H"]), rule, holes, fix_present=[1, 0, 1])
    expected = kalman(
        given["x"], given["P"], given["y"][some], given["H"][some], given["R"][np.ix_(some, some)]
    )
    np.testing.assert_allclose(x, expected[0], rtol=1e-11)
    np.testing.assert_allclose(P, expected[1], atol=1e-12)
    assert out["innovation.dof"] == 2
    assert out["innovation.nis"] == pytest.approx(expected[2])


@RULES
def test_angles_are_wrapped_at_the_cut(rule):
    """A bearing measured at -pi + 0.05 of one predicted at pi - 0.1 is 0.15 ahead, not 6.13."""
    state, observation = ErrorState(vector("a", 1)), linear(np.eye(1), angles=["y0"])
    given = {"x": [np.pi - 0.1], "P": [[0.04]], "y": [-np.pi + 0.05], "R": [[0.01]]}
    x, P, _ = corrected(state, observation, rule, given)
    assert x[0] == pytest.approx(np.pi - 0.1 + 0.8 * 0.15, abs=1e-12)
    assert pytest.approx(0.04 * 0.2) == P


@RULES
def test_a_considered_block_counts_and_is_not_corrected(rule):
    """Schmidt's filter: the gain's rows are zero, the covariance that of any gain."""
    state, given = ErrorState(vector("a", 3), considered(vector("b", 2))), case(4)
    x, P, _ = corrected(state, linear(given["H"]), rule, given)
    expected = kalman(given["x"], given["P"], given["y"], given["H"], given["R"], kept=(3, 4))
    np.testing.assert_allclose(x, expected[0], rtol=1e-11)
    np.testing.assert_allclose(P, expected[1], rtol=1e-10, atol=1e-11)
    assert x[3:].tolist() == given["x"][3:].tolist()
    np.testing.assert_allclose(P[3:, 3:], given["P"][3:, 3:], rtol=1e-14)


@RULES
def test_a_chain_of_two_is_the_two_stacked(rule):
    given = case(5)
    sensors = [(k, linear(given["H"][k])) for k in (slice(0, 1), slice(1, 3))]
    R = np.zeros((3, 3))
    R[0, 0], R[1:, 1:] = given["R"][0, 0], given["R"][1:, 1:]
    whole = corrected(TWO, linear(given["H"]), rule, given | {"R": R})
    x, P = given["x"], given["P"]
    for part, sensor in sensors:
        link = {"x": x, "P": P, "y": given["y"][part], "R": R[part, part]}
        x, P, _ = corrected(TWO, sensor, rule, link)
    np.testing.assert_allclose(x, whole[0], rtol=1e-11)
    np.testing.assert_allclose(P, whole[1], rtol=1e-10, atol=1e-12)


def test_the_last_of_a_chain_says_what_was_corrected_before_it():
    observation = linear(np.eye(5)[:1])
    model = correct_model("c", TWO, observation, underweighting=False, chained=True)
    given = {"prior_P": np.eye(5), "fix_R": 1.0, "gate": np.inf, "fix_present": 1}
    for fresh, earlier in ((0, 0), (0, 1), (1, 0), (1, 1)):
        out = model(**given, fix_fresh=fresh, earlier_fresh=earlier, fix_y=2.0)
        assert out["posterior.valid"] == max(fresh, earlier)
        assert out["innovation.valid"] == out["innovation.accepted"] == fresh
        assert out["estimate.a"][0] == (1.0 if fresh else 0.0)


@RULES
def test_the_error_of_what_a_fix_reports_is_mapped(rule):
    """A distance to a reported point: its covariance D enters along the line of sight."""
    state = ErrorState(vector("r", 2))

    def distance(values, given):
        line = given["point"] - values["r"]
        return ca.sqrt(ca.dot(line, line))

    observation = Observation(
        distance, {"range": "m"}, fields=[vector("point", 2, unit="m")], mapped={"point": "D"}
    )
    assert list(observation.shapes()) == ["y", "point", "R", "D", "present"]
    D = np.array([[4.0, 1.0], [1.0, 9.0]])
    given = {"x": [0.0, 0.0], "P": 1e-8 * np.eye(2), "y": [5.0], "R": [[0.25]]}
    _, _, out = corrected(state, observation, rule, given, fix_point=[3, 4], fix_D=D)
    line = np.array([0.6, 0.8])
    assert out["innovation.sigma"] == pytest.approx(np.sqrt(0.25 + line @ D @ line), rel=1e-6)


def test_gates_go_by_the_elements_that_were_measured():
    given = case(6)
    observation = linear(given["H"])
    nis = {}
    for present in ([1, 0, 0], [1, 1, 1]):
        out = corrected(TWO, observation, "ekf", given, fix_present=present)[2]
        nis[sum(present)] = out["innovation.nis"].item()
    for dof, present in ((1, [1, 0, 0]), (3, [1, 1, 1])):
        for share, reason in ((1.001, "accepted"), (0.999, "gate")):
            gate = np.full(3, 1e-9)
            gate[dof - 1] = share * nis[dof]
            x, _, out = corrected(TWO, observation, "ekf", given, fix_present=present, gate=gate)
            assert REASONS[int(out["innovation.reason"].item())] == reason
            assert (x.tolist() == given["x"].tolist()) == (reason == "gate")


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"fix_present": 0}, "nothing measured"),
        ({"fix_t": 5.0, "time": 5.01}, "not of this instant"),
        ({"fix_R": -1e6 * np.eye(3)}, "innovation covariance not positive definite"),
    ],
)
def test_a_fix_that_cannot_be_used_says_why(more, reason):
    given = case(7)
    if "fix_R" in more:
        given["R"], more = more["fix_R"], {}
    x, P, out = corrected(TWO, linear(given["H"]), "ekf", given, **more)
    assert REASONS[int(out["innovation.reason"].item())] == reason
    assert out["innovation.valid"] == 1
    assert x.tolist() == given["x"].tolist()
    assert np.array_equal(P, np.triu(given["P"]) + np.triu(given["P"], 1).T)


# ------------------------------------------------------------------------- predict, and bad input


def test_a_filter_starts_from_what_it_is_told_and_from_sigmas():
    state = ErrorState(vector("r", 2), rotation("q", side="right"), vector("v", 2), vector("b", 1))
    process = Process(rates=lambda x, _, __, ___: {"r": x["v"]})
    model = predict_model(
        "p", state, process, told=("r", "v"), sigmas={"q": "tilt_sigma0", "b": "bias_sigma0"}
    )
    P = np.arange(16.0).reshape(4, 4) + 100 * np.eye(4)
    function = model.initial_function()
    names = function.name_in()
    values = {"start_r": [1, 2], "start_v": [3, 4], "start_P": (P + P.T).ravel()}
    values |= {"tilt_sigma0": 0.1, "bias_sigma0": 5.0}
    sizes = [function.size_in(k) for k in range(len(names))]
    numbers = [ca.DM(values.get(n, np.zeros(s))) for n, s in zip(names, sizes, strict=True)]
    found = function.call(numbers)
    out = dict(zip(function.name_out(), (np.array(f).ravel() for f in found), strict=True))
    assert out["prior_r_"].tolist() == [1, 2]
    assert out["prior_q_"].tolist() == [0, 0, 0, 1]
    got = out["prior_P_"].reshape(8, 8)
    told = [0, 1, 5, 6]
    assert np.array_equal(got[np.ix_(told, told)], P + P.T)
    assert np.diag(got)[2:5].tolist() == [0.1**2] * 3
    assert got[7, 7] == 25.0
    got[np.ix_(told, told)] = 0
    assert np.count_nonzero(got) == 4


def test_one_parameter_is_the_sigma_at_the_start_and_that_of_the_process():
    """A stationary Gauss-Markov process is as uncertain at t = 0 as ever after."""
    process = Process(decays={"b": ("tau", "sigma")})
    model = predict_model("p", ErrorState(vector("b", 1)), process, told=(), sigmas={"b": "sigma"})
    assert list(model.parameters) == ["tau", "sigma"]
    symbols = [model.states["P"], *model.parameters.values(), model.step]
    start = ca.Function("start", symbols, [model.initial["P"]])
    following = ca.substitute(model.next["P"], model.inputs["posterior.fresh"], 0)
    following = ca.Function("following", symbols, [following])
    P = start(0, 5, 2, 1)
    assert float(P) == 4.0
    assert float(following(P, 5, 2, 1)) == pytest.approx(4.0, rel=1e-15)


@pytest.mark.parametrize(
    ("told", "sigmas", "said"),
    [
        (("a", "c"), {}, "starts 'c', which is no block; the blocks are a, b"),
        (("a",), {}, "block 'b' of filter 'p' starts from a message or from a sigma"),
        (("a", "b"), {"b": "s"}, "block 'b' of filter 'p' starts from a message or from a sigma"),
    ],
)
def test_a_filter_that_does_not_know_how_to_start_is_refused(told, sigmas, said):
    with pytest.raises(ValueError, match=said):
        predict_model("p", TWO, Process(), told=told, sigmas=sigmas)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: Observation(lambda *_: 0, {"a": "m"}, mapped={"point": "D"}),
            "maps the error of 'point', which is no field of its message; the fields are none",
        ),
        (
            lambda: linear(np.eye(5)[:1], angles=["y"]),
            r"'y' is said .* the elements are y0 \[rad\]",
        ),
        (
            lambda: correct_model("c", TWO, Observation(lambda *_: ca.SX.zeros(2), {"a": "m"})),
            r"predicts an array of shape \(2, 1\); it measures 1 elements",
        ),
        (lambda: correct_model("c", TWO, linear(np.eye(5)), "ukf"), "update must be one of"),
        (
            lambda: correct_model("c", TWO, Observation(lambda x, _: x["z"], {"a": "m"})),
            "there is no block 'z'; the blocks are a, b",
        ),
    ],
)
def test_what_is_no_measurement_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
