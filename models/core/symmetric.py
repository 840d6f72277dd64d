r"""Small symmetric matrices in symbols: exact symmetry, and factors without pivoting.

Pivoting would let the data decide the order of the operations. A positive definite matrix needs
none; where a pivot is not positive the factors stay finite and a flag says so.
"""

from __future__ import annotations

from typing import Any

import casadi as ca


def mirrored(matrix: Any) -> Any:
    """Upper triangle reflected to the lower, (n, n): symmetric to the bit, and half the work."""
    return ca.triu2symm(ca.triu(matrix))


def ldl(matrix: Any, floor: float) -> tuple[Any, Any, Any]:
    r"""Factors of a symmetric matrix, :math:`S = L\, \mathrm{diag}(d)\, L^T`, unpivoted.

    Parameters
    ----------
    matrix : SX, shape (n, n)
        Only the lower triangle is read.
    floor : float
        Smallest pivot accepted, relative to the diagonal element it comes from.

    Returns
    -------
    L : SX, shape (n, n)
        Unit lower triangular.
    d : SX, shape (n, 1)
        Pivots; 1 in the place of one that was not accepted.
    positive : SX
        1 where every pivot was accepted, else 0; 0 also where one is not a number.
    """
    n = matrix.shape[0]
    L, d, positive = ca.SX.eye(n), ca.SX.ones(n), ca.SX(1)
    for j in range(n):
        pivot = matrix[j, j] - sum(L[j, k] * L[j, k] * d[k] for k in range(j))
        accepted = ca.logic_and(pivot > floor * matrix[j, j], pivot > 0)
        positive = ca.logic_and(positive, accepted)
        d[j] = ca.if_else(accepted, pivot, 1.0)
        for i in range(j + 1, n):
            L[i, j] = (matrix[i, j] - sum(L[i, k] * L[j, k] * d[k] for k in range(j))) / d[j]
    return L, d, positive


def ldl_solve(L: Any, d: Any, right: Any) -> Any:
    """Solve S x = right, shape (n, m), from the factors of `ldl`."""
    n = L.shape[0]
    x = ca.SX(right)
    for i in range(n):
        for k in range(i):
            x[i, :] -= L[i, k] * x[k, :]
    for i in range(n):
        x[i, :] = x[i, :] / d[i]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i, :] -= L[k, i] * x[k, :]
    return x


def semidefinite_root(matrix: Any) -> Any:
    """Lower triangular root of a covariance, (n, n), in which variances may be zero.

    A direction whose remaining variance is below rounding gets a column of zeros.
    """
    n = matrix.shape[0]
    root = ca.SX.zeros(n, n)
    for j in range(n):
        pivot = matrix[j, j] - sum(root[j, k] * root[j, k] for k in range(j))
        accepted = ca.logic_and(pivot > 1e-15 * matrix[j, j], pivot > 0)
        diagonal = ca.sqrt(ca.if_else(accepted, pivot, 1.0))
        root[j, j] = ca.if_else(accepted, diagonal, 0.0)
        for i in range(j + 1, n):
            remaining = matrix[i, j] - sum(root[i, k] * root[j, k] for k in range(j))
            root[i, j] = ca.if_else(accepted, remaining / diagonal, 0.0)
    return root
