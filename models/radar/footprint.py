"""What a side-looking radar sees: a grid of time and range, and the terrain under it.

Grids are of the time and the slant range at which the beam's center passes a place (broadside for
an unsquinted beam). Terrain is looked up at every few lines and cells and interpolated between.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.geometry.ground import EllipsoidGround, Ground
from terrafix.models.motion.arc import seen_at
from terrafix.models.motion.sampled import Arc
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.scene import Scene, brightness

_COARSE = (16, 4)
"""Lines and cells between the points at which terrain is looked up."""


_CLOSE = 0.05
"""How well the height of the terrain must agree with where it is looked up [m]."""
_HIGHEST = 5000.0
"""Relief about the middle that is allowed for from orbit [m]."""
_SPARE = 20.0
"""Relief that is allowed for beyond what a coarse look finds [m]."""
_WIDEST = float(np.radians(90.0))
"""Longitudes that a footprint may span: beyond, polynomials of them fail [rad]."""
_EARTH = EllipsoidGround()
_ROUNDS = 40
"""Rounds of looking up; layover, where the height has several values, ends without agreement."""


class Footprint:
    """Grid of the places that an acquisition sees, by time and range of the beam's center.

    Parameters
    ----------
    arc : Arc
        Of the radar, an orbit's or a track's; it must reach half an aperture beyond the grid.
    first_time, n_lines, near_range, n_cells
        Of the grid: lines at the repetition frequency, cells at the range spacing.
    radar : Radar
    centroid : float
        Doppler frequency of the beam's center [Hz].
    ground : Ground
        Frame of the arc.
    side : {1, -1}
        To the right of the track, or to the left.
    """

    def __init__(
        self,
        arc: Arc,
        radar: Radar,
        first_time: float,
        n_lines: int,
        near_range: float,
        n_cells: int,
        centroid: float,
        ground: Ground = _EARTH,
        side: int = 1,
    ) -> None:
        self.ground, self.side = ground, side
        self.arc, self.radar, self.centroid = arc, radar, centroid
        self.first_time, self.n_lines = first_time, n_lines
        self.near_range, self.n_cells = near_range, n_cells

    @property
    def middle(self) -> tuple[float, float]:
        """Time [s] and range [m] of the middle of the grid."""
        return (
            self.first_time + (self.n_lines - 1) / 2 / self.radar.prf,
            self.near_range + (self.n_cells - 1) / 2 * self.radar.range_spacing,
        )

    def points(self, t: ArrayLike, slant_range: ArrayLike, height: ArrayLike) -> FloatArray:
        """Points (..., 3) [m] seen at times [s] and ranges [m], at heights [m]."""
        r, v = self.arc.position(t), self.arc.velocity(t)
        sine = self.radar.wavelength * self.centroid / (2 * np.linalg.norm(v, axis=-1))
        return self.ground.seen(r, v, slant_range, sine, height, self.side)

    def place(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Line and cell, fractional, at which points (..., 3) [m] are seen."""
        t, R = seen_at(self.arc, p, self.centroid, self.radar.wavelength)
        line = (t - self.first_time) * self.radar.prf
        return line, (R - self.near_range) / self.radar.range_spacing


class TerrainGrid:
    """Terrain under a footprint, at every few lines and cells.

    Parameters
    ----------
    footprint : Footprint
    scene : Scene

    Attributes
    ----------
    cells : tuple of range
        Cells of the scene's texture that hold the grid, in latitude and longitude.
    latitude, longitude, height : ndarray, shape (n_i, n_j)
        Of the points seen at lines ``16 i`` and cells ``4 j``, [rad] and [m].
    power_db : ndarray, shape (n_i, n_j)
        Brightness of the terrain there, without texture [dB].
    """

    def __init__(self, footprint: Footprint, scene: Scene) -> None:
        self.footprint = footprint
        n_i, n_j = (
            -(-(n - 1) // s) + 1
            for n, s in zip((footprint.n_lines, footprint.n_cells), _COARSE, strict=True)
        )
        radar = footprint.radar
        lines, cells = _COARSE[0] * np.arange(n_i), _COARSE[1] * np.arange(n_j)
        t: FloatArray = np.asarray(footprint.first_time + lines / radar.prf, np.float64)
        R: FloatArray = np.asarray(footprint.near_range + cells * radar.range_spacing, np.float64)
        surface = _Surface(footprint, t[[0, -1]], R[[0, -1]], scene)
        self.latitude, self.longitude, self.height = surface.on(t, R)
        self.power_db = self._power_db(scene, t)
        self._i, self._j = self.latitude / scene.cell, self.longitude / scene.cell
        self.cells = tuple(
            range(int(np.floor(a.min())) - 1, int(np.ceil(a.max())) + 2) for a in (self._i, self._j)
        )
        self._texture = scene.texture(*self.cells)
        inside = [a - own.start for a, own in zip((self._i, self._j), self.cells, strict=True)]
        self._coarse = [a.astype(np.float32) for a in (*inside, self.power_db, self.height)]

    @property
    def ties(self) -> tuple[FloatArray, FloatArray]:
        """Lines and cells of the footprint at which the arrays above hold."""
        n_i, n_j = self.latitude.shape
        return _COARSE[0] * np.arange(n_i, dtype=float), _COARSE[1] * np.arange(n_j, dtype=float)

    def pixels(self, start: int, stop: int) -> tuple[Single, Single]:
        """Mean amplitude and terrain height [m] of every pixel of some lines, (stop - start, n).

        Without bright points and speckle.
        """
        i, j, db, height = (self._interpolated(a, start, stop) for a in self._coarse)
        db += cv2.remap(self._texture, j, i, cv2.INTER_LINEAR)
        db *= np.float32(np.log(10) / 20)
        return np.exp(db, out=db), height

    def _interpolated(self, coarse: Single, start: int, stop: int) -> Single:
        """Linear interpolation of coarse values to all cells of some lines."""
        by_line, by_cell = (1 / step for step in _COARSE)
        places = np.array([[by_cell, 0.0, 0.0], [0.0, by_line, start * by_line]])
        # places are multiples of a 16th, which OpenCV's fixed point holds exactly
        size = (self.footprint.n_cells, stop - start)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        fine = cv2.warpAffine(coarse, places, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(fine)

    def _power_db(self, scene: Scene, t: FloatArray) -> FloatArray:
        p = self.footprint.ground.point(self.latitude, self.longitude, self.height)
        line = self.footprint.arc.position(t)[:, None, :] - p
        line /= np.linalg.norm(line, axis=-1, keepdims=True)
        north, east, down = np.moveaxis(self.footprint.ground.axes(p), -2, 0)
        slope_north, slope_east = scene.dem.slopes(self.latitude, self.longitude)
        normal = -down - slope_north[..., None] * north - slope_east[..., None] * east
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        power = brightness(np.sum(line * normal, axis=-1))
        return 10 * np.log10(np.maximum(power, 1e-6))


class _Surface:
    """Places of a footprint as polynomials of time, range and height, then on the terrain."""

    def __init__(
        self, footprint: Footprint, times: FloatArray, ranges: FloatArray, scene: Scene
    ) -> None:
        self.scene = scene
        t, R = (_nodes(a, 7) for a in (times, ranges))
        middle = footprint.points(np.mean(times), np.mean(ranges), 0.0)
        ground = footprint.ground
        guess = float(scene.dem.at(*ground.geodetic(middle)[:2]))
        above = float(ground.geodetic(footprint.arc.position(np.mean(times)))[2]) - guess
        span = _HIGHEST
        # near the ground, polynomials of height hold over its relief alone
        if above < 10 * _HIGHEST:
            grid = [np.linspace(a[0], a[1], 33) for a in (times, ranges)]
            p = footprint.points(grid[0][:, None], grid[1][None, :], np.array(guess))
            relief = scene.dem.at(*ground.geodetic(p)[:2]) - guess
            span = 1.5 * float(np.abs(relief).max()) + _SPARE
        self.spans = (times, ranges, np.array([guess - span, guess + span]))
        h = _nodes(self.spans[2], 4)
        self.start = guess
        p = footprint.points(t[:, None, None], R[None, :, None], h[None, None, :])
        latitude, longitude, _ = ground.geodetic(p)
        center = float(longitude.flat[0])
        longitude = center + np.angle(np.exp(1j * (longitude - center)))
        if np.ptp(longitude) > _WIDEST:
            raise ValueError(
                f"its footprint lies about a pole: its longitudes span "
                f"{np.degrees(np.ptp(longitude)):.0f} deg, and terrain is a grid of latitude and "
                "longitude\n  fly farther from the pole, or receive fewer lines and cells"
            )
        self.coefficients = [_chebyshev3(a) for a in (latitude, longitude)]

    def on(self, t: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude, longitude [rad] and height [m] of the terrain seen at times and ranges."""
        x, y = (_scaled(a, s) for a, s in zip((t, R), self.spans[:2], strict=True))
        n = len(t) * len(R)
        by_height = [chebyshev.chebgrid2d(x, y, c).reshape(-1, n) for c in self.coefficients]
        h, place = np.full(n, self.start), np.empty((2, n))
        moving, step, missed = np.arange(n), np.ones(n), np.zeros(n)
        for k in range(_ROUNDS):
            z = _scaled(h[moving], self.spans[2])
            place[:, moving] = [chebyshev.chebval(z, c[:, moving], tensor=False) for c in by_height]
            miss = self.scene.dem.at(*place[:, moving]) - h[moving]
            # secant, its slope held to what terrain short of layover can have
            slope = (missed - miss) / step if k else np.ones(n)
            still = np.abs(miss) > _CLOSE
            step = (miss / np.clip(slope, 0.3, 2.5))[still]
            moving, missed = moving[still], miss[still]
            if not len(moving):
                break
            h[moving] += step
        shape = (len(t), len(R))
        return place[0].reshape(shape), place[1].reshape(shape), h.reshape(shape)


def _nodes(span: FloatArray, n: int) -> FloatArray:
    return np.mean(span) + np.ptp(span) / 2 * chebyshev.chebpts1(n)


def _scaled(x: FloatArray, span: FloatArray) -> FloatArray:
    return (x - np.mean(span)) / (np.ptp(span) / 2)


def _chebyshev3(values: FloatArray) -> FloatArray:
    """Coefficients (n_x, n_y, n_z) of the polynomial through values at Chebyshev nodes."""
    for axis, n in enumerate(values.shape):
        inverse = np.linalg.inv(chebyshev.chebvander(chebyshev.chebpts1(n), n - 1))
        values = np.moveaxis(np.tensordot(inverse, values, (1, axis)), 0, axis)
    return values
