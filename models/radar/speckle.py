r"""Speckle and thermal noise: complex normal numbers from random bits, one for every pixel.

Of 64 random bits, uniform numbers :math:`u \in (0, 1)` and :math:`w \in [-1/2, 1/2)` are made, and
of these

.. math:: z = \sqrt{-\ln u}\; e^{2\pi j w},

which is normal in both parts and of unit power [1]_. It is compiled from ``speckle.c`` by whoever
can (`terrafix.components.sensors.compiled`) and handed to the models, which know no compiler;
`ArraySpeckle` computes the same with arrays, some times slower.

References
----------
.. [1] G. E. P. Box, M. E. Muller, "A note on the generation of random normal deviates", Annals of
       Mathematical Statistics 29, 1958.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray
from terrafix.models.core.parallel import batches, over
from terrafix.models.radar.footprint import COARSE, TerrainGrid

Bits = NDArray[np.uint64]

_ROWS = 64
"""Rows that a thread draws at a time, from a stream of random numbers of their own."""
_BLOCK = 64
"""Cells that are looked up at a time, as in speckle.c."""


class Speckle(Protocol):
    """Who makes scatterers and noise of random bits, one number for a pixel."""

    def scatter(
        self,
        terrain: TerrainGrid,
        first: tuple[int, int],
        bits: Bits,
        heights: tuple[float, float],
        low: ComplexArray,
        high: ComplexArray | None,
    ) -> None:
        """Write the scatterers from a first line and cell on, (n, m), in two layers.

        The first cell is one at which terrain is looked up, a multiple of four.
        They are shared in the proportion in which the terrain lies between the layers' heights
        [m]; without an upper layer, all of them are in the lower one.
        """

    def add_noise(self, rows: ComplexArray, bits: Bits, sigma: float) -> None:
        """Add noise of a standard deviation `sigma` in each of both parts to rows."""


class ArraySpeckle:
    """With NumPy."""

    def scatter(
        self,
        terrain: TerrainGrid,
        first: tuple[int, int],
        bits: Bits,
        heights: tuple[float, float],
        low: ComplexArray,
        high: ComplexArray | None,
    ) -> None:
        """Write the scatterers of a part of the grid, in two layers."""
        n_lines, n_cells = bits.shape
        columns = slice(first[1], first[1] + n_cells)
        amplitude, share = terrain.pixels(first[0], first[0] + n_lines, columns)
        np.multiply(_normal(bits), amplitude, out=low)
        if high is None:
            return
        share -= np.float32(heights[0])
        share *= np.float32(1 / (heights[1] - heights[0]))
        np.multiply(share, low, out=high)
        low -= high

    def add_noise(self, rows: ComplexArray, bits: Bits, sigma: float) -> None:
        """Add noise to rows."""
        noise = _normal(bits)
        noise *= np.float32(np.sqrt(2) * sigma)
        rows += noise


def _normal(bits: Bits) -> ComplexArray:
    """Complex numbers of unit power, from the upper and the lower half of 64 bits each."""
    share = (bits >> np.uint64(40)).astype(np.float32)
    share += np.float32(0.5)
    share *= np.float32(2.0**-24)
    size = np.sqrt(-np.log(share))
    angle = bits.astype(np.uint32).view(np.int32).astype(np.float32)
    angle *= np.float32(np.pi * 2.0**-31)
    out = np.empty(bits.shape, np.complex64)
    np.multiply(size, np.cos(angle), out=out.real)
    np.multiply(size, np.sin(angle), out=out.imag)
    return out


ARRAY_SPECKLE = ArraySpeckle()


def c_source() -> str:
    """C of the compiled operations; whoever compiles it defines ``TERRAFIX_KEY``, a string."""
    own = Path(__file__).with_name("speckle.c")
    return own.with_name("turn.c").read_text() + own.read_text()


class CompiledSpeckle:
    """Compiled.

    Parameters
    ----------
    library : ctypes.CDLL
        Made of `c_source`.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        pointer, count, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_float
        self._scatter: Any = library["terrafix_scatter"]
        self._scatter.argtypes = [
            *[count] * 7,
            *(pointer, count, count, count, pointer, real, real),
            *[pointer] * 4,
        ]
        self._noise: Any = library["terrafix_noise"]
        self._noise.argtypes = [count, pointer, real, pointer]
        for function in (self._scatter, self._noise):
            function.restype = None

    def scatter(
        self,
        terrain: TerrainGrid,
        first: tuple[int, int],
        bits: Bits,
        heights: tuple[float, float],
        low: ComplexArray,
        high: ComplexArray | None,
    ) -> None:
        """Write the scatterers of a part of the grid, in two layers."""
        if terrain.folded:
            ARRAY_SPECKLE.scatter(terrain, first, bits, heights, low, high)
            return
        n_lines, n_cells = bits.shape
        _require_whole(bits, low, *([] if high is None else [high]))
        coarse, texture = terrain.coarse, terrain.texture
        if texture.strides[1] != texture.itemsize:
            texture = np.ascontiguousarray(texture)
        n_i, n_j = coarse.shape[1:]
        last = first[0] + n_lines - 1, first[1] + n_cells - 1
        covered = COARSE[0] * (n_i - 1), COARSE[1] * (n_j - 1)
        if min(first) < 0 or first[1] % COARSE[1] or last[0] > covered[0] or last[1] > covered[1]:
            raise ValueError(f"lines and cells {first} to {last} are not of the terrain")
        between = np.empty((4, n_j + _BLOCK), np.float32)
        self._scatter(
            *(first[0], n_lines, first[1], n_cells, COARSE[0], n_i, n_j, coarse.ctypes.data),
            *(*texture.shape, texture.strides[0] // texture.itemsize, texture.ctypes.data),
            *(heights[0], 1 / (heights[1] - heights[0])),
            *(bits.ctypes.data, between.ctypes.data, low.ctypes.data),
            None if high is None else high.ctypes.data,
        )

    def add_noise(self, rows: ComplexArray, bits: Bits, sigma: float) -> None:
        """Add noise to rows."""
        _require_whole(bits, rows)
        self._noise(bits.size, bits.ctypes.data, sigma, rows.ctypes.data)


def _require_whole(bits: Bits, *rows: ComplexArray) -> None:
    arrays: list[tuple[NDArray[Any], type]] = [(bits, np.uint64)]
    arrays += [(own, np.complex64) for own in rows]
    for array, kind in arrays:
        if array.dtype != kind or array.shape != bits.shape or not array.flags.c_contiguous:
            raise ValueError(
                f"{array.dtype} of shape {array.shape} where whole rows of "
                f"{np.dtype(kind)} of shape {bits.shape} are needed"
            )


def add_noise(
    image: ComplexArray, sigma: float, rng: np.random.Generator, speckle: Speckle = ARRAY_SPECKLE
) -> None:
    """Add noise of a standard deviation in each of both parts, from a stream for each few rows."""

    def add(part: tuple[slice, np.random.Generator]) -> None:
        own, stream = part
        speckle.add_noise(image[own], random_bits(stream, image[own].shape), sigma)

    over(streams(rng, len(image)), add)


def scattered(
    terrain: TerrainGrid,
    heights: tuple[float, float],
    rng: np.random.Generator,
    speckle: Speckle = ARRAY_SPECKLE,
    n_layers: int = 2,
) -> list[ComplexArray]:
    """Fully developed speckle in layers: a complex normal scatterer on every pixel of a footprint.

    Parameters
    ----------
    terrain : TerrainGrid
    heights : tuple of float
        Of the lower and of the upper layer [m].
    rng : numpy.random.Generator
    speckle : Speckle
        Who makes it.
    n_layers : {2, 1}
        The two layers, or their sum.
    """
    shape = terrain.footprint.n_lines, terrain.footprint.n_cells
    layers = [np.empty(shape, np.complex64) for _ in range(n_layers)]

    def add(part: tuple[slice, np.random.Generator]) -> None:
        own, stream = part
        low, high = layers[0][own], layers[1][own] if n_layers == 2 else None
        speckle.scatter(terrain, (own.start, 0), random_bits(stream, low.shape), heights, low, high)

    over(streams(rng, shape[0]), add)
    return layers


def scattered_columns(
    terrain: TerrainGrid,
    columns: slice,
    heights: tuple[float, float],
    rng: np.random.Generator,
    speckle: Speckle = ARRAY_SPECKLE,
    n_layers: int = 2,
) -> list[ComplexArray]:
    """Speckle as of `scattered`, of some columns and of one stream."""
    shape = terrain.footprint.n_lines, columns.stop - columns.start
    layers = [np.empty(shape, np.complex64) for _ in range(n_layers)]
    for own in batches(shape[0], 8 * _ROWS):
        low, high = layers[0][own], layers[1][own] if n_layers == 2 else None
        bits = random_bits(rng, low.shape)
        speckle.scatter(terrain, (own.start, columns.start), bits, heights, low, high)
    return layers


def streams(rng: np.random.Generator, n_rows: int) -> list[tuple[slice, np.random.Generator]]:
    """Rows by a few, each with a stream of random numbers of its own."""
    rows = batches(n_rows, _ROWS)
    return list(zip(rows, rng.spawn(len(rows)), strict=True))


def random_bits(rng: np.random.Generator, shape: tuple[int, ...]) -> Bits:
    """64 random bits for every pixel."""
    return rng.integers(0, 2**64 - 1, shape, np.uint64, endpoint=True)
