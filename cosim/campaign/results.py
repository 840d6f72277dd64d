"""A campaign's result as labeled arrays and as plain types."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.campaign.batch import BlockResult
from terrafix.cosim.campaign.statistics.ensemble import Statistics
from terrafix.cosim.campaign.statistics.statistic import BLOCK, SHOWN
from terrafix.cosim.campaign.verdict import Verdict

if TYPE_CHECKING:
    import xarray


SCHEMA = "terrafix-campaign-result/1"
MOST_NAMED = 1000
"""Failed members listed in a result; all are counted, and all are in the blocks."""
COMMON = ("member", "quantile")
"""Dimensions that all evaluation components share."""


@dataclass(repr=False)
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

    def __repr__(self) -> str:
        """A table of the errors at the end, and the verdict."""
        from terrafix.cosim.campaign.display import as_text

        return as_text(self)

    def _repr_html_(self) -> str:
        from terrafix.cosim.campaign.display import as_html

        return as_html(self)

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


def summary_of(result: CampaignResult) -> dict[str, Any]:
    """Plain types for JSON; by evaluation component where there are several."""
    from terrafix.cosim.records.results import cpu_name, versions

    each = {
        path: s.summary() | {"verdict": result.verdicts[path].summary()}
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
    for path, s in result.statistics.items():
        prefix = f"{path}:" if len(result.statistics) > 1 else ""
        time, axis = f"{prefix}time", f"{prefix}axis"
        coordinates[time] = (time, s.layout.times, {"units": "s"})
        coordinates[axis] = s.layout.labels
        coordinates[f"{prefix}unit"] = (axis, s.layout.units)
        coordinates[f"{axis}_b"] = s.layout.labels
        for name, (dims, values) in s.columns().items():
            own = [dim if dim in COMMON else f"{prefix}{dim}" for dim in dims]
            into = coordinates if dims == (name,) else variables
            into[name if name in COMMON else f"{prefix}{name}"] = (own, values)
    for name, values in result.parameters.items():
        dims = [f"dim_{extent}" for extent in values.shape[1:]]
        dims = [d if dims.index(d) == i else f"{d}b" for i, d in enumerate(dims)]
        about = {"units": result.parameter_units.get(name, "")}
        variables[f"parameter:{name}"] = (["member", *dims], values[:SHOWN], about)
    return xarray.Dataset(variables, coordinates, _attributes(result))


def _attributes(result: CampaignResult) -> dict[str, Any]:
    from terrafix.cosim.records.results import cpu_name, versions

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
