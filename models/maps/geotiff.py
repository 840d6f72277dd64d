"""Georeferenced images (GeoTIFF): pixels, and where each lies, in UTM or in degrees of WGS-84.

Pixels are read by Pillow; of the keys of a georeference those are understood that a satellite image
needs: one origin, one spacing, and the code of its projection.

References
----------
.. [1] OGC 19-008r4, "OGC GeoTIFF Standard", version 1.1, 2019.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.utm import SOUTH, utm_from_geodetic

_SCALE, _TIE, _KEYS = 33550, 33922, 34735
_MODEL, _GEOGRAPHIC, _PROJECTED = 1024, 2048, 3072
_POINT, _PIXEL_IS = 2, 1025
_WGS84 = 4326
_STEP = 1e-5
"""Of finite differences of latitude and longitude [rad]: 64 m."""


@dataclass(frozen=True, eq=False)
class GeoImage:
    """An image of the ground, and where it lies.

    Parameters
    ----------
    pixels : ndarray of float32, shape (rows, columns)
    west, north : float
        Of the middle of its first pixel: [m] in the zone, or [rad].
    spacing : (float, float)
        Southward from row to row, and eastward from column to column, in the same unit.
    zone : int
        Of UTM; 0: latitude and longitude.
    name : str
        For messages.

    Raises
    ------
    ValueError
        If it is no image, or the date line lies in it.
    """

    pixels: Single
    west: float
    north: float
    spacing: tuple[float, float]
    zone: int
    name: str

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2:
            raise ValueError(f"'{self.name}' is no image of one band: shape {self.pixels.shape}")
        if self._has_date_line():
            raise ValueError(
                f"the date line lies inside the map '{self.name}'\n"
                "  cut it at 180 degrees, and use the part that the target lies in"
            )

    def _has_date_line(self) -> bool:
        east = self.west + self.spacing[1] * (self.pixels.shape[1] - 1)
        if self.zone == 0:
            return self.west < -np.pi or east > np.pi
        if self.zone not in (1, 60):
            return False
        middle = self.north - self.spacing[0] * self.pixels.shape[0] / 2
        latitude = middle / EARTH.radius  # to the percent that a border needs
        border, _ = utm_from_geodetic(latitude, np.pi if self.zone == 60 else -np.pi, self.zone)
        return bool(self.west < float(border) < east)

    def pixel(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Column and row, fractional, of places [rad], two (...)."""
        if self.zone:
            x, y = utm_from_geodetic(latitude, longitude, self.zone)
        else:
            x, y = np.asarray(longitude, np.float64), np.asarray(latitude, np.float64)
        return (
            np.asarray((x - self.west) / self.spacing[1]),
            np.asarray((self.north - y) / self.spacing[0]),
        )

    def grid(self, latitude: float, longitude: float) -> FloatArray:
        """Columns and rows by meters north and east about a place [rad]: (2, 2) [px/m]."""
        w = 1 - EARTH.flattening * (2 - EARTH.flattening) * np.sin(latitude) ** 2
        normal = EARTH.radius / np.sqrt(w)
        meridian = normal * (1 - EARTH.flattening) ** 2 / w
        off = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * _STEP
        column, row = self.pixel(latitude + off[:, 0], longitude + off[:, 1])
        at = np.stack([column, row])
        meters = 2 * _STEP * np.array([meridian, normal * np.cos(latitude)])
        return np.asarray((at[:, ::2] - at[:, 1::2]) / meters)


def read_geotiff(path: Path) -> GeoImage:
    """Read an image of one band with its georeference.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no such image, has no georeference, or one that is not understood.
    """
    pixels, tags = _opened(path)
    if not {_SCALE, _TIE, _KEYS} <= set(tags):
        raise ValueError(
            f"the map '{path}' has no georeference: nothing says where its pixels lie\n"
            "  use a GeoTIFF in UTM or in degrees of WGS-84; or take it for a texture alone"
        )
    words = [int(k) for k in tags[_KEYS]]
    keys = {words[k]: words[k + 3] for k in range(4, len(words), 4) if words[k + 1] == 0}
    zone, south = _zone(keys, path)
    unit = 1.0 if zone else np.pi / 180
    (column, row), (x, y) = tags[_TIE][:2], tags[_TIE][3:5]
    dx, dy = (float(s) * unit for s in tags[_SCALE][:2])
    half = 0.0 if keys.get(_PIXEL_IS) == _POINT else 0.5
    west = float(x) * unit + (half - column) * dx
    north = float(y) * unit - (half - row) * dy - (SOUTH if south else 0.0)
    return GeoImage(pixels, west, north, (dy, dx), zone, path.name)


def read_texture(path: Path) -> Single:
    """Pixels (rows, columns) of an image of one band, wherever it lies.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no such image.
    """
    pixels, _ = _opened(path)
    if pixels.ndim != 2:
        raise ValueError(f"'{path.name}' is no image of one band: shape {pixels.shape}")
    return pixels


def _opened(path: Path) -> tuple[Single, dict[int, Any]]:
    """Pixels and tags of a file."""
    from PIL import Image, UnidentifiedImageError

    if not path.is_file():
        raise FileNotFoundError(f"'{path}': no such file")
    try:
        with Image.open(path) as image:
            return np.asarray(image, np.float32), dict(getattr(image, "tag_v2", {}))
    except UnidentifiedImageError as error:
        raise ValueError(f"'{path}' is no image that can be read (.tif)") from error
    except Image.DecompressionBombError as error:
        raise ValueError(f"'{path}' is too large\n  cut out the part about the target") from error


def _zone(keys: dict[int, int], path: Path) -> tuple[int, bool]:
    """Zone of UTM, and whether it is of the south; 0 of latitude and longitude."""
    code = keys.get(_PROJECTED, 0)
    if 32601 <= code <= 32660:
        return code - 32600, False
    if 32701 <= code <= 32760:
        return code - 32700, True
    if keys.get(_MODEL) == 2 and keys.get(_GEOGRAPHIC) == _WGS84:
        return 0, False
    raise ValueError(
        f"the map '{path}' is in a projection of code {code or keys.get(_GEOGRAPHIC)}; understood "
        "are UTM and degrees of WGS-84\n  warp it to one of these"
    )
