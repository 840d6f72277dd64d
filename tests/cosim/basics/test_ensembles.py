"""Statistics over members: sample moments, members without a value left out, and intervals."""

import numpy as np
import pytest
from scipy.stats import chi2

from terrafix.cosim.basics.ensembles import (
    chi_square_interval,
    member_mean,
    root_mean_square,
    sample_sigma,
)


@pytest.mark.parametrize(
    ("dof", "n", "bounds"),
    [
        (9, 100, (8.19, 9.85)),
        (9, 300, (8.53, 9.49)),
        (4, 100, (3.46, 4.57)),
        (4, 7200, (3.935, 4.066)),
    ],
)
def test_chi_square_intervals(dof, n, bounds):
    """Against SciPy's quantile, and the published bounds to the digits printed there."""
    found = chi_square_interval(dof, n)
    np.testing.assert_allclose(found, chi2.ppf([0.025, 0.975], dof * n) / n, rtol=1e-10)
    np.testing.assert_allclose(found, bounds, atol=0.006)
    wide = chi_square_interval(dof, n, 0.99)
    assert wide[0] < found[0] < found[1] < wide[1]


def test_sample_statistics_leave_failed_members_out():
    values = np.random.default_rng(1).normal(size=(4, 6, 3))
    holed = values.copy()
    holed[1, 2] = np.nan
    holed[2, 1:] = np.nan
    holed[3] = np.nan
    np.testing.assert_allclose(sample_sigma(holed)[0], values[0].std(axis=0, ddof=1), rtol=1e-14)
    np.testing.assert_allclose(
        sample_sigma(holed)[1], np.delete(values[1], 2, axis=0).std(axis=0, ddof=1), rtol=1e-14
    )
    assert np.isnan(sample_sigma(holed)[2:]).all()
    np.testing.assert_allclose(member_mean(holed)[2], values[2, 0], rtol=0)
    assert np.isnan(member_mean(holed)[3]).all()
    np.testing.assert_allclose(root_mean_square(values)[0], np.sqrt((values[0] ** 2).mean(axis=0)))


def test_a_mean_square_leaves_members_without_a_value_out():
    """Of 3 and 4: sqrt((9 + 16) / 2); the deviation of two values is |a - b| / sqrt(2)."""
    values = np.array([[3.0, np.nan, -4.0]])
    np.testing.assert_allclose(root_mean_square(values), [np.sqrt(12.5)], rtol=1e-15)
    np.testing.assert_allclose(sample_sigma(values), [7 / np.sqrt(2)], rtol=1e-15)
    np.testing.assert_allclose(member_mean(values), [-0.5], rtol=1e-15)
