"""A filter of one's own: a tracker in two classes, its ports, its consistency, its verdicts."""

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf
from terrafix.components.filters.family import FilterCorrect, FilterPredict
from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.lincov.deviations import linear_covariance
from terrafix.models.core.model import Model
from terrafix.models.filters.error_state import ErrorState, clone, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process
from terrafix.models.filters.robust import WEIGHTS

STATE = ErrorState(vector("r", 1, unit="m"), vector("v", 1, unit="m/s"))
PROCESS = Process(
    rates=lambda x, _, w, __: {"r": x["v"], "v": w["a"]}, noise={"a": ("accel_psd", 1)}
)
RANGE = Observation(lambda x, _: x["r"], {"range": "m"})
SPEED = Observation(lambda x, _: x["v"], {"speed": "m/s"})


class Truth(NoisyComponent):
    """A car pushed about by white acceleration, from a drawn start."""

    default_rate = tf.Rate("0.1")
    sigma0 = tf.Parameter([10.0, 1.0], shape=(2,), unit=("m", "m/s"))
    accel_psd = tf.Parameter(0.04, unit="m^2/s^3")
    r = tf.Output((1,), unit="m")
    v = tf.Output((1,), unit="m/s")

    def build_model(self):
        r, v, dt, psd = (ca.SX.sym(n) for n in ("r", "v", "dt", "psd"))
        sigma0, w = ca.SX.sym("sigma0", 2), ca.SX.sym("w", 2)
        # exact: the two increments of white acceleration have this covariance's root
        root = ca.sqrt(psd * dt)
        dv = root * w[0]
        dr = root * dt * (w[0] / 2 + w[1] / np.sqrt(12))
        return Model(
            "truth",
            states={"r": r, "v": v},
            parameters={"sigma0": sigma0, "accel_psd": psd},
            noise={"w": w},
            initial={"r": sigma0[0] * w[0], "v": sigma0[1] * w[1]},
            next={"r": r + dt * v + dr, "v": v + dv},
            outputs={"r": r, "v": v},
            step=dt,
        )


class Sensor(NoisyComponent):
    """Measures a number with white noise."""

    default_rate = tf.Rate("1", offset="1")
    sigma = tf.Parameter(2.0)
    x = tf.Input((1,))
    fix = tf.MessageOutput(
        fields={"y": tf.Field((1,)), "R": tf.Field((1, 1)), "present": tf.Field((1,))}
    )

    def build_model(self):
        x, sigma, w = ca.SX.sym("x"), ca.SX.sym("sigma"), ca.SX.sym("w")
        return Model(
            "sensor",
            inputs={"x": x},
            parameters={"sigma": sigma},
            noise={"w": w},
            outputs={"fix.y": x + sigma * w, "fix.R": sigma**2, "fix.present": 1, "fix.valid": 1},
        )


class RangeSensor(Sensor):
    x = tf.Input((1,), unit="m")
    fix = tf.MessageOutput(
        fields={"y": tf.Field((1,), "m"), "R": tf.Field((1, 1)), "present": tf.Field((1,))}
    )


class SpeedSensor(Sensor):
    x = tf.Input((1,), unit="m/s")
    fix = tf.MessageOutput(
        fields={"y": tf.Field((1,), "m/s"), "R": tf.Field((1, 1)), "present": tf.Field((1,))}
    )


class TrackerPredict(FilterPredict):
    """Where the car is, and how fast."""

    default_rate = tf.Rate("0.1")
    error_state, process = STATE, PROCESS
    accel_psd = tf.Parameter(0.04, unit="m^2/s^3")
    r_sigma0 = tf.Parameter(10.0, unit="m")
    v_sigma0 = tf.Parameter(1.0, unit="m/s")


class RangeCorrect(FilterCorrect):
    """Corrects by a range."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, RANGE


class SpeedCorrect(FilterCorrect):
    """Corrects by a speed."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, SPEED


class TrackerEvaluation(FilterEvaluation):
    """Errors of the tracker."""

    default_rate = tf.Rate("1")
    error_state, observation = STATE, RANGE


class BothEvaluation(FilterEvaluation):
    """Errors of the tracker that has two sensors; NEES of the speed alone."""

    default_rate = tf.Rate("1")
    error_state, judged = STATE, ("v",)
    observations = {"range": RANGE, "speed": SPEED}  # noqa: RUF012
    called = {"r": "distance"}  # noqa: RUF012


def tracker(*, chain=False, every="1", predict=None, judge=None, speed_sigma=0.5, **sensor):
    with tf.System("tracker", duration="60", seed=3) as system:
        truth = system.add(Truth(), "truth")
        ranger = system.add(RangeSensor(**sensor), "ranger")
        predict = system.add(predict or TrackerPredict(), "predict")
        correct = system.add(RangeCorrect(), "correct")
        judge = system.add(judge or TrackerEvaluation(), "judge")
        system.connect(truth["r"], ranger["x"])
        system.connect(ranger["fix"], correct["fix"])
        system.connect(predict["prior"], correct["prior"])
        last = correct
        if chain:
            speeder = system.add(
                SpeedSensor(sigma=speed_sigma, rate=tf.Rate(every, offset=every)), "speeder"
            )
            last = system.add(SpeedCorrect(), "second")
            system.connect(truth["v"], speeder["x"])
            system.connect(speeder["fix"], last["fix"])
            system.connect(correct["estimate"], last["prior"])
            system.connect(correct["posterior"], last["earlier"])
        system.connect(last["posterior"], predict["posterior"])
        system.connect(last["estimate"], judge["estimate"])
        if "innovation" in judge.ports:
            system.connect(correct["innovation"], judge["innovation"])
        else:
            system.connect(correct["innovation"], judge["range_innovation"])
            system.connect(last["innovation"], judge["speed_innovation"])
        for name in ("r", "v"):
            system.connect(truth[name], judge[name])
    return system


def test_ports_follow_from_the_error_state():
    estimate = TrackerPredict().ports["prior"].fields
    assert {n: (f.shape, f.unit) for n, f in estimate.items()} == {
        "r": ((1,), "m"),
        "v": ((1,), "m/s"),
        "P": ((2, 2), "1"),
    }
    assert RangeCorrect().ports["innovation"].fields["residual"].unit == "m"
    assert RangeCorrect().settings()["gate"].shape == (1,)


def kalman(system_seconds, *, second=None):
    """Covariance of the tracker's error just after its last fix: by the textbook."""
    F, q = np.array([[1, 0.1], [0, 1]]), 0.04
    Q = q * np.array([[1e-3 / 3, 1e-2 / 2], [1e-2 / 2, 0.1]])
    P = np.diag([100.0, 1.0])
    for k in range(1, 10 * system_seconds + 1):
        P = F @ P @ F.T + Q
        sensors = [([[1.0, 0.0]], 4.0)] if k % 10 == 0 else []
        if second and k % (10 * second) == 0:
            sensors.append(([[0.0, 1.0]], 0.25))
        for H, R in sensors:
            H = np.array(H)
            K = P @ H.T / (H @ P @ H.T + R)
            P = (np.eye(2) - K @ H) @ P
    return P


@pytest.mark.parametrize("second", [None, 1, 3])
def test_the_covariance_is_the_textbook_s_and_the_errors_are_of_its_size(second):
    system = tracker(chain=second is not None, every=str(second or 1))
    result = tf.simulate(system, members=400)
    P = result.dataset["judge.covariance"].values[-1, 0]
    np.testing.assert_allclose(P, kalman(60, second=second), rtol=1e-9)
    low, high = result.evaluation["nees"]["interval_95"]
    nees = result.dataset["judge.nees"].values[10:]
    assert 0.9 < nees.mean() / 2 < 1.1
    assert np.mean((nees.mean(axis=1) > low) & (nees.mean(axis=1) < high)) > 0.8
    low, high = result.evaluation["nis"]["interval_95"]
    assert low - 0.02 < result.evaluation["nis"]["mean"] < high + 0.02


@pytest.mark.parametrize("weights", WEIGHTS)
def test_linear_covariance_takes_it_without_knowing_which(weights):
    """Robust weights are one where nothing is off, which is where it is linear."""
    system = tracker()
    system.find("correct").weights = weights
    found = linear_covariance(system)
    np.testing.assert_allclose(found.total[-1], kalman(60), rtol=1e-9)
    np.testing.assert_allclose(found.filter[-1], kalman(60), rtol=1e-9)
    assert [label.strip() for label in found.labels] == ["r", "v"]


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({}, "consistent"),
        ({"predict": lambda: TrackerPredict(accel_psd=0.01)}, "overconfident"),
        ({"predict": lambda: TrackerPredict(accel_psd=0.16)}, "conservative"),
    ],
)
def test_a_campaign_calls_it_by_its_name(settings, word):
    made = {name: make() for name, make in settings.items()}
    verdict = run_campaign(tracker(**made), runs=100, workers=1).verdicts["judge"]
    assert verdict.words[0] == word, verdict.text


def test_each_of_several_measurements_is_judged_by_its_own():
    """Ranges every second, speeds every third: 60 and 20 fixes, of one degree of freedom each."""
    system = tracker(chain=True, every="3", judge=BothEvaluation())
    result = tf.simulate(system, members=200)
    found = {
        name: result.dataset[f"judge.{name}"].values for name in system.find("judge").outputs()
    }
    counts = [np.isfinite(found[f"{name}_nis"]).sum() / 200 for name in ("range", "speed")]
    assert counts == [60, 20]
    both = np.where(np.isfinite(found["speed_nis"]), found["speed_nis"], 0.0)
    np.testing.assert_allclose(found["nis"], found["range_nis"] + both, rtol=1e-12)
    np.testing.assert_array_equal(found["nis_dof"][1:, 0], 20 * [1, 1, 2])
    np.testing.assert_array_equal(found["accepted"][1:], 1.0)  # of one fix, or of both
    z = found["normalized_innovation"]
    np.testing.assert_allclose(z[:, :, 0] ** 2, found["range_nis"], rtol=1e-9)
    np.testing.assert_allclose(z[:, :, 1] ** 2, found["speed_nis"], rtol=1e-9)
    # NEES of the speed alone: its error over its sigma, squared
    squared = (found["v_error"] / found["v_sigma"])[..., 0] ** 2
    np.testing.assert_allclose(found["nees"], squared, rtol=1e-9)
    assert result.evaluation["nees"]["dof"] == 1
    assert [fix["of"] for fix in result.evaluation["fixes"]][:4] == ["range"] * 3 + ["speed"]
    for name in ("nis", "range_nis", "speed_nis"):
        low, high = result.evaluation[name]["interval_95"]
        assert low - 0.02 < result.evaluation[name]["mean"] < high + 0.02
    assert "range: fixes 60, accepted 100.0%" in str(result)
    assert "speed: fixes 20, accepted 100.0%" in str(result)
    assert "NIS of range mean" in str(result)


def test_a_campaign_names_the_measurement_that_is_worse_than_it_says():
    """Speeds of sigma 1 that claim 0.25: their NIS is 9 or so, that of the ranges below 1.1."""

    class Boastful(SpeedSensor):
        def build_model(self):
            model = super().build_model()
            return Model(
                "boastful",
                inputs=model.inputs,
                parameters=model.parameters,
                noise=model.noise,
                outputs={**model.outputs, "fix.R": model.parameters["sigma"] ** 2 / 16},
            )

    sound = tracker(chain=True, every="3", judge=BothEvaluation())
    verdict = run_campaign(sound, runs=100, workers=1).verdicts["judge"]
    assert verdict.words[0] == "consistent", verdict.text
    bad = tracker(chain=True, every="3", judge=BothEvaluation())
    bad.replace("speeder", Boastful(sigma=1.0, rate=tf.Rate("3", offset="3")))
    campaign = run_campaign(bad, runs=100, workers=1)
    said = [f.text for f in campaign.verdicts["judge"].findings if f.text.startswith("NIS")]
    assert said
    assert said[0].startswith("NIS of speed is "), said
    assert "NIS of range" in str(campaign)
    assert campaign.summary()["evaluation"]["nees"]["dof"] == 1


def test_a_block_that_is_none_cannot_be_judged():
    with pytest.raises(ValueError, match=r"judged names 'w', which is no block .* are r, v"):

        class Wrong(FilterEvaluation):
            error_state, judged = STATE, ("w",)


def test_a_parameter_that_the_process_names_must_be_declared():
    class Forgetful(FilterPredict):
        default_rate = tf.Rate("0.1")
        error_state, process = STATE, PROCESS
        r_sigma0 = tf.Parameter(10.0, unit="m")
        v_sigma0 = tf.Parameter(1.0, unit="m/s")

    with pytest.raises(tf.SystemCheckError, match="parameter 'accel_psd' that Forgetful does"):
        tracker(predict=Forgetful()).check()


# ------------------------------------------------------------------------- late measurements

LATE_STATE = ErrorState(*STATE, clone(STATE.blocks[0], "center"))
LATE_RANGE = Observation(lambda x, _: x["r_at_center"], {"range": "m"}, instant="center")


class Mark(tf.Component):
    """Says when an aperture has its center."""

    default_rate = tf.Rate("1", offset="0.5")
    center = tf.MessageOutput(fields={"index": tf.Field(())})

    def _step_impl(self, t, dt):
        self.center.publish(t, index=0.0)


class LatePredict(TrackerPredict):
    """With a copy of the position at the center."""

    error_state, process = LATE_STATE, PROCESS


class LateCorrect(FilterCorrect):
    """Corrects by a range that was measured half a second ago."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = LATE_STATE, LATE_RANGE


class LateEvaluation(FilterEvaluation):
    """Of what is known now."""

    default_rate = tf.Rate("1")
    error_state, observation = LATE_STATE, LATE_RANGE


class Held(tf.Component):
    """Hands a message on half a second later, with the time it was measured at."""

    default_rate = tf.Rate("1", offset="1")
    fix = tf.MessageInput(fields=RangeSensor.declarations["fix"].fields)
    late = tf.MessageOutput(fields=RangeSensor.declarations["fix"].fields)
    shift = tf.Parameter(0.0, unit="s")

    def _step_impl(self, t, dt):
        fix = self.fix
        self.late.publish(
            fix.t + self.shift, valid=fix.fresh, y=fix.y, R=fix.R, present=fix.present
        )


def late(*, waits, shift="0 s", predict=None):
    """Ranges of half a second ago: by a clone, or with a filter that has them at once."""
    with tf.System("late", duration="30", seed=5) as system:
        truth = system.add(Truth(), "truth")
        ranger = system.add(RangeSensor(rate=tf.Rate("1", offset="0.5")), "ranger")
        system.connect(truth["r"], ranger["x"])
        if waits:
            predict = system.add(predict or LatePredict(), "predict")
            correct = system.add(LateCorrect(), "correct")
            judge = system.add(LateEvaluation(), "judge")
            held, mark = system.add(Held(shift=shift), "held"), system.add(Mark(), "mark")
            system.connect(ranger["fix"], held["fix"])
            system.connect(held["late"], correct["fix"])
            system.connect(mark["center"], predict["center"])
        else:
            predict = system.add(TrackerPredict(), "predict")
            correct = system.add(RangeCorrect(rate=tf.Rate("0.5", offset="0.5")), "correct")
            judge = system.add(TrackerEvaluation(), "judge")
            system.connect(ranger["fix"], correct["fix"])
        system.connect(predict["prior"], correct["prior"])
        system.connect(correct["posterior"], predict["posterior"])
        system.connect(correct["estimate"], judge["estimate"])
        system.connect(correct["innovation"], judge["innovation"])
        for name in ("r", "v"):
            system.connect(truth[name], judge[name])
    return system


def test_a_clone_equals_the_filter_that_had_the_measurement_in_time():
    """The same draws: the same errors and covariance once both have it."""
    cloned, timely = (tf.simulate(late(waits=w), members=5).dataset for w in (True, False))
    for name in ("r_error", "v_error", "covariance"):
        a, b = (
            d[f"judge.{name}"].sel(**{d[f"judge.{name}"].dims[0]: slice(1, None)}).values
            for d in (cloned, timely)
        )
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


class SmoothedPredict(LatePredict):
    """With its transition."""

    smoothed = True


def test_a_filter_with_a_clone_is_smoothed_and_consistent():
    """Of position and speed, two of three elements: means of 200 in their 99.9 % intervals."""
    system = late(waits=True, predict=SmoothedPredict())
    predict = system.find("predict")
    ports = [predict[n] for n in ("error_transition", "transition_since", "prior")]
    system.record("smoother", [*ports, system.find("correct")["estimate"]], period="1")
    result = tf.simulate(system, members=200)
    found = tf.smooth_run(result).dataset
    assert found.sizes["time"] == 31
    low, high = chi2.ppf([0.0005, 0.9995], 2 * 200) / 200
    record = tf.smooth_run(result)
    P = record.dataset["smoothed.P"].values[:, :, :2, :2]
    truth = {n: result.dataset[f"judge.{n}_error"].values for n in ("r", "v")}
    for k in (1, 10, 20, 29):
        error = np.concatenate(
            [
                record.dataset[f"smoothed.{n}"].values[k]
                - (result.dataset[f"correct.estimate.{n}"].values[k] - truth[n][k])
                for n in ("r", "v")
            ],
            axis=1,
        )
        nees = np.einsum("mi,mij,mj->m", error, np.linalg.inv(P[k]), error)
        assert low < nees.mean() < high, (k, nees.mean())
    assert (found["smoothed.sigma"].values[10] < 0.8 * found["filter.sigma"].values[10]).all()


def test_a_late_measurement_of_another_instant_is_not_taken():
    result = tf.simulate(late(waits=True, shift="0.1 s"))
    assert {fix["reason"] for fix in result.evaluation["fixes"]} == {"not of this instant"}


class Hopeful(FilterCorrect):
    """Corrects by what was measured at an instant that its state has no clone of."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, LATE_RANGE


def test_a_late_measurement_without_a_clone_is_refused():
    hopeful = Hopeful()
    with pytest.raises(ValueError, match=r"'center', of which there is no clone; .* none"):
        hopeful.build_model()


# ----------------------------------------------------------------------------- bad input


def refused(filter_class):
    """What the check of a system with a filter part says."""
    system = tracker()
    system.replace(
        "predict" if issubclass(filter_class, FilterPredict) else "correct", filter_class()
    )
    with pytest.raises(tf.SystemCheckError) as told:
        system.check()
    return str(told.value)


def test_a_measurement_of_a_block_that_is_none_is_refused_before_the_run():
    class Wrong(FilterCorrect):
        default_rate = tf.Rate("1", offset="1")
        error_state, observation = STATE, Observation(lambda x, _: x["w"], {"range": "m"})

    said = "'correct' cannot build its model: there is no block 'w'; the blocks are r, v"
    assert said in refused(Wrong)


def test_noise_of_another_size_is_refused_before_the_run():
    class Wrong(TrackerPredict):
        error_state = STATE
        process = Process(
            rates=lambda x, _, w, __: {"r": x["v"], "v": w["a"]}, noise={"a": ("accel_psd", 3)}
        )

    said = refused(Wrong)
    assert "moves 'v' by a rate of shape (3, 1); its error has 1 elements" in said
    assert "(its noise has: 'a' 3)" in said


def test_two_chains_cannot_feed_one_predict():
    system = tracker(chain=True)
    with pytest.raises(tf.WiringError, match=r"'predict.posterior' has two drivers\n  'second"):
        system.connect(system.find("correct")["posterior"], system.find("predict")["posterior"])


def test_a_gate_has_as_many_elements_as_the_measurement():
    with pytest.raises(tf.ConfigurationError, match=r"'gate' has shape \(2,\); it takes .* \(1,\)"):
        RangeCorrect(gate=[1.0, 2.0])


class Told(TrackerPredict):
    """Told where it starts."""

    error_state, process, told = STATE, PROCESS, ("r", "v")


class Start(tf.Component):
    """Tells members of one covariance each."""

    default_rate = tf.Rate(times=["0"])
    state = tf.MessageOutput(fields=Told.declarations["start"].fields)
    P: tuple = ()

    @property
    def publishes_at_start(self):
        return True

    def _initialize_impl(self):
        self.state.publish(0.0, r=[0.0], v=[0.0], P=np.array(self.P))

    def _step_impl(self, t, dt):
        pass


def test_a_covariance_that_is_none_at_the_start_fails_that_member_alone():
    """A correlation of 5, a variance below 0, an asymmetry; a singular one and zero are fine."""
    sound, wrong = [[4.0, 1.0], [1.0, 1.0]], [[1.0, 5.0], [5.0, 1.0]]
    singular, zero = [[4.0, 2.0], [2.0, 1.0]], np.zeros((2, 2))
    negative, crooked = [[-1e-12, 0.0], [0.0, 1.0]], [[4.0, 1.0], [0.5, 1.0]]
    system = tracker(predict=Told())
    start = system.add(Start(), "start")
    start.P = (sound, wrong, singular, zero, negative, crooked)
    system.connect(start["state"], system.find("predict")["start"])
    result = tf.simulate(system, members=6, duration="5")
    assert {e["member"]: e["reason"] for e in result.excluded} == {
        1: "the covariance in 'start' is not positive definite",
        4: "the covariance in 'start' is not positive definite",
        5: "the covariance in 'start' is not symmetric",
    }
    assert {e["component"] for e in result.excluded} == {"predict"}


def test_a_clone_that_was_not_made_yet_or_is_too_old_says_why():
    """Made at 20.5 s alone: of 30 fixes, each of half a second ago, the 21st is of that instant."""
    system = late(waits=True)
    system.replace("mark", Mark(rate=tf.Rate(times=["20.5"])))
    fixes = tf.simulate(system).evaluation["fixes"]
    accepted = [fix["t_s"] for fix in fixes if fix["reason"] == "accepted"]
    assert accepted == [21.0]
    assert {fix["reason"] for fix in fixes} == {"accepted", "not of this instant"}
    assert len(fixes) == 30


def test_a_filter_of_one_state_is_evaluated():
    """A random walk that is measured: its error has an axis like any other; NEES is chi-square."""
    one = ErrorState(vector("x", 1, unit="m"))

    class Walks:
        default_rate = tf.Rate("1")
        error_state, process = one, Process(walks={"x": "psd"})
        psd = tf.Parameter(1.0, unit="m^2/s")
        x_sigma0 = tf.Parameter(3.0, unit="m")

    class Seen:
        default_rate = tf.Rate("1", offset="1")
        error_state, observation = one, Observation(lambda x, _: x["x"], {"place": "m"})

    def made(*bases, **settings):
        return type(bases[-1].__name__[6:], bases, {"__doc__": "Own."})(**settings)

    with tf.System("one", duration="10", seed=2) as system:
        truth = system.add(made(Walks, tf.filters.FilterTruth), "truth")
        sensor = system.add(made(Seen, tf.filters.FilterSensor, sigma=2.0), "sensor")
        predict = system.add(made(Walks, FilterPredict), "predict")
        correct = system.add(made(Seen, FilterCorrect), "correct")
        judge = system.add(made(Seen, FilterEvaluation, rate=tf.Rate("1")), "judge")
        system.connect(truth["x"], sensor["x"])
        system.connect(truth["x"], judge["x"])
        system.connect(sensor["fix"], correct["fix"])
        system.connect(predict["prior"], correct["prior"])
        system.connect(correct["posterior"], predict["posterior"])
        system.connect(correct["estimate"], judge["estimate"])
        system.connect(correct["innovation"], judge["innovation"])
    found = tf.simulate(system, members=400).dataset
    low, high = chi2.ppf([0.0005, 0.9995], 400) / 400
    for epoch in (1, 5, 10):
        assert low < found["judge.nees"].values[epoch].mean() < high
    assert found["judge.x_error"].shape == (11, 400, 1)
