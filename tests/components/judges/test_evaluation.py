"""Evaluation of a filter: errors, sigma, NEES and NIS in closed form, of what was accepted."""

import numpy as np
import pytest
from scipy.stats import chi2

from terrafix.components.fields import ESTIMATE, INNOVATION
from terrafix.components.judges.evaluation import NavigationEvaluation
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import BundleOutput, MessageOutput, Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.system.system import System
from terrafix.models.filters.measurement import REASONS

SIGMA = np.array([100.0, 200.0, 300.0, 1.0, 2.0, 3.0, 1e-3, 2e-3, 3e-3])
ERROR = np.array([1.0, -2.0, 0.5])  # in sigma, of position, velocity and misalignment alike


class Filter(Component):
    """An estimate that is off by some sigma, and the innovations of its fixes."""

    r_e = Output((3,), unit="m", frame="e")
    v_e = Output((3,), unit="m/s", frame="e")
    q_mu = Output((4,), unit="1", frame="s")
    estimate = BundleOutput(ESTIMATE)
    innovation = MessageOutput(fields=INNOVATION)
    fixes: tuple = ()

    def _initialize_impl(self):
        self.r_e, self.v_e, self.q_mu = 0.0, 0.0, [0.0, 0.0, 0.0, 1.0]
        off = np.tile(ERROR, 3) * SIGMA
        self.estimate.r_e, self.estimate.v_e = off[:3], off[3:6]
        half = off[6:] / 2
        self.estimate.q_mu = [*half, np.sqrt(1 - half @ half)]
        self.estimate.P = np.diag(SIGMA**2)

    def _step_impl(self, t, dt):
        if self.step_index <= len(self.fixes):
            self.innovation.publish(t, **self.fixes[self.step_index - 1])


def fix(residual, nis, reason="accepted", dof=4.0, sigma=2.0):
    residual = np.asarray(residual, float)
    return {
        "residual": residual,
        "sigma": np.where(np.isnan(residual), 1.0, sigma),
        "nis": nis,
        "dof": dof,
        "accepted": float(reason == "accepted"),
        "reason": float(REASONS.index(reason)),
    }


def evaluated(*fixes):
    system = System("judged")
    source = system.add(Filter(rate=Rate("1")), "filter")
    source.fixes = fixes
    evaluation = system.add(NavigationEvaluation(rate=Rate("1")), "evaluation")
    for name in ("r_e", "v_e", "q_mu", "estimate", "innovation"):
        system.connect(source[name], evaluation[name])
    result = simulate(system, members=2, duration=str(len(fixes)))
    return result.evaluation, result.dataset


def test_errors_sigma_and_nees_are_those_of_the_estimate():
    """NEES of errors of (1, -2, 1/2) sigma, three times: 3 (1 + 4 + 1/4) = 15.75, of 9 degrees."""
    summary, found = evaluated(fix([1.0, 1.0, 1.0, 1.0], 1.0))
    for k, name in enumerate(("position", "velocity", "misalignment")):
        part = slice(3 * k, 3 * k + 3)
        error = found[f"evaluation.{name}_error"].to_numpy()[-1, 0]
        np.testing.assert_allclose(error, ERROR * SIGMA[part], rtol=1e-5)
        sigma = found[f"evaluation.{name}_sigma"].to_numpy()[-1, 0]
        np.testing.assert_allclose(sigma, SIGMA[part], rtol=1e-12)
    np.testing.assert_allclose(found["evaluation.nees"].to_numpy()[-1], 15.75, rtol=1e-5)
    assert summary["nees"]["mean"] == pytest.approx(15.75, rel=1e-5)
    # two members: the mean of 18 degrees of freedom over 2
    np.testing.assert_allclose(
        summary["nees"]["interval_95"], chi2.ppf([0.025, 0.975], 18) / 2, rtol=1e-9
    )


def test_normalized_innovations_are_residuals_over_their_sigma():
    _, found = evaluated(fix([4.0, -1.0, 0.0, np.nan], 4.25, dof=3.0))
    normalized = found["evaluation.normalized_innovation"].to_numpy()[-1, 0]
    np.testing.assert_array_equal(normalized, [2.0, -0.5, 0.0, np.nan])


def test_a_refused_fix_does_not_enter_nis():
    """Of values 3, 778 (refused) and 5 the mean is 4, and so are the degrees of freedom."""
    good = [1.0, 1.0, 1.0, 1.0]
    fixes = fix(good, 3.0), fix([40.0] * 4, 778.0, "gate", dof=2.0), fix(good, 5.0)
    summary, found = evaluated(*fixes)
    assert summary["nis"]["mean"] == pytest.approx(4.0)
    assert summary["nis"]["dof"] == 4.0
    assert [f["reason"] for f in summary["fixes"]] == ["accepted", "gate", "accepted"]
    for name, values in (("nis", [3.0, np.nan, 5.0]), ("nis_dof", [4.0, np.nan, 4.0])):
        np.testing.assert_array_equal(found[f"evaluation.{name}"].to_numpy()[1:, 0], values)
    normalized = found["evaluation.normalized_innovation"].to_numpy()
    assert np.isnan(normalized[2]).all()
    np.testing.assert_array_equal(normalized[3], 0.5)


def test_where_every_fix_is_refused_there_is_no_nis():
    summary, _ = evaluated(fix([40.0] * 4, 778.0, "gate"))
    assert summary["nis"]["mean"] is None
    assert summary["fixes"][0]["accepted"] == 0.0
