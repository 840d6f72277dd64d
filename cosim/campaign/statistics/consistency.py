r"""NEES and NIS: means over the members, their chi-square intervals, and the test of NIS.

The sum of NIS is :math:`\chi^2` of all the innovations' elements, times :math:`1.05^2` or
:math:`0.95^2` at most.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.campaign.statistics.hypotheses import Evidence, judge_ratios
from terrafix.cosim.campaign.statistics.statistic import Columns, Layout, Members, Statistic, Sums
from terrafix.cosim.show.numbers import number


class Consistency(Statistic):
    """Mean of a normalized square at each epoch; a subclass says of which, and what is expected."""

    name: ClassVar[str]

    def degrees(self, layout: Layout, sums: Sums) -> FloatArray:
        """Expected value at each epoch."""
        raise NotImplementedError

    def counted(self, sums: Sums) -> NDArray[np.bool_]:
        """Epochs that count over all."""
        return np.asarray(sums[f"{self.name}_n"] > 0)

    def independent(self, layout: Layout, n: NDArray[np.int64]) -> int:
        """How many independent values the mean over all epochs has, given how many each has."""
        raise NotImplementedError

    def sum(self, members: Members) -> Sums:
        """Sum and count at each epoch; of each member, its mean over time."""
        values = members.history[self.name]
        finite = np.isfinite(values)
        return {
            f"{self.name}_sum": np.where(finite, values, 0.0).sum(axis=1),
            f"{self.name}_n": finite.sum(axis=1).astype(np.int64),
            f"member_{self.name}": _row_mean(values.T),
        }

    def mean(self, sums: Sums) -> FloatArray:
        """Mean over the members, (n_epochs,); NaN where there is none."""
        n = sums[f"{self.name}_n"]
        return np.where(n > 0, sums[f"{self.name}_sum"] / np.maximum(n, 1), np.nan)

    def columns(self, layout: Layout, sums: Sums) -> Columns:
        """The mean, and the bounds of its 95 % interval."""
        bounds = _bounds(self.degrees(layout, sums), sums[f"{self.name}_n"])
        return {
            self.name: (("time",), self.mean(sums)),
            f"{self.name}_low": (("time",), bounds[:, 0]),
            f"{self.name}_high": (("time",), bounds[:, 1]),
        }

    def summarize(self, layout: Layout, sums: Sums) -> dict[str, Any]:
        """Time mean, its interval, and the part of epochs inside theirs."""
        given = self.counted(sums)
        if not given.any():
            return {self.name: {"mean": None, "interval_95": None, "fraction_inside": None}}
        mean = self.mean(sums)[given]
        n, dof = sums[f"{self.name}_n"][given], self.degrees(layout, sums)[given]
        bounds = _bounds(dof, n)
        inside = (mean >= bounds[:, 0]) & (mean <= bounds[:, 1])
        return {
            self.name: {
                "mean": float(np.average(mean, weights=n)),
                "dof": float(np.average(dof, weights=n)),
                "interval_95": list(
                    chi_square_interval(float(np.mean(dof)), self.independent(layout, n))
                ),
                "fraction_inside": float(inside.mean()),
            }
        }

    def facts(self, summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """One sentence."""
        found = summary.get(self.name)
        if found and found["mean"] is not None:
            low, high = found["interval_95"]
            yield (
                self.name.upper(),
                f"{number(found['mean'])} on average, expected {number(found['dof'])}, "
                f"95 % interval {number(low)} to {number(high)}; "
                f"{found['fraction_inside']:.0%} of the epochs inside theirs",
            )


class Nees(Consistency):
    """Normalized estimation error squared; it is correlated from epoch to epoch."""

    name = "nees"
    merged = ("nees_sum", "nees_n")

    def degrees(self, layout: Layout, sums: Sums) -> FloatArray:
        """As many as axes that it is of."""
        return np.full(len(sums["nees_n"]), float(layout.nees_axes))

    def counted(self, sums: Sums) -> NDArray[np.bool_]:
        """Those at fixes, where there are any."""
        given = super().counted(sums)
        at_fixes = given & (sums["nis_n"] > 0) if "nis_n" in sums else given
        return at_fixes if at_fixes.any() else given

    def independent(self, layout: Layout, n: NDArray[np.int64]) -> int:
        """As many as members: an interval is that of a single epoch."""
        return int(n.max())

    def sum(self, members: Members) -> Sums:
        """Nothing where it is not published."""
        return super().sum(members) if self.name in members.history else {}


class Nis(Consistency):
    """Normalized innovation squared, and the test of its sum; of several measurements, of each."""

    name = "nis"
    merged = ("nis_sum", "nis_n", "dof", "nis_of_sum", "nis_of_n", "nis_of_dof")
    families = ("NIS",)
    spoiled_by_bias = True

    def degrees(self, layout: Layout, sums: Sums) -> FloatArray:
        """Mean number of elements measured."""
        del layout
        n = sums["nis_n"]
        return np.where(n > 0, sums["dof"] / np.maximum(n, 1), 0.0)

    def independent(self, layout: Layout, n: NDArray[np.int64]) -> int:
        """Every value, where innovations are white; else as many as members."""
        return int(n.sum() if layout.white else n.max())

    def sum(self, members: Members) -> Sums:
        """The degrees of freedom too; and over all epochs of each measurement."""
        if not members.layout.has_innovation:
            return {}
        dof = _total(members.history["nis_dof"], axis=1)
        names = [f"{name}_nis" for name in members.layout.measurements] or ["nis"]
        values = [members.history[name] for name in names]
        return super().sum(members) | {
            "dof": dof,
            "nis_of_sum": np.array([_total(v) for v in values]),
            "nis_of_n": np.array([np.isfinite(v).sum() for v in values], dtype=np.int64),
            "nis_of_dof": np.array([_total(members.history[f"{name}_dof"]) for name in names]),
        }

    def summarize(self, layout: Layout, sums: Sums) -> dict[str, Any]:
        """Means of each measurement too, where there are several."""
        found = super().summarize(layout, sums)
        n = np.maximum(sums["nis_of_n"], 1)
        for k, name in enumerate(layout.measurements):
            mean = sums["nis_of_sum"][k] / n[k] if sums["nis_of_n"][k] else None
            found["nis"].setdefault("of", {})[name] = {
                "mean": mean if mean is None else float(mean),
                "dof": float(sums["nis_of_dof"][k] / n[k]),
                "n": int(sums["nis_of_n"][k]),
            }
        return found

    def facts(self, summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """One sentence, and one of each measurement."""
        yield from super().facts(summary)
        for name, of in (summary.get("nis") or {}).get("of", {}).items():
            if of["mean"] is not None:
                yield (
                    f"NIS of {name}",
                    f"{number(of['mean'])} on average, expected {number(of['dof'])}, "
                    f"over {of['n']} innovations",
                )

    def judge(self, layout: Layout, sums: Sums, share: float) -> Evidence:
        """Test the sum over everything, measurement by measurement."""
        total, n, dof = (sums[f"nis_of_{what}"] for what in ("sum", "n", "dof"))
        given = np.flatnonzero(dof)
        if not len(given):
            return [], 0

        def describe(worst: Any) -> str:
            k = int(given[worst])
            of = f" of {layout.measurements[k]}" if layout.measurements else ""
            return (
                f"NIS{of} is {total[k] / n[k]:.4g} on average, expected "
                f"{dof[k] / n[k]:.4g}, over {n[k]} innovations"
            )

        # alike all the time, at worst: they say no more than those of one epoch
        epochs = 1 if layout.white else int((sums["nis_n"] > 0).sum())
        return judge_ratios(total[given] / dof[given], dof[given] / epochs, describe, share)


def _total(values: FloatArray, axis: int | None = None) -> Any:
    """Sum of what is finite."""
    return np.where(np.isfinite(values), values, 0.0).sum(axis=axis)


def _bounds(dof: FloatArray, n: NDArray[np.int64]) -> FloatArray:
    """95 % intervals of the mean of `n` values each, (n_epochs, 2); NaN where there is none."""
    pairs = [(float(d), int(k)) for d, k in zip(dof, n, strict=True)]
    found = {
        (d, k): chi_square_interval(d, k) if k and d else (np.nan, np.nan) for d, k in set(pairs)
    }
    return np.array([found[pair] for pair in pairs])


def _row_mean(rows: FloatArray) -> FloatArray:
    rows = np.ascontiguousarray(rows)
    finite = np.isfinite(rows)
    n = finite.sum(axis=1)
    total = np.where(finite, rows, 0.0).sum(axis=1)
    return np.where(n > 0, total / np.maximum(n, 1), np.nan)
