r"""What the statistics say of a filter: consistent, overconfident, conservative, biased.

Each statement is a test of a null hypothesis that leaves room for what no engineer would call
wrong, five percent of the root mean square error in any direction: a sigma within five percent, a
mean error within :math:`\sqrt{1.05^2 - 1} = 0.32` sigma; and a correlation within 0.05. With
:math:`N` members, :math:`d` axes, mean error :math:`\bar e`, sample covariance :math:`S` and
predicted covariance :math:`P` at an epoch:

- bias: :math:`\frac{N - d}{d (N - 1)} N \bar e^T S^{-1} \bar e` is :math:`F_{d, N - d}` with
  noncentrality :math:`(1.05^2 - 1) N` at most (Hotelling);
- spread: :math:`(N - 1)\, \mathrm{tr}(P^{-1} S)` is :math:`\chi^2_{d (N - 1)}`, and for each axis
  :math:`(N - 1)\, S_{ii} / P_{ii}` is :math:`\chi^2_{N - 1}`, each times :math:`1.05^2` or
  :math:`0.95^2` at most;
- innovations: the sum of NIS is :math:`\chi^2` of all their elements; each element's correlation
  with the one before has the variance :math:`1 / n`.

The level is shared among the five families, and within each among epochs and axes (Bonferroni):
the probability to accuse a right filter of anything is at most the level, 1 %.

A bias raises NIS and NEES too, so what NIS says is left out of the verdict where there is a bias.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.campaign.statistics import Statistics

LEVEL = 0.01
SIGMA_TOLERANCE = 0.05
BIAS_TOLERANCE = ((1 + SIGMA_TOLERANCE) ** 2 - 1) ** 0.5
CORRELATION_TOLERANCE = 0.05
FAMILIES = ("bias", "spread", "spread of an axis", "NIS", "whiteness")


@dataclass(frozen=True)
class Finding:
    """One hypothesis that was rejected.

    Attributes
    ----------
    word : str
        ``"biased"``, ``"overconfident"``, ``"conservative"`` or ``"correlated innovations"``.
    text : str
        The numbers behind it, in a sentence.
    p : float
        Smallest p-value, multiplied by how many tests its family made.
    """

    word: str
    text: str
    p: float


@dataclass(frozen=True)
class Verdict:
    """The verdict and what it rests on.

    Attributes
    ----------
    words : tuple of str
        The first is the verdict; ``("consistent",)`` where nothing was found.
    findings : list of Finding
    tests : int
        How many hypotheses were tested.
    """

    words: tuple[str, ...]
    findings: list[Finding] = field(default_factory=list)
    tests: int = 0

    @property
    def text(self) -> str:
        """One line."""
        return " and ".join(self.words)

    def summary(self) -> dict[str, Any]:
        """Plain types."""
        return {
            "verdict": self.text,
            "level": LEVEL,
            "tests": self.tests,
            "findings": [{"word": f.word, "text": f.text, "p": f.p} for f in self.findings],
        }


def judge(statistics: Statistics, *, level: float = LEVEL) -> Verdict:
    """Judge a filter by the statistics of its campaign.

    Parameters
    ----------
    statistics : Statistics
        Of at least d + 2 members at the end, where d is the number of axes.
    level : float
        Probability to accuse a right filter of anything, at most.
    """
    n_axes = len(statistics.layout.labels)
    usable = statistics.n >= n_axes + 2
    if not usable.any():
        return Verdict(("undecided",), [_too_few(statistics, n_axes)])
    share = level / len(FAMILIES)
    found, tests = _bias(statistics, usable, share)
    for family in (_spread, _axes, _nis, _whiteness):
        more, n = family(statistics, usable, share)
        tests += n
        found += more
    biased = any(f.word == "biased" for f in found)
    if biased:
        found = [f for f in found if not f.text.startswith("NIS")]
    words = [w for w in ("biased", "overconfident", "conservative") if _any(found, w)]
    if "overconfident" in words and "conservative" in words:
        words.remove("conservative")  # said in the findings; what endangers a mission comes first
    if not words and found:
        words = ["correlated innovations"]
    return Verdict(tuple(words) or ("consistent",), found, tests)


def _any(found: list[Finding], word: str) -> bool:
    return any(f.word == word for f in found)


def _too_few(statistics: Statistics, n_axes: int) -> Finding:
    most = int(statistics.n.max(initial=0))
    return Finding(
        "undecided", f"{most} members are too few for {n_axes} axes: fly {n_axes + 2} or more", 1.0
    )


def _whitened(
    statistics: Statistics, usable: Any
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Times, mean, sample and predicted covariance of the usable epochs, scaled to sigma one."""
    P = statistics.covariance_predicted[usable]
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    S = statistics.covariance_sample[usable] / scale
    return statistics.layout.times[usable], statistics.mean[usable] / sigma, S, P / scale


def _bias(statistics: Statistics, usable: Any, share: float) -> tuple[list[Finding], int]:
    from scipy.stats import ncf

    times, mean, S, _ = _whitened(statistics, usable)
    n = statistics.n[usable].astype(float)
    d = mean.shape[1]
    square = np.einsum("ei,ei->e", mean, _solve(S, mean[:, :, None])[:, :, 0])
    F = (n - d) / (d * (n - 1)) * n * square
    p = ncf.sf(F, d, n - d, BIAS_TOLERANCE**2 * n) * len(times)
    worst = int(np.nanargmin(p))
    if not p[worst] < share:
        return [], len(times)
    axis = int(np.argmax(np.abs(mean[worst])))
    value = statistics.mean[usable][worst, axis]
    error = value / (mean[worst, axis] * np.sqrt(n[worst])) * np.sqrt(S[worst, axis, axis])
    label, unit = statistics.layout.labels[axis], statistics.layout.units[axis]
    text = (
        f"mean error of {label} at t = {times[worst]:.6g} s is {value:.3g} {unit}, "
        f"{abs(value / error):.1f} standard errors"
    )
    return [Finding("biased", text, float(p[worst]))], len(times)


def _solve(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Solve each system; NaN where a matrix is singular."""
    found = np.full_like(right, np.nan)
    for i, (matrix, column) in enumerate(zip(matrices, right, strict=True)):
        try:
            found[i] = np.linalg.solve(matrix, column)
        except np.linalg.LinAlgError:
            continue
    return found


def _ratio_findings(
    ratio: FloatArray, dof: FloatArray, describe: Any, share: float
) -> tuple[list[Finding], int]:
    """Test mean squares against one, over and under; `describe(index)` names the worst."""
    from scipy.stats import chi2

    over, under = (1 + SIGMA_TOLERANCE) ** 2, (1 - SIGMA_TOLERANCE) ** 2
    n_tests = 2 * ratio.size
    p_over = chi2.sf(dof * ratio / over, dof) * n_tests
    p_under = chi2.cdf(dof * ratio / under, dof) * n_tests
    found = []
    for word, p in (("overconfident", p_over), ("conservative", p_under)):
        if np.isfinite(p).any():
            worst = np.unravel_index(int(np.nanargmin(p)), ratio.shape)
            if p[worst] < share:
                found.append(Finding(word, describe(worst), float(p[worst])))
    return found, n_tests


def _spread(statistics: Statistics, usable: Any, share: float) -> tuple[list[Finding], int]:
    times, mean, S, P = _whitened(statistics, usable)
    d = mean.shape[1]
    ratio = np.trace(_solve(P, S), axis1=1, axis2=2) / d
    dof = d * (statistics.n[usable] - 1.0)

    def describe(worst: Any) -> str:
        return (
            f"spread of all {d} axes at t = {times[worst]:.6g} s is {np.sqrt(ratio[worst]):.3g} "
            "of the predicted one"
        )

    return _ratio_findings(ratio, dof, describe, share)


def _axes(statistics: Statistics, usable: Any, share: float) -> tuple[list[Finding], int]:
    times, _, S, _ = _whitened(statistics, usable)
    ratio = np.diagonal(S, axis1=1, axis2=2)
    dof = np.broadcast_to((statistics.n[usable] - 1.0)[:, None], ratio.shape)
    layout = statistics.layout

    def describe(worst: Any) -> str:
        predicted = np.sqrt(statistics.covariance_predicted[usable][worst[0], worst[1], worst[1]])
        sample = np.sqrt(statistics.covariance_sample[usable][worst[0], worst[1], worst[1]])
        return (
            f"sigma of {layout.labels[worst[1]]} at t = {times[worst[0]]:.6g} s is "
            f"{sample:.3g} {layout.units[worst[1]]}, predicted {predicted:.3g} "
            f"(ratio {sample / predicted:.3g})"
        )

    return _ratio_findings(ratio, dof, describe, share)


def _nis(statistics: Statistics, usable: Any, share: float) -> tuple[list[Finding], int]:
    del usable
    if "nis_sum" not in statistics.sums:
        return [], 0
    total, dof = statistics.sums["nis_sum"].sum(), statistics.sums["dof"].sum()
    if not dof:
        return [], 0
    ratio = np.array([total / dof])

    def describe(worst: Any) -> str:
        del worst
        n = int(statistics.sums["nis_n"].sum())
        return f"NIS is {total / n:.4g} on average, expected {dof / n:.4g}, over {n} innovations"

    return _ratio_findings(ratio, np.array([dof]), describe, share)


def _whiteness(statistics: Statistics, usable: Any, share: float) -> tuple[list[Finding], int]:
    del usable
    if "lag_n" not in statistics.sums:
        return [], 0
    from scipy.special import ndtr

    rho, n = statistics.whiteness
    given = n > 1
    if not given.any():
        return [], 0
    excess = np.maximum(np.abs(rho) - CORRELATION_TOLERANCE, 0.0) * np.sqrt(n)
    p = np.where(given, 2 * ndtr(-excess), 1.0) * given.sum()
    worst = int(np.argmin(p))
    if not p[worst] < share:
        return [], int(given.sum())
    text = (
        f"element {worst + 1} of the innovation is correlated with that of the fix before: "
        f"{rho[worst]:.3f} over {int(n[worst])} pairs"
    )
    return [Finding("correlated innovations", text, float(p[worst]))], int(given.sum())
