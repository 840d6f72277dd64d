"""What linear covariance analysis predicts, as it is kept, stored and shown at a prompt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray

SCHEMA = "terrafix-lincov/1"
UNOBSERVED = 0.5
"""Part of a variance that fixes leave, above which its direction counts as not observed."""


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
        found = {name: np.sqrt(np.diagonal(c[-1])) for name, c in self.sources.items()}
        return dict(sorted(found.items(), key=lambda item: -float((item[1] ** 2 / total).max())))

    def unobserved(self) -> list[Direction]:
        """Directions of which the fixes leave more than `UNOBSERVED`."""
        return [d for d in self.directions if d.remaining > UNOBSERVED]

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
