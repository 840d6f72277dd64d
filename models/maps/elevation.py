"""Elevation models from files of any kind that is read, on a grid of latitude and longitude.

Heights of a raster in another system than degrees of WGS-84, or turned, are interpolated to a grid
of its own spacing, bilinearly; next to what is not known nothing is, so that no void is filled by
it. Others are taken as they are.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.maps.dem import Dem, heights_of_the_earth, read_dem
from terrafix.models.maps.raster import LARGEST, SUFFIXES, Raster, knots, open_raster

_CLOSE = 0.02
"""How exactly places of a grid are known in pixels of a raster."""
_STRIP = 128
"""Rows of a grid that are interpolated at a time."""
_MERIDIAN = 6371e3
_NEAR_POLE = np.radians(89.9)


def read_elevations(path: Path) -> Dem:
    """Read a whole elevation model: .hgt, .npz, or a raster.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If it is a raster, and rasterio or pyproj is not installed.
    ValueError
        If it cannot be read, is too large, or holds what is no height of the Earth.
    """
    if path.suffix.lower() not in SUFFIXES:
        dem = read_dem(path)
        _require_heights(dem, path)
        return dem
    raster = open_raster(path)
    n = raster.shape[0] * raster.shape[1]
    if n > LARGEST:
        raise ValueError(
            f"'{path}' has {raster.shape[0]} x {raster.shape[1]} points; "
            f"{LARGEST / 1e6:.0f} million are read at once at most\n"
            "  read of it what images need (elevation_map), or cut it (gdal_translate -projwin)"
        )
    if raster.north_up:
        return _cut(raster, slice(0, raster.shape[0]), slice(0, raster.shape[1]))
    rows, columns = (np.linspace(0, k - 1, 9) for k in raster.shape)
    latitude, longitude = raster.places(rows[:, None], columns[None, :])
    return _resampled(raster, latitude, longitude)


def elevations_about(raster: Raster, latitude: float, longitude: float, reach: float) -> Dem:
    """Read the part of an elevation model that lies about a place.

    Parameters
    ----------
    raster : Raster
    latitude, longitude : float
        [rad]
    reach : float
        Half of the side of what is read [m].

    Raises
    ------
    ValueError
        If the raster does not cover the place, or the part is too large.
    """
    lat, lon = square_about(latitude, longitude, reach)
    if not raster.north_up:
        return _resampled(raster, lat, lon)
    return _cut(raster, *raster.window(lat, lon))


def square_about(latitude: float, longitude: float, reach: float) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes [rad] of points (9, 9) in a square of half a side `reach` [m].

    Raises
    ------
    ValueError
        If it holds a pole.
    """
    if abs(latitude) + reach / _MERIDIAN > _NEAR_POLE:
        raise ValueError("a part of a map about a pole is not bounded by longitudes")
    part = np.linspace(-1, 1, 9)
    north = latitude + part * reach / _MERIDIAN
    widest = np.abs(north).max()
    lat, lon = np.meshgrid(
        north, longitude + part * reach / (_MERIDIAN * np.cos(widest)), indexing="ij"
    )
    return np.asarray(lat), np.asarray(lon)


def _cut(raster: Raster, rows: slice, columns: slice) -> Dem:
    """Heights on the raster's own grid, southernmost first."""
    values = _known(raster, rows, columns)
    down = raster.transform[1, 0] < 0
    last = rows.stop - 1 if down else rows.start
    south, west = (float(a) for a in raster.places(last, columns.start))
    steps = np.radians(np.abs([raster.transform[1, 0], raster.transform[0, 1]]))
    height = np.ascontiguousarray(values[::-1] if down else values)
    return _dem(raster, height, south, west, *map(float, steps))


def _resampled(raster: Raster, latitude: FloatArray, longitude: FloatArray) -> Dem:
    """Heights on a grid of latitude and longitude that bounds places (...) [rad]."""
    from scipy.ndimage import map_coordinates

    rows, columns = raster.window(latitude, longitude)
    size = raster.pixel_size((rows.start + rows.stop) / 2, (columns.start + columns.stop) / 2)
    south, north, west, east = (f(a) for a in (latitude, longitude) for f in (np.min, np.max))
    n_lat = int(np.ceil(_MERIDIAN * (north - south) / size)) + 1
    parallel = _MERIDIAN * np.cos((south + north) / 2)
    n_lon = int(np.ceil(parallel * (east - west) / size)) + 1
    if n_lat * n_lon > LARGEST or min(n_lat, n_lon) < 2:
        raise ValueError(f"'{raster.path.name}': {n_lat} x {n_lon} heights cannot be held")
    values = _known(raster, rows, columns)
    at = knots(raster.pixels, (south, north), (west, east), np.full(2, _CLOSE))[2]
    u, w = (np.linspace(0, len(at) - 1, n) for n in (n_lat, n_lon))
    height = np.empty((n_lat, n_lon), np.float32)
    for first in range(0, n_lat, _STRIP):
        places = np.meshgrid(u[first : first + _STRIP], w, indexing="ij")
        pixel = [
            map_coordinates(at[..., k], places, order=1, mode="nearest") - start
            for k, start in ((0, rows.start), (1, columns.start))
        ]
        height[first : first + _STRIP] = map_coordinates(
            values, pixel, order=1, mode="constant", cval=np.nan
        )
    step = (north - south) / (n_lat - 1), (east - west) / (n_lon - 1)
    return _dem(raster, height, south, west, *step)


def _known(raster: Raster, rows: slice, columns: slice) -> Single:
    """Heights of a window, NaN where they are not known."""
    values, known = raster.read(rows, columns)
    values[~known] = np.nan
    return heights_of_the_earth(values, raster.path)


def _dem(
    raster: Raster, height: Single, south: float, west: float, north_step: float, east_step: float
) -> Dem:
    dem = Dem(height, south, west, north_step, east_step, raster.path.name)
    _require_heights(dem, raster.path)
    return replace(dem, datum=raster.vertical, sigma=raster.vertical_sigma)


def _require_heights(dem: Dem, path: Path) -> None:
    if dem.n_void == dem.height.size:
        raise ValueError(f"'{path}' holds nothing but voids where it is read")
