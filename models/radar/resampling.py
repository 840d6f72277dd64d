"""Resampling of band-limited rows by shifts that grow with the column."""

from __future__ import annotations

import numpy as np

from terrafix.models.core.arrays import ComplexArray, FloatArray

_TAPS = 8
_BLOCK_SHIFT = 0.01
"""Largest error of position inside a block of interpolation, in cells."""


def stretched(
    rows: ComplexArray, offset: FloatArray, stretch: FloatArray, spacing: float
) -> ComplexArray:
    """Resample rows at ``offset * (1 + stretch)`` [m] by sinc, constant over blocks of columns.

    The shift is proportional to the distance from the reference range, hence nearly constant in a
    block; sums of shifted blocks then need no gathering. Rows fade out over the taps at the ends.
    """
    n = rows.shape[1]
    steepest = float(np.abs(stretch).max())
    width = n if steepest == 0 else max(_TAPS, int(2 * _BLOCK_SHIFT / steepest))
    reach = int(np.ceil(steepest * np.abs(offset).max() / spacing)) + _TAPS // 2
    taps = np.arange(-reach, reach + 1)
    padded = np.pad(rows, ((0, 0), (reach, reach)))
    out = np.zeros((rows.shape[0], n), np.complex64)
    for start in range(0, n, width):
        stop = min(start + width, n)
        shift = stretch * offset[start:stop].mean() / spacing
        x = taps - shift[:, None]
        inside = np.abs(x) < _TAPS / 2
        taper = np.i0(2.5 * np.sqrt(1 - np.minimum(1, (2 * x / _TAPS) ** 2)))
        kernel = np.sinc(x) * np.where(inside, taper, 0)
        kernel /= kernel.sum(axis=1, keepdims=True)
        kernel = kernel.astype(np.float32)
        for k in np.flatnonzero(inside.any(axis=0)):
            out[:, start:stop] += kernel[:, k, None] * padded[:, start + k : stop + k]
    return out
