"""Unpivoted factors of small symmetric matrices."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.symmetric import ldl, ldl_solve, mirrored, semidefinite_root

S, B = ca.SX.sym("S", 4, 4), ca.SX.sym("B", 4, 2)
_L, _d, _positive = ldl(S, 1e-12)
solve = ca.Function("solve", [S, B], [ldl_solve(_L, _d, B), _positive])
root = ca.Function("root", [S], [semidefinite_root(S)])
mirror = ca.Function("mirror", [S], [mirrored(S)])


def covariance(seed, scale=(1e-4, 1e-4, 1.0, 0.5)):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 6)) * np.array(scale)[:, None]
    return A @ A.T


@pytest.mark.parametrize("seed", range(5))
def test_solves_as_numpy_does(seed):
    """Condition numbers of some hundred after scaling: 1e-12 leaves room for both."""
    P, right = covariance(seed), np.random.default_rng(9).normal(size=(4, 2))
    x, positive = solve(P, right)
    assert positive == 1
    np.testing.assert_allclose(x.full(), np.linalg.solve(P, right), rtol=1e-11)


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((4, 4)),
        np.ones((4, 4)),
        np.diag([1.0, 1, -1, 1]),
        np.diag([1.0, np.nan, 1, 1]),
        np.array([[1.0, 2, 0, 0], [2, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    ],
)
def test_what_is_not_definite_is_flagged(bad):
    x, positive = solve(bad, np.ones((4, 2)))
    assert positive == 0
    assert np.isfinite(x.full()).all() or np.isnan(bad).any()


def test_root_of_a_covariance_and_of_one_with_known_directions():
    P = covariance(1)
    L = root(P).full()
    np.testing.assert_allclose(L @ L.T, P, rtol=1e-12)
    assert np.array_equal(L, np.tril(L))
    P[1, :] = P[:, 1] = 0
    L = root(P).full()
    np.testing.assert_allclose(L @ L.T, P, rtol=1e-12, atol=1e-25)


def test_mirrored_is_symmetric_to_the_bit_and_reads_the_upper_triangle():
    A = np.arange(16.0).reshape(4, 4)
    M = mirror(A).full()
    assert np.array_equal(M, M.T)
    assert np.array_equal(np.triu(M), np.triu(A))
