"""A monitor's statistics against their definitions, and their rates against published tables."""

import numpy as np
import pytest
from scipy.stats import chi2

from terrafix.models.filters.measurement import REASONS
from terrafix.models.filters.monitor import ALARMS, monitor_model

DEFAULTS = {"allowance": 0.5, "decision_interval": 5.0}


class Flown:
    """A monitor of many members, stepped by innovations."""

    def __init__(self, model, members, **settings):
        function = model.step_function()
        self.names, self.results = function.name_in(), function.name_out()
        self.function, self.members = function.map(members), members
        self.state = {
            key: np.zeros((symbol.numel(), members)) for key, symbol in model.states.items()
        }
        self.settings = DEFAULTS | settings

    def step(self, z, **given):
        """Feed normalized innovations (m, members), uncorrelated, all elements measured."""
        z = np.atleast_2d(z)
        given = {
            "residual": z,
            "sigma": np.full_like(z, 2.0),
            "nis": (z**2).sum(axis=0),
            "dof": len(z),
            "reason": 0,
            "fresh": 1,
        } | given
        given["residual"] = np.asarray(given["residual"]) * np.where(given["sigma"] == 1.0, 1, 2)
        values = {f"innovation_{k}": v for k, v in given.items()} | self.settings | self.state
        rows = [
            np.broadcast_to(values[n], (self.function.size1_in(i), self.members))
            for i, n in enumerate(self.names)
        ]
        out = dict(zip(self.results, map(np.asarray, self.function.call(rows)), strict=True))
        self.state = {key: out[f"next_{key}_"] for key in self.state}
        return {k.rstrip("_"): v for k, v in out.items() if not k.startswith("next_")}


def one(z, model=None, **settings):
    """Step one member by rows of normalized innovations; outputs with a row for each."""
    flown = Flown(model or monitor_model("m", len(z[0]), 3, 0.01), 1, **settings)
    found = [flown.step(np.reshape(row, (-1, 1))) for row in z]
    return {k: np.array([f[k].ravel() for f in found]).squeeze() for k in found[0]}


def test_the_sums_are_those_of_the_definition():
    """k = 0.5, h = 3: 0.5, 2.0, 1.5, 3.5 (alarm), then from 0: 0.5; and the other side."""
    z = np.array([1.0, 2.0, 0.0, 2.5, 1.0, -4.0, -1.0])
    found = one(z[:, None], monitor_model("m", 1, 3, 1e-9), decision_interval=3.0)
    assert found["mean_high"].tolist() == [0.5, 2.0, 1.5, 3.5, 0.5, 0.0, 0.0]
    assert found["mean_low"].tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 3.5, 0.5]
    assert found["alarm_valid"].tolist() == [0, 0, 0, 1, 0, 1, 0]
    assert found["alarms"][-1].tolist() == [0, 1, 1]
    for at, test in ((3, "mean high"), (5, "mean low")):
        assert ALARMS[int(found["alarm_test"][at])] == test
        assert (found["alarm_statistic"][at], found["alarm_threshold"][at]) == (3.5, 3.0)
        assert found["alarm_element"][at] == 0


def test_the_window_is_the_last_fixes_and_starts_anew_after_an_alarm():
    """Three fixes of two elements: 6 degrees of freedom, of which 16.81 leaves 0.01."""
    squares = np.array([1.0, 4.0, 9.0, 2.0, 8.0, 1.0, 1.0, 1.0])
    z = np.column_stack([np.sqrt(squares / 2)] * 2)
    z[1::2] *= -1  # no mean
    found = one(z, decision_interval=100.0)
    assert found["chi_square"] == pytest.approx([1, 5, 14, 15, 19, 1, 2, 3])
    assert found["chi_square_dof"].tolist() == [2, 4, 6, 6, 6, 2, 4, 6]
    assert found["alarm_valid"].tolist() == [0, 0, 0, 0, 1, 0, 0, 0]
    assert found["alarm_element"][4] == -1
    assert found["alarm_threshold"][4] == pytest.approx(16.812, abs=5e-4)  # any table
    assert found["alarm_statistic"][4] == pytest.approx(19.0)
    assert found["alarms"][-1].tolist() == [1, 0, 0]


def test_thresholds_are_the_quantiles_for_every_number_of_elements():
    model = monitor_model("m", 3, 4, 1e-4)
    for dofs in ([3, 3, 3, 3], [1, 2, 3, 1], [1, 1, 1, 1], [3, 0, 0, 0]):
        flown = Flown(model, 1)
        flown.state["dofs"] = np.array(dofs, dtype=float)[:, None]
        flown.step(np.zeros((3, 1)), fresh=0)
        found = flown.step(np.zeros((3, 1)), fresh=0)["chi_square_threshold"].item()
        assert found == pytest.approx(chi2.isf(1e-4, sum(dofs)), rel=1e-12)


def test_absent_elements_are_left_as_they_are():
    """The second element is measured in every other fix; its sums have half the steps."""
    flown = Flown(monitor_model("m", 2, 3, 0.01), 1)
    for step in range(4):
        both = step % 2 == 0
        given = (
            {}
            if both
            else {"residual": [[1.0], [0.0]], "sigma": [[2.0], [1.0]], "nis": 1.0, "dof": 1}
        )
        out = flown.step([[1.0], [1.0]], **given)
    assert out["mean_high"].ravel() == pytest.approx([2.0, 1.0])
    assert out["chi_square_dof"].item() == 1 + 2 + 1


def test_an_element_that_is_absent_after_its_alarm_gives_no_other():
    flown = Flown(monitor_model("m", 2, 3, 1e-9), 1)
    assert flown.step([[0.0], [6.0]])["alarm_element"].item() == 1
    absent = {"residual": [[0.0], [0.0]], "sigma": [[2.0], [1.0]], "nis": 0.0, "dof": 1}
    out = flown.step([[0.0], [0.0]], **absent)
    assert (out["alarm_valid"].item(), out["alarms"].ravel().tolist()) == (0, [0, 1, 0])
    assert flown.step([[0.0], [1.0]])["mean_high"].ravel().tolist() == [0.0, 0.5]


@pytest.mark.parametrize("reason", REASONS)
def test_what_the_gate_refused_counts_and_what_says_nothing_does_not(reason):
    flown = Flown(monitor_model("m", 1, 1, 0.01), 1)
    out = flown.step([[9.0]], reason=REASONS.index(reason))
    counts = reason in ("accepted", "gate")
    assert out["alarm_valid"].item() == counts
    assert out["mean_high"].item() == (8.5 if counts else 0.0)
    assert out["chi_square"].item() == (81.0 if counts else 0.0)


def test_an_alarm_is_given_once_though_its_statistic_stands_until_the_next_fix():
    flown = Flown(monitor_model("m", 1, 1, 0.01), 1)
    assert flown.step([[9.0]])["alarm_valid"].item() == 1
    idle = flown.step([[9.0]], fresh=0)
    assert (idle["alarm_valid"].item(), idle["mean_high"].item()) == (0, 8.5)
    assert idle["alarms"].ravel().tolist() == [1, 1, 0]
    after = flown.step([[0.1]])
    assert (after["alarm_valid"].item(), after["mean_high"].item()) == (0, 0.0)


def test_of_several_alarms_the_furthest_beyond_its_threshold_is_told():
    """z = (3, -9): sums 2.5 and 8.5 over 2 (ratio 4.25), 90 over 9.21 (9.8); then without."""
    model = monitor_model("m", 2, 1, 0.01)
    found = one([[3.0, -9.0]], model, decision_interval=2.0)
    assert found["alarm_test"] == ALARMS.index("chi-square")
    found = one([[3.0, -9.0]], model, decision_interval=0.5)
    assert (found["alarm_test"], found["alarm_element"]) == (ALARMS.index("mean low"), 1)
    assert found["alarms"].tolist() == [1, 1, 1]


def test_a_fix_at_the_start_counts():
    model = monitor_model("m", 1, 2, 0.01)
    function = model.initial_function()
    values = {"innovation_residual": 3.0, "innovation_sigma": 2.0, "innovation_nis": 2.25}
    values |= {"innovation_dof": 1, "innovation_fresh": 1} | DEFAULTS
    found = function.call([values.get(n, 0.0) for n in function.name_in()])
    out = dict(zip(function.name_out(), map(np.asarray, found), strict=True))
    assert out["mean_high_"].item() == 1.0
    assert out["chi_square_"].item() == 2.25


# ------------------------------------------------------------------------- rates


@pytest.mark.parametrize("window", [1, 8])
@pytest.mark.parametrize("false_alarm", [0.01, 0.1])
def test_sound_windows_give_as_many_alarms_as_was_stated(window, false_alarm):
    """The first full window of each member: disjoint, of 1 to 3 elements a fix, drawn.

    A share p of n windows has a sigma of sqrt(p (1 - p) / n): within four.
    """
    members, rng = 40_000, np.random.default_rng(3)
    flown = Flown(monitor_model("m", 3, window, false_alarm), members, decision_interval=1e6)
    for _ in range(window):
        present = rng.random((3, members)) < 0.6
        present[rng.integers(3, size=members), np.arange(members)] = True
        z = rng.normal(size=(3, members)) * present
        out = flown.step(
            z,
            sigma=np.where(present, 2.0, 1.0),
            dof=present.sum(axis=0),
            nis=(z**2).sum(axis=0),
        )
    share = out["alarm_valid"].mean()
    assert abs(share - false_alarm) < 4 * np.sqrt(false_alarm * (1 - false_alarm) / members)


def test_the_normalized_squares_of_sound_fixes_give_alarms_at_the_rate_in_the_long_run():
    """A window of one: every fix is a window, alarms start it anew, 500 of each of 100 members."""
    members, steps, p, rng = 100, 500, 0.02, np.random.default_rng(4)
    flown = Flown(monitor_model("m", 2, 1, p), members, decision_interval=1e6)
    for _ in range(steps):
        out = flown.step(rng.normal(size=(2, members)))
    n = members * steps
    assert abs(out["alarms"][0].sum() / n - p) < 4 * np.sqrt(p * (1 - p) / n)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((1, 5, 0.0), "false_alarm must be between 0 and 1, got 0.0"),
        ((1, 5, 1.0), "false_alarm must be between 0 and 1, got 1.0"),
        ((1, 0, 0.1), "a monitor of 1 elements over 0 fixes has nothing to test"),
        ((0, 5, 0.1), "a monitor of 0 elements over 5 fixes has nothing to test"),
    ],
)
def test_what_cannot_be_tested_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        monitor_model("m", *arguments)
