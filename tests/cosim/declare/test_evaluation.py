"""What evaluation components publish: intervals, sample statistics, consistency, failed members."""

import json

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.evaluation import Evaluation, Quantity, consistency
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.run import simulate


def test_consistency_of_chi_square_values():
    """Drawn as they should be they lie inside, drawn larger they do not; NaN is no value."""
    rng = np.random.default_rng(5)
    values = rng.chisquare(4, size=(200, 50))
    values[3] = np.nan  # an epoch without a fix
    values[10:, 7] = np.nan  # a member that failed
    found = consistency(values, 4, independent_epochs=True)
    assert found["mean"] == pytest.approx(np.nanmean(values), rel=1e-12)
    n = int(np.isfinite(values).sum())
    assert found["interval_95"] == list(chi_square_interval(4, n))
    # 199 independent epochs, each inside with probability 0.95: 4 standard deviations of 0.0154
    assert found["fraction_inside"] == pytest.approx(0.95, abs=0.062)
    assert consistency(1.3 * values, 4, independent_epochs=True)["fraction_inside"] < 0.5
    one = consistency(values, 4, independent_epochs=False)
    assert one["interval_95"] == list(chi_square_interval(4, 50))
    empty = consistency(np.full((3, 2), np.nan), 4, independent_epochs=True)
    assert empty == {"mean": None, "interval_95": None, "dof": 4, "fraction_inside": None}


class Truth(Component):
    default_rate = Rate("1")
    x = Output((2,), unit="m")

    def _step_impl(self, t, dt):
        self.x = 5.0 + 10.0 * self.normals("truth", 2)
        if self.step_index == 2:
            self.fail(self.environment.members == 3, "lost")


class Error(Evaluation):
    default_rate = Rate("1")
    x = Input((2,), unit="m")
    position_error = Output((2,), unit="m")
    position_sigma = Output((2,), unit="m")
    quantities = (Quantity("position", "m", ("x", "y")),)

    def _step_impl(self, t, dt):
        self.position_error = self.x
        self.position_sigma = 10.0


def evaluated(toys, **options):
    system = toys.wire(
        {"truth": Truth(), "nav": Error()}, ["truth.x -> nav.x"], duration=2, name="e"
    )
    return simulate(system, **options)


def test_evaluations_are_recorded_by_themselves_and_summarized(toys):
    result = evaluated(toys, members=400)
    found = result.evaluation["position"]
    last = result.dataset["nav.position_error"].values[-1]
    assert np.isnan(last[3]).all()
    kept = np.delete(last, 3, axis=0)
    assert found["unit"] == "m"
    assert found["axes"] == ["x", "y"]
    np.testing.assert_allclose(found["error"], kept.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found["sigma_sample"], kept.std(axis=0, ddof=1), rtol=1e-12)
    assert found["sigma_predicted"] == [10.0, 10.0]
    np.testing.assert_allclose(found["error"], 5, atol=4 * 10 / 20)  # 4 sigma of a mean of 400
    assert json.loads(result.dataset.attrs["evaluation"]) == result.evaluation


def test_one_member_has_no_sample_sigma_and_still_is_json(toys):
    found = evaluated(toys).evaluation
    assert found["position"]["sigma_sample"] == [None, None]
    assert json.dumps(found)


def test_predicted_sigma_is_the_root_mean_square_of_the_members(toys):
    """Of 1 and 7 m that is 5 m."""

    class UnevenError(Error):
        def _step_impl(self, t, dt):
            self.position_error = self.x
            self.position_sigma = (1.0 + 6.0 * self.environment.members)[:, None]

    system = toys.wire({"truth": Truth(), "nav": UnevenError()}, ["truth.x -> nav.x"], duration=1)
    found = simulate(system, members=2).evaluation["position"]["sigma_predicted"]
    assert found == [pytest.approx(5.0), pytest.approx(5.0)]


def test_several_evaluations_are_kept_apart_by_path(toys):
    parts = {"truth": Truth(), "ekf": Error(), "ukf": Error(rate=Rate(2))}
    system = toys.wire(parts, ["truth.x -> ekf.x", "truth.x -> ukf.x"], duration=2)
    found = simulate(system, members=5).evaluation
    assert set(found) == {"ekf", "ukf"}
    assert found["ekf"]["position"]["error"] == found["ukf"]["position"]["error"]
