r"""What a range-Doppler processor does to rows of complex numbers: it turns and resamples them.

Beside transforms this is what imaging costs. It is compiled from ``spectra.c`` by whoever can
(`terrafix.components.sensors.compiled`) and handed to the models, which know no compiler;
`ArrayRows` computes the same with arrays, five times slower.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.radar.chirp import unit_phasor

_TAPS, _BAND = 16, 0.43
"""Cells that interpolation weighs, and the band that it is made for, in cycles per cell. Its error
is 0.3 % rms up to 0.4 cycles per cell, and 4.4 % over 0.466, the band of RADARSAT-1's pulses."""
_FINE = 1024
"""Places between two cells that kernels are tabulated at."""
_BLOCK_SHIFT = 0.01
"""Largest error of position inside a block of interpolation with arrays, in cells."""
_FLOOR = 1e-9
"""Of the solved equations, of the white part of what is interpolated."""


@cache
def kernels() -> Single:
    r"""Interpolation kernels (_FINE + 1, _TAPS) of least squares over a band.

    Row k weighs cells :math:`m`, ``1 - _TAPS / 2`` to ``_TAPS / 2``, about a place x = k / _FINE:
    where the band is white up to :math:`\pm b`, the error is least with

    .. math:: \sum_n 2b \operatorname{sinc}(2b (m - n))\, w_n = 2b \operatorname{sinc}(2b (m - x)).
    """
    m = np.arange(1 - _TAPS // 2, _TAPS // 2 + 1)
    alike = 2 * _BAND * np.sinc(2 * _BAND * (m[:, None] - m)) + _FLOOR * np.eye(_TAPS)
    place = np.arange(_FINE + 1) / _FINE
    weights = np.linalg.solve(alike, 2 * _BAND * np.sinc(2 * _BAND * (m[:, None] - place)))
    return np.ascontiguousarray(weights.T, np.float32)


@cache
def _pairs() -> Single:
    """Every weight twice: for real and for imaginary parts."""
    return np.repeat(kernels(), 2, axis=1)


@dataclass(frozen=True)
class Columns:
    """What rows are straightened by that is the same for all of them, see `Rows.straighten`.

    Parameters
    ----------
    factor : ndarray of complex64, shape (n_columns,)
    squared, rest : ndarray, shape (n_columns,)
    scale : float
        In cycles per unit of the root.
    """

    factor: ComplexArray
    squared: FloatArray
    rest: FloatArray
    scale: float


class Rows(Protocol):
    """Operations on rows, complex64 (n_rows, n_columns); what is said of i and j is of them."""

    def straighten(
        self, rows: ComplexArray, along: Columns, transverse: FloatArray, subtracted: FloatArray
    ) -> None:
        """Multiply by ``factor[j]`` and turn by a root's phase, in place.

        By ``scale * (sqrt(squared[j] - transverse[i]) - subtracted[i] - rest[j])`` cycles.
        """

    def turn(
        self,
        rows: ComplexArray,
        steep: FloatArray,
        along: FloatArray,
        constant: FloatArray,
        weights: Single,
    ) -> None:
        """Turn by ``steep[i] * along[j] + constant[i]`` cycles and weigh by ``weights[i]``."""

    def turn_by(self, rows: ComplexArray, cycles: FloatArray) -> None:
        """Turn by ``cycles[i, j]``, in place."""

    def stretched(self, rows: ComplexArray, origin: float, stretch: FloatArray) -> ComplexArray:
        """Resample at ``j + stretch[i] * (j - origin)`` by weights of 16 cells.

        Rows are zero beyond their ends.
        """


class ArrayRows:
    """The operations with NumPy."""

    def straighten(
        self, rows: ComplexArray, along: Columns, transverse: FloatArray, subtracted: FloatArray
    ) -> None:
        """Multiply by a factor of columns and turn by a root's phase, in place."""
        root = along.squared - transverse[:, None]
        np.sqrt(root, out=root)
        root -= subtracted[:, None]
        root -= along.rest
        root *= along.scale
        rows *= along.factor
        rows *= unit_phasor(root)

    def turn(
        self,
        rows: ComplexArray,
        steep: FloatArray,
        along: FloatArray,
        constant: FloatArray,
        weights: Single,
    ) -> None:
        """Turn by a phase that grows along the columns, and weigh rows: in place."""
        cycles = np.outer(steep, along)
        cycles += constant[:, None]
        rows *= unit_phasor(cycles)
        rows *= weights[:, None]

    def turn_by(self, rows: ComplexArray, cycles: FloatArray) -> None:
        """Turn by cycles, in place."""
        rows *= unit_phasor(cycles)

    def stretched(self, rows: ComplexArray, origin: float, stretch: FloatArray) -> ComplexArray:
        """Resample, with shifts that are constant over blocks of columns.

        The shift is proportional to the distance from `origin`, hence nearly constant in a block;
        sums of shifted blocks then need no gathering.
        """
        n_rows, n = rows.shape
        steepest = float(np.abs(stretch).max())
        width = n if steepest == 0 else min(n, max(1, int(2 * _BLOCK_SHIFT / steepest)))
        starts = np.arange(0, n, width)
        stops = np.minimum(starts + width, n)
        shift = stretch * ((starts + stops - 1) / 2 - origin)[:, None]
        whole = np.floor(shift).astype(np.intp)
        weights = kernels()[np.rint((shift - whole) * _FINE).astype(np.intp)]
        first = whole.min(axis=1)
        reach = int(np.abs(whole).max()) + _TAPS
        padded = np.zeros((n_rows, n + 2 * reach), np.complex64)
        padded[:, reach : reach + n] = rows
        out = np.zeros((n_rows, n), np.complex64)
        # weights are real: real and imaginary parts are columns of their own
        source, sink = padded.view(np.float32), out.view(np.float32)
        product = np.empty((n_rows, 2 * width), np.float32)
        for k, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            part, term = sink[:, 2 * start : 2 * stop], product[:, : 2 * (stop - start)]
            late = whole[k] - first[k]
            taps = np.zeros((n_rows, _TAPS + int(late.max())), np.float32)
            np.put_along_axis(taps, late[:, None] + np.arange(_TAPS), weights[k], axis=1)
            begin = reach + int(first[k]) + 1 - _TAPS // 2
            for tap in range(taps.shape[1]):
                moved = slice(2 * (start + begin + tap), 2 * (stop + begin + tap))
                np.multiply(source[:, moved], taps[:, tap, None], out=term)
                part += term
        return out


ARRAY_ROWS = ArrayRows()


def c_source() -> str:
    """C of the compiled operations; whoever compiles it defines ``TERRAFIX_KEY``, a string."""
    own = Path(__file__).with_name("spectra.c")
    return own.with_name("turn.c").read_text() + own.read_text()


class CompiledRows:
    """The operations, compiled.

    Parameters
    ----------
    library : ctypes.CDLL
        Made of `c_source`.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        pointer, count, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
        self._straighten: Any = library["terrafix_straighten"]
        self._straighten.argtypes = [count, count, *[pointer] * 4, real, pointer, pointer]
        self._turn: Any = library["terrafix_turn"]
        self._turn.argtypes = [count, count, *[pointer] * 5]
        self._turn_by: Any = library["terrafix_turn_by"]
        self._turn_by.argtypes = [count, count, pointer, pointer]
        self._stretch: Any = library["terrafix_stretch"]
        self._stretch.argtypes = [
            *(count, count, count, pointer, real),
            *(pointer, count, pointer, pointer),
        ]
        for function in (self._straighten, self._turn, self._turn_by, self._stretch):
            function.restype = None

    def straighten(
        self, rows: ComplexArray, along: Columns, transverse: FloatArray, subtracted: FloatArray
    ) -> None:
        """Multiply by a factor of columns and turn by a root's phase, in place."""
        n, m = _contiguous(rows)
        arrays = [_of(along.squared, m), _of(along.rest, m), _of(transverse, n), _of(subtracted, n)]
        factor = _of(along.factor, m, np.complex64)
        self._straighten(
            *(n, m, *(a.ctypes.data for a in arrays)),
            *(along.scale, factor.ctypes.data, rows.ctypes.data),
        )

    def turn(
        self,
        rows: ComplexArray,
        steep: FloatArray,
        along: FloatArray,
        constant: FloatArray,
        weights: Single,
    ) -> None:
        """Turn by a phase that grows along the columns, and weigh rows: in place."""
        n, m = _contiguous(rows)
        arrays = [_of(steep, n), _of(along, m), _of(constant, n), _of(weights, n, np.float32)]
        self._turn(n, m, *(a.ctypes.data for a in arrays), rows.ctypes.data)

    def turn_by(self, rows: ComplexArray, cycles: FloatArray) -> None:
        """Turn by cycles, in place."""
        n, m = _contiguous(rows)
        if cycles.shape != (n, m):
            raise ValueError(f"cycles of shape {cycles.shape} for rows of shape {rows.shape}")
        cycles = np.ascontiguousarray(cycles, np.float64)
        self._turn_by(n, m, cycles.ctypes.data, rows.ctypes.data)

    def stretched(self, rows: ComplexArray, origin: float, stretch: FloatArray) -> ComplexArray:
        """Resample."""
        n, m = rows.shape
        if rows.strides[1] != rows.itemsize:
            rows = np.ascontiguousarray(rows)
        out, stretch, pairs = np.empty((n, m), np.complex64), _of(stretch, n), _pairs()
        self._stretch(
            *(n, m, rows.strides[0] // rows.itemsize, rows.ctypes.data, origin),
            *(stretch.ctypes.data, _FINE, pairs.ctypes.data, out.ctypes.data),
        )
        return out


def _contiguous(rows: ComplexArray) -> tuple[int, int]:
    if rows.dtype != np.complex64 or rows.ndim != 2 or not rows.flags.c_contiguous:
        raise ValueError(f"rows are {rows.dtype} of shape {rows.shape}, not complex64 and whole")
    return rows.shape[0], rows.shape[1]


def _of(array: NDArray[Any], n: int, kind: Any = np.float64) -> NDArray[Any]:
    """As the compiled operations read it; ValueError if it is not one for each row or column."""
    if array.shape != (n,):
        raise ValueError(f"there are {n}, and an array of shape {array.shape} for them")
    return np.ascontiguousarray(array, kind)
