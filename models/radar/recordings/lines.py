"""Where lines belong, and lines that slipped.

A file that does not say so, though lines between others are lost, has slipped: what comes after is
too early. It shows where neighboring lines, which the antenna's beam makes alike, suddenly are not:
the correlation of their phases falls to nothing between two lines, and is back at the next.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray

MOST_LOST = 0.02
"""Share of lines that may be missing: an image of the others has that part of energy astray."""
_FALL = 0.5
"""Correlation of a pair of lines, relative to those about it, at which they are no neighbors: that
of RADARSAT-1's recordings does not fall below 0.6 over land; where ten lines are lost it is below
0.5 at 91 to 100 % of places, most others being water, which hardly correlates at all."""
_CERTAIN = 5.0
"""How far it must fall, in standard errors of a correlation of noise."""
_OFF_GRID = 0.25
"""How far a time may be from the grid of the others, in lines."""
_ABOUT = 65
"""Pairs of lines to compare with."""
_TAG_ERROR = 0.05e-3
"""How far a time that was cut to a resolution may be off it [s]."""
_FEWEST_TAGS = 24
"""Lines between slips whose times, cut, tell the time of the first of them to a fifth of a line."""
_MOST_TAGS = 400


class Neighbors:
    """How alike neighboring lines are, taken block by block.

    Parameters
    ----------
    n_cells : int
    """

    def __init__(self, n_cells: int) -> None:
        self.n_cells = n_cells
        self._last = np.zeros((0, n_cells), np.complex64)
        self._there: list[NDArray[np.bool_]] = []
        self._alike: list[ComplexArray] = []

    def take(self, block: ComplexArray) -> None:
        """Take the lines that follow, (n, n_cells)."""
        size = np.abs(block)
        phase = np.divide(block, size, out=np.zeros_like(block), where=size > 0)
        phase = np.concatenate([self._last, phase])
        self._there.append(np.any(size, axis=1))
        self._alike.append(np.einsum("ij,ij->i", phase[1:], phase[:-1].conj()) / self.n_cells)
        self._last = phase[-1:]

    @property
    def correlation(self) -> FloatArray:
        """Size of the correlation of the phases of each line and the next, (n - 1,)."""
        return np.asarray(np.abs(np.concatenate(self._alike)), np.float64)

    @property
    def there(self) -> NDArray[np.bool_]:
        """Lines that are not zero, (n,)."""
        return np.concatenate(self._there)

    @property
    def alike(self) -> FloatArray:
        """Correlation of the phases of each line and the next, (n - 1,), in the mean's phase."""
        alike = np.concatenate(self._alike)
        total = alike.sum()
        return np.asarray((alike * np.conj(total)).real / max(abs(total), 1e-30), np.float64)


def slips_among(neighbors: Neighbors, place: NDArray[np.intp]) -> tuple[int, ...]:
    """Lines, counted from 0, before which others are lost, though no place says so.

    They are no neighbors of those before them, though the lines about them are each other's.

    Parameters
    ----------
    neighbors : Neighbors
    place : ndarray of int, shape (n,)
        Where each line belongs, counted from 0: those with others between are not compared.
    """
    from scipy.ndimage import median_filter

    there = neighbors.there
    pairs = np.flatnonzero(there[1:] & there[:-1] & (np.diff(place) == 1))
    if len(pairs) < _ABOUT:
        return ()
    own = neighbors.alike[pairs]
    usual = median_filter(own, size=_ABOUT, mode="nearest")
    fallen = (own < _FALL * usual) & ((usual - own) * np.sqrt(neighbors.n_cells) > _CERTAIN)
    return tuple(int(k) + 1 for k in place[pairs[fallen]])


def places_by_number(numbers: FloatArray, name: str) -> NDArray[np.intp]:
    """Where lines belong, counted from 0, by their numbers (n,).

    Raises
    ------
    ValueError
        If they do not count lines.
    """
    whole = np.rint(numbers)
    wrong = np.append(np.diff(numbers) <= 0, False)
    wrong |= ~(np.abs(numbers - whole) <= _OFF_GRID)
    if wrong.any():
        raise ValueError(
            f"'{name}' does not count lines one by one: look at its element {np.argmax(wrong)}"
        )
    return _not_too_few(np.asarray(whole - whole[0], dtype=np.intp))


def places_by_time(times: FloatArray, name: str) -> NDArray[np.intp]:
    """Where lines belong, counted from 0, by their times (n,) [s].

    Raises
    ------
    ValueError
        If they do not increase by whole lines.
    """
    steps = np.diff(times)
    spacing = float(np.median(steps))
    counted = steps / spacing if spacing > 0 else np.zeros(len(steps))
    wrong = ~((counted > _OFF_GRID) & (np.abs(counted - np.rint(counted)) <= _OFF_GRID))
    if wrong.any():
        raise ValueError(
            f"'{name}' does not count lines one by one: look at its element {np.argmax(wrong) + 1}"
        )
    return _not_too_few(np.concatenate([[0], np.cumsum(np.rint(counted), dtype=np.intp)]))


def places_by_tags(
    place: NDArray[np.intp],
    tags: FloatArray,
    spacing: float,
    resolution: float,
    neighbors: Neighbors,
) -> NDArray[np.intp]:
    """Places of lines, moved on where their times say that lines between were lost.

    Times that are cut to less than a line leave the place of a slip open by some lines: it is where
    neighbors are least alike. How many lines were lost they tell exactly: what is cut off differs
    from line to line, and the largest remainder of many lines is next to nothing.

    Parameters
    ----------
    place : ndarray of int, shape (n,)
        Counted from 0, without the slips.
    tags : ndarray, shape (n,)
        Times, cut to the resolution [s].
    spacing : float
        Between lines [s].
    resolution : float
        [s]
    neighbors : Neighbors

    Raises
    ------
    ValueError
        If times run back, or slips are too near to each other.
    """
    place, begin = place.copy(), 0
    while True:
        since = tags - spacing * place
        low = np.minimum.accumulate(since[begin:])
        high = np.maximum.accumulate(since[begin:])
        wide = np.flatnonzero(high - low > resolution + _TAG_ERROR)
        if not len(wide):
            return place
        seen = begin + int(wide[0])
        if since[seen] <= low[wide[0]]:
            raise ValueError(
                f"the time of line {place[seen] + 1} is too early for lines every "
                f"{1e3 * spacing:.6g} ms: times, their order or the repetition frequency are wrong"
            )
        at, lost = _slip(since, begin, seen, spacing, resolution, neighbors)
        place[at:] += lost
        _not_too_few(place)
        begin = at


def _slip(
    since: FloatArray,
    begin: int,
    seen: int,
    spacing: float,
    resolution: float,
    neighbors: Neighbors,
) -> tuple[int, int]:
    """First line after a slip that is seen at some line, and how many were lost before it."""
    after = since[seen : seen + _MOST_TAGS]
    wide = np.ptp(np.stack([np.minimum.accumulate(after), np.maximum.accumulate(after)]), axis=0)
    after = after[wide <= resolution + _TAG_ERROR]
    latest = after.max()
    first = seen
    while first > begin + 1 and since[first - 1] >= latest - resolution - _TAG_ERROR:
        first -= 1
    before = since[max(begin, first - _MOST_TAGS) : first]
    lost = (latest - before.max()) / spacing
    if min(len(before), len(after)) < _FEWEST_TAGS or abs(lost - round(lost)) > _OFF_GRID:
        raise ValueError(
            f"lines are lost before line {seen + 1}, and its times do not tell how many"
        )
    alike = neighbors.correlation[first - 1 : seen]
    return first + int(np.argmin(alike)), round(lost)


def _not_too_few(place: NDArray[np.intp]) -> NDArray[np.intp]:
    """The same places; ValueError where too many others lie between them."""
    n = int(place[-1]) + 1
    if n - len(place) > MOST_LOST * n:
        k = int(place[np.argmax(np.diff(place) > 1)]) + 2
        raise too_many_lost(n - len(place), n, k)
    return place


def too_many_lost(n_lost: int, n: int, first: int) -> ValueError:
    """What to raise where too many lines are lost."""
    return ValueError(
        f"{n_lost} of its {n} lines are missing (zero), the first is line {first}; "
        f"{MOST_LOST:.0%} of them may be"
    )


def on_grid(times: FloatArray, place: NDArray[np.intp]) -> FloatArray:
    """Times of all lines [s], those between filled in, from times (n,) of the lines at places."""
    return np.interp(np.arange(int(place[-1]) + 1), place, times)
