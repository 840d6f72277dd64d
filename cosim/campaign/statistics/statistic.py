"""What a statistic of a campaign is, and what it is given."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.campaign.statistics.hypotheses import Evidence
from terrafix.cosim.declare.evaluation import Evaluation

BLOCK = 64
"""Members of a block."""
SHOWN = 128
"""Members whose error histories are kept for figures."""

Sums = dict[str, NDArray[Any]]
"""Sums by name: of one block, or merged."""
Columns = dict[str, tuple[tuple[str, ...], Any]]
"""Dimensions and values of labeled arrays, by name."""


@dataclass(frozen=True)
class Layout:
    """What an evaluation publishes, as campaigns need it.

    Attributes
    ----------
    path : str
        Of the component.
    quantities : tuple of (name, unit, axes)
        In the order of the errors.
    times : ndarray, shape (n_epochs,)
        [s]
    has_covariance, has_innovation : bool
        Whether it publishes a covariance, and innovations.
    nees_axes : int
        Number of axes that its NEES is of.
    measurements : tuple of str
        Names of several measurements whose NIS it publishes one by one.
    white : bool
        Whether innovations of a sound filter are white.
    """

    path: str
    quantities: tuple[tuple[str, str, tuple[str, ...]], ...]
    times: FloatArray
    has_covariance: bool
    has_innovation: bool
    nees_axes: int
    measurements: tuple[str, ...] = ()
    white: bool = True

    @classmethod
    def of(cls, path: str, component: Evaluation, times: FloatArray) -> Layout:
        """Look at the ports of a component."""
        outputs = component.outputs()
        return cls(
            path,
            tuple((q.name, q.unit, q.axes) for q in component.quantities),
            times,
            "covariance" in outputs,
            "normalized_innovation" in outputs,
            component.nees_axes or sum(len(q.axes) for q in component.quantities),
            component.measurements,
            component.white,
        )

    @property
    def labels(self) -> list[str]:
        """Names of all axes, ``"position x"``."""
        return [f"{name} {axis}" for name, _, axes in self.quantities for axis in axes]

    @property
    def units(self) -> list[str]:
        """Unit of each axis."""
        return [unit for _, unit, axes in self.quantities for _ in axes]


@dataclass(frozen=True)
class Members:
    """Histories of the members of one block, up to 64.

    Attributes
    ----------
    layout : Layout
    history : mapping of str to ndarray, shape (n_epochs, n_members, ...)
        By port of the evaluation; NaN where a member has failed.
    first : int
        Number of the first member.
    """

    layout: Layout
    history: Mapping[str, NDArray[Any]]
    first: int

    @cached_property
    def error(self) -> FloatArray:
        """Estimate minus truth of all axes, (n_epochs, n_members, n_axes)."""
        return self._side_by_side("error")

    @cached_property
    def sigma(self) -> FloatArray:
        """As the filter predicts it, (n_epochs, n_members, n_axes)."""
        return self._side_by_side("sigma")

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Whether a member has not failed, (n_epochs, n_members)."""
        return np.asarray(np.isfinite(self.error).all(axis=2))

    def _side_by_side(self, kind: str) -> FloatArray:
        arrays = [self.history[f"{name}_{kind}"] for name, _, _ in self.layout.quantities]
        return np.concatenate([a.reshape(*a.shape[:2], -1) for a in arrays], axis=2)


class Statistic:
    """One statistic of a campaign.

    Members are summed up in blocks, by workers, and blocks are merged in the order of their
    numbers, so that a result has the same bytes however it was flown. A subclass

    1. gives in `sum` the arrays of one block, by names of its own; none, if the evaluation
       publishes nothing for it, and the statistic is left out;
    2. names in `merged` those of them that go on from block to block (the others stay in the
       block's file), and merges them in `merge` if adding is not enough;
    3. says what follows from the merged sums: in `columns` the arrays of the dataset, in
       `summarize` the plain types of the summary, in `facts` what people read of these;
    4. if it speaks for or against a filter, names in `families` its families of tests, and
       makes them in `judge`.

    ``STATISTICS.append(MyStatistic())`` makes it part of every campaign from then on; other
    processes must be able to import its class.
    """

    merged: ClassVar[tuple[str, ...]] = ()
    families: ClassVar[tuple[str, ...]] = ()
    spoiled_by_bias: ClassVar[bool] = False
    """Whether a mean error makes its tests fail too, so that they say nothing more then."""

    def sum(self, members: Members) -> Sums:
        """Sum up the members of a block."""
        raise NotImplementedError

    def merge(self, sums: Sums, block: Sums) -> None:
        """Merge the next block into `sums`, in place; both hold all statistics' arrays."""
        for name in self.merged:
            sums[name] += block[name]

    def columns(self, layout: Layout, sums: Sums) -> Columns:
        """Labeled arrays; dimensions ``"time"``, ``"axis"``, ``"axis_b"``, ``"member"``, others.

        A column named like its only dimension is a coordinate.
        """
        del layout, sums
        return {}

    def summarize(self, layout: Layout, sums: Sums) -> dict[str, Any]:
        """Plain types (JSON), by names of its own."""
        del layout, sums
        return {}

    def facts(self, summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Terms and sentences about them, from the summary of all statistics.

        Nothing where the summary has none: it may be that of a campaign flown without.
        """
        del summary
        yield from ()

    def judge(self, layout: Layout, sums: Sums, share: float) -> Evidence:
        """Test hypotheses, each family at the level `share`: findings, and how many tests."""
        del layout, sums, share
        return [], 0


def plain(values: Any) -> Any:
    """Nested lists of floats; None for what is not finite."""
    return [
        plain(v) if np.ndim(v) else (float(v) if np.isfinite(v) else None)
        for v in np.asarray(values)
    ]
