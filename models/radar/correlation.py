r"""Where one amplitude image lies on another, how much that stands out, and how well it is held.

Amplitude itself is correlated, each less its own local mean and relative to it: bright points are
what two passes share, and the logarithm of amplitude gives them no more weight than speckle.

The surface of correlation is the sum of the surfaces of the image's blocks. Its peak, refined by a
parabola in two dimensions, is the shift; its height over the rms of the surface says whether the
peak could be chance (the largest of some thousand independent values is 4 to 5, a right one is 7
and more); and peaks of the sums that leave out one block at a time (jackknife) give its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from terrafix.models.core.arrays import FloatArray, Single

_BROAD = 24.0
"""Standard deviation of the local mean that is divided out [pixels]."""
_NEIGHBORS = 2
"""How far from the peak of all blocks that of all but one may lie [pixels]."""


@dataclass(frozen=True)
class Shift:
    """Where an image lies on another.

    Parameters
    ----------
    pixels : ndarray, shape (2,)
        Rows and columns by which what the image shows lies farther than on the other.
    covariance : ndarray, shape (2, 2)
        Of the shift that its blocks agree on (jackknife) [pixels^2].
    quality : float
        Height of the peak over the rms of the correlation surface.
    inside : bool
        Whether the peak is not on the border of what was searched.
    """

    pixels: FloatArray
    covariance: FloatArray
    quality: float
    inside: bool


def contrast(amplitude: Single, broad: float = _BROAD, fine: float = 0.0) -> Single:
    """Amplitude relative to its local mean, less one; zero where nothing is seen.

    Parameters
    ----------
    amplitude : ndarray of float32, shape (n_rows, n_columns)
        Zero where nothing is known.
    broad : float
        Standard deviation of the local mean [pixels].
    fine : float
        Of a smoothing, for where pixels are as large as what they show: their peaks would be
        sharper than a parabola between them [pixels].
    """
    seen = (amplitude > 0).astype(np.float32)
    mean, share = (cv2.GaussianBlur(a, (0, 0), broad) for a in (amplitude, seen))
    safe = np.where(seen > 0, mean / np.maximum(share, 1e-6), 1.0)
    found = seen * (amplitude / np.maximum(safe, 1e-30) - 1)
    return np.asarray(cv2.GaussianBlur(found, (0, 0), fine) if fine else found, np.float32)


def shift_between(
    image: Single, other: Single, reach: tuple[int, int], blocks: tuple[int, int] = (4, 4)
) -> Shift:
    """Shift of an image on another, from the contrast of both.

    Parameters
    ----------
    image : ndarray of float32, shape (n_rows, n_columns)
        Contrast.
    other : ndarray of float32, shape (n_rows + 2 * reach[0], n_columns + 2 * reach[1])
        Contrast about where the image is expected: unshifted, the image lies in its middle.
    reach : tuple of int
        Largest shift looked for, in rows and columns [pixels].
    blocks : tuple of int
        Parts of the image along each axis, left out in turn.

    Raises
    ------
    ValueError
        If shapes do not fit, or the image is smaller than its blocks.
    """
    wanted = tuple(n + 2 * k for n, k in zip(image.shape, reach, strict=True))
    if other.shape != wanted:
        raise ValueError(f"an image {image.shape} is sought on {wanted} pixels, got {other.shape}")
    if any(n < 4 * k for n, k in zip(image.shape, blocks, strict=True)):
        raise ValueError(f"an image of {image.shape} pixels is too small for {blocks} blocks")
    surfaces = np.array([_surface(image, other, reach, part) for part in _parts(image, blocks)])
    total = surfaces.sum(axis=0)
    top = tuple(int(k) for k in np.unravel_index(total.argmax(), total.shape))
    inside = all(0 < k < n - 1 for k, n in zip(top, total.shape, strict=True))
    n = len(surfaces)
    found = _refined(total, top)
    without = np.array([_refined(total - s, _near(total - s, top)) for s in surfaces])
    spread = without - without.mean(axis=0)
    return Shift(
        np.array(reach, np.float64) - found,
        (n - 1) / n * spread.T @ spread,
        float((total[top] - total.mean()) / total.std()),
        inside,
    )


def _parts(image: Single, blocks: tuple[int, int]) -> list[tuple[slice, slice]]:
    edges = [np.linspace(0, n, k + 1).astype(int) for n, k in zip(image.shape, blocks, strict=True)]
    rows, columns = ([slice(a, b) for a, b in pairwise(e)] for e in edges)
    return [(i, j) for i in rows for j in columns]


def _surface(
    image: Single, other: Single, reach: tuple[int, int], part: tuple[slice, slice]
) -> FloatArray:
    """Correlation of one block at every shift; element (i, j) lies i - reach rows farther."""
    block = np.ascontiguousarray(image[part])
    where = tuple(slice(p.start, p.stop + 2 * k) for p, k in zip(part, reach, strict=True))
    template = block - block.mean()
    found = cv2.matchTemplate(np.ascontiguousarray(other[where]), template, cv2.TM_CCORR)
    return np.asarray(found, np.float64)


def _near(surface: FloatArray, top: tuple[int, ...]) -> tuple[int, ...]:
    """Peak next to a place."""
    start = [max(k - _NEIGHBORS, 0) for k in top]
    part = surface[tuple(slice(a, k + _NEIGHBORS + 1) for a, k in zip(start, top, strict=True))]
    best = np.unravel_index(part.argmax(), part.shape)
    return tuple(int(a + k) for a, k in zip(start, best, strict=True))


_OFFSETS = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), -1).reshape(
    9, 2
)
_Y, _X = _OFFSETS.T
_FIT = np.linalg.pinv(np.stack([np.ones(9), _Y, _X, _Y * _Y, _X * _X, _Y * _X], axis=1))


def _refined(surface: FloatArray, top: tuple[int, ...]) -> FloatArray:
    """Row and column (2,) of the peak of the parabola through the pixels about a peak."""
    peak = np.array(top, np.float64)
    if not all(0 < k < n - 1 for k, n in zip(top, surface.shape, strict=True)):
        return peak
    around = surface[top[0] - 1 : top[0] + 2, top[1] - 1 : top[1] + 2].ravel()
    _, gy, gx, cy, cx, cxy = _FIT @ around
    curvature = np.array([[2 * cy, cxy], [cxy, 2 * cx]])
    if not np.all(np.linalg.eigvalsh(curvature) < 0):
        return peak
    return np.asarray(peak + np.clip(-np.linalg.solve(curvature, [gy, gx]), -1, 1))
