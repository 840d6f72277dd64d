r"""Detected images: amplitudes averaged in power over neighboring pixels against speckle.

Pixel :math:`k` of an image of :math:`n` looks covers the original pixels :math:`n k` to
:math:`n k + n - 1` after its start, and is centered at :math:`n k + (n - 1)/2`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single


def detected(image: ComplexArray, looks: tuple[int, int]) -> Single:
    """Amplitude (n_lines // looks[0], n_cells // looks[1]) of a complex image.

    Parameters
    ----------
    image : ndarray of complex64, shape (n_lines, n_cells)
    looks : tuple of int
        Pixels averaged along each axis; what does not fill a pixel is left out.

    Raises
    ------
    ValueError
        If a number of looks is not positive, or the image is smaller than a pixel.
    """
    if min(looks) < 1:
        raise ValueError(f"{looks} looks: there must be one at least along each axis")
    shape = tuple(n // k for n, k in zip(image.shape, looks, strict=True))
    if min(shape) < 1:
        raise ValueError(f"an image of {image.shape} pixels has no pixel of {looks} looks")
    part = image[: shape[0] * looks[0], : shape[1] * looks[1]]
    power = part.real**2 + part.imag**2
    power = power.reshape(shape[0], looks[0], shape[1], looks[1]).mean(axis=(1, 3))
    return np.asarray(np.sqrt(power), np.float32)


def full_index(pixel: ArrayLike, n: int) -> FloatArray:
    """Index among the original pixels, fractional, of a pixel of `n` looks."""
    return np.asarray(n * np.asarray(pixel, np.float64) + (n - 1) / 2)


def multilook_index(original: ArrayLike, n: int) -> FloatArray:
    """Index, fractional, of an original pixel among those of `n` looks."""
    return np.asarray((np.asarray(original, np.float64) - (n - 1) / 2) / n)
