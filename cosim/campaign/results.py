"""A campaign's result as labeled arrays and as plain types."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.campaign.outcome import Outcome
from terrafix.cosim.campaign.statistics.statistic import SHOWN

if TYPE_CHECKING:
    import xarray

SCHEMA = "terrafix-campaign-result/1"
COMMON = ("member", "quantile")
"""Dimensions that all evaluation components share."""


class CampaignResult(Outcome):
    """What a campaign gives back; `Outcome` says what each attribute is."""

    def summary(self) -> dict[str, Any]:
        """Plain types, for JSON."""
        return summary_of(self)

    def dataset(self) -> xarray.Dataset:
        """Statistics as an `xarray.Dataset`."""
        return build_result(self)

    def __repr__(self) -> str:
        """A table of the errors at the end, and the verdict."""
        from terrafix.cosim.campaign.display import as_text

        return as_text(self)

    def _repr_html_(self) -> str:
        from terrafix.cosim.campaign.display import as_html

        return as_html(self)


def summary_of(result: CampaignResult) -> dict[str, Any]:
    """Plain types for JSON; by evaluation component where there are several."""
    from terrafix.cosim.basics.machine import cpu_name
    from terrafix.cosim.records.results import versions

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
        "versions": versions(result.configuration.get("epoch")),
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
        own = [f"dim_{extent}" for extent in values.shape[1:]]
        own = [d if own.index(d) == i else f"{d}b" for i, d in enumerate(own)]
        about = {"units": result.parameter_units.get(name, "")}
        variables[f"parameter:{name}"] = (["member", *own], values[:SHOWN], about)
    return xarray.Dataset(variables, coordinates, _attributes(result))


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
        "versions": versions(result.configuration.get("epoch")),
        "paths": list(result.statistics),
    }
    return {
        k: v if isinstance(v, str | int | float) else json.dumps(v, default=str)
        for k, v in plain.items()
    }
