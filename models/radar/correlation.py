r"""Where one amplitude image lies on another, how much that stands out, and how well it is held.

Amplitude itself is correlated, each less its own local mean and relative to it: bright points are
what two passes share, and the logarithm of amplitude gives them no more weight than speckle. What
is more than `_BRIGHTEST` times its surroundings counts as that.

The peak of the correlation surface :math:`S`, refined by a parabola in two dimensions, is the
shift; its height over the rms of the surface says whether it could be chance (the largest of some
thousand independent values is 4 to 5, a right one is 7 and more). Where the peak lies is uncertain
by the slope that chance gives the surface, over the peak's curvature :math:`H`,

.. math:: P = H^{-1} \operatorname{cov}(\nabla S)\, H^{-1},

with the covariance of slopes taken from the surface away from the peak. (Leaving out one block of
the image at a time, a jackknife, claims the same over texture; where one bright point holds the
image, the peak without it lies anywhere, and the claims scatter by a factor of three.)

A peak that stands out may still be wrong: the brightest point of one image on the brightest of
another is 20 times the rms. What tells is how many parts of the image hold the peak: with
:math:`s_i` what each of 16 contributes, :math:`(\sum s_i)^2 / \sum s_i^2`. Right matches have 3 to
15, mirrored references 1 to 2.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.models.core.arrays import FloatArray, Single

_BROAD = 24.0
"""Standard deviation of the local mean that is divided out [pixels]."""
_BRIGHTEST = 8.0
"""Contrast that counts, at most: else the brightest point outweighs all others together."""
_PEAK = 8
"""Pixels about the peak that belong to it."""
_FEWEST = 64
"""Pixels away from the peak, at least."""
_BLOCKS = 4
"""Parts of the image along each axis."""
_TINY = 1e-30


@dataclass(frozen=True)
class Shift:
    """Where an image lies on another.

    Parameters
    ----------
    pixels : ndarray, shape (2,)
        Rows and columns by which what the image shows lies farther than on the other.
    covariance : ndarray, shape (2, 2)
        Of the shift [pixels^2]; infinite where the peak is not inside.
    quality : float
        Height of the peak over the rms of the correlation surface.
    inside : bool
        Whether the peak is not on the border of what was searched.
    parts : float
        How many of 16 parts of the image hold the peak.
    """

    pixels: FloatArray
    covariance: FloatArray
    quality: float
    inside: bool
    parts: float


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
    found = seen * np.minimum(amplitude / np.maximum(safe, 1e-30) - 1, _BRIGHTEST)
    return np.asarray(cv2.GaussianBlur(found, (0, 0), fine) if fine else found, np.float32)


def shift_between(image: Single, other: Single, reach: tuple[int, int]) -> Shift:
    """Shift of an image on another, from the contrast of both.

    Parameters
    ----------
    image : ndarray of float32, shape (n_rows, n_columns)
        Contrast.
    other : ndarray of float32, shape (n_rows + 2 * reach[0], n_columns + 2 * reach[1])
        Contrast about where the image is expected: unshifted, the image lies in its middle.
    reach : tuple of int
        Largest shift looked for, in rows and columns [pixels].

    Raises
    ------
    ValueError
        If shapes do not fit.
    """
    wanted = tuple(n + 2 * k for n, k in zip(image.shape, reach, strict=True))
    if other.shape != wanted:
        raise ValueError(f"an image {image.shape} is sought on {wanted} pixels, got {other.shape}")
    # element (i, j) is the correlation with what lies i - reach[0] rows farther on the other
    found = cv2.matchTemplate(other, image - image.mean(), cv2.TM_CCORR)
    surface = np.asarray(found, np.float64)
    row, column = (int(k) for k in np.unravel_index(surface.argmax(), surface.shape))
    quality = float((surface[row, column] - surface.mean()) / max(surface.std(), _TINY))
    peak = np.array([row, column], np.float64)
    middle = np.array(reach, np.float64)
    parts = _parts(image - image.mean(), other[row:, column:])
    inside = 0 < row < surface.shape[0] - 1 and 0 < column < surface.shape[1] - 1
    if not inside:
        return Shift(middle - peak, np.full((2, 2), np.inf), quality, False, parts)
    slope, curvature = _parabola(surface[row - 1 : row + 2, column - 1 : column + 2])
    if not np.all(np.linalg.eigvalsh(curvature) < 0):
        return Shift(middle - peak, np.full((2, 2), np.inf), quality, False, parts)
    inverse = np.linalg.inv(curvature)
    peak -= np.clip(inverse @ slope, -1, 1)
    slopes = np.stack([np.gradient(surface, axis=axis) for axis in (0, 1)], axis=-1)
    away = np.ones(surface.shape, np.bool_)
    away[max(row - _PEAK, 0) : row + _PEAK + 1, max(column - _PEAK, 0) : column + _PEAK + 1] = False
    if away.sum() < _FEWEST:
        raise ValueError(f"a search of {reach} pixels is no wider than a peak")
    covariance = inverse @ np.cov(slopes[away].T) @ inverse
    return Shift(middle - peak, covariance, quality, True, parts)


def _parts(image: Single, other: Single) -> float:
    """How many parts of an image hold its correlation with the first pixels of another."""
    product = image * other[: image.shape[0], : image.shape[1]]
    held = np.array(
        [
            part.sum(dtype=np.float64)
            for band in np.array_split(product, _BLOCKS, axis=0)
            for part in np.array_split(band, _BLOCKS, axis=1)
        ]
    )
    return float(held.sum() ** 2 / max(np.sum(held**2), _TINY))


_OFFSETS = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), -1).reshape(
    9, 2
)
_Y, _X = _OFFSETS.T
_FIT = np.linalg.pinv(np.stack([np.ones(9), _Y, _X, _Y * _Y, _X * _X, _Y * _X], axis=1))


def _parabola(around: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slope (2,) and curvature (2, 2) of the parabola through 3 x 3 pixels, in their middle."""
    _, gy, gx, cy, cx, cxy = _FIT @ around.ravel()
    return np.array([gy, gx]), np.array([[2 * cy, cxy], [cxy, 2 * cx]])
