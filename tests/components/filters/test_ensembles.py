"""Corrections by functions of whole ensembles: the same numbers as symbolic ones, to rounding."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import terrafix as tf
from terrafix.components.filters.ensembles import EnsembleCorrect
from terrafix.components.filters.family import FilterCorrect, FilterPredict
from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.lincov.deviations import linear_covariance
from terrafix.models.core.model import Model
from terrafix.models.filters.ensembles import EnsembleObservation, ensemble_observation
from terrafix.models.filters.error_state import ErrorState, considered, rotation, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process

STATE = ErrorState(
    vector("r", 2, unit="m"), rotation("q", side="left"), considered(vector("bias", 2, unit="m"))
)
PROCESS = Process(walks={"r": "r_psd", "q": "q_psd"})
BEACONS = np.array([[30.0, 5.0], [-20.0, 40.0]])
ELEMENTS = {"bearing": "rad", "range": "m"}


def bearing_and_range(x, given):
    """Of a beacon that moves, in axes that are turned by q, with a bias of its place."""
    d = given["beacon"] + x["bias"] - x["r"] + given["t"] * ca.DM([0.2, -0.1])
    turn = 2 * ca.atan2(x["q"][2], x["q"][3])
    return ca.vertcat(ca.atan2(d[1], d[0]) - turn, ca.sqrt(ca.dot(d, d)))


KINDS = {"angles": ("bearing",), "fields": [vector("beacon", 2, unit="m")]}
SYMBOLIC = Observation(bearing_and_range, ELEMENTS, **KINDS)
OF_ENSEMBLES = ensemble_observation(STATE, bearing_and_range, ELEMENTS, **KINDS)


class Predict(FilterPredict):
    """Where it is, and which way it looks."""

    default_rate = tf.Rate("0.5")
    error_state, process = STATE, PROCESS
    r_psd = tf.Parameter(0.04, unit="m^2/s")
    q_psd = tf.Parameter(1e-5, unit="rad^2/s")
    r_sigma0 = tf.Parameter(3.0, unit="m")
    q_sigma0 = tf.Parameter(0.05, unit="rad")
    bias_sigma0 = tf.Parameter(0.5, unit="m")


class Plain(FilterCorrect):
    """Corrects by an expression."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, SYMBOLIC


class Whole(EnsembleCorrect):
    """Corrects by a function of the ensemble."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, OF_ENSEMBLES


class Judge(FilterEvaluation):
    """Errors of both."""

    default_rate = tf.Rate("1")
    error_state, observation = STATE, SYMBOLIC


class World(NoisyComponent):
    """Walks and turns; every third bearing is missing. Members see beacons in their own turns."""

    default_rate = tf.Rate("1")
    r = tf.Output((2,), unit="m")
    q = tf.Output((4,))
    bias = tf.Output((2,), unit="m")
    fix = tf.MessageOutput(fields=Plain.declarations["fix"].fields)

    def build_model(self):
        r, turn, bias, k = (
            ca.SX.sym("r", 2),
            ca.SX.sym("turn", 3),
            ca.SX.sym("b", 2),
            ca.SX.sym("k"),
        )
        w, dt, t = ca.SX.sym("w", 7), ca.SX.sym("dt"), ca.SX.sym("t")
        angle = ca.norm_2(turn) + 1e-30
        q = ca.vertcat(turn / angle * ca.sin(angle / 2), ca.cos(angle / 2))
        beacon = ca.if_else(ca.fmod(k, 2) > 0.5, ca.DM(BEACONS[0]), ca.DM(BEACONS[1]))
        h = bearing_and_range({"r": r, "q": q, "bias": bias}, {"beacon": beacon, "t": t})
        noise = ca.vertcat(0.01 * w[5], 0.2 * w[6])
        return Model(
            "world",
            states={"r": r, "turn": turn, "bias": bias, "k": k},
            noise={"w": w},
            step=dt,
            time=t,
            initial={"r": 3 * w[:2], "turn": 0.05 * w[2:5], "bias": 0.5 * w[5:7], "k": w[0] > 0},
            next={
                "r": r + 0.2 * ca.sqrt(dt) * w[:2],
                "turn": turn + ca.sqrt(1e-5 * dt) * w[2:5],
                "k": k + 1,
            },
            outputs={
                "r": r,
                "q": q,
                "bias": bias,
                "fix.y": h + noise,
                "fix.beacon": beacon,
                "fix.R": ca.diag(ca.vertcat(1e-4, 0.04)),
                "fix.present": ca.vertcat(ca.fmod(k, 3) > 0.5, 1),
                "fix.valid": ca.fmod(k, 5) > 0.5,
            },
        )


def system(correct):
    with tf.System("beacons", duration="20", seed=4) as made:
        world, predict = made.add(World(), "world"), made.add(Predict(), "predict")
        made.add(correct, "correct")
        judge = made.add(Judge(), "judge")
        made.connect(world["fix"], correct["fix"])
        made.connect(predict["prior"], correct["prior"])
        made.connect(correct["posterior"], predict["posterior"])
        made.connect(correct["estimate"], judge["estimate"])
        made.connect(correct["innovation"], judge["innovation"])
        for name in ("r", "q", "bias"):
            made.connect(world[name], judge[name])
    return made


@pytest.mark.parametrize("weights", ["none", "huber", "nis"])
@pytest.mark.parametrize("update", ["ekf", "iterated", "unscented"])
def test_a_function_of_ensembles_corrects_as_its_expression_does(update, weights):
    """Members with a fix and without, elements absent, angles, a rotation, a considered block."""
    settings = {"update": update, "underweighting": 0.3, "underweighted_updates": 4.0}
    settings |= {"weights": weights}
    found = [tf.simulate(system(kind(**settings)), members=7).dataset for kind in (Plain, Whole)]
    assert float(found[0]["judge.nees"][-1].mean()) < 20  # of 7: it follows the truth
    for name in ("r_error", "q_error", "covariance", "normalized_innovation", "nis", "reason"):
        a, b = (d[f"judge.{name}"].values for d in found)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11, err_msg=name)


class Early(World):
    """Measures at the start, too."""

    def build_model(self):
        model = super().build_model()
        return replace(model, outputs={**model.outputs, "fix.valid": ca.SX(1)})

    @property
    def publishes_at_start(self):
        return True


def test_a_fix_at_the_start_is_weighed_as_the_expression_does():
    found = []
    for kind in (Plain, Whole):
        made = system(kind(update="iterated", rate=tf.Rate("1")))
        made.replace("world", Early())
        made.record("first", [made.find("correct")["estimate"]], period="1")
        found.append(tf.simulate(made, members=3, duration="3").dataset)
    for name in ("correct.estimate.r", "correct.estimate.P"):
        a, b = (d[name].values for d in found)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11, err_msg=name)
    # it corrected: nine square meters before
    assert (found[0]["correct.estimate.P"].values[0, :, 0, 0] < 8.9).all()


def test_a_member_alone_is_that_of_the_ensemble():
    """The same bytes, whatever others have a fix."""
    together = tf.simulate(system(Whole(update="iterated")), members=5).dataset
    alone = tf.simulate(system(Whole(update="iterated")), members=[3]).dataset
    np.testing.assert_array_equal(
        together["judge.r_error"].values[:, 3], alone["judge.r_error"].values[:, 0]
    )


# --------------------------------------------------------------------- hundreds of vertices

N_VERTICES = 240


def moments(x, given):
    """Area, and first moments, of a polygon that is moved by -r: a map over its edges."""
    a, b = ca.MX.sym("a", 2), ca.MX.sym("b", 2)
    cross = a[0] * b[1] - a[1] * b[0]
    edge = ca.Function("edge", [a, b], [ca.vertcat(cross / 2, (a + b) * cross / 6)])
    corners = given["contour"].T - ca.repmat(x["r"], 1, N_VERTICES)
    following = ca.horzcat(corners[:, 1:], corners[:, 0])
    return ca.sum2(edge.map(N_VERTICES)(corners, following))


MOMENTS = ensemble_observation(
    STATE,
    moments,
    {"area": "m^2", "x": "m^3", "y": "m^3"},
    shared={"contour": (N_VERTICES, 2)},
)


def test_moments_of_a_contour_and_their_derivative_are_the_closed_form():
    """An ellipse of 3 by 2 about (1, -1): A and A (c - r), and the derivative is -A."""
    t = 2 * np.pi * np.arange(N_VERTICES) / N_VERTICES
    contour = np.stack([1 + 3 * np.cos(t), -1 + 2 * np.sin(t)], axis=1)
    area = 0.5 * N_VERTICES * 3 * 2 * np.sin(2 * np.pi / N_VERTICES)  # of that polygon
    r = np.array([[0.0, 0.0], [2.0, 1.0], [-1.0, 4.0]])
    values = {"r": r, "q": np.tile([0.0, 0, 0, 1], (3, 1)), "bias": np.zeros((3, 2))}
    y = MOMENTS.predict(values, {"contour": contour})
    center = np.array([1.0, -1.0]) - r
    np.testing.assert_allclose(y, np.column_stack([np.full(3, area), area * center]), rtol=1e-12)
    H = MOMENTS.derivative(values, {"contour": contour})
    expected = np.zeros((3, STATE.size))
    expected[1, 0] = expected[2, 1] = -area
    np.testing.assert_allclose(H, np.tile(expected, (3, 1, 1)), atol=1e-10)


# ----------------------------------------------------------------------------- refusals


def test_an_observation_of_ensembles_brings_its_derivative():
    with pytest.raises(ValueError, match="brings its derivative"):
        EnsembleObservation(lambda x, _: x["r"], {"x": "m"})


def test_each_kind_of_observation_has_its_base():
    with pytest.raises(ValueError, match=r"Wrong is a function of ensembles: .* EnsembleCorrect"):

        class Wrong(FilterCorrect):
            error_state, observation = STATE, OF_ENSEMBLES

    with pytest.raises(ValueError, match=r"Other is symbolic: .* FilterCorrect"):

        class Other(EnsembleCorrect):
            error_state, observation = STATE, SYMBOLIC


def test_an_answer_of_another_shape_is_named():
    class Short(EnsembleCorrect):
        default_rate = tf.Rate("1", offset="1")
        error_state = STATE
        observation = EnsembleObservation(
            lambda x, _: x["r"][:, :1],
            ELEMENTS,
            derivative=lambda x, _: np.zeros((len(x["r"]), 2, STATE.size)),
            **KINDS,
        )

    with pytest.raises(tf.RunError, match=r"shape \(3, 1\) .* 'y' needs \(3, 2\)"):
        tf.simulate(system(Short()), members=3)


def test_what_an_observation_reads_must_be_declared():
    class Blind(EnsembleCorrect):
        default_rate = tf.Rate("1", offset="1")
        error_state, observation = STATE, MOMENTS

    blind = Blind()
    with pytest.raises(tf.TerrafixError, match="reads 'contour', which is no shared input"):
        blind.validate()


def test_it_cannot_be_linearized():
    with pytest.raises(
        tf.ConfigurationError, match=r"'correct' \(Whole\) has no symbolic Jacobian"
    ):
        linear_covariance(system(Whole()))
