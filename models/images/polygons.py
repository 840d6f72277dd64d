r"""Polygons in an image: moments and their noise, clipping to the frame, distances.

A polygon is an array (K, 2) of vertices :math:`p_k = (x_k, y_k)` [px], x to the right (columns), y
down (rows), whole at the centers of pixels, as in OpenCV, scikit-image and `matching`; the last
vertex is joined to the first, which is not repeated. A frame of `width` x `height` pixels so spans
-0.5 to width - 0.5 and -0.5 to height - 0.5.

The six moments are area A, centroid and central second moments over the area,

.. math:: m = (A, \bar x, \bar y, \mu_{xx}, \mu_{yy}, \mu_{xy}), \qquad
          \mu_{xx} = \frac 1A \iint (x - \bar x)^2 dx\,dy,

by Green's theorem from sums over edges [1]_, with :math:`c_k = x_k y_{k+1} - x_{k+1} y_k`,

.. math::
    2 A = \sum c_k, \quad 6 S_x = \sum (x_k + x_{k+1}) c_k, \quad
    12 I_{xx} = \sum (x_k^2 + x_k x_{k+1} + x_{k+1}^2) c_k, \\
    24 I_{xy} = \sum (x_k y_{k+1} + 2 x_k y_k + 2 x_{k+1} y_{k+1} + x_{k+1} y_k) c_k,

relative to the first vertex, then again to the centroid: far from the origin, sums about the origin
would cancel. All six are the same for both orientations; A is positive. Of several rings the sums
add up: islands, which run the other way round than their shore, are no part of the area.

References
----------
.. [1] C. Steger, "On the Calculation of Moments of Polygons", Technical Report FGBV-96-05,
       Technische Universität München, 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray

MOMENTS = ("area", "x", "y", "mxx", "myy", "mxy")
"""The six moments, in this order: [px^2], [px], [px], then [px^2] three times."""

_ON_FRAME = 1e-9
"""How far from the frame an edge that lies on it may be [px]: rounding at 1e6 px is 1e-10."""
_PAIRS = 1 << 20
"""Pairs of point and segment that are held at once."""


def outline(vertices: ArrayLike, what: str = "an outline") -> FloatArray:
    """Check an outline, and drop a last vertex that repeats the first.

    Parameters
    ----------
    vertices : array_like, shape (K, 2) or (K + 1, 2)
    what : str
        What it is, for errors.

    Returns
    -------
    ndarray, shape (K, 2) [px]

    Raises
    ------
    ValueError
        If it has fewer than three vertices, one of them is not finite, it crosses or touches
        itself, or encloses nothing.
    """
    p = _points(vertices, what)
    if p.ndim != 2:
        raise ValueError(f"{what} has shape (K, 2), got {p.shape}")
    if len(p) > 1 and np.array_equal(p[0], p[-1]):
        p = p[:-1]
    _enough(p, what)
    polygon = shapely.Polygon(p)
    if not shapely.is_valid(polygon):
        why = shapely.is_valid_reason(polygon)
        raise ValueError(f"{what} encloses one area and does not cross itself; got {why} [px]")
    return p


def moments(vertices: ArrayLike, starts: Sequence[int] = (0,)) -> tuple[FloatArray, FloatArray]:
    r"""Area, centroid and central second moments, and their Jacobian.

    About the centroid, where :math:`S = 0`,

    .. math:: d\bar x = dS_x / A, \qquad d\mu_{xx} = (dI_{xx} - \mu_{xx}\, dA) / A.

    Parameters
    ----------
    vertices : array_like, shape (..., K, 2) [px]
        That they do not cross is not checked: `outline` does.
    starts : sequence of int
        Where the rings start: the shore with 0, then islands, which run the other way round.

    Returns
    -------
    ndarray, shape (..., 6)
        Moments, in the order of `MOMENTS`.
    ndarray, shape (..., 6, K, 2)
        Their derivatives by the vertices, exact.

    Raises
    ------
    ValueError
        If there are fewer than three vertices, one is not finite, or nothing is enclosed.
    """
    return _moments(vertices, starts)[:2]


def moment_noise(
    vertices: ArrayLike, sigma: ArrayLike, starts: Sequence[int] = (0,)
) -> tuple[FloatArray, FloatArray]:
    r"""Covariance and bias of the moments of vertices with independent noise.

    .. math:: P = \sigma^2 J J^T, \qquad
              E[m(p + n)] - m(p) = \tfrac{\sigma^2}{2} \operatorname{tr} H + O(\sigma^4)

    The traces of the Hessians of A, S and :math:`I_{xy}` over all vertices are zero, that of
    :math:`I_{xx}` and of :math:`I_{yy}` is 4 A / 3 whatever the shape. About the centroid, with
    :math:`g = \nabla A / A, s = \nabla S / A, h = \nabla I / A`,

    .. math:: \operatorname{tr} H_{\bar x} = -2\, s_x \cdot g, \qquad
        \operatorname{tr} H_{xx} = \tfrac 43 - 2\, h_{xx} \cdot g + 2 \mu_{xx}\, g \cdot g
                                   - 2\, s_x \cdot s_x,

    and for :math:`\mu_{xy}` the same with :math:`s_x \cdot s_y` and without 4/3. The bias of
    :math:`\mu_{xx}` so tends to :math:`\tfrac 23 \sigma^2` with the number of vertices.

    Parameters
    ----------
    vertices : array_like, shape (..., K, 2) [px]
    sigma : array_like, shape (...)
        Standard deviation of every coordinate of every vertex [px].
    starts : sequence of int
        As of `moments`.

    Returns
    -------
    ndarray, shape (..., 6, 6)
        Covariance, to first order.
    ndarray, shape (..., 6)
        Bias, to second order: subtract it from moments that were measured. That of A is zero.

    Raises
    ------
    ValueError
        As `moments`; if `sigma` is negative or not finite.
    """
    variance = np.asarray(sigma, np.float64)
    if not (np.isfinite(variance).all() and (variance >= 0).all()):
        raise ValueError(f"the noise of vertices is 0 px or more, got {np.min(variance)}")
    variance = variance**2
    m, J, sums = _moments(vertices, starts)
    flat = J.reshape(*J.shape[:-2], -1)
    P = variance[..., None, None] * flat @ flat.swapaxes(-1, -2)
    dA, dSx, dSy, *dI = np.moveaxis(sums.reshape(flat.shape), -2, 0)  # over A
    trace = np.zeros_like(m)
    pairs = ((dSx, dSx, 4 / 3), (dSy, dSy, 4 / 3), (dSx, dSy, 0.0))
    trace[..., 1], trace[..., 2] = -2 * (dSx * dA).sum(-1), -2 * (dSy * dA).sum(-1)
    for k, (h, (a, b, own)) in enumerate(zip(dI, pairs, strict=True), start=3):
        ratio = 2 * m[..., k] * (dA * dA).sum(-1) - 2 * (h * dA).sum(-1)
        trace[..., k] = own + ratio - 2 * (a * b).sum(-1)
    return P, variance[..., None] / 2 * trace


@dataclass(frozen=True, eq=False)
class Clipped:
    """What a frame shows of a polygon.

    Parameters
    ----------
    rings : tuple of ndarray, shape (K, 2) [px]
        None, one or several, each closed implicitly, none in another.
    on_frame : tuple of ndarray of bool, shape (K,)
        Which edges, from vertex k to k + 1, lie on the frame: they are no shore. An edge of the
        polygon that happens to lie there is one of them.
    """

    rings: tuple[FloatArray, ...]
    on_frame: tuple[NDArray[np.bool_], ...]

    @property
    def whole(self) -> bool:
        """Whether one ring is seen and none of it lies on the frame."""
        return len(self.rings) == 1 and not self.on_frame[0].any()


def split_rings(vertices: FloatArray) -> tuple[FloatArray, tuple[int, ...]]:
    """Vertices of rings between which a row is not a number, without these rows, and their starts.

    Parameters
    ----------
    vertices : ndarray, shape (..., K, 2)
        Such rows are the same for all leading axes.

    Returns
    -------
    ndarray, shape (..., K - number of islands, 2)
    tuple of int
        Where the rings start.
    """
    first = vertices.reshape(-1, *vertices.shape[-2:])[0]
    gaps = np.flatnonzero(np.isnan(first[:, 0]))
    if not len(gaps):
        return vertices, (0,)
    return np.delete(vertices, gaps, axis=-2), (0, *(int(g) - k for k, g in enumerate(gaps)))


def clip_to_frame(vertices: ArrayLike, width: int, height: int) -> Clipped:
    """Clip a polygon, convex or not, to the frame of an image.

    Parameters
    ----------
    vertices : array_like, shape (K, 2) [px]
    width, height : int
        Of the frame [px]: it spans -0.5 to width - 0.5, -0.5 to height - 0.5.

    Raises
    ------
    ValueError
        As `outline`; if the frame has no pixels.
    """
    size = _frame(width, height)
    polygon = shapely.Polygon(outline(vertices))
    frame = shapely.box(-0.5, -0.5, size[0] - 0.5, size[1] - 0.5)
    parts = shapely.get_parts(shapely.intersection(polygon, frame))
    rings, edges = [], []
    areal = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(parts)
    for part in parts[areal]:
        ring = shapely.get_coordinates(part)[:-1]
        sides = np.concatenate([ring + 0.5, ring + 0.5 - np.array(size)], axis=1)
        on = np.abs(sides) < _ON_FRAME
        rings.append(ring)
        edges.append(np.asarray((on & np.roll(on, -1, axis=0)).any(axis=1)))
    return Clipped(tuple(rings), tuple(edges))


@dataclass(frozen=True, eq=False)
class Nearest:
    """Where points are nearest to a closed polyline.

    Parameters
    ----------
    distance : ndarray, shape (N,)
        [px], not negative.
    signed : ndarray, shape (N,)
        The same, negative inside: ``normal @ (point - foot)``.
    normal : ndarray, shape (N, 2)
        Unit outward normal at the foot, the gradient of `signed` by the point: across the segment,
        or, where a vertex is nearest, along the line to the point.
    foot : ndarray, shape (N, 2)
        The nearest place [px].
    segment : ndarray of int, shape (N,)
        That the foot lies on: from vertex k to k + 1; the first of several.
    parameter : ndarray, shape (N,)
        Where on it, 0 to 1.
    """

    distance: FloatArray
    signed: FloatArray
    normal: FloatArray
    foot: FloatArray
    segment: NDArray[np.intp]
    parameter: FloatArray


def distances(points: ArrayLike, polyline: ArrayLike) -> Nearest:
    """Nearest places on a closed polyline, exact but for rounding.

    Parameters
    ----------
    points : array_like, shape (N, 2) [px]
    polyline : array_like, shape (K, 2) [px]
        Closed implicitly. That it does not cross itself is not checked: `outline` does.

    Raises
    ------
    ValueError
        If a point or vertex is not finite, there are fewer than three vertices, or nothing is
        enclosed.
    """
    p, q = _points(points, "a set of points"), _points(polyline, "a polyline")
    if p.ndim != 2 or q.ndim != 2:
        raise ValueError(
            f"points and a polyline have shapes (N, 2) and (K, 2), got {p.shape} and {q.shape}"
        )
    _enough(q, "a polyline")
    area = float(_area(q - q[0]))
    if area == 0.0:
        raise ValueError("a polyline encloses an area, got one of 0 px^2: inside is not defined")
    step = max(1, _PAIRS // len(q))
    parts = [_nearest(p[k : k + step], q, np.sign(area)) for k in range(0, max(len(p), 1), step)]
    return Nearest(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _nearest(p: FloatArray, q: FloatArray, turn: float) -> tuple[Any, ...]:
    """The fields of `Nearest` for some of the points."""
    edge = np.roll(q, -1, axis=0) - q
    length2 = (edge**2).sum(axis=1)
    dx, dy = p[:, None, 0] - q[:, 0], p[:, None, 1] - q[:, 1]
    along = dx * edge[:, 0] + dy * edge[:, 1]
    t = np.clip(along / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
    d2 = (dx - t * edge[:, 0]) ** 2 + (dy - t * edge[:, 1]) ** 2
    k = d2.argmin(axis=1)
    rows = np.arange(len(p))
    t = t[rows, k]
    foot = q[k] + t[:, None] * edge[k]
    offset = p - foot
    distance = np.hypot(offset[:, 0], offset[:, 1])
    # inside: an odd number of edges is crossed on the way to the right
    upward = (q[:, 1] > p[:, None, 1]) != (np.roll(q[:, 1], -1) > p[:, None, 1])
    rise = np.where(edge[:, 1] == 0.0, 1.0, edge[:, 1])
    crossed = upward & (dx < dy / rise * edge[:, 0])
    sign = np.where(crossed.sum(axis=1) % 2 == 1, -1.0, 1.0)
    across = turn * np.stack([edge[k, 1], -edge[k, 0]], axis=1)
    across /= np.where(length2[k] > 0, np.sqrt(length2[k]), 1.0)[:, None]
    corner = ((t == 0.0) | (t == 1.0)) & (distance > 0.0)
    away = sign[:, None] * offset / np.where(distance > 0.0, distance, 1.0)[:, None]
    return distance, sign * distance, np.where(corner[:, None], away, across), foot, k, t


def _moments(
    vertices: ArrayLike, starts: Sequence[int] = (0,)
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Moments, their Jacobian, and derivatives of (A, S, I) about the centroid, over A."""
    p = _points(vertices, "a polygon")
    ends = [*starts[1:], p.shape[-2]]
    for start, end in zip(starts, ends, strict=True):
        _enough(p[..., start:end, :], "a polygon")
    behind = ahead = None
    if len(ends) > 1:
        behind = np.arange(-1, p.shape[-2] - 1)
        behind[list(starts)] = np.array(ends) - 1
        ahead = np.argsort(behind)
    origin = p[..., :1, :]
    local = p - origin
    area = _area(local, ahead)
    if (area == 0.0).any():
        raise ValueError("a polygon encloses an area, got one of 0 px^2: it has no centroid")
    x, y, x1, y1, c = _edges(local, ahead)
    center = np.stack([((x + x1) * c).sum(-1), ((y + y1) * c).sum(-1)], -1) / (6 * area[..., None])
    x, y, x1, y1, c = _edges(local - center[..., None, :], ahead)
    polynomials: tuple[
        tuple[Any, ...], ...
    ] = (  # each, and its derivatives by x, y, x1, y1; and what the sum is divided by
        (np.ones_like(x), 0.0, 0.0, 0.0, 0.0, 2.0),
        (x + x1, 1.0, 0.0, 1.0, 0.0, 6.0),
        (y + y1, 0.0, 1.0, 0.0, 1.0, 6.0),
        (x * x + x * x1 + x1 * x1, 2 * x + x1, 0.0, x + 2 * x1, 0.0, 12.0),
        (y * y + y * y1 + y1 * y1, 0.0, 2 * y + y1, 0.0, y + 2 * y1, 12.0),
        (
            x * y1 + 2 * x * y + 2 * x1 * y1 + x1 * y,
            *(y1 + 2 * y, 2 * x + x1, 2 * y1 + y, x + 2 * x1),
            24.0,
        ),
    )
    shape = (*x.shape[:-1], 6, x.shape[-1], 2)
    m, sums = np.empty(shape[:-2]), np.empty(shape)
    for k, (f, fx, fy, fx1, fy1, n) in enumerate(polynomials):
        scale = 1 / (n * area)
        m[..., k] = (f * c).sum(-1) * scale
        first = np.stack([fx * c + f * y1, fy * c - f * x1], -1)
        second = np.stack([fx1 * c - f * y, fy1 * c + f * x], -1)
        sums[..., k, :, :] = (first + _neighbor(second, behind, 1, axis=-2)) * scale[
            ..., None, None
        ]
    J = sums.copy()
    J[..., 0, :, :] *= np.abs(area)[..., None, None]
    J[..., 3:, :, :] -= m[..., 3:, None, None] * sums[..., :1, :, :]
    m[..., 0] = np.abs(area)
    m[..., 1:3] = origin[..., 0, :] + center
    return m, J, sums


def _neighbor(
    values: FloatArray, index: NDArray[np.intp] | None, shift: int, axis: int = -1
) -> FloatArray:
    """Values of neighbors along the ring: rolled, or by number where there are several rings."""
    return np.roll(values, shift, axis) if index is None else np.take(values, index, axis)


def _edges(p: FloatArray, ahead: NDArray[np.intp] | None = None) -> tuple[FloatArray, ...]:
    """Coordinates of every edge's ends, and their cross product, each (..., K)."""
    x, y = p[..., 0], p[..., 1]
    x1, y1 = _neighbor(x, ahead, -1), _neighbor(y, ahead, -1)
    return x, y, x1, y1, x * y1 - x1 * y


def _area(p: FloatArray, ahead: NDArray[np.intp] | None = None) -> FloatArray:
    """Area, positive from x to y."""
    return np.asarray(_edges(p, ahead)[4].sum(-1) / 2)


def _points(values: ArrayLike, what: str) -> FloatArray:
    p = np.asarray(values, np.float64)
    if p.ndim < 2 or p.shape[-1] != 2:
        raise ValueError(f"{what} has two coordinates in its last axis, (K, 2), got {p.shape}")
    if not np.isfinite(p).all():
        *_, k = np.argwhere(~np.isfinite(p).all(axis=-1))[0]
        raise ValueError(f"{what} has finite coordinates, got a NaN or infinity in vertex {k}")
    return p


def _enough(p: FloatArray, what: str) -> None:
    if p.shape[-2] < 3:
        raise ValueError(f"{what} has three vertices or more, got {p.shape[-2]}")


def _frame(width: int, height: int) -> tuple[int, int]:
    if min(width, height) < 1:
        raise ValueError(f"a frame has one pixel or more along each side, got {width} x {height}")
    return int(width), int(height)
