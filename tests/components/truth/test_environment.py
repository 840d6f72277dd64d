"""The environment: what is published is the chain of the epoch, to the end of the run."""

import sys

import numpy as np
import pytest

import terrafix as tf
from terrafix.components.fields import ENVIRONMENT
from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.models.core.iers import date_of, orientation_table
from terrafix.models.core.timescales import parse_epoch
from terrafix.models.motion.bodies import environment_at


class Reader(tf.Component):
    """Reads the surroundings by members, at the start of its step."""

    default_rate = tf.Rate("1")
    surroundings = tf.BundleInput(ENVIRONMENT, at="start")
    age = tf.Output(unit="s")

    def _initialize_impl(self):
        self.age = 0.0

    def _step_impl(self, t, dt):
        self.age = t - self.surroundings.time
        assert all(getattr(self.surroundings, n).shape[0] == self.n_members for n in ENVIRONMENT)


def surrounded(epoch, duration=30, **options):
    system = tf.System("surrounded", epoch=epoch, duration=duration)
    system.add(tf.components.environment(**options), "environment")
    reader = system.add(Reader(), "reader")
    system.connect("environment.surroundings", "reader.surroundings")
    system.record("world", ["environment.surroundings"], period=10)
    system.record("age", [reader["age"]], period=1)
    return system


def test_every_publication_is_the_chain_of_its_time_across_a_leap_second():
    epoch = "2016-12-31T23:59:50 UTC"
    data = simulate(surrounded(epoch), members=3).dataset
    instants = parse_epoch(epoch).plus(np.arange(4) * 10.0)
    expected = environment_at(instants) | {"time": np.arange(4) * 10.0}
    for name in ENVIRONMENT:
        found = data[f"environment.surroundings.{name}"].to_numpy()
        for member in range(3):
            np.testing.assert_allclose(found[:, member], expected[name], rtol=1e-14, atol=1e-16)


def test_it_is_read_at_its_age():
    """Published every 10 s, and read at the start of a step: 1 to 10 s old."""
    age = simulate(surrounded("2022-09-18T07:49:21 UTC")).dataset["reader.age"].to_numpy()[1:, 0]
    np.testing.assert_array_equal(age, [*range(1, 11)] * 3)


def test_without_an_epoch_it_says_how_to_give_one():
    with pytest.raises(SystemCheckError, match=r'needs to know what time(.|\n)*epoch = "2022'):
        surrounded(None).check()


@pytest.mark.parametrize(
    ("epoch", "said"),
    [
        ("2099-01-01T00:00:00 TAI", "reaches from 1973-01-02 to the start of 20"),
        ("1972-06-01T00:00:00 UTC", "reaches from 1973-01-02 to the start of 20"),
        ("2022-09-18T07:49:21.5", "has no time scale"),
        ("2015-12-31T23:59:60 UTC", "does not exist: there was no leap second"),
    ],
)
def test_what_is_refused_once_before_the_first_step(epoch, said):
    with pytest.raises(SystemCheckError, match=said) as caught:
        surrounded(epoch).check()
    assert len(caught.value.problems) == 1


def test_a_run_that_leaves_the_tables_is_refused_before_it_starts():
    last = date_of(orientation_table().day[-1] - 1)
    epoch = f"{last}T23:00:00 UTC"
    surrounded(epoch, duration=3000).check()
    with pytest.raises(
        SystemCheckError, match=f"reaches from 1973-01-02 to the start of {last[:7]}"
    ):
        surrounded(epoch, duration=4000).check()


def test_without_the_extra_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "erfa", None)
    with pytest.raises(
        SystemCheckError, match=r"'erfa', which is not installed\n.*terrafix\[truth"
    ):
        surrounded("2022-09-18T07:49:21 UTC").check()
