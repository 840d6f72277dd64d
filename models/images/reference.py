"""A geocoded reference: an amplitude image of which every pixel has a place on Earth.

Places are given at tie points, on some rows and columns, and interpolated between; so an image in
the slant geometry of an earlier pass and a map serve alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray, Single, read_arrays
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import geodetic
from terrafix.models.geometry.geolocation import Height, ground_point_on_terrain
from terrafix.models.geometry.ground import Ground, seen_on_terrain
from terrafix.models.motion.sampled import Arc
from terrafix.models.radar.echo import ideal_image
from terrafix.models.radar.focusing import Image
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.multilook import detected, full_index, multilook_index
from terrafix.models.radar.scene import Scene
from terrafix.models.radar.speckle import ARRAY_SPECKLE, Speckle

_ROUNDS, _CLOSE = 20, 1e-3
"""Of the search for a place's pixel, and how close it comes [pixels]; of heights [m]."""
_RISES, _RISE_STEP = (100.0, 500.0), 2.0
"""Heights below and above those known between tie points at which a place is sought; steps [m]."""
_FEWEST_TIES, _MOST_TIES = 8, 65
"""Tie points along each axis through which the polynomial of heights is put, at least and most."""
_NO_POLYNOMIAL = 0.5
"""Distance of a tie point from it beyond which it is not used [m]."""

_RELIEF = 3.0
"""Standard deviation of heights that tell how places move with height [m]."""

KEYS = ("amplitude", "rows", "columns", "latitude_deg", "longitude_deg", "height_m")
_TURN = 2 * np.pi
_WIDEST = float(np.radians(30.0))
"""Largest change of longitude between tie points: beyond, they are about a pole [rad]."""


@dataclass(frozen=True, eq=False)
class Reference:
    """A geocoded amplitude image.

    Parameters
    ----------
    amplitude : ndarray of float32, shape (n_rows, n_columns)
    rows, columns : ndarray, shape (n_i,) and (n_j,)
        Rows and columns of the tie points, fractional, increasing.
    latitude, longitude, height : ndarray, shape (n_i, n_j)
        Places of the tie points: [rad], [rad], and [m] above the ellipsoid. Longitudes are kept
        within half a turn of the middle one, so that they go on across 180 degrees.

    Raises
    ------
    ValueError
        If shapes do not fit, something is not finite, a latitude is beyond a pole, or the image
        lies about one, where longitude cannot be interpolated.
    """

    amplitude: Single
    rows: FloatArray
    columns: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    height: FloatArray

    def __post_init__(self) -> None:
        if self.amplitude.ndim != 2:
            raise ValueError(f"a reference is an image, got shape {self.amplitude.shape}")
        ties = (len(self.rows), len(self.columns))
        if min(ties) < 2:
            raise ValueError(f"a reference needs two rows and columns of tie points, got {ties}")
        for name in ("latitude", "longitude", "height"):
            values = getattr(self, name)
            if values.shape != ties:
                raise ValueError(
                    f"{name} of a reference has shape {values.shape}, its tie points {ties}"
                )
        for name in ("amplitude", "rows", "columns", "latitude", "longitude", "height"):
            values = getattr(self, name)
            if not np.isfinite(values).all():
                raise ValueError(f"{name} of a reference is not finite everywhere")
        for name in ("rows", "columns"):
            if not (np.diff(getattr(self, name)) > 0).all():
                raise ValueError(f"{name} of the tie points of a reference do not increase")
        if np.abs(self.latitude).max() > np.pi / 2:
            raise ValueError("latitude of a reference is beyond a pole: is it in degrees?")
        middle = self.longitude[ties[0] // 2, ties[1] // 2]
        longitude = self.longitude - _TURN * np.rint((self.longitude - middle) / _TURN)
        object.__setattr__(self, "longitude", longitude)
        steps = [np.abs(np.diff(longitude, axis=axis)).max() for axis in (0, 1)]
        if max(steps) > _WIDEST:
            raise ValueError(
                f"a reference lies about a pole: the longitude of its tie points changes by "
                f"{np.degrees(max(steps)):.0f} deg from one to the next"
            )

    def place(self, row: ArrayLike, column: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, longitude [rad] and height [m] of pixels, fractional, shape (...).

        Raises
        ------
        ValueError
            If a pixel is outside the tie points.
        """
        i, u = _between(row, self.rows, "row")
        j, w = _between(column, self.columns, "column")

        def interpolated(values: FloatArray) -> FloatArray:
            near = values[i, j] * (1 - w) + values[i, j + 1] * w
            far = values[i + 1, j] * (1 - w) + values[i + 1, j + 1] * w
            return np.asarray(near * (1 - u) + far * u)

        return (
            interpolated(self.latitude),
            interpolated(self.longitude),
            interpolated(self.height),
        )

    def place_on(self, terrain: Height, row: float, column: float) -> tuple[float, float, float]:
        """Latitude, longitude [rad] and height [m] of a pixel on a terrain.

        Between tie points relief bends an image in slant geometry more than a line between them
        tells: by meters where they are 60 m apart. What a pixel sees at one height is smooth, so
        its place is taken as a polynomial of row, column and height through all tie points, and
        the height as that of the terrain there. Where tie points are no such polynomial (within
        0.5 m), or level, it is that of `place`.

        Parameters
        ----------
        terrain : callable
            Height [m] at latitudes and longitudes [rad].
        row, column : float
            Fractional.

        Raises
        ------
        ValueError
            If the pixel is outside the tie points, or shows several places (layover).
        """
        latitude, longitude, height = (float(x) for x in self.place(row, column))
        there = float(terrain(np.array(latitude), np.array(longitude)))
        if not self.tells_heights:
            return latitude, longitude, there
        for reach in _RISES:
            h = np.arange(min(height, there) - reach, max(height, there) + reach, _RISE_STEP)
            above = np.asarray(terrain(*self._seen_at(row, column, h))) - h
            crossed = np.flatnonzero((above[:-1] >= 0) != (above[1:] >= 0))
            if len(crossed):
                break
        if len(crossed) != 1:
            raise ValueError(
                f"{len(crossed)} places of the terrain are seen at row {row:.1f}, column "
                f"{column:.1f} of a reference, from {h[0]:.0f} to {h[-1]:.0f} m of height"
            )
        k = int(crossed[0])
        low, high = h[k], h[k + 1]
        while high - low > _CLOSE:
            middle = (low + high) / 2
            rise = float(terrain(*self._seen_at(row, column, middle))) - middle
            low, high = (middle, high) if (rise >= 0) == (above[k] >= 0) else (low, middle)
        found = self._seen_at(row, column, (low + high) / 2)
        return float(found[0]), float(found[1]), float((low + high) / 2)

    def _seen_at(self, row: float, column: float, height: ArrayLike) -> FloatArray:
        """Latitude and longitude (2, ...) [rad] that a pixel sees at heights (...) [m]."""
        terms = self._terms(np.array(row), np.array(column), np.asarray(height, np.float64))
        assert self._by_height is not None
        return np.moveaxis(terms @ self._by_height, -1, 0)

    @property
    def tells_heights(self) -> bool:
        """Whether tie points tell how places move with height: they have heights that differ."""
        return self._by_height is not None and float(self.height.std()) > _RELIEF

    def _terms(self, row: FloatArray, column: FloatArray, height: FloatArray) -> FloatArray:
        """Terms (..., 15) of the polynomial of row, column and height, in ranges about one."""
        (i0, i1), (j0, j1) = self.rows[[0, -1]], self.columns[[0, -1]]
        i, j = (2 * row - i0 - i1) / (i1 - i0), (2 * column - j0 - j1) / (j1 - j0)
        h = (height - self.height.mean()) / 1000.0
        one = np.ones(np.broadcast_shapes(i.shape, j.shape, h.shape))
        plane = [i**a * j**b for a in range(4) for b in range(4 - a)]
        return np.stack([one * x for x in (*plane, h, h * i, h * j, h * h, h * j * j)], axis=-1)

    @cached_property
    def _by_height(self) -> FloatArray | None:
        """Coefficients (15, 2) of latitude and longitude; None where tie points differ from it."""
        if min(self.height.shape) < _FEWEST_TIES:
            return None
        own = [np.unique(np.linspace(0, n - 1, _MOST_TIES).astype(int)) for n in self.height.shape]
        at = np.ix_(*own)
        row, column = self.rows[own[0]][:, None], self.columns[own[1]][None, :]
        terms = self._terms(row, column, self.height[at])
        terms = terms.reshape(-1, terms.shape[-1])
        known = np.stack([self.latitude[at].ravel(), self.longitude[at].ravel()], axis=-1)
        coefficients = np.linalg.lstsq(terms, known, rcond=None)[0]
        miss = EARTH.radius * np.abs(terms @ coefficients - known)
        miss[:, 1] *= np.cos(known[:, 0])
        return coefficients if miss.max() < _NO_POLYNOMIAL else None

    def pixel(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Row and column, fractional, of places [rad], and whether they are inside.

        Of `place`; of places whose height is given, as `place_on` finds them.

        Solved by Newton's method with the mean slope of the tie points, which relief bends by less
        than a half; where it does not settle (layover), a place counts as outside.

        Parameters
        ----------
        latitude, longitude : array_like, shape (...)
        height : array_like, shape (...), optional
            Of the places [m].
        """
        coefficients = None if height is None else self._by_height
        wanted = np.stack([np.asarray(latitude), self.own_turn(longitude)], axis=-1)
        i, j = np.meshgrid(self.rows, self.columns, indexing="ij")
        ties = np.stack([np.ones_like(i), i, j], axis=-1).reshape(-1, 3)
        known = np.stack([self.latitude, self.longitude], axis=-1).reshape(-1, 2)
        center = known.mean(axis=0)
        slopes = np.linalg.lstsq(ties, known - center, rcond=None)[0]
        inverse = np.linalg.inv(slopes[1:])
        pixel = (wanted - center - slopes[0]) @ inverse
        low = np.array([self.rows[0], self.columns[0]])
        high = np.array([self.rows[-1], self.columns[-1]])
        for _ in range(_ROUNDS):
            held = np.clip(pixel, low, high)
            if coefficients is None:
                found = np.stack(self.place(held[..., 0], held[..., 1])[:2], axis=-1)
            else:
                terms = self._terms(held[..., 0], held[..., 1], np.asarray(height, np.float64))
                found = terms @ coefficients
            change = (wanted - found) @ inverse
            pixel = held + change
            inside = np.all((pixel >= low) & (pixel <= high), axis=-1)
            settled = np.abs(change).max(axis=-1) < _CLOSE
            if np.all(settled | ~inside):
                break
        inside &= np.abs(change).max(axis=-1) < 0.1
        return pixel[..., 0], pixel[..., 1], inside

    def pixel_size(self, ground: Ground) -> FloatArray:
        """Lengths of a pixel in the middle from row to row and column to column (2,) [m]."""
        i, j = (n // 2 for n in self.latitude.shape)
        at = [i, i - 1, i], [j, j, j - 1]
        p = ground.point(self.latitude[at], self.longitude[at], self.height[at])
        pixels = self.rows[i] - self.rows[i - 1], self.columns[j] - self.columns[j - 1]
        return np.asarray(np.linalg.norm(p[1:] - p[0], axis=1) / pixels)

    def own_turn(self, longitude: ArrayLike) -> FloatArray:
        """The same longitudes [rad], within half a turn of the middle of the reference."""
        middle = (self.longitude.min() + self.longitude.max()) / 2
        longitude = np.asarray(longitude, np.float64)
        return np.asarray(longitude - _TURN * np.rint((longitude - middle) / _TURN))

    def described(self) -> str:
        """What it covers, for messages."""
        south, north = np.degrees([self.latitude.min(), self.latitude.max()])
        west, east = np.degrees([self.longitude.min(), self.longitude.max()])
        return f"latitude {south:.3f} to {north:.3f}, longitude {west:.3f} to {east:.3f} deg"


def _between(x: ArrayLike, knots: FloatArray, what: str) -> tuple[np.ndarray, FloatArray]:
    x = np.asarray(x, dtype=np.float64)
    if x.size and not (x.min() >= knots[0] and x.max() <= knots[-1]):
        raise ValueError(
            f"{what} {x.min():.1f} to {x.max():.1f} of a reference is outside its tie points, "
            f"{knots[0]:.1f} to {knots[-1]:.1f}"
        )
    k = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    return k, (x - knots[k]) / (knots[k + 1] - knots[k])


def geocoded(
    image: Image,
    arc: Arc,
    terrain: Height,
    looks: tuple[int, int],
    n_ties: int = 33,
    side: int = 1,
) -> Reference:
    """Reference from a focused image whose orbit is known.

    Parameters
    ----------
    image : Image
    arc : Arc
        Of the radar, on the clock of the image; it must cover when the scene was in the beam.
    terrain : callable
        Height [m] at latitudes and longitudes [rad].
    looks : tuple of int
        Pixels averaged in azimuth and range.
    n_ties : int
        Tie points along each axis.
    side : {1, -1}
        To the right of the track, or to the left.
    """
    amplitude = detected(image.valid, looks)
    ties = [np.linspace(0, n - 1, n_ties) for n in amplitude.shape]
    row, column = (
        part.start + full_index(t, n)
        for t, part, n in zip(ties, (image.rows, image.columns), looks, strict=True)
    )
    t, R = image.seen_at(row[:, None], column[None, :], image.doppler)
    r, v = arc.position(t), arc.velocity(t)
    sine = image.radar.wavelength * image.doppler / (2 * np.linalg.norm(v, axis=-1))
    p = ground_point_on_terrain(r, v, R, sine, terrain, side=side)
    return Reference(amplitude, ties[0], ties[1], *geodetic(p))


def earlier_pass(
    scene: Scene,
    footprint: Footprint,
    looks: tuple[int, int],
    rng: np.random.Generator,
    snr_db: float = 10.0,
    *,
    terrain: Height | None = None,
    speckle: Speckle = ARRAY_SPECKLE,
) -> Reference:
    """Reference as an ideal processor makes it of an earlier pass, with speckle of its own.

    Parameters
    ----------
    scene : Scene
    footprint : Footprint
        Grid of the earlier pass.
    looks : tuple of int
        Pixels averaged in azimuth and range.
    rng : numpy.random.Generator
        Of speckle and noise.
    snr_db : float
        Ratio of mean clutter to noise [dB].
    terrain : callable, optional
        Height [m] at latitudes and longitudes [rad] that who made the reference took for true; the
        scene's own by default.
    speckle : Speckle
        Who makes speckle and noise; `terrafix.components.sensors.compiled` has a quicker one.
    """
    grid = TerrainGrid(footprint, scene)
    amplitude = detected(ideal_image(scene, grid, rng, snr_db=snr_db, speckle=speckle), looks)
    rows, columns = (multilook_index(a, n) for a, n in zip(grid.ties, looks, strict=True))
    if terrain is None:
        return Reference(amplitude, rows, columns, grid.latitude, grid.longitude, grid.height)
    lines, cells = grid.ties
    t = footprint.first_time + lines / footprint.radar.prf
    R = footprint.near_range + cells * footprint.radar.range_spacing
    r, v = (a[:, None, :] for a in (footprint.arc.position(t), footprint.arc.velocity(t)))
    sine = footprint.radar.wavelength * footprint.centroid / (2 * np.linalg.norm(v, axis=-1))
    p = seen_on_terrain(footprint.ground, r, v, R[None, :], sine, terrain, footprint.side)
    return Reference(amplitude, rows, columns, *footprint.ground.geodetic(p))


def write_reference(reference: Reference, path: Path) -> None:
    """Write a reference to a file (.npz) that `read_reference` reads."""
    np.savez(
        path,
        amplitude=reference.amplitude,
        rows=reference.rows,
        columns=reference.columns,
        latitude_deg=np.degrees(reference.latitude),
        longitude_deg=np.degrees(reference.longitude),
        height_m=reference.height,
    )


def read_reference(path: Path) -> Reference:
    """Read a reference from a file (.npz) with the arrays named in `KEYS`.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no such file, or what it holds is not a reference.
    """
    arrays = read_arrays(path, KEYS, "a reference")
    amplitude, rows, columns, latitude, longitude, height = (arrays[k] for k in KEYS)
    try:
        return Reference(
            np.asarray(amplitude, np.float32),
            np.asarray(rows, np.float64),
            np.asarray(columns, np.float64),
            np.radians(latitude),
            np.radians(longitude),
            np.asarray(height, np.float64),
        )
    except (TypeError, ValueError) as error:
        raise ValueError(f"'{path}': {error}") from error
