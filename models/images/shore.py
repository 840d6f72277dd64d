r"""Shores of a predicted outline in an observed one, part by part: distances along normals.

From the middle of every edge of the predicted outline its outward normal is followed, to both
sides, to the observed contour: the signed distance :math:`d_k`. Distances along normals of what is
predicted are without bias to second order in the noise of the observed vertices; distances from
observed points to the nearest place of the prediction are not, since what is outside a corner is
nearest to the corner (0.5 of the sigma of one frame for the area of Seneca Lake, which after 200
frames is seven).

What an outline tells of a camera is an affine map of the image, to the degree to which the ground
is flat. So the distances are summed with the normal parts of six affine displacements,

.. math:: z_j = \sum_k (n_k \cdot a_j(p_k))\, d_k, \qquad
          a = (e_u, e_v, X e_u, X e_v, Y e_u, Y e_v),

and made white with their covariance, which counts that neighbors share a vertex. Equal weights for
all edges: the best weights know that the noise of neighbors, alternating, cancels, and multiply
what is left of it at second order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, starmap

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from terrafix.models.core.arrays import FloatArray

ELEMENTS = 6
"""Affine displacements that distances are summed with."""

_ALIKE = 0.3
"""Least cosine between normals of two shores that may be the same."""
_PARALLEL = 1e-12
_FLOOR = 1e-4
"""Variance added to that of distances, in that of a vertex: a zero cannot be divided by."""
_KNOWN = 1e-9
"""Least share of the largest information that an element has."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where normals of a predicted outline meet an observed contour.

    Parameters
    ----------
    edge : ndarray of int, shape (N,)
        Of the predicted outline, from vertex k to k + 1.
    normal : ndarray, shape (N, 2)
        Outward normal of that edge.
    distance : ndarray, shape (N,)
        From the middle of the edge to the contour [px], positive outward.
    segment : ndarray of int, shape (N,)
        Of the contour, from vertex k to k + 1.
    parameter : ndarray, shape (N,)
        Where on it, 0 to 1.
    """

    edge: NDArray[np.intp]
    normal: FloatArray
    distance: FloatArray
    segment: NDArray[np.intp]
    parameter: FloatArray


class _Polylines:
    """Closed polylines, end to end."""

    def __init__(self, each: Sequence[FloatArray]) -> None:
        lengths = [len(points) for points in each]
        self.starts = np.cumsum([0, *lengths])
        self.points = np.concatenate(each)
        self.owner = np.repeat(np.arange(len(each)), lengths)
        following = np.arange(1, len(self.points) + 1)
        following[self.starts[1:] - 1] = self.starts[:-1]
        self._after = self.points[following]

    @cached_property
    def edge(self) -> FloatArray:
        """From each vertex to the next (N, 2)."""
        return self._after - self.points

    @cached_property
    def middle(self) -> FloatArray:
        """Middle of each edge (N, 2)."""
        return (self.points + self._after) / 2

    @cached_property
    def normal(self) -> FloatArray:
        """Unit normals (N, 2) of the edges, out of the polyline for either orientation."""
        (x, y), (x1, y1), (dx, dy) = self.points.T, self._after.T, self.edge.T
        turn = np.sign(np.add.reduceat(x * y1 - x1 * y, self.starts[:-1]))[self.owner]
        length = np.hypot(dx, dy)
        scale = turn / np.where(length > 0, length, 1.0)
        return np.stack([scale * dy, -scale * dx], axis=1)


def outward_normals(outline: FloatArray) -> FloatArray:
    """Unit normals (K, 2) of the edges of an outline (K, 2), out of it for either orientation."""
    return _Polylines([outline]).normal


def crossings(
    outlines: Sequence[FloatArray],
    contours: Sequence[FloatArray],
    shown: Sequence[NDArray[np.bool_]],
    reach: Sequence[float],
) -> list[Crossings]:
    """Follow the normals of outlines, each to the contour that goes with it.

    Parameters
    ----------
    outlines : sequence of ndarray, shape (K, 2)
        As predicted [px].
    contours : sequence of ndarray, shape (M, 2)
        As observed, closed implicitly [px].
    shown : sequence of ndarray of bool, shape (M,)
        Which segments of each contour, from vertex k to k + 1, are a shore that was seen.
    reach : sequence of float
        How far to follow the normals of each [px].
    """
    own, seen = _Polylines(outlines), _Polylines(contours)
    k, j, t, d = _met(own, seen, np.flatnonzero(np.concatenate(shown)), np.asarray(reach))
    order = np.lexsort((j, np.abs(d), k))
    first = order[np.diff(k[order], prepend=-1) > 0]  # the nearest of each edge
    k, j, t, d = k[first], j[first], t[first], d[first]
    normal = own.normal[k]
    ends = np.searchsorted(k, own.starts)
    return [
        Crossings(k[part] - own.starts[i], normal[part], d[part], j[part] - seen.starts[i], t[part])
        for i, part in enumerate(starmap(slice, pairwise(ends)))
    ]


def _met(
    own: _Polylines, seen: _Polylines, kept: NDArray[np.intp], reach: FloatArray
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray, FloatArray]:
    """Edges and the segments that their normals meet, where on these, and how far off."""
    if not kept.size:
        return kept, kept, np.empty(0), np.empty(0)
    near = float(reach.max() + np.hypot(*seen.edge[kept].T).max() / 2) + 1e-6  # of rounding
    k, j = _close(own, seen, kept, near)
    (nx, ny), (ax, ay) = own.normal[k].T, seen.edge[j].T
    ox, oy = (seen.points[j] - own.middle[k]).T
    sine = nx * ay - ny * ax
    sine = np.where(np.abs(sine) < _PARALLEL, _PARALLEL, sine)
    t, d = (ox * ny - oy * nx) / sine, (ox * ay - oy * ax) / sine
    met = (t >= 0) & (t < 1) & (np.abs(d) < reach[own.owner[k]])
    met &= (own.normal[k] * seen.normal[j]).sum(axis=1) > _ALIKE
    return k[met], j[met], t[met], d[met]


def _close(
    own: _Polylines, seen: _Polylines, kept: NDArray[np.intp], near: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Edges and segments whose middles are no farther apart, along either axis."""
    size = np.ptp(own.middle, axis=0)
    along = int(size.argmax())
    apart = 2 * (size[along] + np.ptp(seen.middle[:, along]) + near)
    x = own.middle[:, along] + apart * own.owner  # so that none is near the contour of another
    at = seen.middle[kept, along] + apart * seen.owner[kept]
    order = np.argsort(at, kind="stable")
    low, high = np.searchsorted(at[order], [x - near, x + near])
    count = high - low
    k = np.repeat(np.arange(len(x)), count)
    within = np.arange(len(k)) - np.repeat(np.cumsum(count) - count, count)
    j = kept[order[np.repeat(low, count) + within]]
    across = 1 - along
    close = np.abs(own.middle[k, across] - seen.middle[j, across]) <= near
    return k[close], j[close]


@dataclass(frozen=True, eq=False)
class Weights:
    """What is made of crossings: sums of unit covariance.

    Parameters
    ----------
    of_vertices : ndarray, shape (6, K, 2)
        Weights of the pixels of the predicted outline's vertices [1/px].
    value : ndarray, shape (6,)
        The sums of the pixels that were observed.
    told : ndarray of bool, shape (6,)
        Which of them the contour tells at all.
    """

    of_vertices: FloatArray
    value: FloatArray
    told: NDArray[np.bool_]


def weights(found: Crossings, outline: FloatArray, sigma: float, n_contour: int) -> Weights:
    """Six sums that tell of crossings what they tell of an affine map, white.

    Parameters
    ----------
    found : Crossings
    outline : ndarray, shape (K, 2)
        As predicted [px].
    sigma : float
        Standard deviation of every coordinate of every observed vertex [px], positive.
    n_contour : int
        Vertices of the contour.

    Raises
    ------
    ValueError
        If there are fewer than six crossings.
    """
    n = len(found.edge)
    if n < ELEMENTS:
        raise ValueError(f"six sums need six crossings or more, got {n}")
    middle = (outline[found.edge] + outline[(found.edge + 1) % len(outline)]) / 2
    off = middle - middle.mean(axis=0)
    off = off / np.abs(off).max()
    u, v = found.normal.T
    x, y = off.T
    affine = np.stack([u, v, x * u, x * v, y * u, y * v])  # (6, N)
    share = found.parameter
    ends = ((found.segment, 1 - share), ((found.segment + 1) % n_contour, share))
    flat = _shared(affine, found.normal, ends, n_contour).reshape(ELEMENTS, -1)
    covariance = sigma**2 * (flat @ flat.T + _FLOOR * affine @ affine.T)
    information, axes = np.linalg.eigh(covariance)
    told = information > _KNOWN * information[-1]
    scale = np.where(told, 1 / np.sqrt(np.where(told, information, 1.0)), 0.0)
    own = scale[:, None] * axes.T @ affine
    seen = np.sum(found.normal * middle, axis=1) + found.distance
    half = np.full(n, 0.5)
    ends = ((found.edge, half), ((found.edge + 1) % len(outline), half))
    return Weights(_shared(own, found.normal, ends, len(outline)), own @ seen, told)


def _shared(
    values: FloatArray,
    normal: FloatArray,
    ends: Iterable[tuple[NDArray[np.intp], FloatArray]],
    n: int,
) -> FloatArray:
    """Values (6, N) along normals (N, 2), given to n vertices in shares: (6, n, 2)."""
    matrix = np.zeros((len(normal), n))
    rows = np.arange(len(normal))
    for vertex, share in ends:
        matrix[rows, vertex] += share
    parts = (values[:, None] * normal.T).reshape(2 * len(values), -1)
    return (parts @ matrix).reshape(len(values), 2, n).transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class Placed:
    """Where an outline may lie for what was seen of it.

    Parameters
    ----------
    shift : ndarray, shape (N, 2)
        Of its middle [px], the best first.
    scale : ndarray, shape (N,)
    cost : ndarray, shape (N,)
        Mean distance of the points to it, each no larger than `CAP` [px].
    """

    shift: FloatArray
    scale: FloatArray
    cost: FloatArray


CELL, CAP = 6.0, 24.0
"""Of the search: its grid, and the largest distance that counts [px]."""
_POINTS = 60
_APART = 6.0
"""Least distance of two places that are two, in cells."""
_PLACES = 4


def places(
    outline: FloatArray, points: FloatArray, reach: FloatArray, scales: FloatArray
) -> Placed:
    """Search where an outline lies, by the distances of points to it.

    Parameters
    ----------
    outline : ndarray, shape (K, 2)
        As predicted [px].
    points : ndarray, shape (N, 2)
        Of the shore, as observed [px].
    reach : ndarray, shape (2,)
        Largest shift to either side [px].
    scales : ndarray, shape (S,)
        Scales to be tried.
    """
    step = max(1, len(points) // _POINTS)
    points = points[::step]
    shifts = [np.arange(-int(r / CELL) - 1, int(r / CELL) + 2) for r in reach]
    found: list[tuple[float, FloatArray, float]] = []
    center = outline.mean(axis=0)
    for scale in scales:
        own = center + scale * (outline - center)
        distance, low = _distances_to(own)
        at = np.rint((points - low) / CELL).astype(np.int64)
        cost = np.zeros((len(shifts[0]), len(shifts[1])))
        for x, y in at:
            column, row = x - shifts[0], y - shifts[1]
            inside = (column >= 0) & (column < distance.shape[1])
            within = (row >= 0) & (row < distance.shape[0])
            part = np.full(cost.shape, CAP)
            part[np.ix_(inside, within)] = distance[np.ix_(row[within], column[inside])].T
            cost += part
        cost /= len(at)
        for _ in range(_PLACES):
            i, j = np.unravel_index(int(cost.argmin()), cost.shape)
            if cost[i, j] >= CAP:
                break
            shift = CELL * np.array([shifts[0][i], shifts[1][j]], dtype=np.float64)
            found.append((float(cost[i, j]), shift, float(scale)))
            near = np.hypot(*np.meshgrid(shifts[0] - shifts[0][i], shifts[1] - shifts[1][j]))
            cost[near.T < _APART] = np.inf
    found.sort(key=lambda place: place[0])
    kept: list[tuple[float, FloatArray, float]] = []
    for place in found:
        if all(np.hypot(*(place[1] - other[1])) >= _APART * CELL for other in kept):
            kept.append(place)
    kept = kept[:_PLACES]
    return Placed(
        np.array([p[1] for p in kept]).reshape(-1, 2),
        np.array([p[2] for p in kept]),
        np.array([p[0] for p in kept]),
    )


def _distances_to(outline: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances to an outline on a grid of cells, none above `CAP`, and where the grid begins."""
    after = np.roll(outline, -1, axis=0)
    number = np.ceil(np.hypot(*(after - outline).T) / (CELL / 2)).astype(np.int64) + 1
    dense = np.concatenate(
        [
            a + np.linspace(0, 1, n)[:, None] * (b - a)
            for a, b, n in zip(outline, after, number, strict=True)
        ]
    )
    low = dense.min(axis=0) - CAP
    cells = np.rint((dense - low) / CELL).astype(np.int64)
    size = cells.max(axis=0) + 1 + int(np.ceil(CAP / CELL))
    empty = np.ones((size[1], size[0]), dtype=np.bool_)
    empty[cells[:, 1], cells[:, 0]] = False
    return np.minimum(CELL * distance_transform_edt(empty), CAP), low
