"""Twins of a filter: a truth and a sensor that are what it believes, and nothing else."""

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf
from terrafix.models.filters.error_state import ErrorState, clone, considered, rotation, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process

f = tf.filters
SIDES = ("left", "right")


def parts(side):
    """A turning body that is pushed, a drifting bias, a constant that is considered."""
    state = ErrorState(
        vector("r", unit="m"),
        vector("v", unit="m/s"),
        rotation("q", side=side),
        vector("drift", 1, unit="m"),
        considered(vector("scale", 1)),
    )
    process = Process(
        rates=lambda x, given, w, t: {
            "r": x["v"],
            "v": w["push"],
            "q": given["rate_b"] + w["turn"],
        },
        noise={"push": ("psd", 3), "turn": ("turn_psd", 3)},
        decays={"drift": ("tau", "drift_sigma0")},
        inputs={"rate_b": 3},
    )
    place = Observation(
        lambda x, given: ca.vertcat(
            (1 + x["scale"]) * x["r"] + x["drift"] * ca.DM([1, 0, 0]),
            2 * ca.atan2(x["q"][2], x["q"][3]),
        ),
        {"x": "m", "y": "m", "z": "m", "heading": "rad"},
        angles=("heading",),
    )
    return state, process, place


class Gyro(tf.Component):
    """Says how fast it turns."""

    default_rate = tf.Rate("0.1")
    rate_b = tf.Output((3,), unit="rad/s")

    def _initialize_impl(self):
        self.rate_b = [0.0, 0.0, 0.3]

    def _step_impl(self, t, dt):
        self.rate_b = [0.02 * np.sin(t), 0.0, 0.3]


class Belief:
    """What filter and truth have in common."""

    default_rate = tf.Rate("0.1")
    psd = tf.Parameter(0.01, unit="m^2/s^3", minimum=0.0)
    turn_psd = tf.Parameter(1e-4, unit="rad^2/s", minimum=0.0)
    tau = tf.Parameter(20.0, unit="s")
    r_sigma0 = tf.Parameter(5.0, unit="m", minimum=0.0)
    v_sigma0 = tf.Parameter(0.5, unit="m/s", minimum=0.0)
    q_sigma0 = tf.Parameter(0.05, unit="rad", minimum=0.0)
    drift_sigma0 = tf.Parameter(1.0, unit="m", minimum=0.0)
    scale_sigma0 = tf.Parameter(1e-3, minimum=0.0)
    rate_b = tf.Input((3,), unit="rad/s")


def system(side, **settings):
    state, process, place = parts(side)

    def of(base, **more):
        bases = (Belief, base) if "process" in more else (base,)
        return type(base.__name__[6:], bases, {"__doc__": "Own.", "error_state": state, **more})

    at = {"default_rate": tf.Rate("1", offset="1"), "observation": place}
    made = tf.System("twins", duration="20", seed=6)
    gyro = made.add(Gyro(), "gyro")
    truth = made.add(of(f.FilterTruth, process=process)(**settings), "truth")
    sensor = made.add(of(f.FilterSensor, **at)(sigma=[1.0, 1.0, 1.0, 0.1]), "sensor")
    predict = made.add(of(f.FilterPredict, process=process)(), "predict")
    correct = made.add(of(f.FilterCorrect, **at)(), "correct")
    judge = made.add(
        of(f.FilterEvaluation, default_rate=tf.Rate("1"), observation=place)(), "judge"
    )
    for reader in (truth, predict):
        made.connect(gyro["rate_b"], reader["rate_b"])
    for block in state:
        made.connect(truth[block.name], judge[block.name])
        if block.name in sensor.inputs():
            made.connect(truth[block.name], sensor[block.name])
    made.connect(sensor["fix"], correct["fix"])
    made.connect(predict["prior"], correct["prior"])
    made.connect(correct["posterior"], predict["posterior"])
    made.connect(correct["estimate"], judge["estimate"])
    made.connect(correct["innovation"], judge["innovation"])
    made.record("truth", [*(truth[b.name] for b in state), sensor["fix"]], period="1")
    return made


@pytest.mark.parametrize("side", SIDES)
def test_a_filter_is_consistent_with_its_twins(side):
    """Eleven degrees, four measured: means of 400 members in their 99.9 % intervals."""
    found = tf.simulate(system(side), members=400).dataset
    for name, dof in (("nees", 11), ("nis", 4)):
        low, high = chi2.ppf([0.0005, 0.9995], dof * 400) / 400
        for epoch in (1, 5, 20):
            mean = found[f"judge.{name}"].values[epoch].mean()
            assert low < mean < high, (name, epoch, mean)
    assert np.abs(np.linalg.norm(found["truth.q"].values, axis=2) - 1).max() < 1e-12


def test_a_truth_that_is_not_as_the_filter_believes_is_seen():
    """Four times the density of the push: at 20 s NEES leaves its bounds."""
    found = tf.simulate(system("left", psd=0.04), members=400).dataset
    assert found["judge.nees"].values[20].mean() > chi2.ppf(0.9995, 11 * 400) / 400


def test_moments_of_the_truth_are_those_of_the_process():
    """Var v = 0.25 + 0.01 t, var r = 25 + 0.25 t^2 + 0.01 t^3 / 3; the drift keeps its sigma."""
    found = tf.simulate(system("left"), members=4000, duration="10").dataset
    t, tolerance = 10.0, 5 * np.sqrt(2 / (3 * 4000))
    for name, variance in (
        ("v", 0.25 + 0.01 * t),
        ("r", 25 + 0.25 * t**2 + 0.01 * t**3 / 3),
        ("scale", 1e-6),
        ("drift", 1.0),
    ):
        values = found[f"truth.{name}"].values[-1]
        slack = tolerance if values.shape[-1] == 3 else np.sqrt(3) * tolerance
        np.testing.assert_allclose((values**2).mean(), variance, rtol=slack, err_msg=name)


def test_a_sensor_reports_the_noise_that_it_draws_and_wraps_angles():
    found = tf.simulate(system("right", r_sigma0=0.0), members=4000, duration="12").dataset
    truth = found["truth.r"].values[-1] * (1 + found["truth.scale"].values[-1])
    truth[:, 0] += found["truth.drift"].values[-1, :, 0]
    noise = found["sensor.fix.y"].values[-1][:, :3] - truth
    np.testing.assert_allclose(noise.std(axis=0), 1.0, rtol=5 / np.sqrt(2 * 4000))
    R = found["sensor.fix.R"].values[-1, 0]
    np.testing.assert_array_equal(R, np.diag(np.square([1.0, 1.0, 1.0, 0.1])))
    heading = found["sensor.fix.y"].values[-1][:, 3]  # 12 s at 0.3 rad/s: beyond half a turn
    assert (np.abs(heading) <= np.pi).all()
    assert (heading < -2.0).mean() > 0.99


def test_it_starts_about_what_it_is_told():
    """A start of 100 m and 3 m/s with its covariance: mean and sigma of 2,000 members."""
    state = ErrorState(vector("r", 1, unit="m"), vector("v", 1, unit="m/s"))

    class Truth(f.FilterTruth):
        """Told where it starts."""

        default_rate = tf.Rate("1")
        error_state, process, told = state, Process(), ("r", "v")

    P = np.array([[4.0, 1.0], [1.0, 1.0]])
    driven = tf.testing.drive(
        Truth(), {"start": {0.0: {"r": [100.0], "v": [3.0], "P": P}}}, steps=1, members=2000
    )
    values = np.column_stack([driven[name][-1].reshape(2000) for name in ("r", "v")])
    np.testing.assert_allclose(values.mean(axis=0), [100, 3], atol=5 * 2 / np.sqrt(2000))
    np.testing.assert_allclose(np.cov(values.T), P, atol=5 * 4 * np.sqrt(2 / 2000))


def test_a_sensor_of_what_is_past_or_whole_is_one_s_own():
    state = ErrorState(vector("r", 1), clone(vector("r", 1), "then"))
    late = Observation(lambda x, _: x["r_at_then"], {"x": "1"}, instant="then")
    with pytest.raises(ValueError, match=r"is of the instant 'then'.*component of its own"):

        class Sensor(f.FilterSensor):
            error_state, observation = state, late
