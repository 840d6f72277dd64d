"""Figures of a campaign's result, for a page or a paper."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.lincov.prediction import LinearCovariance
from terrafix.cosim.show.numbers import shown_unit
from terrafix.cosim.show.plots import PREDICTED, Panel, draw_panel

if TYPE_CHECKING:
    import xarray

FORMATS = ("png", "svg", "pdf")
MOST_SOURCES = 8
_ANALYZED = "#1f77b4"


def figures(
    dataset: xarray.Dataset, prediction: LinearCovariance | None = None
) -> dict[str, Callable[[], Any]]:
    """What can be drawn of a result: by name, what draws it.

    Parameters
    ----------
    dataset : xarray.Dataset
        Of one evaluation, as `read_campaign` gives it.
    prediction : LinearCovariance, optional
        Drawn beside the sample, and as an error budget.
    """
    found: dict[str, Callable[[], Any]] = {}
    for quantity in quantities(dataset):
        found[f"{quantity}_error"] = partial(_error_figure, dataset, quantity, prediction)
    for name in ("nees", "nis"):
        if name in dataset and np.isfinite(dataset[name].values).any():
            found[name] = partial(_consistency_figure, dataset, name)
    if prediction is not None and prediction.sources:
        found["error_budget"] = partial(_budget_figure, prediction)
    return found


def quantities(dataset: xarray.Dataset) -> dict[str, list[int]]:
    """Numbers of the axes of each quantity, ``"position"``."""
    found: dict[str, list[int]] = {}
    for i, label in enumerate(dataset["axis"].values):
        found.setdefault(str(label).rpartition(" ")[0], []).append(i)
    return found


def save_figures(
    dataset: xarray.Dataset,
    folder: Path,
    *,
    form: str = "png",
    prediction: LinearCovariance | None = None,
) -> list[Path]:
    """Write every figure to a file of its own.

    Raises
    ------
    ConfigurationError
        If the form is not one of `FORMATS`, or the folder cannot be written.
    """
    if form not in FORMATS:
        raise ConfigurationError(f"figures are {', '.join(FORMATS)}, not '{form}'")
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, draw in figures(dataset, prediction).items():
            target = folder / f"{name}.{form}"
            render(draw, target, form)
            written.append(target)
    except OSError as error:
        raise ConfigurationError(
            f"cannot write figures to '{folder}': {error.strerror or error}"
        ) from error
    return written


def render(draw: Callable[[], Any], target: Any, form: str) -> None:
    """Draw to a file or stream; the same result gives the same bytes."""
    import matplotlib.style

    about: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with (
        matplotlib.style.context("default", after_reset=True),
        matplotlib.rc_context({"svg.hashsalt": "terrafix", "axes.axisbelow": True}),
    ):
        draw().savefig(target, format=form, dpi=160, metadata=about.get(form))


def _error_figure(
    dataset: xarray.Dataset, quantity: str, prediction: LinearCovariance | None
) -> Any:
    """Every run in gray, three sigma predicted and of the sample, as in the papers' figures."""
    from matplotlib.figure import Figure

    axes = quantities(dataset)[quantity]
    times = dataset["time"].values
    drawn = Figure(figsize=(7.2, 0.9 + 1.7 * len(axes)), layout="constrained")
    handles: dict[str, Any] = {}
    for ax, i in zip(
        drawn.subplots(len(axes), 1, sharex=True, squeeze=False)[:, 0], axes, strict=True
    ):
        unit, factor = shown_unit(str(dataset["unit"].values[i]))
        panel = Panel(
            quantity,
            str(dataset["axis"].values[i]).rpartition(" ")[2],
            unit,
            times,
            dataset["error"].values[:, :, i] * factor,
            np.sqrt(dataset["covariance_predicted"].values[:, i, i]) * factor,
            np.sqrt(dataset["covariance_sample"].values[:, i, i]) * factor,
            dataset["mean_error"].values[:, i] * factor,
        )
        handles |= draw_panel(ax, panel)
        if prediction is not None:
            sigma = 3 * prediction.sigma[:, i] * factor
            (line,) = ax.plot(prediction.times, sigma, color=_ANALYZED, linestyle=":", zorder=5)
            ax.plot(prediction.times, -sigma, color=_ANALYZED, linestyle=":", zorder=5)
            handles["linear covariance 3 sigma"] = line
        ax.set_ylabel(f"{panel.axis} [{unit}]", rotation=90, labelpad=4)
    ax.set_xlabel("time [s]")
    shown = dataset.sizes["member"]
    runs = int(dataset.attrs["runs"])
    drawn.suptitle(
        f"{quantity} error" + (f" ({shown} of {runs} runs in gray)" if shown < runs else ""),
        fontsize=11,
    )
    _legend(drawn, handles)
    return drawn


def _legend(drawn: Any, handles: dict[str, Any]) -> None:
    drawn.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=8,
    )


def _consistency_figure(dataset: xarray.Dataset, name: str) -> Any:
    """Mean over the members at each epoch, and its 95 % interval."""
    from matplotlib.figure import Figure

    given = np.isfinite(dataset[name].values)
    times = dataset["time"].values[given]
    mean = dataset[name].values[given]
    low, high = dataset[f"{name}_low"].values[given], dataset[f"{name}_high"].values[given]
    drawn = Figure(figsize=(7.2, 2.6), layout="constrained")
    ax = drawn.subplots()
    handles: dict[str, Any] = {
        "95 % interval if consistent": ax.fill_between(
            times, low, high, color="0.86", linewidth=0, step="mid"
        )
    }
    (handles["expected"],) = ax.plot(times, 0.5 * (low + high), color="0.5", linewidth=0.8)
    style: dict[str, Any] = {"marker": ".", "markersize": 4, "linewidth": 0.9, "color": PREDICTED}
    (handles["mean over the runs"],) = ax.plot(times, mean, **style)
    top = max(float(np.nanmax(high)), float(np.nanquantile(mean, 0.98)))
    bottom = min(float(np.nanmin(low)), float(np.nanquantile(mean, 0.02)))
    if top > 20 * max(float(np.nanmax(high)), 1e-300):
        ax.set_yscale("log")
    else:
        room = 0.15 * (top - bottom)
        ax.set_ylim(max(0.0, bottom - room), top + room)
    ax.set_title(
        {"nees": "normalized estimation error squared", "nis": "normalized innovation squared"}[
            name
        ],
        fontsize=11,
    )
    ax.set_xlabel("time [s]")
    ax.grid(visible=True, color="0.92", linewidth=0.6)
    _legend(drawn, handles)
    return drawn


def _budget_figure(prediction: LinearCovariance) -> Any:
    """What part of each axis's variance at the end each source makes."""
    from matplotlib.figure import Figure

    total = np.diagonal(prediction.total[-1])
    budget = prediction.budget()
    names = list(budget)[:MOST_SOURCES]
    drawn = Figure(figsize=(7.2, 0.9 + 0.34 * len(prediction.labels)), layout="constrained")
    ax = drawn.subplots()
    left = np.zeros(len(total))
    y = np.arange(len(total))[::-1]
    handles: dict[str, Any] = {}
    for k, name in enumerate(names):
        part = np.where(total > 0, budget[name] ** 2 / np.where(total > 0, total, 1.0), 0.0)
        handles[name] = ax.barh(y, 100 * part, left=left, color=f"C{k}", height=0.7)
        left = left + 100 * part
    rest = np.where(total > 0, 100.0 - left, 0.0)
    if np.any(rest > 0.5):
        handles["others"] = ax.barh(y, rest, left=left, color="0.8", height=0.7)
    ax.set_yticks(y, prediction.labels, fontsize=8)
    ax.set_xlim(0, 100)
    ax.set_xlabel("part of the variance at the end [%]")
    drawn.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        ncols=2,
        frameon=False,
        fontsize=8,
    )
    return drawn
