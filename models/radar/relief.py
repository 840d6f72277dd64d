r"""Layover and shadow: what a line of terrain that a beam passes together shows, range by range.

Along such a line, from below the radar outward, terrain at distance :math:`x` is seen at the range
:math:`R(x)` and the angle off nadir :math:`\eta(x)`. Where slopes that face the radar are steeper
than its view :math:`R` falls: a range is then reached several times, and a cell shows the sum of
all that share it (layover). What lies at a smaller angle than something before it is hidden
(shadow).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray


@dataclass(frozen=True)
class Crossings:
    """Where a line of terrain crosses the ranges of cells.

    Parameters
    ----------
    cell : ndarray of int, shape (n,)
    place : ndarray, shape (n,)
        Sample of the line, fractional.
    rank : ndarray of int, shape (n,)
        How many crossings of the cell come before it on the line.
    """

    cell: NDArray[np.intp]
    place: FloatArray
    rank: NDArray[np.intp]


def seen(angle: FloatArray) -> NDArray[np.bool_]:
    """Whether samples of lines (..., n) are seen past all before them, by angles off nadir."""
    return np.asarray(angle >= np.maximum.accumulate(angle, axis=-1))


def folded_share(slant_range: FloatArray, angle: FloatArray) -> float:
    """Share of the samples of lines (..., n) that are nearer than those before them, or hidden."""
    falling = np.diff(slant_range) <= 0
    return float(np.mean(falling | ~seen(angle)[..., 1:]))


def crossings(cells: FloatArray, visible: NDArray[np.bool_]) -> Crossings:
    """Crossings of whole cells by a line.

    Parameters
    ----------
    cells : ndarray, shape (n,)
        Cell, fractional, at which each sample is seen.
    visible : ndarray of bool, shape (n,)
        A part between two samples of which one is hidden counts as hidden.
    """
    low, high = np.minimum(cells[:-1], cells[1:]), np.maximum(cells[:-1], cells[1:])
    first = np.ceil(low).astype(np.intp)
    n = np.where(visible[:-1] & visible[1:], np.ceil(high).astype(np.intp) - first, 0)
    part = np.repeat(np.arange(len(n)), n)
    step = np.arange(len(part)) - np.repeat(np.cumsum(n) - n, n)
    cell = first[part] + step
    place = part + (cell - cells[part]) / (cells[part + 1] - cells[part])
    order = np.argsort(cell, kind="stable")
    cell, place = cell[order], place[order]
    begins = np.flatnonzero(np.diff(cell, prepend=cell[:1] - 1))
    counts = np.diff(np.append(begins, len(cell)))
    rank = np.arange(len(cell)) - np.repeat(begins, counts)
    return Crossings(cell, place, rank)
