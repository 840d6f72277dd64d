"""Georeferenced rasters in files of any size: opened, and read where they are needed.

GeoTIFF, cloud-optimized or not, DTED, and mosaics (VRT) of these, by rasterio; in any coordinate
reference system that PROJ knows, north up or turned. Nothing but the header is read until a window
is. `terrafix.models.maps.geotiff` reads small images in UTM or degrees by Pillow, without these
packages.

Places of pixels are whole at their centers: row 0, column 0 is the middle of the first. Pixels are
not known where the file masks them (nodata, a mask, an alpha band) or holds no number.

References
----------
.. [1] OGC 19-008r4, "OGC GeoTIFF Standard", version 1.1, 2019.
.. [2] MIL-PRF-89020B, "Digital Terrain Elevation Data (DTED)", 2000.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.core.extras import optional
from terrafix.models.core.formats import kind_of

SUFFIXES = {
    **dict.fromkeys((".tif", ".tiff"), "GTiff"),
    **dict.fromkeys((".dt0", ".dt1", ".dt2"), "DTED"),
    ".vrt": "VRT",
}
"""How names of files end, and what reads them."""
LARGEST = 64_000_000
"""Pixels of a window that are held at most: 256 MB."""
_CACHE = 64 * 2**20
"""Of GDAL, for blocks that are read again [bytes]."""
_STRIP = 4_000_000
"""Pixels that are averaged at a time."""
_WORST = 5.0
"""Accuracy of a change of horizontal datum, at most [m]."""
_METERS = ("", "m", "metre", "metres", "meter", "meters")
_SEEN = 0.5
"""Share of a block of pixels that must be known, for its mean to be."""
_EDGE, _MOST_KNOTS = 9, 257
_FULL_TURN = 359.999
"""Degrees of longitude from which on a raster goes around the Earth."""

Known = NDArray[np.bool_]
"""Whether pixels are known."""


@dataclass(frozen=True, eq=False)
class Raster:
    """A georeferenced raster of one band.

    Parameters
    ----------
    path : Path
    shape : (int, int)
        Rows and columns.
    transform : ndarray, shape (2, 3)
        From (row, column, 1) to the coordinates x, y of `crs`, in its units.
    crs : str
        Horizontal coordinate reference system, as WKT.
    vertical : str
        What heights refer to as the file says: "ellipsoid", "EGM96", "EGM2008", "EPSG:..." of
        another system; empty if it says nothing.
    vertical_sigma : float
        Standard error of heights [m] that the file states; NaN if it states none.
    scale, offset : float
        Values are these times what is stored, and plus that.
    """

    path: Path
    shape: tuple[int, int]
    transform: FloatArray
    crs: str
    vertical: str = ""
    vertical_sigma: float = np.nan
    scale: float = 1.0
    offset: float = 0.0

    def places(self, rows: ArrayLike, columns: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude [rad], WGS-84, of pixels, fractional, shape (...).

        Longitudes go on across 180 degrees from that of the first pixel asked for.
        """
        rows, columns = np.broadcast_arrays(
            np.asarray(rows, np.float64), np.asarray(columns, np.float64)
        )
        x, y = (c[0] * rows + c[1] * columns + c[2] for c in self.transform)
        if not self._plain:
            x, y = self._transformer.transform(x, y)
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError(f"'{self.path}': PROJ finds no latitude and longitude of its pixels")
        longitude = np.radians(x)
        first = longitude.flat[0]
        longitude = longitude - 2 * np.pi * np.rint((longitude - first) / (2 * np.pi))
        return np.asarray(np.radians(y)), np.asarray(longitude)

    def pixels(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Row and column, fractional, of places [rad] of WGS-84, (...); NaN if there is none.

        Longitudes that go on across 180 degrees give columns that go on.
        """
        y, x = np.broadcast_arrays(np.degrees(latitude), np.degrees(longitude))
        if self._plain:
            middle = self.transform[0] @ [(self.shape[0] - 1) / 2, (self.shape[1] - 1) / 2, 1]
            x = x - 360 * np.rint((x.mean() - middle) / 360)
        else:
            x, y = self._transformer.transform(x, y, direction="INVERSE")
        known = np.isfinite(x) & np.isfinite(y)
        at = np.stack([np.where(known, x, np.nan), np.where(known, y, np.nan)], axis=-1)
        pixel = (at - self.transform[:, 2]) @ np.linalg.inv(self.transform[:, :2]).T
        return pixel[..., 0], pixel[..., 1]

    def window(
        self, latitude: FloatArray, longitude: FloatArray, margin: int = 2
    ) -> tuple[slice, slice]:
        """Rows and columns that hold places [rad], with a margin, within the raster.

        Raises
        ------
        ValueError
            If it holds none of them.
        """
        rows, columns = self.pixels(latitude, longitude)
        bounds = []
        for at, n, around in ((rows, self.shape[0], 0), (columns, self.shape[1], self.turn)):
            if not np.isfinite(at).any():
                break
            low, high = int(np.floor(np.nanmin(at))) - margin, int(np.ceil(np.nanmax(at))) + margin
            if not around:
                low, high = max(low, 0), min(high, n - 1)
            if low >= high:
                break
            bounds.append(slice(low, high + 1))
        if len(bounds) < 2:
            north, east = (float(np.degrees(np.mean(a))) for a in (latitude, longitude))
            raise ValueError(
                f"'{self.path.name}' does not cover latitude {north:.3f}, longitude {east:.3f} deg"
                f"\n  it covers {self.described()}"
            )
        return bounds[0], bounds[1]

    def read(self, rows: slice, columns: slice, step: int = 1) -> tuple[Single, Known]:
        """Values of a window, and whether they are known; those that are not are zero.

        Overviews are not used, as nothing says how they were made.

        Parameters
        ----------
        rows, columns : slice
            Columns may go on beyond the raster where it goes around the Earth.
        step : int
            Side of blocks of which the root of the mean square is taken, of what is known, where
            half of a block is: what averaging power does to amplitudes. What is left of a block at
            the end is dropped.

        Raises
        ------
        ValueError
            If the window is larger than `LARGEST`, or the file is damaged.
        """
        n = (rows.stop - rows.start) // step, (columns.stop - columns.start) // step
        if n[0] * n[1] > LARGEST:
            raise ValueError(
                f"'{self.path.name}': a window of {n[0]} x {n[1]} pixels is too large; "
                f"{LARGEST / 1e6:.0f} million are held at most"
            )
        values, known = np.zeros(n, np.float32), np.zeros(n, np.bool_)
        strip = max(1, _STRIP // max(1, n[1] * step * step))
        with opened(self.path) as dataset:
            for first in range(0, n[0], strip):
                part = slice(first, min(first + strip, n[0]))
                lines = slice(rows.start + part.start * step, rows.start + part.stop * step)
                raw, there = self._raw(dataset, lines, columns.start, n[1] * step)
                if step > 1:
                    raw, there = _root_mean_square(raw, there, step)
                values[part], known[part] = np.where(there, raw, 0), there
        return values, known

    def described(self) -> str:
        """What it covers, for messages."""
        rows, columns = (np.linspace(-0.5, n - 0.5, _EDGE) for n in self.shape)
        latitude, longitude = self.places(rows[:, None], columns[None, :])
        south, north, west, east = (
            np.degrees(f(a)) for a in (latitude, longitude) for f in (np.min, np.max)
        )
        return f"latitude {south:.3f} to {north:.3f}, longitude {west:.3f} to {east:.3f} deg"

    def pixel_size(self, row: float, column: float) -> float:
        """Square root of the area of a pixel on the ground [m], at a pixel."""
        latitude, longitude = self.places([row, row + 1, row], [column, column, column + 1])
        north = 6371e3 * np.diff(latitude[[0, 1, 0, 2]])[::2]
        east = 6371e3 * np.cos(latitude[0]) * np.diff(longitude[[0, 1, 0, 2]])[::2]
        return float(np.sqrt(abs(north[0] * east[1] - north[1] * east[0])))

    @property
    def north_up(self) -> bool:
        """Whether rows run along parallels of WGS-84 and columns along meridians, eastward."""
        (x_row, x_column, _), (_, y_column, _) = self.transform
        return self._plain and x_row == 0 and y_column == 0 and x_column > 0

    @property
    def turn(self) -> int:
        """Columns around the Earth; 0 where it does not go around."""
        step = float(self.transform[0, 1])
        if not self.north_up or step * self.shape[1] < _FULL_TURN:
            return 0
        return round(360 / step)

    @property
    def _plain(self) -> bool:
        """Whether its coordinates are degrees of WGS-84."""
        return self.crs == ""

    @cached_property
    def _transformer(self) -> Any:
        """From its coordinates to longitude and latitude [deg] of WGS-84."""
        pyproj = _pyproj()
        from_crs, to = pyproj.CRS.from_user_input(self.crs), "EPSG:4326"
        rough = pyproj.Transformer.from_crs(from_crs, to, always_xy=True)
        corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * (np.array(self.shape) - 1)
        x, y = (np.column_stack([corners, np.ones(4)]) @ c for c in self.transform)
        east, north = rough.transform(x, y)
        area = None
        if np.isfinite(east).all() and np.isfinite(north).all() and np.ptp(east) < 180:
            area = pyproj.transformer.AreaOfInterest(
                float(np.min(east)), float(np.min(north)), float(np.max(east)), float(np.max(north))
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what is unavailable: told here
            group = pyproj.transformer.TransformerGroup(
                from_crs, to, always_xy=True, allow_ballpark=False, area_of_interest=area
            )
        if group.transformers and 0 <= group.transformers[0].accuracy <= _WORST:
            return group.transformers[0]
        error = (
            f"with an error of {group.transformers[0].accuracy:g} m"
            if group.transformers
            else "by no way that it knows"
        )
        missing = [g.short_name for o in group.unavailable_operations[:1] for g in o.grids]
        fetch = f"fetch its grid (projsync --file): {', '.join(missing)}; or " if missing else ""
        raise ValueError(
            f"'{self.path}' is in {from_crs.name}, which PROJ turns to WGS-84 {error}; at most "
            f"{_WORST:g} m are taken\n  {fetch}warp it to WGS-84 (gdalwarp -t_srs EPSG:4326) where "
            "its grid is"
        )

    def _raw(
        self, dataset: Any, rows: slice, first_column: int, n_columns: int
    ) -> tuple[Single, Known]:
        """A window as it is stored, around the Earth where it goes on there."""
        parts, column, left = [], first_column, n_columns
        while left:
            start = column % self.turn if self.turn else column
            n = min(left, self.shape[1] - start)
            parts.append(self._stored(dataset, rows, start, n))
            column, left = column + n, left - n
        values, known = (np.concatenate(p, axis=1) for p in zip(*parts, strict=True))
        return values, known

    def _stored(self, dataset: Any, rows: slice, column: int, n: int) -> tuple[Single, Known]:
        rasterio = _rasterio()
        window = rasterio.windows.Window(column, rows.start, n, rows.stop - rows.start)
        try:
            raw = dataset.read(1, window=window)
            known = dataset.read_masks(1, window=window) > 0
            if dataset.count == 2:  # alpha, of which masks are made where it is of integers alone
                known &= dataset.read(2, window=window) > 0
        except rasterio.errors.RasterioError as error:
            raise ValueError(f"'{self.path}' is damaged: {error}") from error
        values = raw.astype(np.float32)
        if (self.scale, self.offset) != (1.0, 0.0):
            values = values * np.float32(self.scale) + np.float32(self.offset)
        return values, known & np.isfinite(values)


def _root_mean_square(values: Single, known: Known, step: int) -> tuple[Single, Known]:
    """Root of the mean square of what is known in blocks, and whether enough is."""
    n = values.shape[0] // step, values.shape[1] // step
    power = np.where(known, values, 0).astype(np.float64) ** 2
    blocks = (n[0], step, n[1], step)
    total, count = power.reshape(blocks).sum(axis=(1, 3)), known.reshape(blocks).sum(axis=(1, 3))
    return (
        np.sqrt(total / np.maximum(count, 1)).astype(np.float32),
        count >= _SEEN * step * step,
    )


def open_raster(path: Path) -> Raster:
    """Open a raster: GeoTIFF, DTED, or a mosaic (VRT).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If rasterio or pyproj is not installed.
    ValueError
        If it is no raster of one band of real numbers, or nothing says where it lies.
    """
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    with opened(path) as dataset:
        _check_band(dataset, path)
        crs, vertical = _systems(dataset, path)
        tags = dataset.tags()
        a, b, c, d, e, f = tuple(dataset.transform)[:6]
        # from (row, column) at centers, where the transform is of corners
        transform = np.array([[b, a, c + (a + b) / 2], [e, d, f + (d + e) / 2]])
        if abs(a * e - b * d) < 1e-30:
            raise ValueError(f"'{path}': its transform puts all pixels on a line")
        return Raster(
            path,
            (dataset.height, dataset.width),
            transform,
            crs,
            *_heights(vertical, tags),
            float(dataset.scales[0]),
            float(dataset.offsets[0]),
        )


def _heights(vertical: str, tags: dict[str, str]) -> tuple[str, float]:
    """What heights refer to, and how well they are known, where a header of DTED says so."""
    if tags.get("DTED_VerticalDatum") == "E96":
        vertical = "EGM96"
    accuracy = tags.get("DTED_VerticalAccuracy_ACC") or tags.get("DTED_VerticalAccuracy_UHL") or ""
    stated = float(accuracy) if accuracy.strip().isdigit() else np.nan
    return vertical, stated / 1.6449  # nine in ten errors are smaller


def _check_band(dataset: Any, path: Path) -> None:
    """Refuse what is no band of real numbers."""
    colors = [c.name for c in dataset.colorinterp]
    bands = [c for c in colors if c != "alpha"]
    if len(bands) != 1 or colors[0] == "alpha":
        raise ValueError(
            f"'{path}' has {len(bands)} bands ({', '.join(bands)}); a map is one of them\n"
            "  write one to a file of its own: gdal_translate -b 1"
        )
    if bands[0] == "palette":
        raise ValueError(
            f"'{path}' is a picture: its pixels are numbers of colors\n  use the data that it shows"
        )
    if dataset.dtypes[0].startswith("complex"):
        raise ValueError(
            f"'{path}' is complex, in the geometry of its radar\n"
            "  if it is Sentinel-1's, name its annotation, too; else detect and geocode it"
        )
    unit = (dataset.units[0] or "").strip().lower()
    if unit not in _METERS:
        raise ValueError(f"'{path}' is in '{unit}', not in meters\n  convert it")


def _systems(dataset: Any, path: Path) -> tuple[str, str]:
    """Horizontal system as WKT, empty for degrees of WGS-84, and what heights refer to."""
    if dataset.crs is None or dataset.transform.is_identity:
        if dataset.gcps[0]:
            raise ValueError(
                f"'{path}' has no georeference but control points\n  if it is Sentinel-1's, name "
                "its annotation, too; else warp it (gdalwarp -t_srs EPSG:4326)"
            )
        raise ValueError(
            f"'{path}' has no georeference: nothing says where its pixels lie\n  use a GeoTIFF, or "
            "give it its place (gdal_translate -a_srs ... -a_ullr ...)"
        )
    pyproj = _pyproj()
    try:
        crs = pyproj.CRS.from_wkt(dataset.crs.to_wkt())
    except pyproj.exceptions.CRSError as error:
        raise ValueError(f"'{path}': its coordinate reference system is not known") from error
    vertical = ""
    if crs.is_compound:
        crs, upward = crs.sub_crs_list
        vertical = _vertical(upward, path)
    elif len(crs.axis_info) == 3:
        vertical, crs = "ellipsoid", crs.to_2d()
    if not (crs.is_geographic or crs.is_projected):
        raise ValueError(
            f"'{path}' is in '{crs.name}', which is no place on Earth\n"
            "  say what it is: gdal_translate -a_srs EPSG:..."
        )
    return ("" if crs.to_epsg() == 4326 else crs.to_wkt()), vertical


def _vertical(upward: Any, path: Path) -> str:
    if upward.axis_info[0].unit_name not in _METERS:
        raise ValueError(
            f"'{path}': its heights ({upward.name}) are in {upward.axis_info[0].unit_name}, not in "
            "meters\n  convert it"
        )
    code = upward.to_epsg()
    names = {5773: "EGM96", 3855: "EGM2008"}
    return names.get(code, f"EPSG:{code}" if code else "")


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A file as a dataset of rasterio, open meanwhile.

    Raises
    ------
    ValueError
        If it is no raster; the message says what it is.
    """
    rasterio = _rasterio()
    _pyproj()
    driver = SUFFIXES.get(path.suffix.lower())
    if driver is None:
        found, _ = kind_of(path)
        raise ValueError(
            f"'{path}' is no raster that is read ({', '.join(SUFFIXES)})"
            + (f": it is {found}" if found else "")
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with (
                # heights of GeoTIFF 1.0 have a reference, too
                rasterio.Env(GTIFF_REPORT_COMPD_CS="YES", GDAL_CACHEMAX=_CACHE),
                rasterio.open(path, driver=driver) as dataset,
            ):
                yield dataset
    except rasterio.errors.RasterioIOError as error:
        found, _ = kind_of(path)
        raise ValueError(
            f"'{path}' cannot be read as {driver}: " + (f"it is {found}" if found else str(error))
        ) from error


def _rasterio() -> Any:
    for name in ("rasterio.windows", "rasterio.errors"):
        optional(name, "a map in a GeoTIFF", extra="sar")
    return optional("rasterio", "a map in a GeoTIFF", extra="sar")


def _pyproj() -> Any:
    optional("pyproj.transformer", "a map in a GeoTIFF", extra="sar")
    return optional("pyproj", "a map in a GeoTIFF", extra="sar")


Place = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def knots(
    place: Place, rows: tuple[float, float], columns: tuple[float, float], error: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Knots between which a map of the plane is bilinear to within an error.

    Parameters
    ----------
    place : callable
        Two (n, m) of rows (n, 1) and columns (1, m).
    rows, columns : (float, float)
        First and last.
    error : ndarray, shape (2,)
        Allowed of each of the two; measured at the middles between knots, where that of a smooth
        map is largest.

    Returns
    -------
    rows, columns : ndarray, shape (n,)
    values : ndarray, shape (n, n, 2)

    Raises
    ------
    ValueError
        If 257 knots along each axis do not do.
    """

    def at(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        i, j = np.linspace(*rows, n), np.linspace(*columns, n)
        return i, j, np.stack(place(i[:, None], j[None, :]), axis=-1)

    n = 3
    i, j, fine = at(n)
    while n <= 2 * _MOST_KNOTS:
        coarse = fine[::2, ::2]
        found = np.empty_like(fine)
        found[::2, ::2] = coarse
        found[1::2, ::2] = (coarse[1:] + coarse[:-1]) / 2
        found[:, 1::2] = (found[:, 2::2] + found[:, :-1:2]) / 2
        if (np.abs(found - fine).max(axis=(0, 1)) <= error).all():
            return i[::2], j[::2], coarse
        n = 2 * n - 1
        i, j, fine = at(n)
    raise ValueError("its places change too fast from pixel to pixel: does it lie about a pole?")
