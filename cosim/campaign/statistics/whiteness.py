"""Whiteness of innovations: the correlation of each with that of the fix before.

Of a white sequence it has the variance 1 / n over n pairs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.campaign.statistics.hypotheses import (
    CORRELATION_TOLERANCE,
    Evidence,
    Finding,
)
from terrafix.cosim.campaign.statistics.statistic import (
    Columns,
    Layout,
    Members,
    Statistic,
    Sums,
    plain,
)
from terrafix.cosim.show.numbers import number


class Whiteness(Statistic):
    """Correlation of successive normalized innovations, element by element."""

    merged = ("lag_product", "lag_square", "lag_n")
    families = ("whiteness",)

    def sum(self, members: Members) -> Sums:
        """Sums of products with the fix before, of squares, and of pairs."""
        if not members.layout.has_innovation:
            return {}
        z = members.history["normalized_innovation"]
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
        return {"lag_product": sums[0], "lag_square": sums[1], "lag_n": sums[2]}

    def columns(self, layout: Layout, sums: Sums) -> Columns:
        """Correlations, and from how many pairs."""
        del layout
        return {
            "innovation_correlation": (("element",), correlation(sums)),
            "innovation_pairs": (("element",), sums["lag_n"]),
        }

    def summarize(self, layout: Layout, sums: Sums) -> dict[str, Any]:
        """Correlations with their standard errors."""
        del layout
        return {
            "whiteness": {
                "correlation": plain(correlation(sums)),
                "standard_error": plain(1.0 / np.sqrt(np.maximum(sums["lag_n"], 1))),
            }
        }

    def facts(self, summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """One sentence."""
        found = summary.get("whiteness")
        if found:
            pairs = zip(found["correlation"], found["standard_error"], strict=True)
            values = ", ".join(f"{number(r, 2)} +/- {number(s, 1)}" for r, s in pairs)
            yield "whiteness", f"correlation of successive innovations {values}"

    def judge(self, layout: Layout, sums: Sums, share: float) -> Evidence:
        """Test each element, where innovations of a sound filter are white."""
        if not layout.white:
            return [], 0
        from scipy.special import ndtr

        rho, n = correlation(sums), sums["lag_n"]
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


def correlation(sums: Sums) -> FloatArray:
    """Correlation of each element with the one before, (n,)."""
    square = np.maximum(sums["lag_square"], np.finfo(float).tiny)
    found: FloatArray = sums["lag_product"] / square
    return found
