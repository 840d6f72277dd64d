r"""Digital elevation models: the height of the ground on a grid of latitude and longitude.

Between the points of the grid height is bilinear. What heights refer to goes with them: those of
SRTM count from the geoid EGM96. Everything that is computed with heights wants them above the
ellipsoid; `terrafix.models.maps.geoid` turns them to it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray, Single, read_arrays
from terrafix.models.core.formats import kind_of
from terrafix.models.geometry.earth import EARTH

KEYS = ("height_m", "latitude0_deg", "longitude0_deg", "latitude_step_deg", "longitude_step_deg")
"""Arrays in a file of `write_dem`."""
_EPSG = "vertical_epsg"
"""And a number in it that may be absent: what heights refer to."""
JACKSBORO = "jacksboro"
"""Name of the elevation model that comes with matplotlib: 36.3 N, 84.25 W, of SRTM."""

VOIDS = (-32768.0, -32767.0, -9999.0)
"""What files write where no height is known: SRTM, DTED, and most others."""
ELLIPSOID = "ellipsoid"
DATUMS = {ELLIPSOID: 4979, "EGM96": 5773, "EGM2008": 3855}
"""What heights may refer to, and the code of it (EPSG)."""
LOWEST, HIGHEST = -12_000.0, 9_000.0
"""Bounds of the Earth's heights and depths [m]: the Challenger Deep and Everest lie within."""

_SIZES = {1201 * 1201 * 2: 1201, 3601 * 3601 * 2: 3601}


@dataclass(frozen=True, eq=False)
class Dem:
    """Heights on a grid.

    Parameters
    ----------
    height : ndarray of float32, shape (n_latitudes, n_longitudes)
        [m], the southernmost row first; NaN where it is not known (void).
    latitude0, longitude0 : float
        Of the element (0, 0) [rad].
    latitude_step, longitude_step : float
        Between rows and columns [rad], positive.
    name : str
        What messages call it.
    mirrored : bool
        Whether the grid goes on for ever in mirror images of itself: an artificial world without
        seams, and without borders.
    datum : str
        What heights refer to: of `DATUMS`, "EPSG:..." of another vertical system, or empty where
        nothing says it.
    sigma : float
        Standard error of the heights [m], where it is stated; NaN elsewhere.

    Raises
    ------
    ValueError
        If there are fewer than two rows or columns, or a step is not positive.
    """

    height: Single
    latitude0: float
    longitude0: float
    latitude_step: float
    longitude_step: float
    name: str = "the elevation model"
    mirrored: bool = False
    datum: str = ELLIPSOID
    sigma: float = np.nan

    def __post_init__(self) -> None:
        if self.height.ndim != 2 or min(self.height.shape) < 2:
            raise ValueError(f"{self.name} needs rows and columns, got shape {self.height.shape}")
        if not (self.latitude_step > 0 and self.longitude_step > 0):
            raise ValueError(f"{self.name}: its steps in latitude and longitude must be positive")

    def at(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Height [m] at latitudes and longitudes [rad], shape (...).

        Raises
        ------
        ValueError
            If a place is outside, or next to a void.
        """
        h, out = self.height, self._bilinear(latitude, longitude)
        if not np.isfinite(out).all():
            k = int(np.argmin(np.isfinite(out.ravel())))
            lat, lon = (np.broadcast_to(a, out.shape).ravel()[k] for a in (latitude, longitude))
            raise ValueError(
                f"{self.name} is void at {_place(lat, lon)}, and in {self.n_void} of its "
                f"{h.size} points\n  fill its voids by interpolation, or use another"
            )
        return out

    def known_at(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Height [m] at latitudes and longitudes [rad], shape (...); NaN where it is not known."""
        latitude, longitude = np.broadcast_arrays(latitude, longitude)
        out = np.full(latitude.shape, np.nan)
        inside = self.covers(latitude, longitude)
        out[inside] = self._bilinear(latitude[inside], longitude[inside])
        return out

    def _bilinear(self, latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
        """Height [m] between the points of the grid; NaN next to a void."""
        i, j, u, w = self._cell(latitude, longitude)
        h = self.height
        south = h[i, j] * (1 - w) + h[i, j + 1] * w
        north = h[i + 1, j] * (1 - w) + h[i + 1, j + 1] * w
        return np.asarray(south * (1 - u) + north * u)

    def slopes(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Rise to the north and to the east [m/m] at latitudes and longitudes [rad].

        Central differences over two steps of the grid.
        """
        latitude, longitude = np.asarray(latitude), np.asarray(longitude)
        north, east = self.latitude_step, self.longitude_step
        meridian, parallel = 6371e3 * north, 6371e3 * east * np.cos(latitude)
        if self.mirrored:
            ahead, behind = (self.at(latitude + s * north, longitude) for s in (1, -1))
            right, left = (self.at(latitude, longitude + s * east) for s in (1, -1))
            return (ahead - behind) / (2 * meridian), (right - left) / (2 * parallel)
        longitude = longitude - 2 * np.pi * self._turns(longitude)
        lat1, lat0 = (np.clip(latitude + s * north, *self._span(0)) for s in (1, -1))
        lon1, lon0 = (np.clip(longitude + s * east, *self._span(1)) for s in (1, -1))
        rise_n = self.at(lat1, longitude) - self.at(lat0, longitude)
        rise_e = self.at(latitude, lon1) - self.at(latitude, lon0)
        return rise_n / (meridian * (lat1 - lat0) / north), rise_e / (
            parallel * (lon1 - lon0) / east
        )

    def covers(self, latitude: ArrayLike, longitude: ArrayLike) -> NDArray[np.bool_]:
        """Whether places [rad] are inside."""
        if self.mirrored:
            return np.ones(np.broadcast_shapes(np.shape(latitude), np.shape(longitude)), np.bool_)
        y, x = self._coordinates(latitude, longitude)
        n_lat, n_lon = self.height.shape
        return np.asarray((y >= 0) & (y <= n_lat - 1) & (x >= 0) & (x <= n_lon - 1))

    @property
    def n_void(self) -> int:
        """Number of points without a height."""
        return int(np.isnan(self.height).sum())

    def described(self) -> str:
        """What it covers, for messages."""
        if self.mirrored:
            return "everywhere, by mirror images"
        (south, north), (west, east) = (np.degrees(self._span(k)) for k in (0, 1))
        return f"latitude {south:.3f} to {north:.3f}, longitude {west:.3f} to {east:.3f} deg"

    def filled(self) -> Dem:
        """Fill voids by interpolation from their rims.

        Raises
        ------
        ValueError
            If nothing is known at all.
        """
        from scipy.interpolate import griddata

        void = np.isnan(self.height)
        if void.all():
            raise ValueError(f"{self.name} holds nothing but voids")
        if not void.any():
            return self
        from scipy.ndimage import binary_dilation

        rim = binary_dilation(void, iterations=2) & ~void
        known, wanted = np.argwhere(rim), np.argwhere(void)
        values = self.height[rim]
        found = griddata(known, values, wanted, "nearest")
        if len(known) >= 4 and np.ptp(known, axis=0).min() > 0:
            smooth = griddata(known, values, wanted, "linear")
            found = np.where(np.isnan(smooth), found, smooth)
        height = self.height.copy()
        height[void] = found
        return replace(self, height=height)

    def tiled(self) -> Dem:
        """The same, going on for ever in mirror images of itself."""
        return replace(self, mirrored=True, name=f"{self.name}, in mirror images")

    def _span(self, axis: int) -> tuple[float, float]:
        first, step = (
            (self.latitude0, self.latitude_step),
            (self.longitude0, self.longitude_step),
        )[axis]
        return first, first + step * (self.height.shape[axis] - 1)

    def _coordinates(
        self, latitude: ArrayLike, longitude: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Row and column, fractional; the longitude taken within half a turn of the middle."""
        y = (np.asarray(latitude, np.float64) - self.latitude0) / self.latitude_step
        middle = sum(self._span(1)) / 2
        turn = np.asarray(longitude, np.float64) - middle
        turn = turn - 2 * np.pi * self._turns(longitude)
        x = (turn + middle - self.longitude0) / self.longitude_step
        return y, x

    def _turns(self, longitude: ArrayLike) -> FloatArray:
        """Whole turns from the middle of the model to longitudes [rad]."""
        middle = sum(self._span(1)) / 2
        return np.asarray(np.rint((np.asarray(longitude, np.float64) - middle) / (2 * np.pi)))

    def _cell(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[np.ndarray, ...]:
        """Row and column of the cell's southwestern corner, and the place within it."""
        y, x = self._coordinates(latitude, longitude)
        last = tuple(n - 1 for n in self.height.shape)
        if self.mirrored:
            y, x = (np.abs((a + n) % (2 * n) - n) for a, n in zip((y, x), last, strict=True))
        tolerance = 1e-6  # of a step
        inside = (y >= -tolerance) & (y <= last[0] + tolerance)
        inside &= (x >= -tolerance) & (x <= last[1] + tolerance)
        if not np.all(inside):
            k = int(np.argmin(inside.ravel()))
            lat, lon = (np.broadcast_to(a, inside.shape).ravel()[k] for a in (latitude, longitude))
            raise ValueError(
                f"{self.name} does not cover {_place(lat, lon)}\n  it covers {self.described()}"
            )
        i, j = (np.clip(a.astype(np.intp), 0, n - 1) for a, n in zip((y, x), last, strict=True))
        return i, j, np.clip(y - i, 0, 1), np.clip(x - j, 0, 1)


def _place(latitude: float, longitude: float) -> str:
    return f"latitude {np.degrees(latitude):.4f}, longitude {np.degrees(longitude):.4f} deg"


def dem_from(height: Single, grid: ArrayLike) -> Dem:
    """Elevation model on a grid, without copying its heights.

    Parameters
    ----------
    height : ndarray, shape (n, m)
        [m]
    grid : array_like, shape (5,)
        First latitude and longitude, their steps [rad], and whether it is mirrored.
    """
    south, west, north, east, mirrored = (float(g) for g in np.asarray(grid))
    return Dem(height, south, west, north, east, mirrored=bool(mirrored))


def flat_dem(height: float = 0.0) -> Dem:
    """Everywhere the same height [m]: zero is the sea."""
    grid = np.full((2, 2), height, np.float32)
    return Dem(grid, 0.0, 0.0, 1.0, 1.0, "a flat elevation model", mirrored=True)


_HILL_STEP, _HILL_POINTS = 10.0, 512
"""Spacing [m] and number of the heights of rolling hills along each side."""


def rolling_dem(rms: float, length: float, seed: int) -> Dem:
    """Smooth random hills, going on for ever in mirror images: an artificial world.

    White noise of every 10 m, smoothed by a Gaussian, so that heights a distance :math:`d` apart
    correlate by :math:`e^{-(d / L)^2}`. Distances are those at the equator: elsewhere hills are
    narrower from west to east.

    Parameters
    ----------
    rms : float
        Of the heights, whose mean is zero [m].
    length : float
        L [m].
    seed : int

    Raises
    ------
    ValueError
        If hills are narrower than three spacings, or half as wide as the part that is mirrored.
    """
    from scipy.ndimage import gaussian_filter

    least, most = 3 * _HILL_STEP, _HILL_STEP * _HILL_POINTS / 2
    if not least <= length <= most:
        raise ValueError(f"hills are {least:.0f} to {most:.0f} m long, not {length:g} m")
    noise = np.random.default_rng(seed).standard_normal((_HILL_POINTS, _HILL_POINTS))
    smooth = gaussian_filter(noise, length / 2 / _HILL_STEP, mode="wrap")
    smooth -= smooth.mean()
    height = (smooth * (rms / smooth.std())).astype(np.float32)
    step = _HILL_STEP / EARTH.radius
    first = -step * (_HILL_POINTS // 2)
    return Dem(height, first, first, step, step, "rolling hills").tiled()


def roughened(dem: Dem, rms: float, length: float, seed: int) -> Dem:
    """The same with random errors of its heights, on its own points.

    Errors a distance :math:`d` apart correlate by :math:`e^{-(d / L)^2}`; where points lie
    farther apart than L, each has its own.

    Parameters
    ----------
    dem : Dem
    rms : float
        Of the errors, whose mean over all points is zero [m].
    length : float
        L [m].
    seed : int

    Raises
    ------
    ValueError
        If there are too few points within its borders to tell errors of this length.
    """
    from scipy.ndimage import gaussian_filter

    middle = sum(dem._span(0)) / 2
    spacing = np.array([dem.latitude_step, dem.longitude_step * np.cos(middle)]) * EARTH.radius
    if length > 0.5 * float((spacing * dem.height.shape).min()):
        raise ValueError(
            f"errors of heights {length:g} m long do not fit in {dem.name}, which is "
            f"{float((spacing * dem.height.shape).min()):.0f} m wide"
        )
    noise = np.random.default_rng(seed).standard_normal(dem.height.shape)
    errors = gaussian_filter(noise, length / 2 / spacing, mode="mirror")
    errors -= errors.mean()
    errors *= rms / errors.std()
    return replace(dem, height=dem.height + errors.astype(np.float32))


def heights_of_the_earth(raw: NDArray[Any], path: Path) -> Single:
    """Heights as a file holds them, voids as NaN.

    Raises
    ------
    ValueError
        If there is one that the Earth does not have.
    """
    height = np.array(raw, np.float32)
    height[np.isin(height, np.array(VOIDS, np.float32))] = np.nan
    wrong = (height < LOWEST) | (height > HIGHEST)
    if wrong.any():
        i, j = (int(k) for k in np.argwhere(wrong)[0])
        raise ValueError(
            f"'{path}': {int(wrong.sum())} of its {height.size} heights are beyond {LOWEST:.0f} to "
            f"{HIGHEST:.0f} m, the first is {height[i, j]:g} m in row {i}, column {j}\n"
            "  heights are in meters; write NaN where none is known"
        )
    return height


def read_hgt(path: Path) -> Dem:
    """Read a tile of SRTM (.hgt): big-endian 16-bit, 1201 or 3601 square, `VOIDS` where void.

    The name (N44W072) gives its southwestern corner; its first row is the northernmost. Heights are
    above EGM96, by SRTM's definition.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the name holds no place, or the size is none of a tile.
    """
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    found = re.fullmatch(r"([NS])(\d{2})([EW])(\d{3}).*", path.stem.upper())
    if found is None:
        raise ValueError(f"'{path}': its name must give the southwestern corner, as N44W072.hgt")
    size = path.stat().st_size
    if size not in _SIZES:
        kind, cure = kind_of(path)
        raise ValueError(
            f"'{path}' {kind and f'is {kind}, '}has {size} bytes; a tile of SRTM has "
            f"{' or '.join(map(str, _SIZES))}" + (f"\n  {cure}" if kind else "")
        )
    n = _SIZES[size]
    raw = np.fromfile(path, ">i2").reshape(n, n)[::-1]
    height = heights_of_the_earth(raw, path)
    ns, lat, ew, lon = found.groups()
    south = int(lat) * (1 if ns == "N" else -1)
    west = int(lon) * (1 if ew == "E" else -1)
    step = float(np.radians(1 / (n - 1)))
    corner = float(np.radians(south)), float(np.radians(west))
    return Dem(height, *corner, step, step, path.name, datum="EGM96")


def read_jacksboro() -> Dem:
    """Elevation model that comes with matplotlib, 30 x 32 km about 36.3 N, 84.25 W.

    Row 0 of the file is the northernmost and its bounds are those of the outer points' cells. Its
    ``ymax`` is the northern border; its ``ymin`` lies one height of the model *north* of that, by
    a wrong sign, so the southern border is formed from the step: Cross Mountain, the summit, then
    lies at 36.198 N, 84.231 W, where it is. What its heights refer to is not documented; they are
    taken to be above the ellipsoid.
    """
    from matplotlib import cbook

    opened: Any = cbook.get_sample_data("jacksboro_fault_dem.npz")
    with opened:
        arrays = dict(opened)
    height = np.ascontiguousarray(arrays["elevation"][::-1], dtype=np.float32)
    d_lat, d_lon = float(arrays["dy"]), float(arrays["dx"])
    south = float(arrays["ymax"]) - height.shape[0] * d_lat
    return Dem(
        height,
        float(np.radians(south + d_lat / 2)),
        float(np.radians(float(arrays["xmin"]) + d_lon / 2)),
        float(np.radians(d_lat)),
        float(np.radians(d_lon)),
        "the elevation model of Jacksboro",
    )


def write_dem(dem: Dem, path: Path) -> None:
    """Write an elevation model to a file (.npz) that `read_dem` reads."""
    degrees = np.degrees([dem.latitude0, dem.longitude0, dem.latitude_step, dem.longitude_step])
    arrays: dict[str, Any] = dict(zip(KEYS, (dem.height, *degrees), strict=True))
    if dem.datum:
        arrays[_EPSG] = dem_code(dem)
    np.savez(path, **arrays)


def dem_code(dem: Dem) -> int:
    """Code (EPSG) of what heights refer to."""
    return DATUMS.get(dem.datum) or int(dem.datum.removeprefix("EPSG:"))


def _datum(code: int) -> str:
    return next((name for name, c in DATUMS.items() if c == code), f"EPSG:{code}")


def read_dem(path: Path) -> Dem:
    """Read an elevation model: a tile of SRTM (.hgt) or a file of `write_dem` (.npz).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it cannot be read, or holds what is no height of the Earth.
    """
    if path.suffix.lower() == ".hgt":
        return read_hgt(path)
    if path.suffix.lower() != ".npz":
        found, cure = kind_of(path)
        raise ValueError(
            f"'{path}' is no elevation model: a tile of SRTM (.hgt), arrays (.npz), or a raster "
            "(.tif, .dt0, .dt1, .dt2, .vrt)" + (f"\n  it is {found}: {cure}" if found else "")
        )
    arrays = read_arrays(path, KEYS, "an elevation model", (_EPSG,))
    datum = _datum(int(arrays[_EPSG])) if _EPSG in arrays else ""
    try:
        south, west, north, east = (float(np.radians(float(arrays[k]))) for k in KEYS[1:])
        height = heights_of_the_earth(arrays["height_m"], path)
        return Dem(height, south, west, north, east, path.name, datum=datum)
    except (TypeError, ValueError) as error:
        told = str(error)
        raise ValueError(told if str(path) in told else f"'{path}': {told}") from error
