"""A filter that is told anew where it is: the same as one that starts there."""

import casadi as ca
import numpy as np
import pytest

import terrafix as tf
from terrafix.components.filters.family import FilterCorrect, FilterPredict
from terrafix.models.filters.error_state import ErrorState, clone, rotation, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.models import NEVER, predict_model
from terrafix.models.filters.process import Process
from terrafix.models.filters.spacecraft import mekf_predict_model

R = vector("r", 2, unit="m")
STATE = ErrorState(
    R,
    vector("b", 1, unit="m/s"),
    vector("v", 2, unit="m/s"),
    rotation("q", side="right"),
    clone(R, "center"),
)
PROCESS = Process(
    rates=lambda x, _, w, __: {
        "r": x["v"] + x["b"],
        "v": w["a"] - 0.01 * ca.norm_2(x["r"]) * x["v"],
        "q": 0.1 * ca.vertcat(x["v"], 1),
    },
    noise={"a": ("psd", 2)},
    walks={"b": "b_psd"},
)
RANGE = Observation(
    lambda x, _: ca.norm_2(x["r"] - ca.vertcat(50, 20)) + 3 * x["q"][0], {"range": "m"}
)


class Predict(FilterPredict):
    """Told r and v; b and q start from a sigma."""

    default_rate = tf.Rate("0.1")
    error_state, process, told = STATE, PROCESS, ("r", "v")
    psd = tf.Parameter(0.04, unit="m^2/s^3")
    b_psd = tf.Parameter(0.01, unit="m^2/s^3")
    b_sigma0 = tf.Parameter(0.5, unit="m/s")
    q_sigma0 = tf.Parameter(0.1, unit="rad")


class Correct(FilterCorrect):
    """By a range that depends on all blocks."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, RANGE


START = Predict.declarations["start"].fields
P = np.array([[9, 1, 0, 0.5], [1, 16, 0.2, 0], [0, 0.2, 1, 0.1], [0.5, 0, 0.1, 2.0]])


class Script(tf.Component):
    """Starts, starts again at t1, measures each second, and makes a clone half a second after."""

    default_rate = tf.Rate("0.1")
    t1 = tf.Parameter(0.0, unit="s")
    start, again = tf.MessageOutput(fields=START), tf.MessageOutput(fields=START)
    center = tf.MessageOutput(fields={"index": tf.Field(())})
    fix = tf.MessageOutput(fields=Correct.declarations["fix"].fields)

    def _initialize_impl(self):
        wrong = self.t1[0] > 0
        told = {"r": [400.0, -90.0], "v": [-3, 5], "P": 7 * P} if wrong else self.told()
        self.start.publish(0.0, **told)

    def told(self):
        return {"r": np.tile([3.0, 4.0], (self.n_members, 1)), "v": [1.0, -2.0], "P": P}

    def _step_impl(self, t, dt):
        since = round(10 * (t - self.t1[0]))
        if since == 0:
            self.again.publish(t, **self.told())
        if since % 10 == 0:
            y = 45 + 0.3 * since + np.sin(since)
            self.fix.publish(t, y=y, R=[[4.0]], present=[1.0])
        if since % 10 == 5:
            self.center.publish(t, index=0.0)


def flown(t1, *, connected=True):
    """Estimates from t1 to t1 + 5, by name."""
    with tf.System("again", duration=str(t1 + 5)) as system:
        script = system.add(Script(t1=float(t1)), "script")
        predict, correct = system.add(Predict(), "predict"), system.add(Correct(), "correct")
        system.connect(script["start"], predict["start"])
        if connected:
            system.connect(script["again"], predict["restart"])
        system.connect(script["center"], predict["center"])
        system.connect(script["fix"], correct["fix"])
        system.connect(predict["prior"], correct["prior"])
        system.connect(correct["posterior"], predict["posterior"])
        system.record("all", [predict["prior"]], rate=tf.Rate("0.1"))
    found = tf.simulate(system, members=2).dataset
    return {n: found[f"predict.prior.{n}"].values[10 * t1 :] for n in STATE.shapes}


def test_a_filter_restarted_at_t1_is_one_that_started_there():
    """Values, covariance, and clones, over 50 steps and 5 fixes; a fix at t1 itself is not taken.

    To 1e-12 of what each is at the largest: the two differ in nothing but the tick.
    """
    anew, again = flown(0), flown(4)
    for name, expected in anew.items():
        got = again[name][1:] - (4 * (expected[1:] > 0) if name == "t_center" else 0)
        scale = np.abs(expected[np.abs(expected) < 1e9]).max()
        np.testing.assert_allclose(got, expected[1:], rtol=1e-12, atol=1e-12 * scale, err_msg=name)
    assert not np.allclose(anew["r"][0], again["r"][0])  # at t1, before it begins anew
    assert (anew["t_center"][:6] == NEVER).all()
    assert (anew["t_center"][6:16, 0] == 0.5).all()


def test_a_restart_needs_not_be_connected():
    left = flown(4, connected=False)
    assert not np.allclose(left["r"][1:], flown(0)["r"][1:], atol=1.0)


def test_without_a_restart_results_are_those_of_a_model_that_has_none():
    """To the byte, from numbers with and without a fresh posterior."""
    told = {"told": ("r", "v"), "sigmas": {"b": "b_sigma0", "q": "q_sigma0"}}
    rng = np.random.default_rng(3)
    plain = predict_model("p", STATE, PROCESS, **told)
    able = predict_model("p", STATE, PROCESS, **told, restarts=True)
    functions = [m.step_function() for m in (plain, able)]
    values = {n: rng.normal(size=functions[1].size_in(n)) for n in functions[1].name_in()}
    for fresh in (0.0, 1.0):
        values |= {"posterior_fresh": fresh, "restart_fresh": 0.0, "center_fresh": 0.0, "dt": 0.1}
        values |= {n: np.nan * v for n, v in values.items() if n in ("restart_r", "restart_P")}
        a, b = (f.call([values[n] for n in f.name_in()]) for f in functions)
        for one, other in zip(a, b, strict=True):
            assert np.array_equal(one.full(), other.full())
            assert np.isfinite(one.full()).all()


def test_the_spacecraft_s_kernel_is_what_it_was():
    """1872 instructions, counted before filters could restart."""
    assert mekf_predict_model().step_function().n_instructions() == 1872


def test_a_filter_that_is_told_nothing_cannot_restart():
    with pytest.raises(ValueError, match="filter 'p' restarts, and no block is told: name in"):
        predict_model(
            "p", ErrorState(vector("b", 1)), Process(), told=(), sigmas={"b": "s"}, restarts=True
        )
    assert "restart" not in type("Untold", (FilterPredict,), {
        "error_state": ErrorState(vector("b", 1)), "process": Process()
    }).declarations  # fmt: skip


class SmoothedPredict(Predict):
    """With its transition."""

    error_state, smoothed = STATE, True


def test_nothing_before_a_start_anew_is_smoothed():
    """Started again at 2 s: of fixes each second those from 3 s on; all before was given up."""
    with tf.System("again", duration="6") as system:
        script = system.add(Script(t1=2.0), "script")
        predict = system.add(SmoothedPredict(), "predict")
        correct = system.add(Correct(), "correct")
        system.connect(script["start"], predict["start"])
        system.connect(script["again"], predict["restart"])
        system.connect(script["center"], predict["center"])
        system.connect(script["fix"], correct["fix"])
        system.connect(predict["prior"], correct["prior"])
        system.connect(correct["posterior"], predict["posterior"])
        ports = ("error_transition", "transition_since", "prior")
        system.record("all", [*(predict[n] for n in ports), correct["estimate"]], period="1")
    smoothed = tf.smooth_run(tf.simulate(system)).dataset
    np.testing.assert_allclose(smoothed["time"].values, [3, 4, 5, 6])
