"""References from maps: a part of a large image of the ground, read where it is needed.

A map is a georeferenced raster, or an image of Sentinel-1 with its annotation. Pixels that are
finer than wanted are averaged in power. What a map does not know is zero, which matching takes for
not seen; to fill it would make up texture, and its border is none of the ground.

Tie points of a raster lie as dense as its projection wants, so that places between them are within
0.02 pixels of PROJ's; heights at them are those of the elevation model that is given.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.geometry.geolocation import Height, ground_point_on_terrain, track_axes
from terrafix.models.images.reference import Reference
from terrafix.models.maps.elevation import square_about
from terrafix.models.maps.raster import LARGEST, Raster, knots
from terrafix.models.maps.sentinel1 import Sentinel1
from terrafix.models.radar.multilook import detected, full_index, multilook_index

CLOSE = 0.02
"""How exactly places between tie points are known [pixels]."""
SEEN = 0.5
"""Share of what is asked for that a map must know."""
_SMALLEST = 96
"""Rows and columns of a reference, at least."""
_TIES = 16
"""Pixels from one tie point to the next on relief, about."""
_MERIDIAN = 6371e3
_SAMPLES = 65


class Map(Protocol):
    """A large image of the ground."""

    def about(
        self, latitude: float, longitude: float, reach: float, spacing: float, terrain: Height
    ) -> Reference:
        """Part of the map about a place.

        Parameters
        ----------
        latitude, longitude : float
            [rad]
        reach : float
            Half of the side of a square about it that must be there [m].
        spacing : float
            Of the pixels wanted [m]; finer ones are averaged to about these. 0: as they are.
        terrain : callable
            Height [m] at latitudes and longitudes [rad].

        Raises
        ------
        ValueError
            If the map knows less than half of it, it is too large to be held, or too small.
        """


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
    ) -> Reference:
        """Part of the map about a place: of `Map`."""
        raster = self._raster
        lat, lon = square_about(latitude, longitude, reach)
        rows, columns = raster.window(lat, lon)
        middle = (rows.start + rows.stop) / 2, (columns.start + columns.stop) / 2
        size = raster.pixel_size(*middle)
        step = max(1, round(spacing / size))
        _require_size(raster.path.name, rows, columns, (step, step))
        amplitude, known = raster.read(rows, columns, step)
        if amplitude.min(initial=0.0) < 0:
            raise ValueError(
                f"'{raster.path.name}' holds negative values, which are no amplitudes\n"
                "  if they are decibels, write 10^(dB / 20)"
            )
        at = raster.pixels(*_samples(lat, lon))
        pixels = [
            np.rint(multilook_index(a - part.start, step))
            for a, part in zip(at, (rows, columns), strict=True)
        ]
        _require_seen(raster.path.name, known & (amplitude > 0), *pixels)

        def place(i: FloatArray, j: FloatArray) -> tuple[FloatArray, FloatArray]:
            return raster.places(
                rows.start + full_index(i, step), columns.start + full_index(j, step)
            )

        error = CLOSE * size * step / _MERIDIAN
        last = tuple(float(n - 1) for n in amplitude.shape)
        i, j, places = knots(
            place, (0, last[0]), (0, last[1]), error * np.array([1, 1 / np.cos(latitude)])
        )
        height = np.asarray(terrain(places[..., 0], places[..., 1]), np.float64)
        return Reference(amplitude, i, j, places[..., 0], places[..., 1], height)


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
    ) -> Reference:
        """Part of the image about a place: of `Map`. Without a spacing, its pixels are square."""
        image = self._image
        lat, lon = square_about(latitude, longitude, reach)
        line, sample = image.pixels(ecef(lat, lon, terrain(lat, lon)))
        lines, samples = (
            _within(a, n, image.path.name, latitude, longitude)
            for a, n in ((line, image.shape[0]), (sample, image.shape[1]))
        )
        looks = self._looks(
            lines, samples, terrain(np.array(latitude), np.array(longitude)), spacing
        )
        _require_size(image.path.name, lines, samples, looks)
        amplitude = detected(image.read(lines, samples), looks)
        place = _samples(lat, lon)
        at = image.pixels(ecef(*place, terrain(*place)))
        pixels = [
            np.rint(multilook_index(a - part.start, n))
            for a, part, n in zip(at, (lines, samples), looks, strict=True)
        ]
        _require_seen(image.path.name, amplitude > 0, *pixels)
        i, j = (np.linspace(0, n - 1, max(2, n // _TIES)) for n in amplitude.shape)
        t, R = image.seen_at(
            lines.start + full_index(i, looks[0])[:, None],
            samples.start + full_index(j, looks[1])[None, :],
        )
        r, v = image.orbit.at(t)
        start = float(np.mean(terrain(lat, lon)))
        p = ground_point_on_terrain(r, v, R, 0.0, terrain, start)
        return Reference(amplitude, i, j, *geodetic(p))

    def _looks(
        self, lines: slice, samples: slice, height: FloatArray, spacing: float
    ) -> tuple[int, int]:
        """Lines and samples averaged, of which pixels on the ground are about so large."""
        image = self._image
        line, sample = (np.array([s.start, s.start + 1.0]) for s in (lines, samples))
        t, R = image.seen_at(line[[0, 1, 0]], sample[[0, 0, 1]])
        r, v = image.orbit.at(t)
        p = ground_point_on_terrain(r, v, R, 0.0, lambda a, _: 0 * a + height)
        moved = (p[1:] - p[0]) @ track_axes(p[0], v[0]).T
        along, across = abs(moved[0, 0]), abs(moved[1, 1])
        wanted = spacing if spacing > 0 else max(along, across)
        return max(1, round(wanted / along)), max(1, round(wanted / across))


def _samples(lat: FloatArray, lon: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes evenly spread over a square."""
    i, j = (np.linspace(f(a), g(a), _SAMPLES) for a in (lat, lon) for f, g in ((np.min, np.max),))
    found = np.meshgrid(i, j, indexing="ij")
    return np.asarray(found[0]), np.asarray(found[1])


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


def _require_size(name: str, rows: slice, columns: slice, looks: tuple[int, int]) -> None:
    n = tuple((s.stop - s.start) // k for s, k in zip((rows, columns), looks, strict=True))
    if n[0] * n[1] > LARGEST:
        raise ValueError(
            f"a part of '{name}' of {n[0]} x {n[1]} pixels is too large; {LARGEST / 1e6:.0f} "
            "million are held at most\n  set a coarser spacing, or a smaller reach"
        )
    if min(n) < _SMALLEST:
        raise ValueError(
            f"a part of '{name}' of {n[0]} x {n[1]} pixels is too small: {_SMALLEST} rows and "
            "columns are wanted\n  use a finer map, a finer spacing, or a larger reach"
        )


def _require_seen(name: str, known: np.ndarray, row: FloatArray, column: FloatArray) -> None:
    inside = (row >= 0) & (row < known.shape[0]) & (column >= 0) & (column < known.shape[1])
    seen = np.zeros(row.shape, np.bool_)
    seen[inside] = known[row[inside].astype(np.intp), column[inside].astype(np.intp)]
    if seen.mean() < SEEN:
        raise ValueError(
            f"'{name}' knows {100 * seen.mean():.0f} % of what is asked for; {100 * SEEN:.0f} % "
            "are wanted\n  use a map that covers it, or a smaller reach"
        )
