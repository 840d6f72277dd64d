r"""Statistics of an ensemble, streamed: blocks of 64 consecutive members, merged in index order.

A block is summed the same way however members were grouped to be flown, and blocks are merged in
the order of their numbers, so the sums have the same bits on one process or a hundred. With
:math:`N_b` members, mean :math:`\bar e_b` and scatter :math:`M_b = \sum (e - \bar e_b)(e - \bar
e_b)^T` of a block, merged pairwise [1]_:

.. math::
    \bar e = \bar e_a + \delta \frac{N_b}{N_a + N_b}, \qquad
    M = M_a + M_b + \delta \delta^T \frac{N_a N_b}{N_a + N_b}, \qquad
    \delta = \bar e_b - \bar e_a.

References
----------
.. [1] T. Chan, G. Golub, R. LeVeque, "Algorithms for computing the sample variance", The American
   Statistician 37(3), 1983.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.declare.evaluation import Evaluation

BLOCK = 64
"""Members of a block."""
SHOWN = 128
"""Members whose error histories are kept for figures."""
BINS = 128
"""Of the histogram of normalized errors, an eighth of a sigma wide; the outer ones are open."""
BIN_WIDTH = 0.125
QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)


@dataclass(frozen=True)
class Layout:
    """What an evaluation publishes, as campaigns need it.

    Attributes
    ----------
    path : str
        Of the component.
    quantities : tuple of (name, unit, axes)
        In the order of the errors.
    times : ndarray, shape (n_epochs,)
        [s]
    has_covariance, has_innovation : bool
        Whether it publishes a covariance, and innovations.
    """

    path: str
    quantities: tuple[tuple[str, str, tuple[str, ...]], ...]
    times: FloatArray
    has_covariance: bool
    has_innovation: bool

    @classmethod
    def of(cls, path: str, component: Evaluation, times: FloatArray) -> Layout:
        """Look at the ports of a component."""
        outputs = component.outputs()
        return cls(
            path,
            tuple((q.name, q.unit, q.axes) for q in component.quantities),
            times,
            "covariance" in outputs,
            "normalized_innovation" in outputs,
        )

    @property
    def labels(self) -> list[str]:
        """Names of all axes, ``"position x"``."""
        return [f"{name} {axis}" for name, _, axes in self.quantities for axis in axes]

    @property
    def units(self) -> list[str]:
        """Unit of each axis."""
        return [unit for _, unit, axes in self.quantities for _ in axes]


Block = dict[str, NDArray[Any]]
"""Sums of one block, by name; see `block_of`."""


def block_of(layout: Layout, history: Mapping[str, NDArray[Any]], *, first: int) -> Block:
    """Sum up the histories of up to 64 members.

    Parameters
    ----------
    layout : Layout
    history : mapping of str to ndarray, shape (n_epochs, n_members, ...)
        By port; NaN where a member has failed.
    first : int
        Number of the first member: histories of the first `SHOWN` members of all are kept.
    """
    error = _side_by_side(layout, history, "error")
    sigma = _side_by_side(layout, history, "sigma")
    valid: NDArray[np.bool_] = np.asarray(np.isfinite(error).all(axis=2))
    n = valid.sum(axis=1)
    filled = np.where(valid[:, :, None], error, 0.0)
    divisor = np.maximum(n, 1)[:, None]
    mean = filled.sum(axis=1) / divisor
    deviation = np.where(valid[:, :, None], error - mean[:, None], 0.0)
    block: Block = {
        "n": n.astype(np.int64),
        "mean": mean,
        "scatter": np.einsum("emi,emj->eij", deviation, deviation),
        "predicted": _covariances(layout, history, sigma, valid).sum(axis=1),
        "histogram": _histogram(error / sigma),
    }
    if "nees" in history:
        block |= _sums("nees", history["nees"])
        with np.errstate(invalid="ignore"):
            block["member_nees"] = _row_mean(history["nees"].T)
    if layout.has_innovation:
        dof = history["nis_dof"]
        block |= _sums("nis", history["nis"])
        block["dof"] = np.where(np.isfinite(history["nis"]), dof, 0.0).sum(axis=1)
        block |= _innovations(history["normalized_innovation"])
        block["member_nis"] = _row_mean(history["nis"].T)
    block["final"] = error[-1].copy()
    if first < SHOWN:
        block["shown_error"] = np.ascontiguousarray(error)
        block["shown_sigma"] = np.ascontiguousarray(sigma)
        if "nees" in history:
            block["shown_nees"] = np.ascontiguousarray(history["nees"])
    return block


def _side_by_side(layout: Layout, history: Mapping[str, NDArray[Any]], kind: str) -> FloatArray:
    arrays = [history[f"{name}_{kind}"] for name, _, _ in layout.quantities]
    return np.concatenate([a.reshape(*a.shape[:2], -1) for a in arrays], axis=2)


def _covariances(
    layout: Layout, history: Mapping[str, NDArray[Any]], sigma: FloatArray, valid: NDArray[np.bool_]
) -> FloatArray:
    if layout.has_covariance:
        covariance = history["covariance"]
    else:
        covariance = sigma[..., :, None] ** 2 * np.eye(sigma.shape[2])
    chosen: FloatArray = np.where(valid[:, :, None, None], covariance, 0.0)
    return chosen


def _sums(name: str, values: FloatArray) -> Block:
    finite = np.isfinite(values)
    return {
        f"{name}_sum": np.where(finite, values, 0.0).sum(axis=1),
        f"{name}_n": finite.sum(axis=1).astype(np.int64),
    }


def _row_mean(rows: FloatArray) -> FloatArray:
    rows = np.ascontiguousarray(rows)
    finite = np.isfinite(rows)
    n = finite.sum(axis=1)
    total = np.where(finite, rows, 0.0).sum(axis=1)
    return np.where(n > 0, total / np.maximum(n, 1), np.nan)


def _innovations(z: FloatArray) -> Block:
    """Sums of products of normalized innovations with those of the fix before, and of squares."""
    n_members, size = z.shape[1:]
    sums = np.zeros((3, size))
    finite = np.isfinite(z)
    for m in range(n_members):
        given = finite[:, m].any(axis=1)
        values = np.where(finite[:, m], z[:, m], 0.0)[given]
        known = finite[:, m][given]
        both = known[1:] & known[:-1]
        sums[0] += np.where(both, values[1:] * values[:-1], 0.0).sum(axis=0)
        sums[1] += np.where(both, 0.5 * (values[1:] ** 2 + values[:-1] ** 2), 0.0).sum(axis=0)
        sums[2] += both.sum(axis=0)
    return {
        "lag_product": sums[0],
        "lag_square": sums[1],
        "lag_n": sums[2],
    }


def _histogram(z: FloatArray) -> NDArray[np.uint8]:
    """Counts of normalized errors, shape (n_epochs, n_axes, BINS)."""
    n_epochs, _, n_axes = z.shape
    finite = np.isfinite(z)
    place = np.where(finite, z, 0.0) / BIN_WIDTH + BINS / 2
    bin_of = np.clip(place, 0, BINS - 1).astype(np.int64)
    cell = (np.arange(n_epochs)[:, None, None] * n_axes + np.arange(n_axes)) * BINS + bin_of
    counts = np.bincount(cell[finite], minlength=n_epochs * n_axes * BINS)
    return counts.reshape(n_epochs, n_axes, BINS).astype(np.uint8)


_ADDED = [
    *("predicted", "nees_sum", "nees_n", "nis_sum", "nis_n", "dof"),
    *("lag_product", "lag_square", "lag_n"),
]
_JOINED = {"shown_error": 1, "shown_sigma": 1, "shown_nees": 1}


@dataclass
class Statistics:
    """Everything merged so far; blocks must come in the order of their numbers.

    Attributes
    ----------
    layout : Layout
    runs : int
        Members in all blocks.
    sums : dict of str to ndarray
        As in a block, merged.
    """

    layout: Layout
    runs: int = 0
    sums: Block = field(default_factory=dict)

    def add(self, block: Block) -> None:
        """Merge the next block."""
        self.runs += len(block["final"])
        if not self.sums:
            self.sums = {k: v.copy() for k, v in block.items() if k in _ADDED or k in _JOINED}
            self.sums |= {k: block[k].copy() for k in ("n", "mean", "scatter")}
            self.sums["histogram"] = block["histogram"].astype(np.int64)
            return
        mine = self.sums
        n_a, n_b = mine["n"], block["n"]
        total = n_a + n_b
        divisor = np.maximum(total, 1)
        delta = block["mean"] - mine["mean"]
        weight = n_a * n_b / divisor
        mine["mean"] += delta * (n_b / divisor)[:, None]
        mine["scatter"] += block["scatter"]
        mine["scatter"] += delta[:, :, None] * delta[:, None, :] * weight[:, None, None]
        mine["n"] = total
        mine["histogram"] += block["histogram"]
        for name in _ADDED:
            if name in mine:
                mine[name] += block[name]
        for name, axis in _JOINED.items():
            if name in mine and name in block:
                mine[name] = np.concatenate([mine[name], block[name]], axis=axis)

    # ------------------------------------------------------------------ what follows

    @property
    def n(self) -> NDArray[np.int64]:
        """Members that had not failed, (n_epochs,)."""
        return self.sums["n"]

    @property
    def mean(self) -> FloatArray:
        """Mean error, (n_epochs, n_axes)."""
        return np.where(self.n[:, None] > 0, self.sums["mean"], np.nan)

    @property
    def covariance_sample(self) -> FloatArray:
        """Sample covariance about the mean, (n_epochs, n_axes, n_axes)."""
        divisor = (self.n - 1)[:, None, None]
        return np.where(divisor > 0, self.sums["scatter"] / np.maximum(divisor, 1), np.nan)

    @property
    def covariance_predicted(self) -> FloatArray:
        """Mean of the filters' covariances, (n_epochs, n_axes, n_axes)."""
        n = self.n[:, None, None]
        return np.where(n > 0, self.sums["predicted"] / np.maximum(n, 1), np.nan)

    def mean_of(self, name: str) -> FloatArray:
        """Mean of ``"nees"`` or ``"nis"`` over members, (n_epochs,); NaN where there is none."""
        n = self.sums[f"{name}_n"]
        return np.where(n > 0, self.sums[f"{name}_sum"] / np.maximum(n, 1), np.nan)

    def quantiles(self) -> FloatArray:
        """Quantiles of the normalized errors, (n_quantiles, n_epochs, n_axes), see `QUANTILES`.

        From the histogram: to an eighth of a sigma, interpolated.
        """
        counts = self.sums["histogram"]
        cumulative = np.cumsum(counts, axis=2)
        total = cumulative[:, :, -1]
        found = np.full((len(QUANTILES), *total.shape), np.nan)
        for i, q in enumerate(QUANTILES):
            target = q * total
            place = np.minimum((cumulative < target[:, :, None]).sum(axis=2), BINS - 1)
            inside = np.take_along_axis(counts, place[:, :, None], axis=2)[:, :, 0]
            before = np.take_along_axis(cumulative, place[:, :, None], axis=2)[:, :, 0] - inside
            part = (target - before) / np.maximum(inside, 1)
            value = (place + part - BINS / 2) * BIN_WIDTH
            found[i] = np.where(total > 0, value, np.nan)
        return found

    @property
    def whiteness(self) -> tuple[FloatArray, FloatArray]:
        """Correlation of each innovation with the one before, and of how many pairs, (n,) each."""
        sums = self.sums
        square = np.maximum(sums["lag_square"], np.finfo(float).tiny)
        return sums["lag_product"] / square, sums["lag_n"]
