r"""The Rauch-Tung-Striebel smoother over a recorded run, in the coordinates of the error.

Between two corrections at :math:`t_k` and :math:`t_{k+1}` the error moves by :math:`\Phi`; with the
posterior :math:`\hat x^+_k, P^+_k` and the prior :math:`\hat x^-_{k+1}, P^-_{k+1}`, backward [1]_,

.. math::
    C &= P^+_k \Phi^T (P^-_{k+1})^{-1}, \\
    \hat x^s_k &= \hat x^+_k \oplus C \, (\hat x^s_{k+1} \ominus \hat x^-_{k+1}), \\
    P^s_k &= P^+_k + C \, (P^s_{k+1} - P^-_{k+1}) \, C^T,

each covariance about the estimate that its equation is written about: that of
:math:`\hat x^s_{k+1}` is brought about :math:`\hat x^-_{k+1}` first, and the sum about
:math:`\hat x^s_k` at the end (`ErrorState.recentering`). A prior may be singular (a clone that was
just made, a constant that is known): its inverse is that of what varies.

It is the optimum where the filter is. A filter that considers what it does not correct is not, and
its backward pass would claim too much.

References
----------
.. [1] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic
       systems", AIAA Journal 3(8), 1965.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.filters.error_state import ErrorState

SAME = 1e-6
"""Largest difference between the time of a record and that since which a transition counts [s]."""

_CUTOFF = 1e-13
"""Eigenvalue of a correlation matrix below which nothing varies."""


@dataclass(frozen=True)
class Estimates:
    """Estimates at K times for M members.

    Attributes
    ----------
    values : dict of str to ndarray, shape (K, M, size)
        By block; quaternions of rotations.
    P : ndarray, shape (K, M, n, n)
        Covariance of the error.
    """

    values: Mapping[str, FloatArray]
    P: FloatArray

    def at(self, k: Any) -> tuple[dict[str, FloatArray], FloatArray]:
        """Values and covariance at an index of time."""
        return {name: value[k] for name, value in self.values.items()}, self.P[k]


def smooth(
    state: ErrorState,
    times: FloatArray,
    prior: Estimates,
    posterior: Estimates,
    transition: FloatArray,
    since: FloatArray,
) -> Estimates:
    """Estimates given all that was measured, before and after.

    Parameters
    ----------
    state : ErrorState
    times : ndarray, shape (K,)
        [s]
    prior, posterior : Estimates
        Before and after what was measured at each time.
    transition : ndarray, shape (K, M, n, n)
        Of the error, from the time `since` to each time.
    since : ndarray, shape (K, M)
        [s]

    Returns
    -------
    Estimates
        NaN at times that no transition counts from: between corrections.

    Raises
    ------
    ValueError
        If a block is considered.
    """
    kept = [block.name for block in state if block.considered]
    if kept:
        raise ValueError(
            f"{', '.join(kept)} is considered, not corrected: such a filter's estimate is no "
            "optimum, and cannot be smoothed"
        )
    algebra = _Algebra(state)
    found = Estimates(
        {name: np.full_like(value, np.nan) for name, value in posterior.values.items()},
        np.full_like(posterior.P, np.nan),
    )
    last = len(times) - 1
    for name, value in found.values.items():
        value[last] = posterior.values[name][last]
    found.P[last] = posterior.P[last]
    # of every member: the next time that it was smoothed at
    following = np.full(posterior.P.shape[1], last)
    for k in range(last - 1, -1, -1):
        off = np.abs(since[following, np.arange(len(following))] - times[k])
        who = np.flatnonzero(off <= SAME)
        if not who.size:
            continue
        later = following[who], who
        gain = _gain(posterior.P[k, who], transition[later], prior.P[later])
        step = algebra.step(posterior.at((k, who)), prior.at(later), found.at(later), gain)
        for name, value in step[0].items():
            found.values[name][k, who] = value
        found.P[k, who] = step[1]
        following[who] = k
    return found


def _gain(P: FloatArray, phi: FloatArray, prior: FloatArray) -> FloatArray:
    """P phi' prior^-1, (m, n, n); by the correlations, since units differ by many orders."""
    variance = np.diagonal(prior, axis1=1, axis2=2)
    finite = np.isfinite(prior.sum(axis=(1, 2)))[:, None, None]
    scale = 1.0 / np.sqrt(np.where(variance > 0.0, variance, np.inf))
    correlation = np.where(finite, prior, 0.0) * scale[:, :, None] * scale[:, None, :]
    inverse = np.linalg.pinv(correlation, rcond=_CUTOFF, hermitian=True)
    inverse = np.where(finite, inverse * scale[:, :, None] * scale[:, None, :], np.nan)
    gain: FloatArray = P @ phi.transpose(0, 2, 1) @ inverse
    return gain


class _Algebra:
    """Retraction, difference and re-centering of an error state on arrays."""

    def __init__(self, state: ErrorState) -> None:
        self._state = state
        shapes = [(block.value_size,) for block in state]
        names = [block.name for block in state]

        def retract(error: Any, *values: Any) -> Any:
            moved = state.normalized(state.retract(dict(zip(names, values, strict=True)), error))
            return tuple(moved[name] for name in names)

        self._retract = over_members(retract, (state.size,), *shapes)

    @cached_property
    def _turned(self) -> Callable[[FloatArray], FloatArray] | None:
        """Re-centering matrices; none where all is vectors."""
        if not any(block.is_rotation for block in self._state):
            return None
        return over_members(self._state.recentering, (self._state.size,))

    def step(
        self,
        posterior: tuple[dict[str, FloatArray], FloatArray],
        prior: tuple[dict[str, FloatArray], FloatArray],
        later: tuple[dict[str, FloatArray], FloatArray],
        gain: FloatArray,
    ) -> tuple[dict[str, FloatArray], FloatArray]:
        """Smoothed values and covariance, from those at the next time."""
        m, n = gain.shape[:2]
        values, P = posterior
        error = self._state.difference_of_arrays(*later[0].values(), *prior[0].values())
        correction = (gain @ error[:, :, None])[:, :, 0]
        moved = self._retract(correction, *values.values())
        moved = moved if isinstance(moved, tuple) else (moved,)
        smoothed = {name: value.reshape(m, -1) for name, value in zip(values, moved, strict=True)}
        about_prior = later[1]
        if self._turned is not None:
            back = np.linalg.inv(self._turned(error).reshape(m, n, n))
            about_prior = back @ about_prior @ back.transpose(0, 2, 1)
        P = P + gain @ (about_prior - prior[1]) @ gain.transpose(0, 2, 1)
        if self._turned is not None:
            J = self._turned(correction).reshape(m, n, n)
            P = J @ P @ J.transpose(0, 2, 1)
        return smoothed, (P + P.transpose(0, 2, 1)) / 2
