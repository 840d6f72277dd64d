"""References from maps: a part of a large image of the ground, read where it is needed.

A map is a georeferenced raster, or an image of Sentinel-1 with its annotation. Pixels that are
finer than wanted are averaged in power. What a map does not know is zero, which matching takes for
not seen; to fill it would make up texture, and its border is none of the ground.

A part has the geometry of its map, or is drawn in that of a radar which is to see it: relief moves
what a radar shows, by 125 m in range for 100 m of height at 39 degrees of incidence, and between a
map and an image that is no shift. For the orbit that is expected, each pixel's place on the terrain
is found, and what the map shows there. An orbit that is a kilometer off moves relief of 300 m by
half a meter.

Tie points of a raster lie as dense as its projection wants, so that places between them are within
0.02 pixels of PROJ's; heights at them are those of the elevation model that is given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.geometry.geolocation import (
    Height,
    ground_point,
    ground_point_on_terrain,
    track_axes,
)
from terrafix.models.images.reference import Reference
from terrafix.models.maps.elevation import square_about
from terrafix.models.maps.raster import LARGEST, Raster, knots
from terrafix.models.maps.sentinel1 import Sentinel1
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.multilook import detected, full_index, multilook_index

CLOSE = 0.02
"""How exactly places between tie points are known [pixels]."""
SEEN = 0.5
"""Share of what is asked for that a map must know."""
_SMALLEST = 96
"""Rows and columns of a reference, at least."""
_TIES = 16
"""Pixels from one tie point to the next on relief, about."""
_SEEN_TIES = 4
"""The same, of what is drawn."""
_RELIEF, _ROUNDS, _LEVEL = 300.0, 40, 0.05
"""Heights beyond those found at first, rounds of the search for them, how close it comes [m]."""
_STRIP = 256
"""Rows drawn at a time."""
_LONGEST = 32_000
"""Rows or columns that OpenCV's maps reach."""
_MERIDIAN = 6371e3


Ties = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Rows, columns, and the latitudes, longitudes [rad] and heights [m] of tie points."""


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a map.

    Parameters
    ----------
    name : str
        Of the map.
    amplitude : ndarray of float32, shape (n_rows, n_columns)
        Zero where it is not known.
    size : float
        Of a pixel on the ground [m].
    side : float
        Of the square that was asked for [m].
    pixel : callable
        Row and column, fractional, of latitudes, longitudes [rad] and heights [m].
    ties : callable
        In its own geometry.
    """

    name: str
    amplitude: Single
    size: float
    side: float
    pixel: Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
    ties: Callable[[], Ties]

    def reference(self) -> Reference:
        """Reference in the geometry of the map.

        Raises
        ------
        ValueError
            If less than half of it is known.
        """
        known = np.count_nonzero(self.amplitude) * (self.size / self.side) ** 2
        _require_seen(self.name, min(1.0, known))
        return Reference(self.amplitude, *self.ties())


class Map(Protocol):
    """A large image of the ground."""

    def about(
        self, latitude: float, longitude: float, reach: float, spacing: float, terrain: Height
    ) -> Part:
        """Part of the map about a place.

        Parameters
        ----------
        latitude, longitude : float
            [rad]
        reach : float
            Half of the side of a square about it that is wanted [m].
        spacing : float
            Of the pixels wanted [m]; finer ones are averaged to about these. 0: as they are.
        terrain : callable
            Height [m] at latitudes and longitudes [rad].

        Raises
        ------
        ValueError
            If the map does not reach there, or the part is too large to be held, or too small.
        """


@dataclass(frozen=True, eq=False)
class Beam:
    """Where a radar is and looks, when the middle of an image passes.

    Parameters
    ----------
    r, v : ndarray, shape (3,)
        Position [m] and velocity [m/s], Earth-fixed.
    point : ndarray, shape (3,)
        Where the beam's center meets the ground [m].
    """

    r: FloatArray
    v: FloatArray
    point: FloatArray

    @property
    def side(self) -> int:
        """1 to the right of the track, -1 to the left."""
        return 1 if np.cross(self.v, self.r) @ (self.point - self.r) > 0 else -1

    @property
    def slant_range(self) -> float:
        """To that point [m]."""
        return float(np.linalg.norm(self.point - self.r))

    @property
    def sine(self) -> float:
        """Of the angle of the beam's center ahead of broadside."""
        return float(self.v @ (self.point - self.r) / np.linalg.norm(self.v) / self.slant_range)


def as_seen(part: Part, beam: Beam, reach: float, spacing: float, terrain: Height) -> Reference:
    """Reference drawn of a part of a map as a radar will see it: rows in time, columns in range.

    Parameters
    ----------
    part : Part
    beam : Beam
    reach : float
        Half of the side of what is drawn, on the ground [m].
    spacing : float
        Of its pixels on level ground [m]; 0: those of the part.
    terrain : callable
        Height [m] at latitudes and longitudes [rad].

    Raises
    ------
    ValueError
        If less than half of it is known, or the terrain is not.
    """
    spacing = spacing or part.size
    n = round(2 * reach / spacing)
    _require_size(part.name, (n, n))
    around = max(2.0, reach / 3e3)  # longer than it takes [s]
    arc = OrbitArc(beam.r, beam.v, 0.0, around, around)
    incidence = _incidence(beam)
    along = track_axes(beam.point, beam.v)[0]
    ahead = ground_point(
        arc.position(1.0), arc.velocity(1.0), beam.slant_range, beam.sine, 0.0, beam.side
    ) - ground_point(beam.r, beam.v, beam.slant_range, beam.sine, 0.0, beam.side)
    ties = np.unique(np.linspace(0, n - 1, max(2, n // _SEEN_TIES)))
    t = (ties - (n - 1) / 2) * spacing / float(ahead @ along)
    R = beam.slant_range + (ties - (n - 1) / 2) * spacing * np.sin(incidence)
    r, v = (a[:, None, :] for a in (arc.position(t), arc.velocity(t)))

    def places(height: float) -> FloatArray:
        p = ground_point(r, v, R[None, :], beam.sine, height, beam.side)
        return np.stack(geodetic(p)[:2])

    place, height = _on_terrain(places, terrain)
    row, column = part.pixel(place[0], place[1], height)
    amplitude = _drawn(part.amplitude, ties, row, column)
    _require_seen(part.name, float((amplitude > 0).mean()))
    return Reference(amplitude, ties, ties, place[0], place[1], height)


def _incidence(beam: Beam) -> float:
    """Of the beam on level ground [rad]."""
    up = track_axes(beam.point, beam.v)[2]
    return float(np.arccos((beam.r - beam.point) @ up / beam.slant_range))


def _on_terrain(
    places: Callable[[float], FloatArray], terrain: Height
) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes (2, n, m) [rad] and heights [m] at which places meet the terrain.

    Along the height they are taken as parabolas. Where several heights do (layover), it is one.
    """
    start = places(0.0)
    h = np.asarray(terrain(start[0], start[1]), np.float64)
    low, high = float(h.min()) - _RELIEF, float(h.max()) + _RELIEF
    middle, half = (low + high) / 2, (high - low) / 2
    a, b, c = (places(x) for x in (low, middle, high))
    a, c = (q - 2 * np.pi * np.rint((q - b) / (2 * np.pi)) for q in (a, c))
    slope, bend = (c - a) / 2, (a + c) / 2 - b
    for _ in range(_ROUNDS):
        u = np.clip((h - middle) / half, -1, 1)
        found = b + slope * u + bend * u * u
        rise = np.asarray(terrain(found[0], found[1]), np.float64) - h
        if np.abs(rise).max() < _LEVEL:
            break
        h = h + 0.7 * rise
    return found, h


def _drawn(image: Single, ties: FloatArray, row: FloatArray, column: FloatArray) -> Single:
    """What an image shows at rows and columns given at tie points, bilinear; zero if not known."""
    n = round(float(ties[-1])) + 1
    at = np.interp(np.arange(n), ties, np.arange(len(ties))).astype(np.float32)
    coarse = [a.astype(np.float32) for a in (column, row)]
    known = np.where(image > 0, np.uint8(255), np.uint8(0))
    out = np.empty((n, n), np.float32)
    for first in range(0, n, _STRIP):
        j, i = np.meshgrid(at, at[first : first + _STRIP])
        x, y = (cv2.remap(a, j, i, cv2.INTER_LINEAR) for a in coarse)
        part = cv2.remap(image, x, y, cv2.INTER_LINEAR)
        part[cv2.remap(known, x, y, cv2.INTER_LINEAR) < 255] = 0
        out[first : first + _STRIP] = part
    return out


class RasterMap:
    """A georeferenced raster of amplitudes.

    Parameters
    ----------
    raster : Raster
    """

    def __init__(self, raster: Raster) -> None:
        self._raster = raster

    def about(
        self, latitude: float, longitude: float, reach: float, spacing: float, terrain: Height
    ) -> Part:
        """Part of the map about a place: of `Map`."""
        raster = self._raster
        lat, lon = square_about(latitude, longitude, reach)
        rows, columns = raster.window(lat, lon)
        middle = (rows.start + rows.stop) / 2, (columns.start + columns.stop) / 2
        size = raster.pixel_size(*middle)
        step = max(1, round(spacing / size))
        _require_size(raster.path.name, _sizes((rows, columns), (step, step)))
        amplitude, _ = raster.read(rows, columns, step)
        if amplitude.min(initial=0.0) < 0:
            raise ValueError(
                f"'{raster.path.name}' holds negative values, which are no amplitudes\n"
                "  if they are decibels, write 10^(dB / 20)"
            )

        def pixel(
            north: FloatArray, east: FloatArray, _: FloatArray
        ) -> tuple[FloatArray, FloatArray]:
            at = zip(raster.pixels(north, east), (rows, columns), strict=True)
            i, j = (multilook_index(a - own.start, step) for a, own in at)
            return i, j

        def place(i: FloatArray, j: FloatArray) -> tuple[FloatArray, FloatArray]:
            return raster.places(
                rows.start + full_index(i, step), columns.start + full_index(j, step)
            )

        def ties() -> Ties:
            error = CLOSE * size * step / _MERIDIAN * np.array([1, 1 / np.cos(latitude)])
            last = [float(n - 1) for n in amplitude.shape]
            i, j, places = knots(place, (0, last[0]), (0, last[1]), error)
            north, east = places[..., 0], places[..., 1]
            return i, j, north, east, np.asarray(terrain(north, east), np.float64)

        return Part(raster.path.name, amplitude, size * step, 2 * reach, pixel, ties)


class Sentinel1Map:
    """An image of Sentinel-1, geocoded by its orbit where it is read.

    Parameters
    ----------
    image : Sentinel1
    """

    def __init__(self, image: Sentinel1) -> None:
        self._image = image

    def about(
        self, latitude: float, longitude: float, reach: float, spacing: float, terrain: Height
    ) -> Part:
        """Part of the image about a place: of `Map`. Without a spacing, its pixels are square."""
        image = self._image
        lat, lon = square_about(latitude, longitude, reach)
        line, sample = image.pixels(ecef(lat, lon, terrain(lat, lon)))
        lines, samples = (
            _within(a, n, image.path.name, latitude, longitude)
            for a, n in ((line, image.shape[0]), (sample, image.shape[1]))
        )
        height = terrain(np.array(latitude), np.array(longitude))
        size, looks = self._looks(lines, samples, height, spacing)
        _require_size(image.path.name, _sizes((lines, samples), looks))
        amplitude = detected(image.read(lines, samples), looks)

        def pixel(
            north: FloatArray, east: FloatArray, height: FloatArray
        ) -> tuple[FloatArray, FloatArray]:
            at = zip(image.pixels(ecef(north, east, height)), (lines, samples), looks, strict=True)
            i, j = (multilook_index(a - own.start, n) for a, own, n in at)
            return i, j

        def ties() -> Ties:
            i, j = (np.linspace(0, n - 1, max(2, n // _TIES)) for n in amplitude.shape)
            t, R = image.seen_at(
                lines.start + full_index(i, looks[0])[:, None],
                samples.start + full_index(j, looks[1])[None, :],
            )
            r, v = image.orbit.at(t)
            start = float(np.mean(terrain(lat, lon)))
            return i, j, *geodetic(ground_point_on_terrain(r, v, R, 0.0, terrain, start))

        return Part(image.path.name, amplitude, size, 2 * reach, pixel, ties)

    def _looks(
        self, lines: slice, samples: slice, height: FloatArray, spacing: float
    ) -> tuple[float, tuple[int, int]]:
        """Size of pixels on the ground [m], and lines and samples averaged to about that."""
        image = self._image
        line, sample = (np.array([s.start, s.start + 1.0]) for s in (lines, samples))
        t, R = image.seen_at(line[[0, 1, 0]], sample[[0, 0, 1]])
        r, v = image.orbit.at(t)
        p = ground_point_on_terrain(r, v, R, 0.0, lambda a, _: 0 * a + height)
        moved = (p[1:] - p[0]) @ track_axes(p[0], v[0]).T
        along, across = abs(moved[0, 0]), abs(moved[1, 1])
        wanted = spacing if spacing > 0 else max(along, across)
        return wanted, (max(1, round(wanted / along)), max(1, round(wanted / across)))


def _within(
    at: FloatArray, n: int, name: str, latitude: float, longitude: float, margin: int = 8
) -> slice:
    low, high = np.nanmin(at, initial=n), np.nanmax(at, initial=0)
    first, last = max(0, int(low) - margin), min(n, int(high) + margin + 1)
    if first >= last:
        raise ValueError(
            f"'{name}' does not show latitude {np.degrees(latitude):.3f}, longitude "
            f"{np.degrees(longitude):.3f} deg"
        )
    return slice(first, last)


def _sizes(window: tuple[slice, slice], looks: tuple[int, int]) -> tuple[int, int]:
    rows, columns = ((s.stop - s.start) // k for s, k in zip(window, looks, strict=True))
    return rows, columns


def _require_size(name: str, n: tuple[int, int]) -> None:
    if n[0] * n[1] > LARGEST or max(n) > _LONGEST:
        raise ValueError(
            f"a part of '{name}' of {n[0]} x {n[1]} pixels is too large; {LARGEST / 1e6:.0f} "
            "million are held at most\n  set a coarser spacing, or a smaller reach"
        )
    if min(n) < _SMALLEST:
        raise ValueError(
            f"a part of '{name}' of {n[0]} x {n[1]} pixels is too small: {_SMALLEST} rows and "
            "columns are wanted\n  use a finer map, a finer spacing, or a larger reach"
        )


def _require_seen(name: str, seen: float) -> None:
    if seen < SEEN:
        raise ValueError(
            f"'{name}' knows {100 * seen:.0f} % of what is asked for; {100 * SEEN:.0f} % are wanted"
            "\n  use a map that covers it, or a smaller reach"
        )
