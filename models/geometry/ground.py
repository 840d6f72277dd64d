r"""The ground under an aircraft: the real ellipsoid, or a flat Earth, on the same functions.

A ground is a frame in which tracks and places are given, together with the map from latitude,
longitude and height. `EllipsoidGround` is Earth-fixed (WGS-84). `FlatGround` is the flat,
non-rotating Earth of the aircraft paper: north, east, down of a place, in which

.. math:: n = M (\varphi - \varphi_0), \qquad e = N \cos\varphi_0 (\lambda - \lambda_0),
          \qquad d = -h ,

with the ellipsoid's radii of curvature :math:`M` and :math:`N` at :math:`\varphi_0`, as everywhere
where a flat Earth is read on a map (`terrafix.models.maps.charts`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.geodesy import chart_scales, ecef, geodetic, local_axes
from terrafix.models.geometry.geolocation import Height, ground_point

_ROUNDS, _CLOSE = 50, 1e-3


class Ground(Protocol):
    """A frame of tracks and places."""

    def geodetic(self, p: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, longitude [rad] and height [m] of points (..., 3) [m]."""

    def point(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> FloatArray:
        """Points (..., 3) [m] at latitudes, longitudes [rad] and heights [m]."""

    def axes(self, p: ArrayLike) -> FloatArray:
        """Rows north, east, down at points (..., 3): shape (..., 3, 3)."""

    def seen(
        self,
        r: ArrayLike,
        v: ArrayLike,
        slant_range: ArrayLike,
        sine: ArrayLike,
        height: ArrayLike,
        side: int = 1,
    ) -> FloatArray:
        """Points at heights seen at ranges and sines ahead of broadside.

        To the right (side 1) or to the left (-1) of the track; otherwise as
        `terrafix.models.geometry.geolocation.ground_point`.
        """


class EllipsoidGround:
    """WGS-84, Earth-fixed."""

    def geodetic(self, p: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, longitude [rad] and height [m] of points (..., 3) [m]."""
        return geodetic(p)

    def point(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> FloatArray:
        """Points (..., 3) [m] at latitudes, longitudes [rad] and heights [m]."""
        return ecef(latitude, longitude, height)

    def axes(self, p: ArrayLike) -> FloatArray:
        """Rows north, east, down at points (..., 3): shape (..., 3, 3)."""
        east, north, up = np.moveaxis(local_axes(p), -2, 0)
        return np.stack([north, east, -up], axis=-2)

    def seen(
        self,
        r: ArrayLike,
        v: ArrayLike,
        slant_range: ArrayLike,
        sine: ArrayLike,
        height: ArrayLike,
        side: int = 1,
    ) -> FloatArray:
        """Points at heights seen at ranges and sines ahead of broadside."""
        return ground_point(r, v, slant_range, sine, height, side)


@dataclass(frozen=True)
class FlatGround:
    """A flat Earth: north, east, down of a place.

    Parameters
    ----------
    latitude, longitude : float
        Of the origin [rad].
    """

    latitude: float = 0.0
    longitude: float = 0.0

    @property
    def _scales(self) -> tuple[float, float]:
        """Meters for a radian of latitude, and of longitude."""
        north, east = chart_scales(self.latitude)
        return float(north), float(east)

    def geodetic(self, p: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, longitude [rad] and height [m] of points (..., 3) [m]."""
        n, e, d = np.moveaxis(np.asarray(p, np.float64), -1, 0)
        north, east = self._scales
        return self.latitude + n / north, self.longitude + e / east, -d

    def point(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> FloatArray:
        """Points (..., 3) [m] at latitudes, longitudes [rad] and heights [m]."""
        latitude, longitude, height = np.broadcast_arrays(latitude, longitude, height)
        north, east = self._scales
        n, e = north * (latitude - self.latitude), east * (longitude - self.longitude)
        return np.stack([n, e, -height], axis=-1)

    def axes(self, p: ArrayLike) -> FloatArray:
        """Rows north, east, down at points (..., 3): shape (..., 3, 3)."""
        return np.broadcast_to(np.eye(3), (*np.shape(p), 3))

    def seen(
        self,
        r: ArrayLike,
        v: ArrayLike,
        slant_range: ArrayLike,
        sine: ArrayLike,
        height: ArrayLike,
        side: int = 1,
    ) -> FloatArray:
        """Points at heights seen at ranges and sines ahead of broadside."""
        r, v, R, s, h = (np.asarray(a, np.float64) for a in (r, v, slant_range, sine, height))
        ahead = v / np.linalg.norm(v, axis=-1, keepdims=True)
        down = np.array([0.0, 0.0, 1.0]) - ahead * ahead[..., 2:]
        down /= np.linalg.norm(down, axis=-1, keepdims=True)
        right = side * np.cross(down, ahead)
        across = R * np.sqrt(1 - s * s)
        cosine = (-h - r[..., 2] - R * s * ahead[..., 2]) / (across * down[..., 2])
        if not np.all(np.abs(cosine) < 1):
            raise ValueError(
                f"slant ranges of {R.min():.0f} to {R.max():.0f} m do not all reach the ground"
            )
        look = np.arccos(cosine)
        direction = np.cos(look)[..., None] * down + np.sin(look)[..., None] * right
        return np.asarray(r + (R * s)[..., None] * ahead + across[..., None] * direction)


def seen_on_terrain(
    ground: Ground,
    r: ArrayLike,
    v: ArrayLike,
    slant_range: ArrayLike,
    sine: ArrayLike,
    terrain: Height,
    side: int = 1,
) -> FloatArray:
    """Points of a terrain seen at ranges [m] and sines ahead of broadside, (..., 3) [m].

    Where slopes facing the radar are steeper than its view (layover) several points share a
    pixel, and one of them is found.
    """
    h = np.asarray(0.0)
    for k in range(_ROUNDS):
        p = ground.seen(r, v, slant_range, sine, h, side)
        latitude, longitude, _ = ground.geodetic(p)
        found = terrain(latitude, longitude)
        if np.abs(found - h).max(initial=0.0) < _CLOSE:
            break
        h = found if k == 0 else h + 0.7 * (found - h)
    return p
