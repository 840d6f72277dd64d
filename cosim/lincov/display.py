"""What a linear covariance analysis says, in the terminal and as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.columns import Columns
from rich.console import Console, ConsoleOptions, Group
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.lincov.prediction import WORTH_SHOWING, LinearCovariance
from terrafix.cosim.show.numbers import number

_CELL = 9  # characters of "  100.0 %"


class Fitting:
    """The first of several renderables that is no wider than the terminal; else the last."""

    def __init__(self, *choices: Any) -> None:
        self._choices = choices

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Any]:
        """Choose."""
        for choice in self._choices[:-1]:
            needed = Measurement.get(console, options.update_width(10_000), choice).maximum
            if needed <= options.max_width:
                yield choice
                return
        yield self._choices[-1]


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
    """What a person wants to know, as rich renderables in the order of reading.

    Names are whole in any width: what does not fit side by side is put one below the other.
    """
    shown: list[Any] = [
        Text(f"{system}: linear covariance at t = {found.times[-1]:g} s", style="bold"),
        Padding(Fitting(_sigma_table(found), _sigma_list(found)), (1, 0)),
        Padding(Fitting(_budget_table(found), _budget_list(found)), (0, 0, 1, 0)),
    ]
    more = len(found.sources) - len(found.largest())
    if more:
        shown.append(Text(f"and {more} smaller source{'s' * (more > 1)}", style="dim"))
    for direction in found.unobserved():
        named = describe(direction.components, found.labels)
        shown.append(
            Text(f"hardly observed: {named}; {direction.remaining:.1%} of the variance remains")
        )
    return shown


def _table(first: str, *others: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column(first, no_wrap=True)
    for name in others:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _sigma_table(found: LinearCovariance) -> Table:
    table = _table("one sigma at the end", "unit", "of a sample", "of the filter", "ratio")
    for label, unit, sample, filtered, ratio in found.end():
        table.add_row(label, unit, number(sample), number(filtered), _ratio(ratio))
    return table


def _sigma_list(found: LinearCovariance) -> Group:
    lines = [Text("one sigma at the end: of a sample, of the filter, ratio")]
    for label, unit, sample, filtered, ratio in found.end():
        lines.append(Text(f"{label} [{unit}]"))
        lines.append(Text(f"{number(sample):>11}{number(filtered):>11}{_ratio(ratio):>9}"))
    return Group(*lines)


def _ratio(ratio: float) -> str:
    return f"{ratio:.3f}" if np.isfinite(ratio) else "-"


def _percent(share: FloatArray) -> list[str]:
    return [f"{100 * s:.1f} %" if s >= WORTH_SHOWING else "-" for s in share]


def _budget_table(found: LinearCovariance) -> Table:
    table = _table("part of the variance", *(label.replace(" ", "\n") for label in found.labels))
    for name, share in found.largest().items():
        table.add_row(name, *_percent(share))
    return table


def _budget_list(found: LinearCovariance) -> Group:
    """Each source with its name on a line of its own, quantity by quantity."""
    axes = [label.rpartition(" ")[2] for label in found.labels]
    parts: list[Any] = [Text("part of the variance"), _by_quantity(found.labels, axes)]
    for name, share in found.largest().items():
        parts += [Text(name, style="bold"), _by_quantity(found.labels, _percent(share))]
    return Group(*parts)


def _by_quantity(labels: Sequence[str], cells: Sequence[str]) -> Columns:
    """Cells of one quantity in a line, as many quantities side by side as there is room for."""
    lines: dict[str, str] = {}
    for label, cell in zip(labels, cells, strict=True):
        quantity = label.rpartition(" ")[0]
        lines[quantity] = lines.get(quantity, "") + cell.rjust(_CELL)
    width = max(map(len, lines))
    texts = [f"{quantity.ljust(width)}{line}" for quantity, line in lines.items()]
    return Columns([Text(text) for text in texts], equal=True, padding=(0, 2))


def describe(components: Any, labels: list[str]) -> str:
    """Name the axes that make up a direction, the largest first."""
    order = np.argsort(-np.abs(components))
    chosen = [i for i in order if abs(components[i]) > 0.2]
    sign = np.sign(components[chosen[0]]) if chosen else 1.0
    return ", ".join(f"{labels[i]} ({sign * components[i]:+.2f})" for i in chosen)
