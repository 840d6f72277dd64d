"""A campaign's result as labeled arrays and as plain types."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.campaign.batch import BlockResult
from terrafix.cosim.campaign.statistics import BLOCK, QUANTILES, SHOWN, Statistics
from terrafix.cosim.campaign.verdict import Verdict

if TYPE_CHECKING:
    import xarray


SCHEMA = "terrafix-campaign-result/1"
MOST_NAMED = 1000
"""Failed members listed in a result; all are counted, and all are in the blocks."""


@dataclass
class CampaignResult:
    """What a campaign gives back.

    Attributes
    ----------
    system : str
    seed, runs : int
    statistics : dict of str to Statistics
        By evaluation component.
    verdicts : dict of str to Verdict
    excluded : list of dict
        Failed members, up to `MOST_NAMED`: ``member``, ``component``, ``t_s``, ``reason``.
    n_excluded : int
    parameters : dict of str to ndarray
        Dispersed parameters as they reached the components, of the first `SHOWN` members.
    kernel : str
    wall_s, setup_s : float
        Time of flying and merging; time to check and build before it.
    workers : str
        What flew it.
    configuration : dict
        Everything that was set.
    out : Path or None
    """

    system: str
    doc: str
    seed: int
    runs: int
    duration: Fraction
    configuration: dict[str, Any]
    statistics: dict[str, Statistics]
    workers: str
    setup_s: float
    wall_s: float = 0.0
    kernel: str = ""
    verdicts: dict[str, Verdict] = field(default_factory=dict)
    excluded: list[dict[str, Any]] = field(default_factory=list)
    n_excluded: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    parameter_units: dict[str, str] = field(default_factory=dict)
    graph: str = ""
    source: dict[str, Any] = field(default_factory=dict)
    out: Path | None = None

    def summary(self) -> dict[str, Any]:
        """Plain types, for JSON."""
        return summary_of(self)

    def dataset(self) -> Any:
        """Statistics as an `xarray.Dataset`."""
        return build_result(self)

    def add(self, block: BlockResult) -> None:
        """Take up the statistics and failures of one block; blocks come in order."""
        for path, sums in block.sums.items():
            self.statistics[path].add(sums)
        self.n_excluded += len(block.excluded)
        for each in block.excluded:
            self.reasons[each["reason"]] = self.reasons.get(each["reason"], 0) + 1
            if len(self.excluded) < MOST_NAMED:
                self.excluded.append(each)
        if block.number * BLOCK < SHOWN:
            for name, values in block.parameters.items():
                before = [self.parameters[name]] if name in self.parameters else []
                self.parameters[name] = np.concatenate([*before, values])
        kinds = {k for k in [*self.kernel.split("+"), *block.kernel.split("+")] if k}
        self.kernel = "+".join(sorted(kinds))


def ratio_interval(n: int, probability: float = 0.95) -> tuple[float, float]:
    r"""Factors from a ratio of sigmas (sample over predicted) to its confidence interval.

    :math:`\sqrt{(n - 1) / \chi^2_{n-1}(1 - \alpha/2)}` and :math:`\ldots(\alpha/2)`.
    """
    low, high = chi_square_interval(1.0, n - 1, probability)
    return 1.0 / np.sqrt(high), 1.0 / np.sqrt(low)


def _plain(values: Any) -> Any:
    return [
        _plain(v) if np.ndim(v) else (float(v) if np.isfinite(v) else None)
        for v in np.asarray(values)
    ]


def _consistency(statistics: Statistics, name: str, dof: FloatArray) -> dict[str, Any]:
    """Time mean of NEES or NIS, its interval, and the part of epochs inside theirs."""
    mean = statistics.mean_of(name)
    n = statistics.sums[f"{name}_n"]
    given = n > 0
    if name == "nees" and "nis_n" in statistics.sums:
        at_fixes = given & (statistics.sums["nis_n"] > 0)
        given = at_fixes if at_fixes.any() else given
    if not given.any():
        return {"mean": None, "interval_95": None, "fraction_inside": None}
    bounds = np.array(
        [chi_square_interval(float(d), int(k)) for d, k in zip(dof[given], n[given], strict=True)]
    )
    inside = (mean[given] >= bounds[:, 0]) & (mean[given] <= bounds[:, 1])
    count = int(n[given].sum()) if name == "nis" else int(n[given].max())
    whole = float(np.average(mean[given], weights=n[given]))
    return {
        "mean": whole,
        "dof": float(np.average(dof[given], weights=n[given])),
        "interval_95": list(chi_square_interval(float(np.mean(dof[given])), count)),
        "fraction_inside": float(inside.mean()),
    }


def degrees(statistics: Statistics, name: str) -> FloatArray:
    """Expected value of NEES or NIS at each epoch."""
    if name == "nees":
        return np.full(len(statistics.n), float(len(statistics.layout.labels)))
    n = statistics.sums["nis_n"]
    return np.where(n > 0, statistics.sums["dof"] / np.maximum(n, 1), 0.0)


def _evaluation(statistics: Statistics) -> dict[str, Any]:
    n = int(statistics.n[-1])
    sample = np.sqrt(np.diagonal(statistics.covariance_sample[-1]))
    predicted = np.sqrt(np.diagonal(statistics.covariance_predicted[-1]))
    mean = statistics.mean[-1]
    low, high = ratio_interval(n) if n > 1 else (np.nan, np.nan)
    found: dict[str, Any] = {"n": n, "t_s": float(statistics.layout.times[-1])}
    start = 0
    for name, unit, axes in statistics.layout.quantities:
        part = slice(start, start + len(axes))
        start += len(axes)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = sample[part] / predicted[part]
        found[name] = {
            "unit": unit,
            "axes": list(axes),
            "mean_error": _plain(mean[part]),
            "standard_error": _plain(sample[part] / np.sqrt(max(n, 1))),
            "sigma_sample": _plain(sample[part]),
            "sigma_predicted": _plain(predicted[part]),
            "ratio": _plain(ratio),
            "ratio_interval_95": _plain(np.stack([low * ratio, high * ratio], axis=1)),
        }
    for name in ("nees", "nis"):
        if f"{name}_n" in statistics.sums:
            found[name] = _consistency(statistics, name, degrees(statistics, name))
    if "lag_n" in statistics.sums:
        rho, pairs = statistics.whiteness
        found["whiteness"] = {
            "correlation": _plain(rho),
            "standard_error": _plain(1.0 / np.sqrt(np.maximum(pairs, 1))),
        }
    return found


def summary_of(result: CampaignResult) -> dict[str, Any]:
    """Plain types for JSON; by evaluation component where there are several."""
    from terrafix.cosim.basics.machine import cpu_name
    from terrafix.cosim.records.results import versions

    each = {
        path: _evaluation(s) | {"verdict": result.verdicts[path].summary()}
        for path, s in result.statistics.items()
    }
    return {
        "system": result.system,
        "seed": result.seed,
        "runs": result.runs,
        "duration_s": float(result.duration),
        "excluded": result.n_excluded,
        "excluded_members": result.excluded[:20],
        "reasons": result.reasons,
        "kernel": result.kernel,
        "workers": result.workers,
        "setup_s": result.setup_s,
        "wall_s": result.wall_s,
        "cpu": cpu_name(),
        "versions": versions(),
        "evaluation": next(iter(each.values())) if len(each) == 1 else each,
    }


def build_result(result: CampaignResult) -> xarray.Dataset:
    """Statistics as labeled arrays; names begin with the path where there are several."""
    import xarray

    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}
    several = len(result.statistics) > 1
    for path, s in result.statistics.items():
        prefix = f"{path}:" if several else ""
        time, axis = f"{prefix}time", f"{prefix}axis"
        coordinates[time] = (time, s.layout.times, {"units": "s"})
        coordinates[axis] = s.layout.labels
        coordinates[f"{prefix}unit"] = (axis, s.layout.units)
        coordinates["quantile"] = list(QUANTILES)
        both = (time, axis, f"{axis}_b")
        coordinates[f"{axis}_b"] = s.layout.labels
        n = np.maximum(s.n, 1)
        sample = np.sqrt(np.diagonal(s.covariance_sample, axis1=1, axis2=2))
        found = {
            "n": (time, s.n),
            "mean_error": ((time, axis), s.mean),
            "standard_error": ((time, axis), sample / np.sqrt(n)[:, None]),
            "covariance_sample": (both, s.covariance_sample),
            "covariance_predicted": (both, s.covariance_predicted),
            "normalized_error_quantiles": (("quantile", time, axis), s.quantiles()),
        }
        for name in ("nees", "nis"):
            if f"{name}_n" in s.sums:
                dof = degrees(s, name)
                bounds = np.array(
                    [
                        chi_square_interval(float(d), int(k)) if k and d else (np.nan, np.nan)
                        for d, k in zip(dof, s.sums[f"{name}_n"], strict=True)
                    ]
                )
                found[name] = (time, s.mean_of(name))
                found[f"{name}_low"] = (time, bounds[:, 0])
                found[f"{name}_high"] = (time, bounds[:, 1])
        if "lag_n" in s.sums:
            rho, pairs = s.whiteness
            found["innovation_correlation"] = (f"{prefix}element", rho)
            found["innovation_pairs"] = (f"{prefix}element", pairs)
        if "shown_error" in s.sums:
            shown = (time, "member", axis)
            coordinates["member"] = np.arange(s.sums["shown_error"].shape[1])
            found["error"] = (shown, s.sums["shown_error"])
            found["sigma"] = (shown, s.sums["shown_sigma"])
            if "shown_nees" in s.sums:
                found["member_nees"] = ((time, "member"), s.sums["shown_nees"])
        variables |= {f"{prefix}{name}": value for name, value in found.items()}
    for name, values in result.parameters.items():
        dims = [f"dim_{extent}" for extent in values.shape[1:]]
        dims = [d if dims.index(d) == i else f"{d}b" for i, d in enumerate(dims)]
        unit = {"units": result.parameter_units.get(name, "")}
        variables[f"parameter:{name}"] = (["member", *dims], values[:SHOWN], unit)
    attributes = _attributes(result)
    return xarray.Dataset(variables, coordinates, attributes)


def _attributes(result: CampaignResult) -> dict[str, Any]:
    from terrafix.cosim.basics.machine import cpu_name
    from terrafix.cosim.records.results import versions

    verdicts: Mapping[str, Any] = {p: v.summary() for p, v in result.verdicts.items()}
    plain = {
        "schema": SCHEMA,
        "system": result.system,
        "doc": result.doc,
        "seed": result.seed,
        "runs": result.runs,
        "duration": f"{text_seconds(result.duration)} s",
        "kernel": result.kernel,
        "workers": result.workers,
        "setup_s": result.setup_s,
        "wall_s": result.wall_s,
        "cpu": cpu_name(),
        "excluded": result.excluded,
        "n_excluded": result.n_excluded,
        "reasons": result.reasons,
        "verdicts": verdicts,
        "configuration": result.configuration,
        "graph": result.graph,
        "source": result.source,
        "versions": versions(),
        "paths": list(result.statistics),
    }
    return {
        k: v if isinstance(v, str | int | float) else json.dumps(v, default=str)
        for k, v in plain.items()
    }
