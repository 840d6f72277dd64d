"""A recorded run, smoothed: what its filter would have known of every instant at the end.

The filter's predict part puts out the transition of its error (``smoothed = True`` of a
`FilterPredict`; the type ``mekf_predict_smoothed``). A run that records it beside priors and
estimates can be smoothed as often as wanted, here or on another machine: the record says which
blocks the error state has.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafix.components.filters.family import SINCE, TRANSITION, TRANSITION_OF
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.show.numbers import number, shown_unit
from terrafix.cosim.show.tables import Block, Shown, Table
from terrafix.models.filters.consistency import normalized_square
from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.smoother import Estimates, smooth

if TYPE_CHECKING:
    import xarray

    from terrafix.cosim.engine.result import Result


@dataclass(repr=False)
class SmoothedRun(Shown):
    """Smoothed estimates of a recorded run.

    Attributes
    ----------
    predict : str
        Path of the filter's predict part.
    state : ErrorState
    dataset : xarray.Dataset
        ``smoothed.BLOCK``, ``smoothed.P``, ``smoothed.sigma`` and ``filter.sigma``, by the labels
        of the error, at the times of the corrections that were accepted, the start and the end;
        ``smoothed.error`` (estimate minus truth), ``filter.error`` and the NEES of both where the
        truth was recorded.
    missing : tuple of str
        Ports of the truth that were not recorded.
    """

    predict: str
    state: ErrorState
    dataset: xarray.Dataset
    missing: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Plain types: root mean squares over times and members, NEES with its 95 % interval."""
        d = self.dataset
        found: dict[str, Any] = {
            "predict": self.predict,
            "times": int(d.sizes["time"]),
            "members": int(d.sizes["member"]),
            "axes": list(self.state.labels),
            "not_recorded": list(self.missing),
        }
        kinds = ["sigma"] if self.missing else ["sigma", "error"]
        for who in ("filter", "smoothed"):
            found[who] = {kind: _rms(d[f"{who}.{kind}"].values) for kind in kinds}
            if not self.missing:
                nees = d[f"{who}.nees"].values
                low, high = chi_square_interval(float(self.state.size), nees.shape[1])
                mean = np.nanmean(nees, axis=1)
                found[who]["nees"] = {
                    "mean": float(np.nanmean(nees)),
                    "dof": self.state.size,
                    "interval_95": [low, high],
                    "fraction_inside": float(((mean >= low) & (mean <= high)).mean()),
                }
        return found

    def _shown(self) -> Sequence[Block]:
        return list(self._blocks())

    def _blocks(self) -> Iterator[Block]:
        summary = self.summary()
        known = not self.missing
        headers = ["root mean square", "axis", "unit", "filter sigma", "smoothed sigma"]
        headers += ["filter error", "smoothed error"] if known else []
        rows, at = [], 0
        for block in self.state:
            value = str(self.dataset[f"smoothed.{block.name}"].attrs["units"])
            unit, factor = shown_unit("rad" if block.is_rotation else value)
            for k, axis in enumerate(block.axes):
                row = [block.name if k == 0 else "", axis, unit]
                for kind in ("sigma", "error") if known else ("sigma",):
                    for who in ("filter", "smoothed"):
                        value = summary[who][kind][at]
                        row.append(number(None if value is None else value * factor))
                rows.append(row)
                at += 1
        yield Table(headers, rows, words=3, grouped=True)
        for who in ("filter", "smoothed") if known else ():
            nees = summary[who]["nees"]
            low, high = nees["interval_95"]
            yield (
                f"NEES {who} mean {number(nees['mean'])} for {nees['dof']} degrees of freedom, "
                f"95 % interval of one time [{number(low)}, {number(high)}], "
                f"{nees['fraction_inside']:.0%} of the times inside"
            )
        if not known:
            yield f"no errors: the truth in {', '.join(self.missing)} was not recorded"


def smooth_run(
    run: str | Path | Result | xarray.Dataset, *, predict: str | None = None
) -> SmoothedRun:
    """Smooth a recorded run.

    Parameters
    ----------
    run : path, Result or xarray.Dataset
        A result file, or what `terrafix.simulate` returned.
    predict : str, optional
        Path of the filter's predict part, where there are several.

    Raises
    ------
    ConfigurationError
        If the run holds nothing to smooth, or not all that it takes.
    """
    dataset = _dataset(run)
    predict = _choose(dataset, predict)
    transition = dataset[f"{predict}.{TRANSITION}"]
    text = str(transition.attrs.get("long_name", "")).partition(TRANSITION_OF)[2]
    state = ErrorState.from_text(text)
    connections = json.loads(dataset.attrs["configuration"])["connections"]
    correct = _source(connections, f"{predict}.posterior").rpartition(".")[0]
    names = [block.name for block in state]
    needed = [f"{predict}.prior.{n}" for n in (*names, "P")]
    needed += [f"{correct}.estimate.{n}" for n in (*names, "P")]
    needed.append(f"{predict}.{SINCE}")
    axis = transition.dims[0]
    recorded = {name: _recorded(dataset, name, axis) for name in needed}
    for name, variable in recorded.items():
        if variable is None:
            raise ConfigurationError(
                f"the run records '{predict}.{TRANSITION}', but not '{name}' at the same times\n"
                f"  {_advice(predict, correct)}"
            )
    times = np.asarray(dataset[axis].values, dtype=np.float64)
    prior, posterior = (
        Estimates(
            {n: _array(recorded[f"{head}.{n}"], 1) for n in names}, _array(recorded[f"{head}.P"], 2)
        )
        for head in (f"{predict}.prior", f"{correct}.estimate")
    )
    since = _array(recorded[f"{predict}.{SINCE}"], 1)[..., 0]
    found = smooth(state, times, prior, posterior, _array(transition, 2), since)
    if len(times) > 1 and not np.isfinite(found.P[:-1]).any():
        raise ConfigurationError(
            f"the last transition counts from t = {np.nanmax(since[-1]):g} s, and the run records "
            f"nothing then, only at {_listed(times)} s\n  {_advice(predict, correct)}"
        )
    return _labeled(dataset, predict, correct, connections, state, times, found, posterior)


def _dataset(run: Any) -> xarray.Dataset:
    if isinstance(run, str | Path):
        from terrafix.cosim.records.results import read_result

        return read_result(run)
    found = getattr(run, "dataset", run)
    if not hasattr(found, "data_vars"):
        raise ConfigurationError(
            f"a run to smooth is a result file, a Result or its dataset, not a "
            f"{type(run).__name__}\n  give the path of a file that `terrafix run --out` wrote"
        )
    return found  # type: ignore[no-any-return]


def _choose(dataset: xarray.Dataset, asked: str | None) -> str:
    """Path of the predict part whose transition was recorded."""
    ending = f".{TRANSITION}"
    filters = [str(v).removesuffix(ending) for v in dataset.data_vars if str(v).endswith(ending)]
    if not filters:
        raise ConfigurationError(
            "the run holds no transition of a filter's error: there is nothing to smooth\n"
            "  fly a filter that puts it out (type mekf_predict_smoothed, or `smoothed = True` of "
            f"a FilterPredict),\n  and {_advice('predict', 'correct')}"
        )
    if asked is not None and asked not in filters:
        raise ConfigurationError(
            f"the run holds no transition of '{asked}'; it holds those of {', '.join(filters)}"
        )
    if asked is None and len(filters) > 1:
        raise ConfigurationError(
            f"the run holds transitions of {', '.join(filters)}\n  say which one to smooth"
        )
    return asked or filters[0]


def _advice(predict: str, correct: str) -> str:
    ports = [f"{predict}.{TRANSITION}", f"{predict}.{SINCE}", f"{predict}.prior"]
    listed = ", ".join(f'"{port}"' for port in (*ports, f"{correct}.estimate"))
    return f"record together, at the times of the corrections and at 0: {listed}"


def _source(connections: Sequence[str], target: str) -> str:
    """Port that is connected to another."""
    for text in connections:
        source, _, to = text.partition(" -> ")
        if to.split(" ")[0] == target:
            return source
    return ""


def _recorded(dataset: xarray.Dataset, name: str, axis: Any) -> xarray.DataArray | None:
    """A variable on a time axis; where several records hold it, ``NAME@RECORD`` is another."""
    for key in dataset.data_vars:
        if str(key).partition("@")[0] == name and dataset[key].dims[0] == axis:
            return dataset[key]
    return None


def _listed(times: FloatArray) -> str:
    shown = [f"{t:g}" for t in times]
    return ", ".join(shown if len(shown) < 6 else [*shown[:3], "...", shown[-1]])


def _array(variable: Any, n_axes: int) -> FloatArray:
    """Values (times, members, ...)."""
    values = np.asarray(variable.values, dtype=np.float64)
    return values.reshape(*values.shape[:2], *(values.shape[2:] or (1,) * n_axes))


def _labeled(
    source: xarray.Dataset,
    predict: str,
    correct: str,
    connections: Sequence[str],
    state: ErrorState,
    times: FloatArray,
    smoothed: Estimates,
    filtered: Estimates,
) -> SmoothedRun:
    """What was found as a dataset, with errors where the truth was recorded."""
    import xarray

    finite = np.isfinite(smoothed.P).reshape(*smoothed.P.shape[:2], -1)
    kept = np.flatnonzero(np.any(finite, axis=(1, 2)))
    axis = str(source[f"{predict}.{TRANSITION}"].dims[0])
    n = state.size
    variables: dict[str, Any] = {}
    for block in state:
        recorded = source[f"{predict}.prior.{block.name}"].attrs
        variables[f"smoothed.{block.name}"] = (
            ("time", "member", f"value_{block.value_size}"),
            smoothed.values[block.name][kept],
            {
                "units": recorded.get("units", ""),
                "frame": recorded.get("frame", ""),
            },
        )
    variables["smoothed.P"] = (("time", "member", "axis", "axis_b"), smoothed.P[kept])
    for who, estimates in (("filter", filtered), ("smoothed", smoothed)):
        variance = np.diagonal(estimates.P[kept], axis1=2, axis2=3)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        variables[f"{who}.sigma"] = (("time", "member", "axis"), sigma)
    truth, missing = _truth(source, correct, connections, state, axis)
    if truth:
        names = [block.name for block in state]
        for who, estimates in (("filter", filtered), ("smoothed", smoothed)):
            values = [estimates.values[name][kept] for name in names]
            error = state.difference_of_arrays(*values, *(truth[name][kept] for name in names))
            nees = normalized_square(error.reshape(-1, n), estimates.P[kept].reshape(-1, n, n))
            variables[f"{who}.error"] = (("time", "member", "axis"), error)
            variables[f"{who}.nees"] = (("time", "member"), nees.reshape(error.shape[:2]))
    coordinates = {
        "time": ("time", times[kept], {"units": "s"}),
        "member": source["member"].values,
        "axis": list(state.labels),
        "axis_b": list(state.labels),
    }
    attributes = {
        name: source.attrs[name] for name in ("system", "seed", "schema") if name in source.attrs
    }
    attributes |= {"predict": predict, "error_state": state.text}
    dataset = xarray.Dataset(variables, coordinates, attributes)
    return SmoothedRun(predict, state, dataset, tuple(missing))


def _truth(
    source: xarray.Dataset,
    correct: str,
    connections: Sequence[str],
    state: ErrorState,
    axis: str,
) -> tuple[dict[str, FloatArray], list[str]]:
    """True values of the blocks as the evaluation reads them; and what of it was not recorded."""
    judge = ""
    for text in connections:
        port, _, target = text.partition(" -> ")
        if port == f"{correct}.estimate" and target.split(" ")[0].endswith(".estimate"):
            judge = target.split(" ")[0].removesuffix(".estimate")
    if not judge:
        return {}, [f"an evaluation of {correct}.estimate"]
    found, missing = {}, []
    for block in state:
        port = _source(connections, f"{judge}.{block.name}")
        variable = _recorded(source, port, axis)
        if variable is not None:
            found[block.name] = _array(variable, 1)
        else:
            missing.append(port or f"{judge}.{block.name}")
    return ({}, missing) if missing else (found, [])


def _rms(values: FloatArray) -> list[float | None]:
    """Root mean square over times and members, by axis."""
    flat = values.reshape(-1, values.shape[-1])
    given = np.isfinite(flat)
    n = given.sum(axis=0)
    total = np.where(given, flat, 0.0) ** 2
    return [float(np.sqrt(t / k)) if k else None for t, k in zip(total.sum(axis=0), n, strict=True)]
