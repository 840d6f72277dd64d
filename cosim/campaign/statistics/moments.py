r"""Mean error, sample and predicted covariance: the moments that tell bias and spread.

With :math:`N_b` members, mean :math:`\bar e_b` and scatter :math:`M_b = \sum (e - \bar e_b)(e -
\bar e_b)^T` of a block, merged pairwise [1]_:

.. math::
    \bar e = \bar e_a + \delta \frac{N_b}{N_a + N_b}, \qquad
    M = M_a + M_b + \delta \delta^T \frac{N_a N_b}{N_a + N_b}, \qquad
    \delta = \bar e_b - \bar e_a.

With :math:`N` members, :math:`d` axes, mean error :math:`\bar e`, sample covariance :math:`S` and
predicted covariance :math:`P` at an epoch:

- bias: :math:`\frac{N - d}{d (N - 1)} N \bar e^T S^{-1} \bar e` is :math:`F_{d, N - d}` with
  noncentrality :math:`(1.05^2 - 1) N` at most (Hotelling);
- spread: :math:`(N - 1)\, \mathrm{tr}(P^{-1} S)` is :math:`\chi^2_{d (N - 1)}`, and for each axis
  :math:`(N - 1)\, S_{ii} / P_{ii}` is :math:`\chi^2_{N - 1}`, each times :math:`1.05^2` or
  :math:`0.95^2` at most.

References
----------
.. [1] T. Chan, G. Golub, R. LeVeque, "Algorithms for computing the sample variance", The American
   Statistician 37(3), 1983.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.campaign.statistics.hypotheses import (
    BIAS_TOLERANCE,
    Evidence,
    Finding,
    judge_ratios,
)
from terrafix.cosim.campaign.statistics.statistic import (
    Columns,
    Layout,
    Members,
    Statistic,
    Sums,
    plain,
)


def mean_error(sums: Sums) -> FloatArray:
    """Mean over the members, (n_epochs, n_axes)."""
    return np.where(sums["n"][:, None] > 0, sums["mean"], np.nan)


def covariance_sample(sums: Sums) -> FloatArray:
    """Sample covariance about the mean, (n_epochs, n_axes, n_axes)."""
    divisor = (sums["n"] - 1)[:, None, None]
    return np.where(divisor > 0, sums["scatter"] / np.maximum(divisor, 1), np.nan)


def covariance_predicted(sums: Sums) -> FloatArray:
    """Mean of the filters' covariances, (n_epochs, n_axes, n_axes)."""
    n = sums["n"][:, None, None]
    return np.where(n > 0, sums["predicted"] / np.maximum(n, 1), np.nan)


def ratio_interval(n: int, probability: float = 0.95) -> tuple[float, float]:
    r"""Factors from a ratio of sigmas (sample over predicted) to its confidence interval.

    :math:`\sqrt{(n - 1) / \chi^2_{n-1}(1 - \alpha/2)}` and :math:`\ldots(\alpha/2)`.
    """
    low, high = chi_square_interval(1.0, n - 1, probability)
    return 1.0 / np.sqrt(high), 1.0 / np.sqrt(low)


class Moments(Statistic):
    """Count, mean, sample and predicted covariance of the errors at each epoch."""

    merged = ("n", "mean", "scatter", "predicted")
    families = ("bias", "spread", "spread of an axis")

    def sum(self, members: Members) -> Sums:
        """Count, mean, scatter about it, sum of the predicted covariances."""
        error, valid = members.error, members.valid
        n = valid.sum(axis=1)
        filled = np.where(valid[:, :, None], error, 0.0)
        mean = filled.sum(axis=1) / np.maximum(n, 1)[:, None]
        deviation = np.where(valid[:, :, None], error - mean[:, None], 0.0)
        return {
            "n": n.astype(np.int64),
            "mean": mean,
            "scatter": np.einsum("emi,emj->eij", deviation, deviation),
            "predicted": _covariances(members).sum(axis=1),
        }

    def merge(self, sums: Sums, block: Sums) -> None:
        """Merge pairwise."""
        n_a, n_b = sums["n"], block["n"]
        total = n_a + n_b
        divisor = np.maximum(total, 1)
        delta = block["mean"] - sums["mean"]
        weight = n_a * n_b / divisor
        sums["mean"] += delta * (n_b / divisor)[:, None]
        sums["scatter"] += block["scatter"]
        sums["scatter"] += delta[:, :, None] * delta[:, None, :] * weight[:, None, None]
        sums["predicted"] += block["predicted"]
        sums["n"] = total

    def columns(self, layout: Layout, sums: Sums) -> Columns:
        """Count, mean with its standard error, and both covariances."""
        del layout
        sample = covariance_sample(sums)
        sigma = np.sqrt(np.diagonal(sample, axis1=1, axis2=2))
        matrix = ("time", "axis", "axis_b")
        return {
            "n": (("time",), sums["n"]),
            "mean_error": (("time", "axis"), mean_error(sums)),
            "standard_error": (
                ("time", "axis"),
                sigma / np.sqrt(np.maximum(sums["n"], 1))[:, None],
            ),
            "covariance_sample": (matrix, sample),
            "covariance_predicted": (matrix, covariance_predicted(sums)),
        }

    def summarize(self, layout: Layout, sums: Sums) -> dict[str, Any]:
        """At the end, by quantity."""
        n = int(sums["n"][-1])
        sample = np.sqrt(np.diagonal(covariance_sample(sums)[-1]))
        predicted = np.sqrt(np.diagonal(covariance_predicted(sums)[-1]))
        mean = mean_error(sums)[-1]
        low, high = ratio_interval(n) if n > 1 else (np.nan, np.nan)
        found: dict[str, Any] = {"n": n, "t_s": float(layout.times[-1])}
        start = 0
        for name, unit, axes in layout.quantities:
            part = slice(start, start + len(axes))
            start += len(axes)
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = sample[part] / predicted[part]
            found[name] = {
                "unit": unit,
                "axes": list(axes),
                "mean_error": plain(mean[part]),
                "standard_error": plain(sample[part] / np.sqrt(max(n, 1))),
                "sigma_sample": plain(sample[part]),
                "sigma_predicted": plain(predicted[part]),
                "ratio": plain(ratio),
                "ratio_interval_95": plain(np.stack([low * ratio, high * ratio], axis=1)),
            }
        return found

    def judge(self, layout: Layout, sums: Sums, share: float) -> Evidence:
        """Bias, spread, and spread of each axis, at the epochs with members enough."""
        used = _Scaled.of(layout, sums)
        found: list[Finding] = []
        tests = 0
        for family in (_bias, _spread, _axes):
            more, n = family(layout, used, share)
            found += more
            tests += n
        return found, tests


class EndRow(NamedTuple):
    """What a summary says of one axis at the end, in SI."""

    quantity: str
    first: bool
    """Of its quantity."""
    axis: str
    unit: str
    mean_error: float | None
    standard_error: float | None
    sigma_sample: float | None
    sigma_predicted: float | None
    ratio: float | None
    interval: tuple[float, float] | None
    """95 % of the ratio."""


def end_rows(summary: Mapping[str, Any]) -> Iterator[EndRow]:
    """Rows of a table of the errors at the end."""
    for name, q in summary.items():
        if not isinstance(q, Mapping) or "sigma_sample" not in q:
            continue
        for i, axis in enumerate(q["axes"]):
            low, high = q["ratio_interval_95"][i]
            yield EndRow(
                name,
                i == 0,
                axis,
                q["unit"],
                q["mean_error"][i],
                q["standard_error"][i],
                q["sigma_sample"][i],
                q["sigma_predicted"][i],
                q["ratio"][i],
                None if low is None else (low, high),
            )


def _covariances(members: Members) -> FloatArray:
    if members.layout.has_covariance:
        covariance = members.history["covariance"]
    else:
        covariance = members.sigma[..., :, None] ** 2 * np.eye(members.sigma.shape[2])
    chosen: FloatArray = np.where(members.valid[:, :, None, None], covariance, 0.0)
    return chosen


class _Scaled(NamedTuple):
    """Moments of the epochs with members enough; `mean`, `S` and `P` in predicted sigmas."""

    n: NDArray[np.int64]
    times: FloatArray
    mean_error: FloatArray
    sigma_sample: FloatArray
    sigma_predicted: FloatArray
    mean: FloatArray
    S: FloatArray
    P: FloatArray

    @classmethod
    def of(cls, layout: Layout, sums: Sums) -> _Scaled:
        used = sums["n"] >= len(layout.labels) + 2
        P, S = covariance_predicted(sums)[used], covariance_sample(sums)[used]
        mean = mean_error(sums)[used]
        sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        scale = sigma[:, :, None] * sigma[:, None, :]
        return cls(
            sums["n"][used],
            layout.times[used],
            mean,
            np.sqrt(np.diagonal(S, axis1=1, axis2=2)),
            sigma,
            mean / sigma,
            S / scale,
            P / scale,
        )


def _bias(layout: Layout, used: _Scaled, share: float) -> Evidence:
    from scipy.stats import ncf

    n, d = used.n.astype(float), used.mean.shape[1]
    square = np.einsum("ei,ei->e", used.mean, _solve(used.S, used.mean[:, :, None])[:, :, 0])
    F = (n - d) / (d * (n - 1)) * n * square
    p = ncf.sf(F, d, n - d, BIAS_TOLERANCE**2 * n) * len(n)
    worst = int(np.nanargmin(p))
    if not p[worst] < share:
        return [], len(n)
    axis = int(np.argmax(np.abs(used.mean[worst])))
    value = used.mean[worst, axis] * np.sqrt(n[worst] / used.S[worst, axis, axis])
    text = (
        f"mean error of {layout.labels[axis]} at t = {used.times[worst]:.6g} s is "
        f"{used.mean_error[worst, axis]:.3g} {layout.units[axis]}, "
        f"{abs(value):.1f} standard errors"
    )
    return [Finding("biased", text, float(p[worst]))], len(n)


def _solve(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Solve each system; NaN where a matrix is singular."""
    found = np.full_like(right, np.nan)
    for i, (matrix, column) in enumerate(zip(matrices, right, strict=True)):
        try:
            found[i] = np.linalg.solve(matrix, column)
        except np.linalg.LinAlgError:
            continue
    return found


def _spread(layout: Layout, used: _Scaled, share: float) -> Evidence:
    del layout
    d = used.mean.shape[1]
    ratio = np.trace(_solve(used.P, used.S), axis1=1, axis2=2) / d

    def describe(worst: Any) -> str:
        return (
            f"spread of all {d} axes at t = {used.times[worst]:.6g} s is "
            f"{np.sqrt(ratio[worst]):.3g} of the predicted one"
        )

    return judge_ratios(ratio, d * (used.n - 1.0), describe, share)


def _axes(layout: Layout, used: _Scaled, share: float) -> Evidence:
    ratio = np.diagonal(used.S, axis1=1, axis2=2)
    dof = np.broadcast_to((used.n - 1.0)[:, None], ratio.shape)

    def describe(worst: Any) -> str:
        sample, predicted = used.sigma_sample[worst], used.sigma_predicted[worst]
        return (
            f"sigma of {layout.labels[worst[1]]} at t = {used.times[worst[0]]:.6g} s is "
            f"{sample:.3g} {layout.units[worst[1]]}, predicted {predicted:.3g} "
            f"(ratio {sample / predicted:.3g})"
        )

    return judge_ratios(ratio, dof, describe, share)
