r"""An artificial scene over a real terrain: what a radar would find at every place on Earth.

Brightness is backscatter at the local angle of incidence :math:`\theta`,

.. math:: \sigma_0(\theta) = \frac{0.0133 \cos\theta}{(\sin\theta + 0.1 \cos\theta)^3},

times a texture: parcels with sharp borders, a smooth variation and a fine one, in decibels. Bright
points (buildings, pylons) are strewn over it. Both are functions of (seed, place) alone, by
counter-based noise on a grid of 1e-4 deg: any two images of a place, from whatever side, show the
same texture and points, under speckle of their own.

References
----------
.. [1] D. O. Muhleman, "Radar scattering from Venus and the Moon", Astronomical Journal 69, 1964:
       the shape of the backscatter; its scale is set to one at 38.7 deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.core.parallel import batches, over
from terrafix.models.maps.dem import Dem

CELL = float(np.radians(1e-4))
"""Spacing of the texture in latitude and longitude [rad], some 11 m."""

_TURN = 3_600_000
"""Cells around the Earth."""
_MOST_CELLS = 32_000
"""Cells along a side of an image that is resampled: OpenCV counts them in 16 bits."""
_BLOCK = 512
_REFERENCE_INCIDENCE = np.radians(38.7)
_COARSE = 32
"""Cells between the samples of the parcels' and the smooth variation's noise."""
_PARCEL, _SMOOTH, _FINE = 1.0, 3.0, 1.0
"""Standard deviations of the smoothing: of the first two in coarse cells, of the last in cells."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Texture and bright points over a terrain.

    Parameters
    ----------
    dem : Dem
        Terrain.
    seed : int
        Of texture and points.
    parcels_db, smooth_db, fine_db : float
        Standard deviations of the three textures [dB].
    points_per_km2 : float
        Density of bright points.
    points_db : float
        Median brightness of a point, relative to the mean brightness of a resolution cell [dB];
        individual ones differ by 4 dB rms.
    detail : int
        How many times finer than `CELL` the texture is: 1 from orbit, 10 from an aircraft.
    """

    dem: Dem
    seed: int = 0
    parcels_db: float = 2.5
    smooth_db: float = 1.5
    fine_db: float = 1.5
    points_per_km2: float = 3.0
    points_db: float = 25.0
    detail: int = 1

    @property
    def cell(self) -> float:
        """Spacing of the texture in latitude and longitude [rad]."""
        return CELL / self.detail

    @property
    def _turn(self) -> int:
        """Cells around the Earth."""
        return _TURN * self.detail

    def __post_init__(self) -> None:
        for name in ("parcels_db", "smooth_db", "fine_db", "points_per_km2"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} of a scene cannot be {getattr(self, name)}")
        if self.detail < 1:
            raise ValueError(f"detail of a scene cannot be {self.detail}: 1 is the coarsest")

    def texture(self, rows: range, columns: range) -> Single:
        """Texture [dB] of cells, shape (len(rows), len(columns)).

        Cell (i, j) is centered at latitude i and longitude j times `cell`; a turn on is the same.

        Raises
        ------
        ValueError
            If there are too many cells for a side of an image, as next to a pole.
        """
        longest = max(len(rows), len(columns))
        if longest > _MOST_CELLS:
            raise ValueError(
                f"the scene about latitude {np.degrees(rows.start * self.cell):.2f} deg takes "
                f"{longest} cells of its texture along one side, {_MOST_CELLS} at most\n"
                "  its grid is one of latitude and longitude: fly farther from the pole, or "
                "receive fewer lines and cells"
            )
        parts = [self._texture(rows, part) for part, _ in _within_a_turn(columns, self._turn)]
        return parts[0] if len(parts) == 1 else np.hstack(parts)

    def _texture(self, rows: range, columns: range) -> Single:
        fine = _smoothed_noise(self.seed, "fine", rows, columns, _FINE)
        fine *= np.float32(self.fine_db)
        # whole coarse cells that cover the rectangle
        ci, cj = (range(r.start // _COARSE - 2, r.stop // _COARSE + 4) for r in (rows, columns))
        coarse = [
            (name, scale, _smoothed_noise(self.seed, name, ci, cj, sigma))
            for name, sigma, scale in (
                ("parcels a", _PARCEL, self.parcels_db / np.sqrt(2)),
                ("parcels b", _PARCEL, self.parcels_db / np.sqrt(2)),
                ("smooth", _SMOOTH, self.smooth_db),
            )
        ]

        def add(part: slice) -> None:
            own = range(rows.start + part.start, rows.start + part.stop)
            for name, scale, values in coarse:
                field = _enlarged(values, ci, cj, own, columns)
                if name == "smooth":
                    field *= np.float32(scale)
                else:
                    np.copysign(np.float32(scale), field, out=field)
                fine[part] += field

        over(batches(len(rows), 256), add)
        return fine

    def points(
        self, rows: range, columns: range
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Bright points in a rectangle of cells.

        Returns
        -------
        latitude, longitude : ndarray, shape (n,)
            [rad]
        amplitude : ndarray, shape (n,)
            Relative to the mean amplitude of a resolution cell [-].
        phase : ndarray, shape (n,)
            Of the reflection [cycles].
        """
        found = [
            self._points(rows, part, turn) for part, turn in _within_a_turn(columns, self._turn)
        ]
        latitude, longitude, amplitude, phase = np.hstack(found)
        return latitude, longitude, amplitude, phase

    def _points(self, rows: range, columns: range, turn: int) -> FloatArray:
        found = []
        for bi in range(rows.start // _BLOCK, -(-rows.stop // _BLOCK)):
            for bj in range(columns.start // _BLOCK, -(-columns.stop // _BLOCK)):
                rng = _generator(self.seed, "points", bi, bj)
                middle = (bi + 0.5) * _BLOCK * self.cell
                area = (_BLOCK * self.cell * 6371.0) ** 2 * np.cos(middle)
                n = rng.poisson(max(area, 0.0) * self.points_per_km2)
                place = rng.random((2, n)) * _BLOCK + np.array([[bi], [bj]]) * _BLOCK
                db = self.points_db + 4.0 * rng.standard_normal(n)
                found.append(np.vstack([place, 10 ** (db / 20), rng.random(n)]))
        i, j, amplitude, phase = np.hstack(found) if found else np.empty((4, 0))
        inside = (i >= rows.start) & (i < rows.stop) & (j >= columns.start) & (j < columns.stop)
        j = j + turn * self._turn
        return np.stack([i * self.cell, j * self.cell, amplitude, phase])[:, inside]


def _within_a_turn(columns: range, around: int) -> list[tuple[range, int]]:
    """Columns between 180 degrees west and east, in parts, and by how many turns they lie on."""
    first, last = ((c + around // 2) // around for c in (columns.start, columns.stop - 1))
    parts = []
    for turn in range(first, last + 1):
        west = turn * around - around // 2
        start, stop = max(columns.start, west), min(columns.stop, west + around)
        parts.append((range(start - turn * around, stop - turn * around), turn))
    return parts


def brightness(cosine: FloatArray) -> FloatArray:
    r"""Power of a slant-range cell of terrain, relative to level ground seen at 38.7 deg.

    Backscatter per area times the area of ground that shares a cell,
    :math:`\sigma_0(\theta) / \sin\theta`. Nothing comes from what faces away (shadow); terrain
    that faces the radar within 5 deg is held at what it is there.

    Parameters
    ----------
    cosine : ndarray, shape (...)
        Of the local angle of incidence.
    """
    c = np.clip(cosine, 0.0, np.cos(np.radians(5.0)))
    s = np.sqrt(1 - c * c)
    power = c / (s + 0.1 * c) ** 3 / s
    c0, s0 = np.cos(_REFERENCE_INCIDENCE), np.sin(_REFERENCE_INCIDENCE)
    return np.asarray(power * (s0 + 0.1 * c0) ** 3 * s0 / c0)


def _generator(seed: int, name: str, *block: int) -> np.random.Generator:
    words = [seed & 0xFFFFFFFF, *name.encode(), *(b & 0xFFFFFFFF for b in block)]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))


def _smoothed_noise(seed: int, name: str, rows: range, columns: range, sigma: float) -> Single:
    """White noise of every cell, smoothed by a Gaussian of `sigma` cells, of unit variance.

    It is uniform and in whole bytes; the mean of a dozen of them or more is all but normal.
    """
    m = int(np.ceil(4 * sigma))
    wide = [range(r.start - m, r.stop + m) for r in (rows, columns)]
    out = np.empty((len(wide[0]), len(wide[1])), np.uint8)

    def fill(bi: int) -> None:
        for bj in range(wide[1].start // _BLOCK, -(-wide[1].stop // _BLOCK)):
            drawn = _generator(seed, name, bi, bj).bytes(_BLOCK * _BLOCK)
            block = np.frombuffer(drawn, np.uint8).reshape(_BLOCK, _BLOCK)
            (i0, i1), (j0, j1) = (
                (max(b * _BLOCK, w.start), min((b + 1) * _BLOCK, w.stop))
                for b, w in zip((bi, bj), wide, strict=True)
            )
            part = block[i0 - bi * _BLOCK : i1 - bi * _BLOCK, j0 - bj * _BLOCK : j1 - bj * _BLOCK]
            out[
                i0 - wide[0].start : i1 - wide[0].start, j0 - wide[1].start : j1 - wide[1].start
            ] = part

    over(range(wide[0].start // _BLOCK, -(-wide[0].stop // _BLOCK)), fill)
    kernel = cv2.getGaussianKernel(2 * m + 1, sigma, cv2.CV_64F)
    filtered = cv2.sepFilter2D(out, cv2.CV_32F, kernel, kernel)
    smooth = np.asarray(filtered, np.float32)[m:-m, m:-m]
    smooth -= np.float32(127.5)
    smooth *= np.float32(1 / (np.sqrt((256**2 - 1) / 12) * np.sum(kernel**2)))
    return smooth


def _cubic_weights() -> Single:
    """Weights (_COARSE, 4) of the four coarse cells about each cell of one."""
    x = np.abs(np.arange(_COARSE)[:, None] / _COARSE - np.arange(-1, 3))
    a = -0.75  # of Keys' kernel, as OpenCV has it
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    return np.where(x <= 1, near, far).astype(np.float32)


_WEIGHTS = _cubic_weights()


def _enlarged(coarse: Single, ci: range, cj: range, rows: range, columns: range) -> Single:
    """Cubic interpolation of values at every `_COARSE`-th cell to a rectangle of cells."""
    wide, first = _lengthened(np.ascontiguousarray(coarse.T), cj, columns)
    long, top = _lengthened(np.ascontiguousarray(wide[first : first + len(columns)].T), ci, rows)
    return long[top : top + len(rows)]


def _lengthened(coarse: Single, knots: range, rows: range) -> tuple[Single, int]:
    """Cubic interpolation between coarse rows to the cells of a range, and which is its first."""
    start, stop = rows.start // _COARSE, (rows.stop - 1) // _COARSE + 1
    out = np.empty((stop - start, _COARSE, coarse.shape[1]), np.float32)
    for k in range(start, stop):
        at = k - 1 - knots.start
        np.matmul(_WEIGHTS, coarse[at : at + 4], out=out[k - start])
    return out.reshape(-1, coarse.shape[1]), rows.start - start * _COARSE
