"""A monitor in a system: run lengths of the tables, a tracker's biased sensor, FMU, checkpoint."""

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf
from terrafix.components.filters.family import FilterCorrect, FilterPredict
from terrafix.components.filters.mekf import MekfCorrect
from terrafix.components.filters.monitor import FilterMonitor
from terrafix.components.noisy import NoisyComponent
from terrafix.models.core.model import Model
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.measurement import REASONS, Observation
from terrafix.models.filters.monitor import ALARMS
from terrafix.models.filters.process import Process
from terrafix.models.filters.spacecraft import sar_observation
from terrafix.testing import drive

STATE = ErrorState(vector("r", 1, unit="m"), vector("v", 1, unit="m/s"))
PROCESS = Process(
    rates=lambda x, _, w, __: {"r": x["v"], "v": w["a"]}, noise={"a": ("accel_psd", 1)}
)
RANGE = Observation(lambda x, _: x["r"], {"range": "m"})


class Monitor(FilterMonitor):
    """Of the range's innovations."""

    default_rate = tf.Rate("1", offset="1")
    observation = RANGE
    false_alarm = 1e-12


class White(NoisyComponent):
    """White innovations of a mean, given in sigmas; sigma is 2 m."""

    default_rate = tf.Rate("1", offset="1")
    shift = tf.Parameter(0.0)
    innovation = tf.MessageOutput(fields=Monitor.declarations["innovation"].fields)

    def build_model(self):
        shift, w = ca.SX.sym("shift"), ca.SX.sym("w")
        z = shift + w
        fields = {"residual": 2 * z, "sigma": 2, "nis": z**2, "dof": 1, "accepted": 1, "reason": 0}
        return Model(
            "white",
            parameters={"shift": shift},
            noise={"w": w},
            outputs={f"innovation.{k}": v for k, v in fields.items()} | {"innovation.valid": 1},
        )


def watched(duration, *, shift=0.0, record=(), monitor=Monitor, **settings):
    with tf.System("watched", duration=duration, seed=8) as system:
        white = system.add(White(shift=shift), "white")
        system.add(monitor(**settings), "monitor")
        system.connect(white["innovation"], "monitor.innovation")
        if record:
            system.record("own", [f"monitor.{name}" for name in record], period=duration)
    return system


@pytest.mark.parametrize(("h", "published"), [(5.0, 465.0), (4.0, 168.0)])
def test_the_run_length_without_a_shift_is_that_of_the_tables(h, published):
    """Montgomery's table of the two-sided sum, k = 0.5.

    In T fixes there are T / ARL alarms (a renewal process). Run lengths are all but exponential,
    so their number n has a sigma of sqrt(n): 4000 members of 2000 fixes give 17,000 and 48,000
    alarms, 0.8 % and 0.5 %; four of them, and what T / ARL leaves out: a run begins at zero, which
    costs (1 - (sigma / mean)^2) / 2 of an alarm for each member.
    """
    members, steps = 4000, 2000
    system = watched(str(steps), record=["alarms"], decision_interval=h)
    alarms = tf.simulate(system, members=members).dataset["monitor.alarms"].values[-1]
    n = alarms[:, 1:].sum()
    assert alarms[:, 0].sum() == 0
    assert members * steps / n == pytest.approx(published, rel=4 / np.sqrt(n) + 0.005)
    high, low = alarms[:, 1].sum(), alarms[:, 2].sum()
    assert abs(high - low) < 4 * np.sqrt(n)


def first_alarm(dataset):
    """Fixes until the first alarm of a mean, by member."""
    counts = dataset["monitor.alarms"].values[..., 1:].sum(axis=-1)
    assert (counts[-1] > 0).all()
    return 1 + np.argmax(counts > 0, axis=0)


def run_length(system, members):
    system.record("own", ["monitor.alarms"], rate=tf.Rate("1", offset="1"))
    return first_alarm(tf.simulate(system, members=members).dataset)


@pytest.mark.parametrize(("h", "published", "rounded"), [(5.0, 10.4, 0.05), (4.0, 8.38, 0.005)])
def test_the_run_length_at_a_shift_of_one_sigma_is_that_of_the_tables(h, published, rounded):
    lengths = run_length(watched("120", shift=1.0, decision_interval=h), 10_000)
    error = lengths.std() / np.sqrt(len(lengths))
    assert error < 0.06
    assert abs(lengths.mean() - published) < 4 * error + rounded


# ------------------------------------------------------------------------- of a tracker


class Car(NoisyComponent):
    """Goes at a constant speed, measured with noise and a bias."""

    default_rate = tf.Rate("1", offset="1")
    sigma = tf.Parameter(2.0, unit="m")
    factor = tf.Parameter(1.0, doc="of the noise, over what is reported")
    bias = tf.Parameter(0.0, unit="m")
    fix = tf.MessageOutput(
        fields={"y": tf.Field((1,), "m"), "R": tf.Field((1, 1)), "present": tf.Field((1,))}
    )

    def build_model(self):
        names = ("sigma", "factor", "bias", "w", "time")
        sigma, factor, bias, w, time = (ca.SX.sym(n) for n in names)
        y = 3.0 * time + bias + factor * sigma * w
        return Model(
            "car",
            parameters={"sigma": sigma, "factor": factor, "bias": bias},
            noise={"w": w},
            outputs={"fix.y": y, "fix.R": sigma**2, "fix.present": 1, "fix.valid": 1},
            time=time,
        )


class Predict(FilterPredict):
    """Knows the car well."""

    default_rate = tf.Rate("1")
    error_state, process, told = STATE, PROCESS, ("r", "v")
    accel_psd = tf.Parameter(1e-9, unit="m^2/s^3")


class Known(tf.SymbolicComponent):
    """Where the car is at t = 0."""

    default_rate = tf.Rate("1000")
    publishes_at_start = True
    start = tf.MessageOutput(fields=Predict.declarations["start"].fields)

    def build_model(self):
        told = {"r": 0, "v": 3, "P": ca.diag(ca.DM([1e-4, 1e-8]))}
        return Model("known", outputs={f"start.{k}": ca.SX(v) for k, v in told.items()})


class Correct(FilterCorrect):
    """Corrects it by a range."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, RANGE


def tracker(duration="100", *, monitor=None, correct=None, **sensor):
    with tf.System("tracker", duration=duration, seed=9) as system:
        known = system.add(Known(), "known")
        car = system.add(Car(**sensor), "car")
        predict = system.add(Predict(), "predict")
        correct = system.add(correct or Correct(), "correct")
        system.add(monitor or Monitor(), "monitor")
        system.connect(known["start"], predict["start"])
        system.connect(car["fix"], correct["fix"])
        system.connect(predict["prior"], correct["prior"])
        system.connect(correct["posterior"], predict["posterior"])
        system.connect(correct["innovation"], "monitor.innovation")
    return system


@pytest.mark.parametrize("gate", [np.inf, 1e-9])
@pytest.mark.parametrize("side", [1, -1])
def test_a_bias_of_the_sensor_is_found_within_the_run_length_of_the_tables(gate, side):
    """A bias of one sigma, S = R: 10.4 fixes, and also where a gate refuses all of them.

    The prior's variance is below 2e-4 m^2 throughout: it takes up 5e-5 of the bias with each fix,
    1.5e-3 in 30, on which the run length depends by less than 0.02.
    """
    system = tracker(bias=2.0 * side, correct=Correct(gate=gate))
    lengths = run_length(system, 4000)
    error = lengths.std() / np.sqrt(len(lengths))
    assert abs(lengths.mean() - 10.4) < 4 * error + 0.05 + 0.02


def test_noise_of_ten_times_the_sigma_is_found_by_its_squares_though_all_fixes_are_refused():
    """The sum of four squares is 100 times chi-square: beyond q where that is beyond q / 100.

    So 0.96 of the members give an alarm with the fourth fix, within four sigma of such a share.
    """
    members, q = 2000, chi2.isf(1e-12, 4)
    system = tracker("4", correct=Correct(gate=1e-9), monitor=Monitor(window=4), factor=10.0)
    system.record("own", ["monitor.alarms", "correct.innovation"], rate=tf.Rate("1", offset="1"))
    out = tf.simulate(system, members=members).dataset
    alarms = out["monitor.alarms"].values[..., 0]
    assert not alarms[:-1].any()
    assert np.nanmax(out["correct.innovation.accepted"].values) == 0
    share = chi2.sf(q / 100, 4)
    assert share < 0.99  # not all: a number to be met
    assert abs(alarms[-1].mean() - share) < 4 * np.sqrt(share * (1 - share) / members)


# ------------------------------------------------------------------------- as a component


def innovation(z, *, reason="accepted"):
    fields = {"residual": [2 * z], "sigma": [2.0], "nis": z**2, "dof": 1.0}
    return fields | {"accepted": float(reason == "accepted"), "reason": REASONS.index(reason)}


def test_an_alarm_is_a_message_that_says_which_test_and_which_way():
    """z = -3 in every fix: 2.5 a fix, beyond 5 with the third; the message comes then, and again
    three fixes later."""
    given = {t: innovation(-3.0, reason="gate" if t % 2 else "accepted") for t in range(1, 8)}
    out = drive(Monitor(), {"innovation": given}, steps=7)
    alarm = out["alarm"]
    assert alarm.fresh.ravel().tolist() == [t in (3, 6) for t in range(8)]
    assert ALARMS[int(alarm["test"][3].item())] == "mean low"
    assert (alarm["element"][3].item(), alarm["statistic"][3].item()) == (0, 7.5)
    assert alarm["threshold"][3].item() == 5.0
    assert alarm.t[3].item() == 3.0
    assert out["mean_low"].ravel().tolist() == [0, 2.5, 5, 7.5, 2.5, 5, 7.5, 2.5]


def test_ports_follow_from_the_observation():
    """It takes the innovations of any correction, the spacecraft's too."""

    class Fixes(FilterMonitor):
        default_rate = tf.Rate("8.2", offset="8.2")
        observation = sar_observation()

    assert Fixes().ports["mean_high"].fields[""].labels == tuple(sar_observation().elements)
    with tf.System("spacecraft") as system:
        correct, monitor = system.add(MekfCorrect(look=0.5), "c"), system.add(Fixes(), "m")
        system.connect(correct["innovation"], monitor["innovation"])


@pytest.mark.parametrize("kernel", ["vm", "c"])
def test_every_kernel_gives_the_same_bytes(kernel, monkeypatch):
    names = ["chi_square", "chi_square_threshold", "mean_high", "mean_low", "alarms"]

    def fly():
        system = watched("50", monitor=Touchy, window=3)
        system.record("own", [f"monitor.{n}" for n in names], rate=tf.Rate("1", offset="1"))
        system.record("alarm", ["monitor.alarm"])
        return tf.simulate(system, members=7).dataset

    one = fly()
    monkeypatch.setenv("TERRAFIX_KERNEL", kernel)
    other = fly()
    assert one["monitor.alarms"].values[-1].sum(axis=0).min() > 0  # of every kind
    for name in one.data_vars:
        assert np.array_equal(one[name].values, other[name].values, equal_nan=True), name


class Touchy(Monitor):
    """Gives many alarms of every kind."""

    observation = RANGE
    false_alarm = 0.1
    decision_interval = tf.Parameter(1.0, positive=True)


@pytest.mark.parametrize("fmi", [2, 3])
def test_as_an_fmu_it_gives_the_same_bytes(tmp_path, fmi):
    tf.export_fmu(Touchy(window=3), tmp_path / "monitor.fmu", fmi=fmi)
    runs = []
    for monitor in (
        Touchy(window=3),
        tf.components.fmu(file=tmp_path / "monitor.fmu", rate=tf.Rate("1", offset="1")),
    ):
        with tf.System("watched", duration="50", seed=8) as system:
            white = system.add(White(), "white")
            system.add(monitor, "monitor")
            system.connect(white["innovation"], "monitor.innovation")
            names = ["chi_square", "mean_high", "mean_low", "alarms"]
            system.record("own", [f"monitor.{n}" for n in names], rate=tf.Rate("1", offset="1"))
            system.record("alarm", ["monitor.alarm"])
        runs.append(tf.simulate(system, members=3).dataset)
    native, flown = runs
    assert native["monitor.alarms"].values[-1].sum(axis=0).min() > 0
    for name in native.data_vars:
        assert np.array_equal(native[name].values, flown[name].values, equal_nan=True), name


def test_it_goes_on_from_a_saved_state_as_if_it_had_not_stopped():
    whole, first, second = (
        tf.Simulation(watched("40", monitor=Touchy, window=3), members=5) for _ in range(3)
    )
    whole.run_until("40")
    first.run_until("17")
    second.set_state(first.get_state())
    second.run_until("40")
    for port in ("alarms", "mean_high", "mean_low", "chi_square", "alarm"):
        a, b = (s.master.wiring.slots[f"monitor.{port}"].data for s in (whole, second))
        assert np.array_equal(a, b, equal_nan=True), port


def test_a_share_that_is_none_is_refused():
    class Certain(Monitor):
        observation = RANGE
        false_alarm = 1.0

    with pytest.raises(ValueError, match=r"false_alarm must be between 0 and 1, got 1\.0"):
        Certain().build_model()
    with pytest.raises(tf.ConfigurationError, match="it must be at least 1"):
        Monitor(window=0)
