"""Pictures of a result: Monte Carlo errors with predicted and sample sigma, or recorded signals.

For an evaluation: the error of every member in gray, the sample mean dashed in black, three
predicted sigma in red and three sample sigma in green, one panel per quantity and axis. A
predicted sigma is the root mean square over members, as in the published numbers. Elsewhere: the
recorded signals over time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.ensembles import member_mean, root_mean_square, sample_sigma
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.show.numbers import shown_unit

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

POINTS = 1200
"""Points of a line; beyond, pairs of least and greatest value of equal stretches are drawn."""
WIDEST = 9
"""Signals of more elements are not drawn."""
SETTLED = 0.95
"""Part of the time in which a line must fit into its panel; a first transient may not."""
LATE = 3.0
"""A transient this many times larger than what follows is cut off, and said to be."""
GRAY, PREDICTED, SAMPLE = "0.72", "#d62728", "#2ca02c"


@dataclass(frozen=True)
class Panel:
    """Error history of one axis of one quantity, in the unit shown.

    Attributes
    ----------
    title, axis, unit : str
    times : ndarray, shape (n,) [s]
    error : ndarray, shape (n, n_members)
    predicted : ndarray, shape (n,)
        One sigma.
    sample, mean : ndarray, shape (n,), optional
        Of all members, where `error` holds some of them; computed from `error` if absent.
    """

    title: str
    axis: str
    unit: str
    times: FloatArray
    error: FloatArray
    predicted: FloatArray
    sample: FloatArray | None = None
    mean: FloatArray | None = None


def plot_result(dataset: xarray.Dataset, path: str | Path) -> None:
    """Draw a result to a .png, .svg or .pdf file; the same result gives the same file.

    Raises
    ------
    ConfigurationError
        If there is nothing to draw, or the file cannot be written.
    """
    path = Path(path)
    about = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with own_style():
        drawn = figure(dataset)
        kinds = drawn.canvas.get_supported_filetypes()
        if path.suffix.lower().removeprefix(".") not in kinds:
            raise ConfigurationError(
                f"'{path}' is no picture\n  its ending says what is drawn: "
                f"name it '{path.with_suffix('.png').name}'"
            )
        try:
            drawn.savefig(path, dpi=150, metadata=about.get(path.suffix.lower()))
        except OSError as error:
            raise ConfigurationError(f"cannot write '{path}': {error.strerror}") from error


@contextmanager
def own_style() -> Iterator[None]:
    """Draw as we do, whatever style the user has set."""
    import matplotlib.style

    with (
        matplotlib.style.context("default", after_reset=True),
        matplotlib.rc_context({"svg.hashsalt": "terrafix", "axes.axisbelow": True}),
    ):
        yield


def result_figure(dataset: xarray.Dataset) -> Figure:
    """The figure of a result, which shows itself in a notebook.

    Raises
    ------
    ConfigurationError
        If there is nothing to draw.
    """
    with own_style():
        drawn = figure(dataset)
    # of its own, a figure shows itself only beside pyplot
    drawn._repr_png_ = partial(_png, drawn)  # type: ignore[attr-defined]
    return drawn


def _png(drawn: Figure) -> bytes:
    with own_style(), BytesIO() as file:
        drawn.savefig(file, format="png", dpi=90)
        return file.getvalue()


def figure(dataset: xarray.Dataset) -> Figure:
    """Build the figure of a result: of its evaluations if there are any, else of its signals.

    Raises
    ------
    ConfigurationError
        If there is nothing to draw.
    """
    found = evaluations(dataset)
    if found:
        return _evaluation_figure(dataset, found)
    signals = list(_signals(dataset))
    if not signals:
        raise ConfigurationError(f"the result of '{_name(dataset)}' holds nothing to draw")
    return _signal_figure(dataset, signals)


def _name(dataset: xarray.Dataset) -> str:
    return str(dataset.attrs.get("system", "run"))


# ---------------------------------------------------------------------- evaluations


def evaluations(dataset: xarray.Dataset) -> dict[str, dict[str, list[Panel]]]:
    """Panels by evaluation component and quantity: pairs of ``PATH.Q_error``, ``PATH.Q_sigma``."""
    found: dict[str, dict[str, list[Panel]]] = {}
    for name in map(str, dataset.data_vars):
        base = name.removesuffix("_error")
        owner, _, quantity = base.rpartition(".")
        if base == name or f"{base}_sigma" not in dataset or not owner:
            continue
        error = dataset[name]
        if error.ndim not in (2, 3) or not error.shape[0]:
            continue
        panels = list(_panels(quantity.replace("_", " "), error, dataset[f"{base}_sigma"]))
        found.setdefault(owner, {})[quantity] = panels
    return found


def _panels(title: str, error: xarray.DataArray, sigma: xarray.DataArray) -> Iterator[Panel]:
    unit, factor = shown_unit(str(error.attrs.get("units", "1")))
    times = _times(error)
    values = _by_element(error) * factor
    sigmas = _by_element(sigma) * factor
    for i, axis in enumerate(_element_names(error)):
        yield Panel(title, axis, unit, times, values[..., i], root_mean_square(sigmas[..., i]))


def _times(variable: xarray.DataArray) -> FloatArray:
    return np.asarray(variable[variable.dims[0]].values, dtype=np.float64)


def _by_element(variable: xarray.DataArray) -> FloatArray:
    values = np.asarray(variable.values, dtype=np.float64)
    return values.reshape(*values.shape[:2], -1)


def _element_names(variable: xarray.DataArray) -> list[str]:
    if variable.ndim == 2:
        return [""]
    last = variable.dims[-1]
    if variable.ndim == 3 and last in variable.coords:
        return [str(v) for v in variable[last].values]
    size = int(np.prod(variable.shape[2:]))
    return list("xyz") if variable.shape[2:] == (3,) else [str(i + 1) for i in range(size)]


def _evaluation_figure(
    dataset: xarray.Dataset, found: Mapping[str, Mapping[str, list[Panel]]]
) -> Figure:
    from matplotlib.figure import Figure

    columns = max(len(quantities) for quantities in found.values())
    heights = [max(len(p) for p in quantities.values()) for quantities in found.values()]
    drawn = Figure(
        figsize=(1.0 + 3.6 * columns, 1.1 + 1.75 * sum(heights) + 0.35 * len(found)),
        layout="constrained",
    )
    title = drawn.suptitle(_headline(dataset), fontsize=12)
    title.set_in_layout(True)
    blocks = drawn.subfigures(len(found), 1, squeeze=False, height_ratios=heights)[:, 0]
    handles: dict[str, Any] = {}
    for block, (path, quantities), rows in zip(blocks, found.items(), heights, strict=True):
        if len(found) > 1:
            block.suptitle(path, fontsize=11)
        axes = block.subplots(rows, columns, squeeze=False, sharex=True)
        for ax in axes.flat:
            ax.set_visible(False)
        for column, panels in enumerate(quantities.values()):
            for row, panel in enumerate(panels):
                ax = axes[row, column]
                ax.set_visible(True)
                handles |= draw_panel(ax, panel)
                if row == 0:
                    ax.set_title(f"{panel.title} error [{panel.unit}]", fontsize=10)
                if row == len(panels) - 1:
                    ax.set_xlabel("time [s]")
                    ax.tick_params(labelbottom=True)
    drawn.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        ncols=len(handles),
        frameon=False,
        fontsize=9,
    )
    return drawn


def _headline(dataset: xarray.Dataset) -> str:
    members = dataset.sizes.get("member", 1)
    text = _name(dataset)
    if members > 1:
        text += f", {members} members"
    if dataset.attrs.get("status", "complete") != "complete":
        text += " (incomplete)"
    return text


def draw_panel(ax: Any, panel: Panel) -> dict[str, Any]:
    """Draw one axis; gives the handles for the legend by what they mean."""
    from matplotlib.collections import LineCollection

    ensemble = panel.error.shape[1] > 1
    times, errors = _thinned(panel.times, panel.error)
    lines = LineCollection(
        [np.column_stack([times, e]) for e in errors.T],
        colors=GRAY if ensemble else "0.25",
        linewidths=0.5 if ensemble else 1.0,
        rasterized=ensemble,
        zorder=1,
    )
    ax.add_collection(lines)
    handles = {"error of each member" if ensemble else "error": lines}
    spread = 3 * panel.predicted
    handles["predicted 3 sigma"] = _both_signs(ax, panel.times, spread, PREDICTED, "-")
    bounds = [spread, np.abs(panel.error).max(axis=1, initial=0.0, where=np.isfinite(panel.error))]
    if ensemble:
        sample = 3 * (sample_sigma(panel.error) if panel.sample is None else panel.sample)
        handles["sample 3 sigma"] = _both_signs(ax, panel.times, sample, SAMPLE, (0, (4, 2)))
        mean = member_mean(panel.error) if panel.mean is None else panel.mean
        (line,) = ax.plot(
            *_thinned(panel.times, mean[:, None]),
            color="black",
            linestyle="--",
            linewidth=1.0,
            zorder=4,
        )
        handles["sample mean"] = line
        bounds.append(sample)
    _limit(ax, panel.times, bounds)
    if panel.axis:
        ax.set_ylabel(panel.axis, rotation=0, labelpad=8)
    ax.grid(visible=True, color="0.92", linewidth=0.6)
    ax.tick_params(labelsize=8)
    return handles


def _both_signs(ax: Any, times: FloatArray, values: FloatArray, color: str, style: Any) -> Any:
    thin_times, thin = _thinned(times, values[:, None])
    options = {"color": color, "linestyle": style, "linewidth": 1.2, "zorder": 3}
    (line,) = ax.plot(thin_times, thin, **options)
    ax.plot(thin_times, -thin, **options)
    return line


def _limit(ax: Any, times: FloatArray, bounds: list[FloatArray]) -> None:
    """Fit the panel to what holds for most of the time, and name what is cut off."""
    ax.set_xlim(times[0], times[-1] if times[-1] > times[0] else times[0] + 1.0)
    envelope = np.fmax.reduce(bounds)
    finite = envelope[np.isfinite(envelope)]
    if not finite.size or finite.max() == 0.0:
        return
    peak, settled = float(finite.max()), float(np.quantile(finite, SETTLED))
    limit = peak if peak < LATE * settled or settled == 0.0 else settled
    ax.set_ylim(-1.08 * limit, 1.08 * limit)
    if limit < peak:
        rounded = np.format_float_positional(peak, 2, fractional=False, trim="-")
        ax.text(
            0.98,
            0.95,
            f"up to {rounded} at t = {times[int(np.nanargmax(envelope))]:g} s",
            transform=ax.transAxes,
            ha="right",
            va="top",
            fontsize=7,
            color="0.35",
        )


def _thinned(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest value of equal stretches of a long history: peaks are kept.

    Parameters
    ----------
    times : ndarray, shape (n,)
    values : ndarray, shape (n, m)
    """
    n = len(times)
    if n <= POINTS:
        return times, values
    starts = np.linspace(0, n, POINTS // 2, endpoint=False).astype(np.intp)
    pairs = np.stack(
        [np.fmin.reduceat(values, starts, axis=0), np.fmax.reduceat(values, starts, axis=0)], axis=1
    )
    return np.repeat(times[starts], 2), pairs.reshape(-1, values.shape[1])


# ---------------------------------------------------------------------- signals


def _signals(dataset: xarray.Dataset) -> Iterator[str]:
    """Recorded variables that make a picture: numbers over time, of few elements."""
    for name in map(str, dataset.data_vars):
        variable = dataset[name]
        recorded = variable.ndim >= 2 and str(variable.dims[0]).startswith("time")
        if recorded and variable.dtype.kind == "f" and len(variable):
            stamp = name.endswith(".t") and name.removesuffix(".t") in _messages(dataset)
            if not stamp and int(np.prod(variable.shape[2:])) <= WIDEST:
                yield name


def _messages(dataset: xarray.Dataset) -> set[str]:
    """Paths of recorded messages: what has both a value and a time of validity."""
    names = [str(n) for n in dataset.data_vars]
    stamps = {n.removesuffix(".t") for n in names if n.endswith(".t")}
    values = [n for n in names if not n.endswith(".t")]
    return {s for s in stamps if any(n == s or n.startswith(f"{s}.") for n in values)}


def _signal_figure(dataset: xarray.Dataset, names: list[str]) -> Figure:
    from matplotlib.figure import Figure

    columns = 1 if len(names) < 4 else 2
    rows = -(-len(names) // columns)
    drawn = Figure(figsize=(1.0 + 5.5 * columns, 0.7 + 2.2 * rows), layout="constrained")
    drawn.suptitle(_headline(dataset), fontsize=12)
    axes = drawn.subplots(rows, columns, squeeze=False).T.reshape(-1)
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    for ax, name in zip(axes, names, strict=False):
        variable = dataset[name]
        unit, factor = shown_unit(str(variable.attrs.get("units", "1")))
        values = _by_element(variable) * factor
        single = values.shape[1] == 1
        for i, label in enumerate(_element_names(variable)):
            times, thin = _thinned(_times(variable), values[..., i])
            marker = {"marker": "."} if np.isnan(thin).any() else {}
            lines = ax.plot(
                times, thin, color=f"C{i}", linewidth=1.1 if single else 0.5, label=label, **marker
            )
            for line in lines[1:]:
                line.set_label("_")
        ax.set_title(name if unit in ("", "1") else f"{name} [{unit}]", fontsize=10)
        if values.shape[2] > 1:
            ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8)
        ax.grid(visible=True, color="0.92", linewidth=0.6)
        ax.tick_params(labelsize=8)
    for ax in (axes[len(names) - 1], axes[rows - 1]):
        ax.set_xlabel("time [s]")
    return drawn
