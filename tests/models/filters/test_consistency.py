"""Normalized squares and their bounds."""

import subprocess
import sys

import numpy as np
import pytest

from terrafix.models.filters.consistency import gate_thresholds, normalized_square


def ensemble(n_members, n=9, seed=0):
    rng = np.random.default_rng(seed)
    sigma = 10.0 ** np.linspace(3, -3, n)  # as different as meters and radians
    A = rng.normal(size=(n_members, n, 2 * n)) * sigma[:, None]
    P = A @ np.swapaxes(A, 1, 2)
    e = np.einsum("kij,kj->ki", np.linalg.cholesky(P), rng.normal(size=(n_members, n)))
    return e, P


def test_agrees_with_a_linear_solver():
    e, P = ensemble(50)
    expected = [x @ np.linalg.solve(C, x) for x, C in zip(e, P, strict=True)]
    np.testing.assert_allclose(normalized_square(e, P), expected, rtol=1e-9)


def test_is_chi_square_for_a_consistent_ensemble():
    """Mean of 2000 members of 9 degrees: 9 +- 3 sqrt(18 / 2000)."""
    values = normalized_square(*ensemble(2000))
    assert values.mean() == pytest.approx(9, abs=3 * np.sqrt(18 / 2000))


@pytest.mark.parametrize("n", [1, 7, 100])
def test_a_member_does_not_depend_on_the_others(n):
    e, P = ensemble(100)
    assert normalized_square(e[:n], P[:n]).tobytes() == normalized_square(e, P)[:n].tobytes()


def test_failed_members_are_not_a_number_and_stop_nobody():
    e, P = ensemble(6)
    expected = normalized_square(e, P)
    P[1] = 0
    P[2, 3, 3] *= -1
    P[3] = np.outer(np.ones(9), np.ones(9))
    P[4, 2, 1] = np.nan
    e[5, 0] = np.inf
    values = normalized_square(e, P)
    assert values[0] == expected[0]
    assert np.isnan(values[1:]).all()


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="do not fit covariances"):
        normalized_square(np.zeros((3, 4)), np.zeros((3, 3, 3)))


def test_gates_of_one_to_four_degrees():
    """Tables of chi-square at 99 %."""
    np.testing.assert_allclose(gate_thresholds(0.99), [6.635, 9.210, 11.345, 13.277], atol=6e-4)
    assert np.isinf(gate_thresholds(1.0)).all()


def test_impossible_arguments_are_refused():
    with pytest.raises(ValueError, match=r"in \(0, 1\]"):
        gate_thresholds(0.0)


def test_importing_is_light():
    """SciPy's statistics take a second to import; they wait until a bound is asked for."""
    code = "import sys, terrafix.models.filters.consistency; sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
