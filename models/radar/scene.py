r"""An artificial scene over a real terrain: what a radar would find at every place on Earth.

Brightness is backscatter at the local angle of incidence :math:`\theta`,

.. math:: \sigma_0(\theta) = \frac{0.0133 \cos\theta}{(\sin\theta + 0.1 \cos\theta)^3},

times a texture: parcels with sharp borders, a smooth variation and a fine one, in decibels; or
fields, towns or sea in place of parcels (`terrafix.models.radar.cover`). Bright points (buildings,
pylons) are strewn over it. All are functions of (seed, place) alone, by counter-based noise on a
grid of 1e-4 deg: any two images of a place, from whatever side, show the same texture and points,
under speckle of their own.

Time changes it: of another season, texture is :math:`\rho` times the old one and
:math:`\sqrt{1 - \rho^2}` times an independent one, in decibels, and a share :math:`1 - \rho` of
the points is gone, and as many are new. Shores, streets and the borders of fields stay.

References
----------
.. [1] D. O. Muhleman, "Radar scattering from Venus and the Moon", Astronomical Journal 69, 1964:
       the shape of the backscatter; its scale is set to one at 38.7 deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.core.parallel import batches, over
from terrafix.models.maps.dem import Dem
from terrafix.models.radar import cover as patterns
from terrafix.models.radar.cover import COVERS

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
_MOTTLED, _MOTTLED_DB = 4.0, 3.4
"""Smoothing [cells] and strength of the variation of a texture without borders: 4 dB in all."""
_WITH_PARCELS = ("parcels", "coast", "causeway")
_SHORE = ((3.2, 1.0), (1.0, 0.3), (4.0, 0.08))
"""Smoothing (in coarse cells, the last in cells) and strength of what is zero along a shore."""


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
    cover : str
        What covers the ground, one of `COVERS`. `parcels_db` is that of fields and blocks, too; a
        texture has neither parcels nor points; a town has points of its own density.
    correlation : float
        Of texture and points with those of `seed` alone, 0 to 1.
    change_seed : int
        Of what has changed.
    """

    dem: Dem
    seed: int = 0
    parcels_db: float = 2.5
    smooth_db: float = 1.5
    fine_db: float = 1.5
    points_per_km2: float = 3.0
    points_db: float = 25.0
    detail: int = 1
    cover: str = "parcels"
    correlation: float = 1.0
    change_seed: int = 1

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
        if self.cover not in COVERS:
            raise ValueError(f"cover of a scene is one of {', '.join(COVERS)}, not '{self.cover}'")
        if not 0 <= self.correlation <= 1:
            raise ValueError(f"correlation of a scene is 0 to 1, not {self.correlation}")

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
        texture = self._on_land(self.seed, rows, columns)
        if self.correlation < 1:
            texture *= np.float32(self.correlation)
            other = self._on_land(self.change_seed, rows, columns)
            texture += np.float32(np.sqrt(1 - self.correlation**2)) * other
        if self.cover == "urban":
            texture[self._streets(rows, columns)] += np.float32(patterns.STREET_DB)
        sea = np.float32(patterns.SEA_DB) + np.float32(patterns.CALM) * texture
        return self._with_sea(texture, sea, rows, columns)

    def _on_land(self, seed: int, rows: range, columns: range) -> Single:
        """What changes with the seasons [dB]."""
        fine = _smoothed_noise(seed, "fine", rows, columns, _FINE)
        fine *= np.float32(self.fine_db)
        if self.cover in ("urban", "fields"):
            fine += np.float32(self.parcels_db) * self._rectangles(seed, rows, columns)
        if self.cover == "texture":
            mottled = _smoothed_noise(seed, "mottled", rows, columns, _MOTTLED)
            fine += np.float32(_MOTTLED_DB) * mottled
        # whole coarse cells that cover the rectangle
        ci, cj = _coarse_cells(rows, columns)
        coarse = [
            (name, scale, _smoothed_noise(seed, name, ci, cj, sigma))
            for name, sigma, scale in (
                ("parcels a", _PARCEL, self.parcels_db / np.sqrt(2)),
                ("parcels b", _PARCEL, self.parcels_db / np.sqrt(2)),
                ("smooth", _SMOOTH, self.smooth_db),
            )
            if name == "smooth" or self.cover in _WITH_PARCELS
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

    def _rectangles(self, seed: int, rows: range, columns: range) -> Single:
        """Brightness of blocks or fields, in standard deviations."""
        at = patterns.districts(self.seed, rows, columns, self.cell)
        own = patterns.streets(at)[1] if self.cover == "urban" else patterns.fields(at)
        return np.asarray(patterns.CROPS[patterns.crops(seed, own)])

    def _streets(self, rows: range, columns: range) -> NDArray[np.bool_]:
        return patterns.streets(patterns.districts(self.seed, rows, columns, self.cell))[0]

    def _with_sea(
        self, texture: Single, sea: Single | np.float32, rows: range, columns: range
    ) -> Single:
        """Texture on land and that of the sea, in what mixture cells have of them [dB]."""
        land = self._land(rows, columns)
        if land is None:
            return texture
        to_power = np.float32(np.log(10) / 10)
        power = land * np.exp(texture * to_power) + (1 - land) * np.exp(sea * to_power)
        return np.asarray(np.log(power) / to_power)

    def _land(self, rows: range, columns: range) -> Single | None:
        """Share of cells that are land; None where all are."""
        if self.cover == "causeway":
            return patterns.causeway(self.seed, rows, columns, self.cell)
        if self.cover != "coast":
            return None
        ci, cj = _coarse_cells(rows, columns)
        (broad, scale), (close, less), (fine, least) = _SHORE
        coarse = np.float32(scale) * _smoothed_noise(self.seed, "shore", ci, cj, broad)
        coarse += np.float32(less) * _smoothed_noise(self.seed, "bays", ci, cj, close)
        level = np.float32(least) * _smoothed_noise(self.seed, "rocks", rows, columns, fine)
        level += _enlarged(coarse, ci, cj, rows, columns)
        return np.asarray(level > 0, np.float32)

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
        found = []
        for part, turn in _within_a_turn(columns, self._turn):
            own = self._points(self.seed, rows, part, self.correlation)
            if self.correlation < 1:
                new = self._points(self.change_seed, rows, part, 1 - self.correlation)
                own = np.hstack([own, new])
            own[1] += turn * self._turn
            found.append(own)
        i, j, amplitude, phase = np.hstack(found)
        return i * self.cell, j * self.cell, amplitude, phase

    def _points(self, seed: int, rows: range, columns: range, share: float) -> FloatArray:
        """Row, column, amplitude and phase of a share of the points of a seed, shape (4, n)."""
        if self.cover == "texture":
            return np.empty((4, 0))
        found = []
        for bi in range(rows.start // _BLOCK, -(-rows.stop // _BLOCK)):
            for bj in range(columns.start // _BLOCK, -(-columns.stop // _BLOCK)):
                rng = _generator(seed, "points", bi, bj)
                n = rng.poisson(self._n_points(bi))
                place = rng.random((2, n)) * _BLOCK + np.array([[bi], [bj]]) * _BLOCK
                db = self.points_db + 4.0 * rng.standard_normal(n)
                points = np.vstack([place, 10 ** (db / 20), rng.random(n)])
                found.append(points if share == 1 else points[:, rng.random(n) < share])
        points = np.hstack(found) if found else np.empty((4, 0))
        i, j = points[:2]
        inside = (i >= rows.start) & (i < rows.stop) & (j >= columns.start) & (j < columns.stop)
        return self._built(points[:, inside], rows, columns)

    def _n_points(self, bi: int) -> float:
        """Expected number of points in a block of cells."""
        middle = (bi + 0.5) * _BLOCK * self.cell
        if self.cover == "urban":
            return max(float(_BLOCK**2 * np.cos(middle)), 0.0) * patterns.DENSE / patterns.BUILT
        area = (_BLOCK * self.cell * 6371.0) ** 2 * np.cos(middle)
        return max(float(area), 0.0) * self.points_per_km2

    def _built(self, points: FloatArray, rows: range, columns: range) -> FloatArray:
        """Those that do not stand on a street or in the sea."""
        if self.cover not in ("urban", "coast", "causeway") or not points.size:
            return points
        wide = [range(r.start, r.stop + 1) for r in (rows, columns)]
        if self.cover == "urban":
            free = ~self._streets(*wide)
        else:
            land = self._land(*wide)
            assert land is not None
            free = land > 0.5
        i, j = (np.rint(p).astype(np.int64) - r.start for p, r in zip(points, wide, strict=False))
        return points[:, free[i, j]]


@dataclass(frozen=True, eq=False)
class CoverMap(Scene):
    """What a land-cover map tells of a scene: borders of classes, and how bright a class is.

    It knows no fine and smooth variation and no single building, and the brightness of each class
    is off by an error of its own. The classes of a town are block and street, those of fields and
    parcels kinds of them.

    Parameters
    ----------
    class_sigma : float
        Standard deviation of the errors of brightness [dB].
    map_seed : int
        Of these errors.
    """

    class_sigma: float = 0.0
    map_seed: int = 0

    def points(
        self, rows: range, columns: range
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """No points."""
        empty = np.empty(0)
        return empty, empty, empty, empty

    def _texture(self, rows: range, columns: range) -> Single:
        kind, levels = self._classes(rows, columns)
        errors = _generator(self.map_seed, "classes").standard_normal(len(levels) + 1)
        errors *= self.class_sigma
        texture = (levels + errors[:-1]).astype(np.float32)[kind]
        sea = np.float32(patterns.SEA_DB + errors[-1])
        return self._with_sea(texture, sea, rows, columns)

    def _classes(self, rows: range, columns: range) -> tuple[NDArray[np.int64], FloatArray]:
        """Class of each cell, and the mean brightness of each class [dB]."""
        shape = len(rows), len(columns)
        if self.cover == "texture":
            return np.zeros(shape, np.int64), np.zeros(1)
        if self.cover == "urban":
            return self._streets(rows, columns).astype(np.int64), np.array([0, patterns.STREET_DB])
        if self.cover == "fields":
            at = patterns.districts(self.seed, rows, columns, self.cell)
            kinds = patterns.crops(self.seed, patterns.fields(at))
            return kinds, self.parcels_db * patterns.CROPS.astype(np.float64)
        ci, cj = _coarse_cells(rows, columns)
        kinds = np.zeros(shape, np.int64)
        for weight, name in ((2, "parcels a"), (1, "parcels b")):
            field = _smoothed_noise(self.seed, name, ci, cj, _PARCEL)
            kinds += weight * (_enlarged(field, ci, cj, rows, columns) > 0)
        return kinds, self.parcels_db / np.sqrt(2) * np.array([-2.0, 0.0, 0.0, 2.0])


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


def _coarse_cells(rows: range, columns: range) -> tuple[range, range]:
    """Whole coarse cells that cover a rectangle of cells."""
    ci, cj = (range(r.start // _COARSE - 2, r.stop // _COARSE + 4) for r in (rows, columns))
    return ci, cj


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
