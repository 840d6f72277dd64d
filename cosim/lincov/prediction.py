"""What linear covariance analysis predicts, as it is kept, stored and shown at a prompt."""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape
from typing import Any, NamedTuple

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.show.numbers import number, shown_unit

SCHEMA = "terrafix-lincov/1"
UNOBSERVED = 0.5
"""Part of a variance that fixes leave, above which its direction counts as not observed."""
MOST_SOURCES = 6
MOST_AXES = 12
WORTH_SHOWING = 0.0005
"""Part of a variance: what rounds to 0.1 % or more."""


class Direction(NamedTuple):
    """A direction of the error: what part of its variance without fixes remains with them.

    `components` are in sigma without fixes, by axis, of unit length.
    """

    remaining: float
    components: FloatArray


@dataclass(repr=False)
class LinearCovariance:
    """What is predicted of a campaign.

    Attributes
    ----------
    path : str
        Of the evaluation component.
    labels, units : list of str
        Of each axis.
    times : ndarray, shape (n_epochs,)
        [s]
    filter : ndarray, shape (n_epochs, n_axes, n_axes)
        Covariance that the filter predicts.
    sources : dict of str to ndarray, shape (n_epochs, n_axes, n_axes)
        Covariance of the error by source: the error budget.
    directions : list of Direction
        Directions of the error at the end by what the fixes leave of them, the largest first;
        empty where the evaluation publishes no covariance.
    """

    path: str
    labels: list[str]
    units: list[str]
    times: FloatArray
    filter: FloatArray
    sources: dict[str, FloatArray] = field(default_factory=dict)
    directions: list[Direction] = field(default_factory=list)

    @property
    def total(self) -> FloatArray:
        """Covariance of the error, (n_epochs, n_axes, n_axes)."""
        return sum(self.sources.values(), np.zeros_like(self.filter))

    @property
    def sigma_filter(self) -> FloatArray:
        """Sigma that the filter predicts, (n_epochs, n_axes)."""
        return np.sqrt(np.diagonal(self.filter, axis1=1, axis2=2))

    @property
    def sigma(self) -> FloatArray:
        """Sigma that a campaign's sample will show, (n_epochs, n_axes)."""
        return np.sqrt(np.diagonal(self.total, axis1=1, axis2=2))

    def budget(self) -> dict[str, FloatArray]:
        """Sigma at the end due to each source alone, (n_axes,), the largest contribution first."""
        total = np.diagonal(self.total[-1])
        whole = np.where(total > 0, total, 1.0)
        found = {name: np.sqrt(np.diagonal(c[-1])) for name, c in self.sources.items()}
        return dict(sorted(found.items(), key=lambda item: -float((item[1] ** 2 / whole).max())))

    def shares(self) -> dict[str, FloatArray]:
        """Part of the variance at the end due to each source, (n_axes,), in that order."""
        total = np.diagonal(self.total[-1])
        whole = np.where(total > 0, total, 1.0)
        return {name: sigma**2 / whole for name, sigma in self.budget().items()}

    def largest(self) -> dict[str, FloatArray]:
        """Of `shares`, the few that a person looks at: none below `WORTH_SHOWING`."""
        seen = {n: share for n, share in self.shares().items() if share.max() >= WORTH_SHOWING}
        return dict(list(seen.items())[:MOST_SOURCES])

    def unobserved(self) -> list[Direction]:
        """Directions of which the fixes leave more than `UNOBSERVED`."""
        return [d for d in self.directions if d.remaining > UNOBSERVED]

    def end(self) -> list[tuple[str, str, float, float, float]]:
        """By axis: label, unit for a person, sigma of a sample and of the filter in it, ratio."""
        found = []
        for i, label in enumerate(self.labels):
            unit, factor = shown_unit(self.units[i])
            sample, filtered = float(self.sigma[-1, i]), float(self.sigma_filter[-1, i])
            ratio = sample / filtered if filtered > 0 else np.nan
            found.append((label, unit, sample * factor, filtered * factor, ratio))
        return found

    def _rows(self) -> tuple[str, list[tuple[str, ...]], list[tuple[str, ...]]]:
        """A title, the sigma by axis, the largest sources: each with its head, a screen at most."""
        title = f"linear covariance of '{self.path}' at t = {self.times[-1]:g} s"
        axes: list[tuple[str, ...]] = [("one sigma", "unit", "of a sample", "of the filter")]
        axes += [(name, unit, number(s), number(f)) for name, unit, s, f, _ in self.end()]
        more = len(axes) - 1 - MOST_AXES
        axes[1 + MOST_AXES :] = [(f"and {more} more", "", "", "")] if more > 0 else []
        sources: list[tuple[str, ...]] = [("largest sources", "part of the variance")]
        for name, share in self.largest().items():
            i = int(share.argmax())
            sources.append((name, f"{100 * share[i]:.1f} % of {self.labels[i]}"))
        return title, axes, sources

    def __repr__(self) -> str:
        title, *tables = self._rows()
        lines = [title]
        for rows in tables:
            widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
            for row in rows:
                cells = [row[0].ljust(widths[0])]
                right = len(row) > 2
                cells += [
                    c.rjust(w) if right else c for c, w in zip(row[1:], widths[1:], strict=True)
                ]
                lines.append("  " + "  ".join(cells).rstrip())
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        title, *tables = self._rows()
        parts = [f"<p>{escape(title)}</p>"]
        for head, *rows in tables:
            cells = "".join(f"<th>{escape(c)}</th>" for c in head)
            body = ("".join(f"<td>{escape(c)}</td>" for c in row) for row in rows)
            lines = "".join(f"<tr>{row}</tr>" for row in body)
            parts.append(f"<table><tr>{cells}</tr>{lines}</table>")
        return "".join(parts)

    def dataset(self) -> Any:
        """As an `xarray.Dataset`."""
        import xarray

        n = len(self.labels)
        both = ("time", "axis", "axis_b")
        remaining = [d.remaining for d in self.directions]
        vectors = [d.components for d in self.directions]
        return xarray.Dataset(
            {
                "filter": (both, self.filter),
                "error": (
                    ("source", *both),
                    np.stack(list(self.sources.values()))
                    if self.sources
                    else np.zeros((0, *self.filter.shape)),
                ),
                "remaining": ("direction", np.array(remaining, dtype=np.float64)),
                "direction_components": (
                    ("direction", "axis"),
                    np.array(vectors, dtype=np.float64).reshape(-1, n),
                ),
            },
            {
                "time": ("time", self.times, {"units": "s"}),
                "axis": self.labels,
                "axis_b": self.labels,
                "unit": ("axis", self.units),
                "source": np.array(list(self.sources), dtype=object),
            },
            {"path": self.path, "schema": SCHEMA},
        )

    @classmethod
    def of_dataset(cls, dataset: Any) -> LinearCovariance:
        """The inverse of `dataset`."""
        return cls(
            str(dataset.attrs["path"]),
            [str(v) for v in dataset["axis"].values],
            [str(v) for v in dataset["unit"].values],
            dataset["time"].values,
            dataset["filter"].values,
            {str(s): dataset["error"].values[i] for i, s in enumerate(dataset["source"].values)},
            [
                Direction(float(r), v)
                for r, v in zip(
                    dataset["remaining"].values, dataset["direction_components"].values, strict=True
                )
            ],
        )
