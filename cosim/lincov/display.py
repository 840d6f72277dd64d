"""What a linear covariance analysis says, in the terminal and as JSON."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich import box
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from terrafix.cosim.lincov.prediction import LinearCovariance
from terrafix.cosim.show.numbers import number, shown_unit

MOST_SOURCES = 6


def summary(found: LinearCovariance) -> dict[str, Any]:
    """Plain types, in SI."""
    return {
        "evaluation": found.path,
        "t_s": float(found.times[-1]),
        "axes": found.labels,
        "units": found.units,
        "sigma": found.sigma[-1].tolist(),
        "sigma_filter": found.sigma_filter[-1].tolist(),
        "budget": {name: sigma.tolist() for name, sigma in found.budget().items()},
        "directions": [
            {"remaining": d.remaining, "components": d.components.tolist()}
            for d in found.directions
        ],
    }


def prediction_tables(system: str, found: LinearCovariance) -> list[Any]:
    """What a person wants to know, as rich renderables in the order of reading."""
    units = [shown_unit(unit) for unit in found.units]
    budget = list(found.budget().items())
    names = [name for name, _ in budget[:MOST_SOURCES]]
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("one sigma at the end")
    for column in ("unit", "of a sample", "of the filter", "ratio"):
        table.add_column(column, justify="right")
    ratio = found.sigma[-1] / found.sigma_filter[-1]
    for i, label in enumerate(found.labels):
        unit, factor = units[i]
        values = [found.sigma[-1, i] * factor, found.sigma_filter[-1, i] * factor]
        table.add_row(label, unit, *(number(float(v)) for v in values), number(float(ratio[i]), 3))
    parts = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    parts.add_column("part of the variance")
    for label in found.labels:
        parts.add_column(label.replace(" ", "\n"), justify="right")
    total = found.sigma[-1] ** 2
    for name, sigma in budget[:MOST_SOURCES]:
        share = 100 * sigma**2 / np.where(total > 0, total, 1.0)
        parts.add_row(name, *(f"{s:.1f} %" if s >= 0.05 else "-" for s in share))
    shown: list[Any] = [
        Text(f"{system}: linear covariance at t = {found.times[-1]:g} s", style="bold"),
        Padding(table, (1, 0)),
        Padding(parts, (0, 0, 1, 0)),
    ]
    if len(budget) > len(names):
        shown.append(Text(f"and {len(budget) - len(names)} smaller sources", style="dim"))
    for direction in found.unobserved():
        named = describe(direction.components, found.labels)
        shown.append(
            Text(f"hardly observed: {named}; {direction.remaining:.1%} of the variance remains")
        )
    return shown


def describe(components: Any, labels: list[str]) -> str:
    """Name the axes that make up a direction, the largest first."""
    order = np.argsort(-np.abs(components))
    chosen = [i for i in order if abs(components[i]) > 0.2]
    sign = np.sign(components[chosen[0]]) if chosen else 1.0
    return ", ".join(f"{labels[i]} ({sign * components[i]:+.2f})" for i in chosen)
