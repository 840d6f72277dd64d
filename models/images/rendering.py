r"""Images of a polygon: exact coverage of pixels, and a scene of water and land.

Coverage of a pixel is the share of its square that the polygon covers, with no sampling: every edge
is cut where it crosses a border of pixels; a piece from :math:`(x_0, y_0)` to :math:`(x_1, y_1)`
within column j covers of its row, to its right,

.. math:: (y_1 - y_0)\,(j + 1 - \bar x) \text{ in column } j, \qquad
          (y_1 - y_0) \text{ in each one after it}, \qquad \bar x = (x_0 + x_1) / 2,

and the signed sum over all pieces is the coverage [1]_. Coordinates are those of `polygons`.

References
----------
.. [1] D. Turner, "The FreeType smooth rasterizer": cells of area and cover, there in fixed point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d, gaussian_filter

from terrafix.models.core.arrays import FloatArray
from terrafix.models.images.polygons import outline

_TAILS = 5.5
"""Where the point spread is cut, in its standard deviations."""


@dataclass(frozen=True)
class Appearance:
    """How water, land and clouds look to a camera.

    Parameters
    ----------
    water, land, cloud : float
        Reflectances [-].
    gradient : (float, float)
        Relative growth of light from the left to the right border, and from the top to the bottom
        [-]; 1 in the frame's middle.
    noise : float
        Standard deviation of the additive white noise [reflectance].
    bits : int
        Of the quantization; 0 for none.
    full_scale : float
        Reflectance of the highest code; more is cut off.

    Raises
    ------
    ValueError
        If a reflectance, `noise` or `bits` is negative, light ends within the frame, or
        `full_scale` is not positive.
    """

    water: float = 0.05
    land: float = 0.25
    cloud: float = 0.7
    gradient: tuple[float, float] = (0.0, 0.0)
    noise: float = 0.0
    bits: int = 12
    full_scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("water", "land", "cloud", "noise", "bits"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be 0 or more, got {value}")
        if not self.full_scale > 0:
            raise ValueError(f"full_scale must be positive, got {self.full_scale}")
        if not sum(map(abs, self.gradient)) < 2:
            raise ValueError(
                f"gradient must leave light in every corner, |x| + |y| < 2, got {self.gradient}"
            )


def render_polygon(
    vertices: ArrayLike,
    width: int,
    height: int,
    holes: Sequence[ArrayLike] = (),
    *,
    blur: float = 0.0,
) -> FloatArray:
    """Exact area coverage of each pixel by a polygon.

    Parameters
    ----------
    vertices : array_like, shape (K, 2) [px]
        Of any shape and orientation; it may reach beyond the frame.
    width, height : int
        Of the image [px].
    holes : sequence of array_like, shape (K, 2) [px]
        Islands: rings within the polygon, apart from each other, which is not checked.
    blur : float
        Standard deviation of a Gaussian point spread [px]; at the border it sees what lies beyond.
        Shifts by parts of pixels, half of `blur` or less, are summed with Gaussian weights: sum and
        variance are exact but for rounding from 0.125 px on; single pixels are to some 0.003.

    Returns
    -------
    ndarray, shape (height, width)
        0 to 1, but for rounding (1e-12).

    Raises
    ------
    ValueError
        As `outline`; if the image has no pixels, or `blur` is negative.
    """
    rings = []
    for ring, turn in ((vertices, 1), *((hole, -1) for hole in holes)):
        p = outline(ring)
        local, after = p - p[0], np.roll(p - p[0], -1, axis=0)
        area = (local[:, 0] * after[:, 1] - after[:, 0] * local[:, 1]).sum()
        rings.append(p if area * turn > 0 else p[::-1])
    return ring_coverage(rings, width, height, blur)


def ring_coverage(
    rings: Sequence[FloatArray], width: int, height: int, blur: float = 0.0
) -> FloatArray:
    """Sum of the coverage by rings, without a check: those that turn from y to x count negative.

    Parameters
    ----------
    rings : sequence of ndarray, shape (K, 2) [px]
        Where one crosses itself, what it winds around twice counts twice.
    width, height : int
        Of the image [px].
    blur : float
        As in `render_polygon`.

    Returns
    -------
    ndarray, shape (height, width)

    Raises
    ------
    ValueError
        If the image has no pixels, or `blur` is negative.
    """
    if min(width, height) < 1:
        raise ValueError(f"an image has one pixel or more along each side, got {width} x {height}")
    if not blur >= 0:
        raise ValueError(f"blur is 0 px or more, got {blur}")
    if not rings:
        return np.zeros((height, width))
    if blur > 0:
        return _blurred_coverage(rings, width, height, blur)
    # coverage lies to the right of edges that go up, y down
    ends = np.concatenate(rings) + 0.5
    starts = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings]) + 0.5
    p0, p1 = _cut(starts, ends, (width, height))
    middle, rise = (p0 + p1) / 2, p1[:, 1] - p0[:, 1]
    row = np.floor(middle[:, 1]).astype(np.intp)
    seen = (row >= 0) & (row < height) & (middle[:, 0] < width)
    x, rise, row = np.maximum(middle[seen, 0], 0.0), rise[seen], row[seen]
    column = x.astype(np.intp)
    index, n = row * (width + 1) + column, height * (width + 1)
    cells = np.bincount(index, rise * (column + 1 - x), n)
    cells += np.bincount(index + 1, rise * (x - column), n)
    covered = np.cumsum(cells.reshape(height, width + 1), axis=1)[:, :width]
    return np.ascontiguousarray(covered)


def render_scene(
    coverage: ArrayLike,
    appearance: Appearance,
    rng: np.random.Generator,
    clouds: ArrayLike | None = None,
) -> FloatArray:
    r"""Image of a water body in land, as a camera codes it.

    .. math:: I = Q\left[ \ell\, ((1 - \alpha) (f w + (1 - f) l) + \alpha c) + n \right]

    with coverage f by water, opacity :math:`\alpha` of clouds, reflectances w, l and c, light
    :math:`\ell`, noise n and quantization Q. The point spread is in f; light and clouds vary little
    across it.

    Parameters
    ----------
    coverage : array_like, shape (height, width)
        By water, 0 to 1, as the camera's point spread shows it (`render_polygon`).
    appearance : Appearance
    rng : numpy.random.Generator
        Of the noise.
    clouds : array_like, shape (height, width)
        Opacity, 0 to 1 (see `cloud_opacity`).

    Returns
    -------
    ndarray, shape (height, width)
        Codes, whole from 0 to 2^bits - 1; reflectance if bits is 0.

    Raises
    ------
    ValueError
        If `coverage` is no image, or `clouds` have another shape.
    """
    f = np.asarray(coverage, np.float64)
    if f.ndim != 2:
        raise ValueError(f"coverage is an image (height, width), got shape {f.shape}")
    look = appearance
    image = f * look.water + (1 - f) * look.land
    if clouds is not None:
        opacity = np.asarray(clouds, np.float64)
        if opacity.shape != f.shape:
            raise ValueError(
                f"clouds have the shape of the coverage, {f.shape}, got {opacity.shape}"
            )
        image = (1 - opacity) * image + opacity * look.cloud
    y, x = (np.arange(n) / max(n - 1, 1) - 0.5 for n in f.shape)
    image = image * (1 + look.gradient[0] * x + look.gradient[1] * y[:, None])
    if look.noise > 0:
        image = image + look.noise * rng.standard_normal(f.shape)
    if look.bits > 0:
        highest = 2**look.bits - 1
        image = np.clip(np.rint(image / look.full_scale * highest), 0, highest)
    return np.asarray(image, np.float64)


def cloud_opacity(
    width: int,
    height: int,
    share: float,
    rng: np.random.Generator,
    *,
    size: float = 12.0,
    edge: float = 0.3,
) -> FloatArray:
    """Opacity of clouds: a smooth random field above a level.

    Parameters
    ----------
    width, height : int
        Of the image [px].
    share : float
        Of the image that they touch, 0 to 1.
    rng : numpy.random.Generator
    size : float
        Standard deviation of the field's smoothing [px].
    edge : float
        Rise of the field, in its standard deviations, from clear to opaque.

    Returns
    -------
    ndarray, shape (height, width)
        0 (clear) to 1 (opaque).

    Raises
    ------
    ValueError
        If `share` is not within 0 to 1, or `size` or `edge` is not positive.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"the share of clouds is 0 to 1, got {share}")
    if not (size > 0 and edge > 0):
        raise ValueError(f"size and edge of clouds are positive, got {size} px and {edge}")
    field = gaussian_filter(rng.standard_normal((height, width)), size, mode="wrap")
    if share == 0:
        return np.zeros_like(field)
    level = np.quantile(field, 1 - share)
    opacity: NDArray[np.float64] = np.clip((field - level) / (edge * field.std()), 0.0, 1.0)
    return opacity


def _cut(
    start: FloatArray, end: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Cut edges at the borders of pixels, which are whole here; ends of the pieces, each (n, 2)."""
    n_edges = len(start)
    edges, at = [np.arange(n_edges)], [np.zeros(n_edges)]
    cuts = [start]
    for axis, n in enumerate(size):
        a, b = start[:, axis], end[:, axis]
        first = np.clip(np.ceil(np.minimum(a, b)), 0, n + 1).astype(np.intp)
        last = np.clip(np.floor(np.maximum(a, b)), -1, n).astype(np.intp)
        count = np.where(a == b, 0, np.maximum(last - first + 1, 0))
        edge = np.repeat(np.arange(n_edges), count)
        line = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + first[edge]
        t = (line - a[edge]) / (b[edge] - a[edge])
        cut = start[edge] + t[:, None] * (end[edge] - start[edge])
        cut[:, axis] = line
        edges, at, cuts = [*edges, edge], [*at, t], [*cuts, cut]
    edge, t, p0 = np.concatenate(edges), np.concatenate(at), np.concatenate(cuts)
    order = np.lexsort((t, edge))
    edge, p0 = edge[order], p0[order]
    p1 = np.roll(p0, -1, axis=0)
    last_of = np.append(edge[1:] != edge[:-1], True)
    p1[last_of] = end
    return p0, p1


def _blurred_coverage(
    rings: Sequence[FloatArray], width: int, height: int, blur: float
) -> FloatArray:
    """Coverage through a point spread, by parts of pixels around the rings alone."""
    parts = int(np.clip(np.ceil(2 / blur), 1, 8))
    reach = int(np.ceil(_TAILS * blur)) + 1
    corners = np.concatenate(rings)
    first = np.maximum(np.floor(corners.min(axis=0)) - reach, -reach).astype(np.intp)
    last = np.ceil(corners.max(axis=0)) + reach + 1
    last = np.minimum(last, np.array([width, height]) + reach).astype(np.intp)
    out = np.zeros((height, width))
    if (first >= last).any():
        return out
    n, m = (int(k) for k in last - first)
    fine = [(ring + 0.5 - first) * parts - 0.5 for ring in rings]
    covered = ring_coverage(fine, n * parts, m * parts)
    taps = int(np.ceil(_TAILS * blur * parts)) + 2
    kernel = np.exp(-((np.arange(-taps, taps + 1) / (blur * parts)) ** 2) / 2)
    for axis in (0, 1):
        covered = correlate1d(covered, kernel / kernel.sum(), axis=axis, mode="nearest")
    covered = covered.reshape(m, parts, n, parts).mean(axis=(1, 3))
    x0, y0 = (max(int(k), 0) for k in first)
    x1, y1 = min(int(last[0]), width), min(int(last[1]), height)
    if x0 < x1 and y0 < y1:
        x, y = x0 - int(first[0]), y0 - int(first[1])
        out[y0:y1, x0:x1] = covered[y : y + y1 - y0, x : x + x1 - x0]
    return out
