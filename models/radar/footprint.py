"""What a side-looking radar sees: a grid of time and range, and the terrain under it.

Grids are of the time and the slant range at which the beam's center passes a place (broadside for
an unsquinted beam). Terrain is looked up at every few lines and cells and interpolated between.
Where slopes are so steep that cells show several places, or places are hidden, it is looked up
along lines outward instead (`terrafix.models.radar.relief`).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.core.parallel import batches, over
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.ground import EllipsoidGround, Ground
from terrafix.models.motion.arc import seen_at
from terrafix.models.motion.sampled import Arc
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.relief import crossings, folded_share, seen
from terrafix.models.radar.scene import Scene, brightness

COARSE = (16, 4)
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
_STEEP = 0.25
"""Sine of the angle between view and slope, or cosine of that of incidence, below which lines are
looked at: slopes between points of an elevation model are up to twice those over two steps."""
_FEW = 1e-4
"""Share of the samples of terrain that are folded or hidden, below which they do not show."""
_SOME = 4
"""Of so many lines one is looked at for folds, before all are."""
_PLACES = 4
"""Places that share a cell, at most: those farther out are left out."""
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
    coarse : ndarray of float32, shape (4, n_i, n_j)
        Row and column of the texture there, brightness and height.
    texture : ndarray of float32
        Texture of the cells [dB].
    """

    def __init__(self, footprint: Footprint, scene: Scene) -> None:
        self.footprint = footprint
        n_i, n_j = (
            -(-(n - 1) // s) + 1
            for n, s in zip((footprint.n_lines, footprint.n_cells), COARSE, strict=True)
        )
        radar = footprint.radar
        lines, cells = COARSE[0] * np.arange(n_i), COARSE[1] * np.arange(n_j)
        t: FloatArray = np.asarray(footprint.first_time + lines / radar.prf, np.float64)
        R: FloatArray = np.asarray(footprint.near_range + cells * radar.range_spacing, np.float64)
        surface = _Surface(footprint, t[[0, -1]], R[[0, -1]], scene)
        self.latitude, self.longitude, self.height, self.power_db = np.empty((4, n_i, n_j))
        steep = np.zeros(n_i, np.bool_)

        def look_up(rows: slice) -> None:
            own = surface.on(t[rows], R)
            self.latitude[rows], self.longitude[rows], self.height[rows] = own
            self.power_db[rows], steep[rows] = self._power_db(scene, t[rows], *own)

        over(batches(n_i), look_up)
        self._relief: _Relief | None = None
        if steep.any() and _Relief(footprint, scene, t[::_SOME], R, self.height).folded:
            self._relief = _Relief(footprint, scene, t, R, self.height)
        self._i, self._j = self.latitude / scene.cell, self.longitude / scene.cell
        self.cells = tuple(
            range(int(np.floor(a.min())) - 1, int(np.ceil(a.max())) + 2) for a in (self._i, self._j)
        )
        if self._relief is not None:
            self.cells = self._relief.cells(scene.cell, self.cells)
        self.texture = scene.texture(*self.cells)
        inside = [a - own.start for a, own in zip((self._i, self._j), self.cells, strict=True)]
        self.coarse = np.array([*inside, self.power_db, self.height], np.float32)
        self._layers: list[list[Single]] = []
        if self._relief is not None:
            self._layers = [
                [
                    (layer[0] / scene.cell - self.cells[0].start).astype(np.float32),
                    (layer[1] / scene.cell - self.cells[1].start).astype(np.float32),
                    *(a.astype(np.float32) for a in layer[2:]),
                ]
                for layer in self._relief.layers()
            ]

    @property
    def folded(self) -> bool:
        """Whether cells show several places, or places are hidden: `coarse` is not all then."""
        return bool(self._layers)

    @property
    def ties(self) -> tuple[FloatArray, FloatArray]:
        """Lines and cells of the footprint at which the arrays above hold."""
        n_i, n_j = self.latitude.shape
        return COARSE[0] * np.arange(n_i, dtype=float), COARSE[1] * np.arange(n_j, dtype=float)

    def pixels(self, start: int, stop: int, columns: slice = slice(None)) -> tuple[Single, Single]:
        """Mean amplitude and terrain height [m] of pixels of some lines and columns.

        Without bright points and speckle.
        """
        if self._layers:
            return self._summed(start, stop, columns)
        i, j, db, height = (self._interpolated(a, start, stop, columns) for a in self.coarse)
        db += cv2.remap(self.texture, j, i, cv2.INTER_LINEAR)
        db *= np.float32(np.log(10) / 20)
        return np.exp(db, out=db), height

    def _summed(self, start: int, stop: int, columns: slice) -> tuple[Single, Single]:
        """The same, of all places that share a cell; the height is that of their mean power."""
        first, last, _ = columns.indices(self.footprint.n_cells)
        shape = stop - start, last - first
        total, raised = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        lowest = np.float32(self.height.min())
        for layer in self._layers:
            i, j, power, height = (self._interpolated(a, start, stop, columns, 1) for a in layer)
            texture = cv2.remap(self.texture, j, i, cv2.INTER_LINEAR)
            power *= np.exp(texture * np.float32(np.log(10) / 10))
            total += power
            raised += power * (height - lowest)
        raised /= np.maximum(total, np.float32(1e-12))
        return np.sqrt(total), np.asarray(raised + lowest)

    def visible(self, p: FloatArray) -> NDArray[np.bool_]:
        """Whether points of the terrain (n, 3) [m] are not hidden by what lies before them."""
        return np.ones(len(p), np.bool_) if self._relief is None else self._relief.visible(p)

    def _interpolated(
        self, coarse: Single, start: int, stop: int, columns: slice, step: int = COARSE[1]
    ) -> Single:
        """Linear interpolation of coarse values, of every `step` cells, to lines and columns."""
        first, last, _ = columns.indices(self.footprint.n_cells)
        by_line, by_cell = 1 / COARSE[0], 1 / step
        places = np.array([[by_cell, 0.0, first * by_cell], [0.0, by_line, start * by_line]])
        # places are multiples of a 16th, which OpenCV's fixed point holds exactly
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = (last - first, stop - start)
        fine = cv2.warpAffine(coarse, places, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(fine)

    def _power_db(
        self,
        scene: Scene,
        t: FloatArray,
        latitude: FloatArray,
        longitude: FloatArray,
        height: FloatArray,
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Brightness, and by lines whether there may be layover or shadow on slopes so steep."""
        p = self.footprint.ground.point(latitude, longitude, height)
        cosine, rising = _facing(self.footprint, scene, p, latitude, longitude, t[:, None])
        steep = np.any((cosine < _STEEP) | (rising < _STEEP), axis=1)
        return 10 * np.log10(np.maximum(brightness(cosine), 1e-6)), np.asarray(steep)


def _facing(
    footprint: Footprint,
    scene: Scene,
    p: FloatArray,
    latitude: FloatArray,
    longitude: FloatArray,
    t: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Cosine of the angle of incidence, and how range grows along the slope outward [m/m]."""
    line = footprint.arc.position(t) - p
    line /= np.linalg.norm(line, axis=-1, keepdims=True)
    north, east, down = np.moveaxis(footprint.ground.axes(p), -2, 0)
    slope_north, slope_east = scene.dem.slopes(latitude, longitude)
    normal = -down - slope_north[..., None] * north - slope_east[..., None] * east
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = np.sum(line * normal, axis=-1)
    # it falls where the normal leans toward the radar by more than the view does
    sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
    level, tilt = (-np.sum(a * down, axis=-1) for a in (line, normal))
    return cosine, np.where((cosine * tilt < level) & (cosine > level * tilt), -sine, sine)


class _Relief:
    """Terrain along lines outward, from what may hide a footprint to what may fall into it.

    Samples are of the terrain above (or below) places at the height of the middle.
    """

    def __init__(
        self,
        footprint: Footprint,
        scene: Scene,
        t: FloatArray,
        ranges: FloatArray,
        height: FloatArray,
    ) -> None:
        self.footprint, self.scene, self.t = footprint, scene, t
        self.level = float(np.median(height))
        latitude = float(
            footprint.ground.geodetic(footprint.points(t[0], ranges[0], self.level))[0]
        )
        spacing = footprint.radar.range_spacing
        margin = 1.5 * float(np.ptp(height)) + 4 * spacing
        # three samples of a step of the elevation model, on ground that is seen at 40 deg
        step = min(scene.dem.latitude_step, scene.dem.longitude_step * np.cos(latitude))
        fine = EARTH.radius * step / 3 * 0.64 / spacing
        self.x = np.arange(
            ranges[0] - margin, ranges[-1] + margin, spacing * np.clip(round(fine), 1, 4)
        )
        nodes = [_nodes(a, 7) for a in (t[[0, -1]], self.x[[0, -1]])]
        p = footprint.points(nodes[0][:, None], nodes[1], np.array(self.level))
        self.latitude, self.longitude = self._places(nodes, p)
        known = scene.dem.known_at(self.latitude, self.longitude)
        self.height = np.where(np.isfinite(known), known, self.level)
        self.p = footprint.ground.point(self.latitude, self.longitude, self.height)
        line = self.p - footprint.arc.position(t)[:, None, :]
        self.slant_range = np.linalg.norm(line, axis=-1)
        down = footprint.ground.axes(footprint.arc.position(t))[:, 2]
        self.angle = np.arccos(np.einsum("mnk,mk->mn", line, down) / self.slant_range)
        self.folded = folded_share(self.slant_range, self.angle) > _FEW

    def _places(self, nodes: list[FloatArray], p: FloatArray) -> list[FloatArray]:
        """Latitude and longitude [rad] of all samples, by polynomials through some."""
        latitude, longitude, _ = self.footprint.ground.geodetic(p)
        center = float(longitude.flat[0])
        longitude = center + np.angle(np.exp(1j * (longitude - center)))
        x = [_scaled(a, a[[0, -1]]) for a in (self.t, self.x)]
        found = []
        for values in (latitude, longitude):
            c = _chebyshev3(values[..., None])[..., 0]
            found.append(np.asarray(chebyshev.chebgrid2d(x[0], x[1], c), np.float64))
        return found

    def cells(self, cell: float, least: tuple[range, ...]) -> tuple[range, ...]:
        """Cells of the scene's texture that hold all samples, and the given ones."""
        return tuple(
            range(
                min(int(np.floor(a.min() / cell)) - 1, own.start),
                max(int(np.ceil(a.max() / cell)) + 2, own.stop),
            )
            for a, own in zip((self.latitude, self.longitude), least, strict=True)
        )

    def layers(self) -> list[FloatArray]:
        """Latitude, longitude, power and height (4, n_i, n_cells) of places that share cells."""
        footprint = self.footprint
        spacing, n = footprint.radar.range_spacing, footprint.n_cells
        cosine, _ = _facing(
            footprint, self.scene, self.p, self.latitude, self.longitude, self.t[:, None]
        )
        power = np.maximum(brightness(cosine), 1e-6)
        own = np.stack([self.latitude, self.longitude, power, self.height])
        out = np.zeros((_PLACES, 4, len(self.t), n))
        visible = seen(self.angle)
        cells = (self.slant_range - footprint.near_range) / spacing
        for k in range(len(self.t)):
            found = crossings(cells[k], visible[k])
            inside = (found.cell >= 0) & (found.cell < n) & (found.rank < _PLACES)
            cell, rank = found.cell[inside], found.rank[inside]
            part = found.place[inside].astype(np.intp)
            share = found.place[inside] - part
            line = own[:, k]
            out[rank, :, k, cell] = (line[:, part] * (1 - share) + line[:, part + 1] * share).T
            # where a layer has no place, it has that of its neighbor and no power
            for layer in out[:, :, k]:
                has = layer[2] > 0
                if not has.any():
                    layer[[0, 1, 3]] = line[[0, 1, 3], :1]
                    continue
                last = np.maximum.accumulate(np.where(has, np.arange(n), -1))
                last = np.where(last < 0, int(np.argmax(has)), last)
                layer[[0, 1, 3]] = layer[[0, 1, 3]][:, last]
        return [layer for layer in out if (layer[2] > 0).any()]

    def visible(self, p: FloatArray) -> NDArray[np.bool_]:
        """Whether points of the terrain (n, 3) [m] are not hidden."""
        footprint = self.footprint
        row, _ = footprint.place(p)
        t = np.clip(footprint.first_time + row / footprint.radar.prf, *self.t[[0, -1]])
        latitude, longitude, _ = footprint.ground.geodetic(p)
        foot = footprint.ground.point(latitude, longitude, np.full(len(p), self.level))
        x = np.linalg.norm(foot - footprint.arc.position(t), axis=-1)
        i = np.rint((t - self.t[0]) / (self.t[1] - self.t[0])).astype(np.intp)
        j = np.rint((x - self.x[0]) / (self.x[1] - self.x[0])).astype(np.intp)
        outside = (j < 0) | (j >= len(self.x))
        return np.asarray(outside | seen(self.angle)[i, np.clip(j, 0, len(self.x) - 1)])


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
