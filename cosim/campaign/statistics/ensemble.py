"""The statistics that campaigns keep: their list, the sums of a block, and all blocks merged."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.campaign.statistics.consistency import Nees, Nis
from terrafix.cosim.campaign.statistics.moments import Moments
from terrafix.cosim.campaign.statistics.quantiles import Quantiles
from terrafix.cosim.campaign.statistics.shown import Shown
from terrafix.cosim.campaign.statistics.statistic import (
    Columns,
    Layout,
    Members,
    Statistic,
    Sums,
)
from terrafix.cosim.campaign.statistics.whiteness import Whiteness

STANDARD = (Moments(), Quantiles(), Nees(), Nis(), Whiteness(), Shown())
STATISTICS: list[Statistic] = [*STANDARD]
"""What campaigns keep, in the order of their results; append your own."""

Value = TypeVar("Value")


def block_of(
    layout: Layout,
    history: Mapping[str, NDArray[Any]],
    *,
    first: int,
    kinds: Sequence[Statistic] | None = None,
) -> Sums:
    """Sum up the histories of up to 64 members.

    Parameters
    ----------
    layout : Layout
    history : mapping of str to ndarray, shape (n_epochs, n_members, ...)
        By port; NaN where a member has failed.
    first : int
        Number of the first member.
    kinds : sequence of Statistic, optional
        `STATISTICS` if absent.
    """
    members = Members(layout, history, first)
    return _together(kind.sum(members) for kind in (STATISTICS if kinds is None else kinds))


@dataclass(repr=False)
class Statistics:
    """All blocks merged so far; they must come in the order of their numbers.

    ``statistics["covariance_sample"]`` is a column of the campaign's dataset.

    Attributes
    ----------
    layout : Layout
    kinds : tuple of Statistic
        What is kept; `STATISTICS` if absent.
    sums : dict of str to ndarray
        As in a block, merged.
    """

    layout: Layout
    kinds: tuple[Statistic, ...] = field(default_factory=lambda: tuple(STATISTICS))
    sums: Sums = field(default_factory=dict)

    def add(self, block: Sums) -> None:
        """Merge the next block."""
        if self.sums:
            for kind in self.present:
                kind.merge(self.sums, block)
            return
        for kind in self.kinds:
            self.sums |= {name: _own(block[name]) for name in kind.merged if name in block}

    @property
    def present(self) -> list[Statistic]:
        """Those for which the evaluation publishes something."""
        return [kind for kind in self.kinds if any(name in self.sums for name in kind.merged)]

    @property
    def n(self) -> NDArray[np.int64]:
        """Members that had not failed, (n_epochs,)."""
        return self.sums["n"]

    def columns(self) -> Columns:
        """Labeled arrays: dimensions and values by name."""
        return _together(kind.columns(self.layout, self.sums) for kind in self.present)

    def summary(self) -> dict[str, Any]:
        """Plain types."""
        return _together(kind.summarize(self.layout, self.sums) for kind in self.present)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Values of a column."""
        columns = self.columns()
        if name not in columns:
            raise ConfigurationError(
                f"statistics of '{self.layout.path}' have no '{name}'\n  {nearest(name, columns)}"
            )
        return np.asarray(columns[name][1])

    def __repr__(self) -> str:
        """One line."""
        end = int(self.n[-1]) if self.sums else 0
        quantities = ", ".join(name for name, _, _ in self.layout.quantities)
        return (
            f"<Statistics of '{self.layout.path}': {end} members at the end, "
            f"{len(self.layout.times)} epochs of {quantities}>"
        )


def facts_of(
    summary: Mapping[str, Any], kinds: Iterable[Statistic] | None = None
) -> Iterator[tuple[str, str]]:
    """What people read of a summary: terms and sentences."""
    for kind in STATISTICS if kinds is None else kinds:
        yield from kind.facts(summary)


def _own(values: NDArray[Any]) -> NDArray[Any]:
    """A copy to merge into; small counts widened."""
    return values.astype(np.int64) if values.dtype.kind == "u" else values.copy()


def _together(parts: Iterable[Mapping[str, Value]]) -> dict[str, Value]:
    found: dict[str, Value] = {}
    for part in parts:
        twice = found.keys() & part.keys()
        if twice:
            raise ConfigurationError(
                f"two statistics of a campaign both give '{min(twice)}'\n  rename that of one"
            )
        found |= part
    return found
