r"""Water in a gray image: coverage, coastlines to a fraction of a pixel, and moments.

Brightness is light times reflectance (a dark offset is removed before). Land, which takes more of
the image than water and clouds together, gives the light: a plane :math:`l(x, y)` through what is
neither darker nor brighter (trimmed least squares). Water has a ratio q to it, the median of what
lies inside dark regions, and coverage by water is

.. math:: f = \frac{1 - I / l}{1 - q};

q is found again when a first contour tells which pixels hold nothing but water.

The contour :math:`f = 1/2` by marching squares rounds off what is convex: it encloses too little,
and the ends of a long lake count most in second moments. So it is moved along its normals until its
own coverage, exact (`rendering`) and blurred by the point spread, is the image's: in each of some
steps a vertex moves by what the image has more than the contour near it, per length.

Measured on the outline of Lake Seneca at 176 x 33 px (1691 px^2, mxx 2083 px^2), noise of pixels
relative to the contrast of water and land, mean and standard deviation over 24 places and angles
without noise, over 60 places with:

====  =====  ==============  =================  ================  ===============  ==============
blur  noise  estimator       A [%]              x [px]            mxx [px^2]       myy [px^2]
====  =====  ==============  =================  ================  ===============  ==============
0     0      plain contour   -0.081, 0.060      -0.002, 0.016     -2.25, 1.89      -1.01, 1.42
0     0      fitted contour  0.0005, 0.0004     -0.0001, 0.0001   0.002, 0.007     0.000, 0.004
0     0      gray moments    0.0005, 0.0004     0.0000, 0.0001    0.002, 0.009     0.000, 0.007
0.7   0      plain contour   -0.153, 0.020      0.003, 0.010      -6.19, 2.98      -2.05, 3.09
0.7   0      fitted contour  0.0000, 0.0002     0.0000, 0.0001    -0.005, 0.008    -0.003, 0.005
0.7   0      gray moments    0.0000, 0.0001     0.0000, 0.0000    -0.002, 0.001    -0.001, 0.001
0     0.01   plain contour   -0.049, 0.057      0.003, 0.023      -3.25, 1.81      -0.079, 0.019
0     0.01   fitted contour  0.000, 0.017       0.000, 0.010      -0.02, 0.43      -0.001, 0.014
0     0.01   gray moments    0.000, 0.017       0.000, 0.010      -0.02, 0.43      -0.002, 0.015
0.7   0.01   plain contour   -0.153, 0.025      0.000, 0.012      -7.92, 0.79      -0.214, 0.020
0.7   0.01   fitted contour  -0.007, 0.031      0.000, 0.014      -0.05, 0.65      -0.005, 0.027
0.7   0.01   gray moments    -0.007, 0.031      0.000, 0.014      -0.05, 0.66      -0.004, 0.028
0.7   0.05   plain contour   -0.134, 0.109      0.007, 0.058      -7.86, 2.45      -0.207, 0.080
0.7   0.05   fitted contour  -0.054, 0.146      0.007, 0.073      -0.76, 3.42      -0.008, 0.116
0.7   0.05   gray moments    -0.053, 0.147      0.008, 0.072      -0.55, 3.31      -0.021, 0.118
====  =====  ==============  =================  ================  ===============  ==============

The plain contour is that of contourpy (which matplotlib brings) or of scikit-image's
``find_contours``: their areas are the same to rounding. Outlines by OpenCV's ``findContours`` have
an area 10 % too small, 1.3 % of an image enlarged 8 times; ``fillPoly`` is 10 % too large. Fitted
contour and gray moments are as good; gray moments come with a covariance, the contour with a shape.
A wrong `blur` matters to both.

Excluded as no coast: what lies near clouds, that is near pixels brighter than land or near gray
that is wider than a blurred coast, and the frame. Thin cloud can still pass for land: of 120 images
with clouds of many sizes over up to 45 %, 14 had coast that was more than a pixel off, up to 9 %
of its vertices. Arms of water narrower than a pixel, which nowhere cover half of one, are lost, to
gray moments too.

Coordinates are those of `polygons`: (x, y), whole at the centers of pixels.

References
----------
.. [1] W. E. Lorensen, H. E. Cline, "Marching Cubes", Computer Graphics 21(4), 1987; in the plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from contourpy import FillType, contour_generator
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, binary_erosion, binary_opening, label
from scipy.special import ndtr

from terrafix.models.core.arrays import FloatArray
from terrafix.models.images.polygons import distances
from terrafix.models.images.rendering import ring_coverage

Mask = NDArray[np.bool_]
"""Which pixels, or vertices."""

_SMALLEST_IMAGE = 8
"""Rows and columns that an image must have."""
_ROUNDS = 30
_TRIM = 2.5
"""Residuals of land, in its standard deviations, beyond which something is not land."""
_DEEP = 25
"""Pixels away from the coast that water's brightness is taken from; else of those nearer to it."""
_INNER = 0.99
"""Coverage by the contour's own, of pixels that it is taken from when there is a contour."""
_STEPS_OF_CODES = 1.5
"""What is added to that, in steps between codes: noise may be less than a step."""
_DARK = 6.0
"""How far water must be below land, in its standard deviations."""
_BRIGHT, _BRIGHTER = 5.0, 0.15
"""How far clouds are above land: in its standard deviations, and in the contrast of water."""
_GRAY = 0.1
"""How far from land and from water coverage is neither."""
_SPECK = 3
"""Pixels that a cloud must have."""
_STEPS = 4
_ROUNDED = 0.03
"""What rounding off capes and bays of a pixel adds to the scatter of vertices, measured [px]."""
_STRIDE = 0.5
"""Largest move of a vertex in one step [px]."""
_KERNEL = np.array([1.0, 2.0, 3.0, 2.0, 1.0])
"""Smoothing of vertices' moves along the contour."""
_SIDES = 1e-9
"""How far from the frame a vertex that lies on it may be [px]."""


@dataclass(frozen=True, eq=False)
class Ring:
    """A closed coastline.

    Parameters
    ----------
    vertices : ndarray, shape (K, 2) [px]
        x and y, whole at the centers of pixels; closed implicitly. From x to y around water, from
        y to x around an island.
    coast : ndarray of bool, shape (K,)
        Which vertices are seen to lie on a coast: not on the frame, nor near a cloud.
    sigma : float
        Standard deviation of a vertex across the coast, within 25 percent, low [px]: by noise of
        pixels, and 0.03 px by the rounding of small capes. Neighbors within some 3 px share it:
        moments of the ring have more noise than `moment_noise` says for independent vertices (see
        `gray_moments`).
    island : bool
    """

    vertices: FloatArray
    coast: Mask
    sigma: float
    island: bool

    @property
    def whole(self) -> bool:
        """Whether all of it is coast."""
        return bool(self.coast.all())


@dataclass(frozen=True, eq=False)
class Coastline:
    """Water in an image.

    Parameters
    ----------
    rings : tuple of Ring
        The largest first.
    mask : ndarray of bool, shape (height, width)
        What is water by half or more, and not hidden.
    coverage : ndarray, shape (height, width)
        By water: measured within `band`; else what the rings cover, 0 or 1.
    band : ndarray of bool, shape (height, width)
        Pixels near a coast: all that hold noise.
    hidden : ndarray of bool, shape (height, width)
        Clouds, and what is near them.
    noise : float
        Standard deviation of `coverage` of each pixel of the band, independent [-].
    gain : float
        That of a factor that all of the band shares, by the brightness of water [-].
    """

    rings: tuple[Ring, ...]
    mask: Mask
    coverage: FloatArray
    band: Mask
    hidden: Mask
    noise: float
    gain: float


@dataclass(frozen=True, eq=False)
class _Nearby:
    """Pixels near rings, and which ring, segment and place on it is nearest; each (n,)."""

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    ring: NDArray[np.intp]
    segment: NDArray[np.intp]
    parameter: FloatArray


def coastline(
    image: ArrayLike, *, blur: float = 0.0, margin: float = 4.0, smallest: float = 20.0
) -> Coastline:
    """Find water in a gray image, darker than the land around it.

    Parameters
    ----------
    image : array_like, shape (height, width)
        Brightness, of any unit; zero without light.
    blur : float
        Standard deviation of the Gaussian point spread [px], from the camera's calibration.
    margin : float
        How far from a cloud a coast is believed [px]. Soft edges of clouds darken to water over
        several pixels.
    smallest : float
        Area of water or island that is kept [px^2].

    Raises
    ------
    ValueError
        If the image is not a plane of finite numbers, `blur`, `margin` or `smallest` is negative,
        or no water is seen in it.
    """
    for name, value in (("blur", blur), ("margin", margin), ("smallest", smallest)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} is finite and 0 or more, got {value}")
    f, noise, cloud = _coverage(_image(image), blur)
    gray = (f > _GRAY) & (f < 1 - _GRAY)  # wider than a coast, it is a cloud's soft edge over water
    n = int(np.ceil(_reach(blur)))
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    thin = binary_opening(gray, x * x + y * y <= n * n)
    hidden = _dilated(cloud | thin, margin)
    found = [ring for ring in _contours(f) if abs(_area(ring)) >= max(smallest, 1e-9)]
    water = [ring for ring in found if _area(ring) > 0]
    if not water:
        raise ValueError(
            f"an image shows water of {smallest:g} px^2 or more, this one has none that is as "
            "large\n  lower smallest, or take an image with the whole lake in it"
        )
    height, width = f.shape
    near = _nearby(found, f, hidden, _reach(blur))
    coasts = [_coast(ring, hidden) for ring in found]
    rings = _fitted(found, coasts, f, near, blur)
    # the brightness of water again, now that it is known how much land is in it
    inner = ring_coverage(rings, width, height, blur)[~hidden]
    least = np.sort(inner)[-_DEEP:].min(initial=_INNER)
    weight = np.where(inner >= least, inner, 0.0)
    total = float(weight @ weight)
    if total < 1:
        raise ValueError(
            f"an image shows water, clouds and their {margin:g} px of margin hide all of this one's"
        )
    scale = float(weight @ f[~hidden]) / total
    f, noise, gain = f / scale, noise / scale, noise / scale / total**0.5
    rings = _fitted(rings, coasts, f, near, blur)
    band = np.zeros(f.shape, np.bool_)
    band[near.row, near.column] = True
    covered = ring_coverage(rings, width, height)
    f = np.where(band, f, np.where(covered > 0.5, 1.0, 0.0))
    made = [
        Ring(ring, coast, _vertex_noise(ring, noise, blur), _area(ring) < 0)
        for ring, coast in zip(rings, coasts, strict=True)
    ]
    made.sort(key=lambda ring: -abs(_area(ring.vertices)))
    return Coastline(tuple(made), (f >= 0.5) & ~hidden, f, band, hidden, noise, gain)


def gray_moments(
    coverage: ArrayLike,
    sigma: float = 0.0,
    band: ArrayLike | None = None,
    *,
    gain: float = 0.0,
    blur: float = 0.0,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    r"""Moments straight from the coverage of pixels, without a contour.

    .. math:: A = \sum f, \quad \bar x = \sum f x / A, \quad
              \mu_{xx} = \sum f (x - \bar x)^2 / A - \tfrac 1{12} - b^2

    A pixel's square adds 1/12 px^2 to second moments, in the mean over places within a pixel (sides
    along whole rows of pixels add -1/12 to 1/6), and a point spread its variance b^2. With
    independent noise of pixels, :math:`\partial m / \partial f` is

    .. math:: 1, \quad (x - \bar x) / A, \quad ((x - \bar x)^2 - \mu'_{xx}) / A, \quad
              ((x - \bar x)(y - \bar y) - \mu_{xy}) / A,

    where :math:`\mu'` has not lost 1/12 and b^2, and bias is half the variance times the trace of
    the second derivatives.

    Parameters
    ----------
    coverage : array_like, shape (height, width)
        By one water body; zero elsewhere.
    sigma : float
        Standard deviation of the coverage of each pixel of `band` [-].
    band : array_like of bool, shape (height, width)
        Pixels that hold noise; all, if it is left out.
    gain : float
        Standard deviation of a factor that the coverage of all of `band` shares [-].
    blur : float
        Standard deviation of the Gaussian point spread [px].

    Returns
    -------
    ndarray, shape (6,)
        Moments, in the order of `polygons.MOMENTS`.
    ndarray, shape (6, 6)
        Covariance, to first order.
    ndarray, shape (6,)
        Bias by noise, to second order.

    Raises
    ------
    ValueError
        If `coverage` is not a plane of finite numbers, its sum is not positive, `band` has another
        shape, or `sigma`, `gain` or `blur` is negative.
    """
    f = _image(coverage, 1)
    if not (sigma >= 0 and gain >= 0 and blur >= 0):
        raise ValueError(f"sigma, gain and blur are 0 or more, got {sigma}, {gain} and {blur} px")
    noisy = np.ones(f.shape, np.bool_) if band is None else np.asarray(band, np.bool_)
    if noisy.shape != f.shape:
        raise ValueError(f"a band has the shape of the coverage, {f.shape}, got {noisy.shape}")
    area = f.sum()
    if not area > 0:
        raise ValueError(f"coverage has a positive sum, got {area:g} px^2: there is no water")
    rows, columns = np.nonzero((f != 0) | noisy)
    weight = f[rows, columns] / area
    cx, cy = weight @ columns, weight @ rows
    x, y = columns - cx, rows - cy
    second = np.stack([x * x, y * y, x * y])
    mu = second @ weight
    own = np.array([1 / 12 + blur**2, 1 / 12 + blur**2, 0.0])
    m = np.array([area, cx, cy, *(mu - own)])
    n = noisy[rows, columns]
    J = np.stack([np.full(int(n.sum()), area), x[n], y[n], *(second[:, n] - mu[:, None])]) / area
    products = J[1:3] @ J[1:3].T  # of the derivatives of the centroid
    trace = np.zeros(6)
    trace[1:] = -2 / area * J[1:].sum(axis=1)
    trace[3:] -= 2 * np.array([products[0, 0], products[1, 1], products[0, 1]])
    shared = gain * J @ f[rows, columns][n]
    return m, sigma**2 * J @ J.T + np.outer(shared, shared), sigma**2 / 2 * trace


def _image(image: ArrayLike, least: int = _SMALLEST_IMAGE) -> FloatArray:
    a = np.asarray(image)
    if a.ndim != 2 or min(a.shape) < least:
        raise ValueError(
            f"an image has two axes, (height, width), of {least} pixels or more, got shape "
            f"{a.shape}"
        )
    if a.dtype.kind not in "buif":
        raise ValueError(f"an image holds real numbers, got {a.dtype}")
    a = a.astype(np.float64)
    if not np.isfinite(a).all():
        row, column = np.argwhere(~np.isfinite(a))[0]
        raise ValueError(
            f"an image holds finite numbers, got {a[row, column]} at row {row}, column {column}"
        )
    return a


def _coverage(image: FloatArray, blur: float) -> tuple[FloatArray, float, Mask]:
    """Coverage by water, its standard deviation, and where clouds are."""
    codes = np.unique(image)
    step = float(np.diff(codes).min()) if len(codes) > 1 else 0.0
    land = _land(image, step)
    if not land.min() > 0:
        raise ValueError(
            f"land is brighter than 0 all over an image, here it falls to {land.min():g}\n"
            "  remove a dark offset from the image, but no more than that"
        )
    ratio = image / land
    off = np.abs(ratio - 1)
    spread = 1.4826 * float(np.median(off))
    least = _STEPS_OF_CODES * step / float(np.median(land))
    for _ in range(_ROUNDS):  # what is not land widens the median
        most = _TRIM * spread + least
        kept = off[off <= most]
        a = most / max(spread, 1e-12)
        lost = 2 * a * np.exp(-a * a / 2) / np.sqrt(2 * np.pi) / (2 * ndtr(a) - 1) if a else 0.0
        spread = float(np.sqrt(np.mean(kept**2) / (1 - lost))) if len(kept) else 0.0
    dark = float(np.quantile(ratio, min(1.0, 4 / ratio.size)))
    floor = max(_DARK * spread, 1e-6)
    if 1 - dark < floor:
        raise ValueError(
            f"an image shows water, {_DARK:g} standard deviations or more darker than land; the "
            f"darkest pixels of this one are {(1 - dark) / max(spread, 1e-9):.1f} darker"
        )
    q = dark
    for _ in range(_ROUNDS):
        water = ratio < (1 + q) / 2
        for depth in range(int(np.ceil(0.5 + 3.5 * blur)), 0, -1):
            inner = binary_erosion(water, iterations=depth)
            if inner.sum() >= _DEEP:
                break
        else:
            inner = water
        before, q = q, float(np.median(ratio[inner]))
        if before == q:
            break
    if 1 - q < floor:
        raise ValueError(
            f"an image shows water, {_DARK:g} standard deviations or more darker than land; what "
            f"is dark in this one is {(1 - q) / max(spread, 1e-9):.1f} darker"
        )
    noise = spread / (1 - q)
    cloud = ratio > 1 + max(_BRIGHT * spread, _BRIGHTER * (1 - q))
    marks, n = label(cloud, np.ones((3, 3)))
    large = np.bincount(marks.ravel(), minlength=n + 1) >= _SPECK
    large[0] = False
    return (1 - ratio) / (1 - q), noise, large[marks]


def _land(image: FloatArray, step: float) -> FloatArray:
    """Brightness of land: a plane through what is neither darker nor brighter than most."""
    y, x = (np.linspace(-1, 1, n) for n in image.shape)
    planes = np.stack([np.ones(image.size), np.tile(x, len(y)), np.repeat(y, len(x))], axis=1)
    values = image.ravel()
    fit = np.full(values.shape, np.median(values))
    for _ in range(_ROUNDS):
        off = np.abs(values - fit)
        most = _TRIM * 1.4826 * float(np.median(off)) + _STEPS_OF_CODES * step
        keep = off <= max(most, 1e-9 * float(np.abs(fit).max()))
        part = planes[keep]
        after = planes @ np.linalg.lstsq(part.T @ part, part.T @ values[keep], rcond=None)[0]
        done = np.abs(after - fit).max() <= 1e-12 * np.abs(after).max()
        fit = after
        if done:
            break
    return np.asarray(fit.reshape(image.shape))


def _contours(f: FloatArray) -> list[FloatArray]:
    """Rings of f = 1/2, closed along the frame; positive around water, negative around islands."""
    y, x = (np.concatenate([[-0.5], np.arange(n), [n - 0.5]]) for n in f.shape)
    generator = contour_generator(x, y, np.pad(f, 1, mode="edge"), fill_type=FillType.OuterOffset)
    rings = []
    for points, offsets in zip(*generator.filled(0.5, np.inf), strict=True):
        for k, (first, last) in enumerate(pairwise(offsets)):
            ring = np.asarray(points[first : last - 1], np.float64)
            ring = ring[np.abs(ring - np.roll(ring, 1, axis=0)).max(axis=1) > 0]
            if len(ring) >= 3:
                rings.append(ring if (_area(ring) > 0) == (k == 0) else ring[::-1])
    return rings


def _nearby(rings: list[FloatArray], f: FloatArray, hidden: Mask, reach: float) -> _Nearby:
    """Pixels within reach of a ring that are not hidden."""
    rows, columns = np.nonzero(_dilated(_border(f), reach) & ~hidden)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    found = [distances(pixels, ring) for ring in rings]
    apart = np.stack([n.distance for n in found])
    ring = apart.argmin(axis=0)
    k = np.arange(len(ring))
    segment = np.stack([n.segment for n in found])[ring, k]
    parameter = np.stack([n.parameter for n in found])[ring, k]
    seen = apart[ring, k] < reach
    return _Nearby(rows[seen], columns[seen], ring[seen], segment[seen], parameter[seen])


def _fitted(
    rings: list[FloatArray], coasts: list[Mask], f: FloatArray, near: _Nearby, blur: float
) -> list[FloatArray]:
    """Move rings until their coverage is f; one that would cross itself stays as it was."""
    height, width = f.shape
    moved = rings
    for _ in range(_STEPS):
        covered = ring_coverage(moved, width, height, blur)
        excess = (f - covered)[near.row, near.column]
        after = []
        for k, (ring, coast) in enumerate(zip(moved, coasts, strict=True)):
            own, count = near.ring == k, len(ring)
            i, t = near.segment[own], near.parameter[own]
            share = np.bincount(i, excess[own] * (1 - t), count).astype(np.float64)
            share += np.roll(np.bincount(i, excess[own] * t, count), 1)
            length = np.hypot(*(np.roll(ring, -1, axis=0) - ring).T)
            length = (length + np.roll(length, 1)) / 2
            step = _smooth(share) / np.maximum(_smooth(length), 1e-6) * coast
            along = np.roll(ring, -1, axis=0) - np.roll(ring, 1, axis=0)
            long = np.maximum(np.hypot(*along.T), 1e-9)
            outward = np.stack([along[:, 1], -along[:, 0]], axis=1) / long[:, None]
            after.append(ring + outward * np.clip(step, -_STRIDE, _STRIDE)[:, None])
        moved = after
    return [
        new if shapely.is_valid(shapely.Polygon(new)) else old
        for new, old in zip(moved, rings, strict=True)
    ]


def _smooth(values: FloatArray) -> FloatArray:
    shifts = range(-(len(_KERNEL) // 2), len(_KERNEL) // 2 + 1)
    parts = [w * np.roll(values, s) for w, s in zip(_KERNEL, shifts, strict=True)]
    return np.asarray(np.sum(parts, axis=0))


def _vertex_noise(ring: FloatArray, noise: float, blur: float) -> float:
    """Of a vertex across the coast [px]: of the contour's two pixels, and of those that move it."""
    # a straight coast's coverage, by the point spread, a pixel's square and interpolation
    slope = 1 / np.sqrt(2 * np.pi * (blur**2 + 1 / 6))
    contour = np.sqrt(2 / 3) / slope
    length = float(np.hypot(*(np.roll(ring, -1, axis=0) - ring).T).mean())
    shared = length * _KERNEL.sum() ** 2 / (_KERNEL**2).sum()
    return float(np.hypot(noise * np.sqrt(contour**2 + 2 * _reach(blur) / shared), _ROUNDED))


def _reach(blur: float) -> float:
    """How far from a coast pixels are fitted [px]."""
    return 1.5 + 2 * blur


def _coast(ring: FloatArray, hidden: Mask) -> Mask:
    """Vertices that are neither hidden nor on the frame."""
    height, width = hidden.shape
    x, y = ring.T
    inside = (x > -0.5 + _SIDES) & (x < width - 0.5 - _SIDES)
    inside &= (y > -0.5 + _SIDES) & (y < height - 0.5 - _SIDES)
    column, row = (
        np.clip(np.rint(a).astype(np.intp), 0, n - 1) for a, n in ((x, width), (y, height))
    )
    return np.asarray(inside & ~hidden[row, column])


def _border(f: FloatArray) -> Mask:
    """Pixels next to the contour f = 1/2."""
    water = f >= 0.5
    return np.asarray(binary_dilation(water) & ~binary_erosion(water, border_value=1))


def _dilated(mask: Mask, radius: float) -> Mask:
    """What is within a radius [px] of a mask."""
    if not mask.any() or radius <= 0:
        return mask
    n = int(np.ceil(radius))
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    return np.asarray(binary_dilation(mask, x * x + y * y <= radius * radius))


def _area(ring: FloatArray) -> float:
    """Area [px^2], positive from x to y."""
    x, y = (ring - ring[0]).T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)
