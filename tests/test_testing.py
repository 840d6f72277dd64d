"""A component driven alone: every kind of input, and what is refused."""

import numpy as np
import pytest

import terrafix as tf

FIX = {"y": tf.Field((2,), "m"), "sigma": tf.Field((), "m")}


class Sum(tf.Component):
    """Adds what it reads: an input at either end of the step, and a bundle."""

    default_rate = tf.Rate("0.5")
    now = tf.Input(unit="m")
    before = tf.Input(unit="m", at="start", default=0.0)
    pair = tf.BundleInput({"a": tf.Field((), "m"), "b": tf.Field((2,), "m")}, optional=True)
    total = tf.State(unit="m", doc="of everything read at the end")
    y = tf.Output((2,), unit="m")

    def _initialize_impl(self):
        self.y = np.stack([self.now, np.zeros(self.n_members)], axis=1)

    def _step_impl(self, t, dt):
        self.total = self.total + self.now
        self.y = np.stack([self.now, self.before], axis=1)


class Echoing(tf.Component):
    """Says again what it was told, half a second older."""

    default_rate = tf.Rate("1")
    heard = tf.MessageInput(fields=FIX)
    said = tf.MessageOutput(fields=FIX)

    def _step_impl(self, t, dt):
        if self.heard.fresh.any():
            self.said.publish(
                self.heard.t - 0.5,
                valid=self.heard.fresh,
                y=2 * self.heard.y,
                sigma=self.heard.sigma,
            )


class Mapped(tf.Component):
    """Looks into a shared table, and keeps a window of samples."""

    default_rate = tf.Rate("1")
    table = tf.SharedInput((None,), unit="m")
    u = tf.WindowInput(unit="1")
    y = tf.Output(unit="m")

    def _initialize_impl(self):
        self.y = self.table[0]

    def _step_impl(self, t, dt):
        self.y = self.table[int(t)] + self.u.samples.sum(axis=1)


def test_what_is_given_for_a_step_is_what_that_step_reads():
    """At whichever end of the step it is read."""
    given = np.array([10.0, 1.0, 2.0, 3.0])
    driven = tf.testing.drive(Sum(), {"now": given, "before": given}, steps=3, members=2)
    assert driven.times.tolist() == [0.0, 0.5, 1.0, 1.5]
    expected = np.stack([given, [0.0, 1.0, 2.0, 3.0]], axis=1)
    assert np.array_equal(driven["y"], np.repeat(expected[:, None], 2, axis=1))
    assert driven["total"][:, 1].tolist() == [0.0, 1.0, 3.0, 6.0]


def test_functions_of_time_and_constants():
    driven = tf.testing.drive(Sum(), {"now": lambda t: t**2, "before": 7.0}, steps=4)
    assert driven["y"][:, 0, 0].tolist() == [0.0, 0.25, 1.0, 2.25, 4.0]
    assert driven["y"][1:, 0, 1].tolist() == [7.0] * 4


def test_messages_have_their_time_of_validity():
    told = {2.0: {"y": [1.0, 2.0], "sigma": 5.0}, 3.0: {"y": [3.0, 4.0], "sigma": 6.0}}
    driven = tf.testing.drive(Echoing(), {"heard": told}, steps=4, members=3)
    said = driven["said"]
    assert said.fresh[:, 2].tolist() == [False, False, True, True, False]
    assert said.t[2:, 0].tolist() == [1.5, 2.5, 2.5]
    assert said["y"][3, 1].tolist() == [6.0, 8.0]
    assert np.isnan(said["sigma"][1]).all()


def test_shared_values_and_windows():
    table = np.array([100.0, 200.0, 300.0])
    driven = tf.testing.drive(Mapped(), {"table": table, "u": 1.0}, steps=2)
    assert driven["y"][:, 0].tolist() == [100.0, 201.0, 301.0]


def test_a_component_of_the_library():
    """The IMU's increments scatter by its random walk times the root of the step."""
    imu = tf.components.imu(velocity_random_walk="0.01 m/s/s^0.5")
    still = {"delta_v_b_true": np.zeros(3), "delta_theta_b_true": np.zeros(3)}
    driven = tf.testing.drive(imu, still, steps=400, members=16, seed=3)
    # 16 x 400 x 3 numbers: their spread is known to 1 / sqrt(2 x 19200) = 0.5 %
    assert driven["delta_v_b"][1:].std() == pytest.approx(0.01 * 0.1, rel=0.02)


def test_who_fails_is_named():
    class Fragile(Sum):
        def _step_impl(self, t, dt):
            self.fail(np.arange(self.n_members) == 1, "fell over")

    driven = tf.testing.drive(Fragile(), {"now": 0.0}, steps=2, members=3)
    assert driven.failed == {1: "fell over"}


@pytest.mark.parametrize(
    ("component", "inputs", "options", "error", "said"),
    [
        (Sum(), {"nwo": 1.0}, {}, tf.WiringError, "Sum has no input 'nwo'\n  did you mean 'now'"),
        (Sum(), {"now": [1.0, 2.0]}, {"steps": 4}, tf.ConfigurationError, r"give one value, or 5"),
        (Sum(), {"now": lambda t: [t, t]}, {}, tf.ConfigurationError, r"shape \(\), got \(2,\)"),
        (Sum(), {"now": 1.0, "pair": 2.0}, {}, tf.ConfigurationError, "a bundle of a, b"),
        (Sum(), {}, {}, tf.SystemCheckError, "input 'driven.now' is not connected"),
        (Sum(), {"now": 1.0}, {"steps": 0}, tf.ConfigurationError, "steps is 0"),
        (Sum, {"now": 1.0}, {}, tf.ConfigurationError, "drive takes a component"),
        (
            Sum(),
            [1.0],
            {},
            tf.ConfigurationError,
            "inputs is .* by the names .*\n  now, before, pair",
        ),
        (Sum(), {"now": "3 km"}, {}, tf.ConfigurationError, "'now' takes float64 in m, got '3 km'"),
        (Sum(), {"now": None}, {}, tf.ConfigurationError, "takes float64 in m, got None"),
        (Sum(), {"now": [[1], [2, 3]]}, {}, tf.ConfigurationError, "got uneven rows"),
        (Echoing(), {"heard": {9.0: {}}}, {}, tf.ConfigurationError, "comes at 9.0\n.* 0 to 1 s"),
        (Echoing(), {"heard": {"x": {}}}, {}, tf.ConfigurationError, "comes at 'x'"),
        (
            Echoing(),
            {"heard": {1.0: {"y": [1, 2], "sigma": "a"}}},
            {},
            tf.ConfigurationError,
            "field 'sigma' takes float64 in m, got 'a'",
        ),
        (Echoing(), {"heard": 1.0}, {}, tf.ConfigurationError, "by the time when they come"),
        (
            Echoing(),
            {"heard": {1.0: {"y": [1, 2]}}},
            {},
            tf.ConfigurationError,
            "has the fields y, sigma",
        ),
        (
            Sum(rate=tf.Rate(times=["1", "2"])),
            {"now": 1.0},
            {"steps": 3},
            tf.RateError,
            "it steps 2 times in all",
        ),
    ],
)
def test_what_cannot_be_driven_is_refused(component, inputs, options, error, said):
    with pytest.raises(error, match=said):
        tf.testing.drive(component, inputs, **{"steps": 1, **options})
