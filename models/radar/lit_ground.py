"""The terrain that an aperture lights: bright points, and clutter strewn over it at random.

Clutter is several scatterers to a resolution cell: with two the echo has a texture of its own,
which looks of it share, and map drift then "works" on a featureless field; with eight it does not.
It is a new draw for each aperture, so that the echo of another pass, and of the next second, has
speckle of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.geometry.ground import Ground
from terrafix.models.radar.aperture import CUT, MARGIN, Aperture
from terrafix.models.radar.chirp import unit_phasor
from terrafix.models.radar.relief import seen
from terrafix.models.radar.scene import Scene, brightness

_SURFACE = 1.0
"""Spacing of the grid on which the terrain under an aperture is looked up [m]."""
FEWEST = 5.0
"""Scatterers in a resolution cell below which clutter is refused."""


@dataclass(frozen=True)
class Scatterers:
    """Points that reflect.

    Parameters
    ----------
    origin : ndarray, shape (3,)
        A place among them [m], in the frame of the aperture.
    offset : ndarray of float32, shape (3, n)
        Places relative to it [m]; quickest if they go along the track.
    reflection : ndarray of complex64, shape (n,)
        As seen from the middle of the aperture: with the phase of that range.
    """

    origin: FloatArray
    offset: Single
    reflection: ComplexArray


def scatterers_at(p: ArrayLike, reflection: ArrayLike) -> Scatterers:
    """Scatterers at places (n, 3) [m] with reflections (n,)."""
    p = np.asarray(p, np.float64)
    origin = p[0] if len(p) else np.zeros(3)
    return Scatterers(
        origin,
        np.ascontiguousarray((p - origin).T, np.float32),
        np.asarray(reflection, np.complex64),
    )


class LitGround:
    """The terrain that an aperture lights, and what is strewn on it.

    Parameters
    ----------
    scene : Scene
    ground : Ground
        Frame of the aperture.
    aperture : Aperture

    Raises
    ------
    ValueError
        If the swath does not reach the ground, or the antenna is not above it.
    """

    def __init__(self, scene: Scene, ground: Ground, aperture: Aperture) -> None:
        self.scene, self.ground, self.aperture = scene, ground, aperture
        self.center = aperture.r[aperture.middle]
        latitude, longitude, height = ground.geodetic(self.center)
        below = float(scene.dem.at(latitude, longitude))
        if not height > below:
            raise ValueError(
                f"an antenna {float(height):.0f} m high is not above the ground, {below:.0f} m"
            )
        self.base = ground.point(latitude, longitude, below)
        self.up = -ground.axes(self.center)[2]
        axis = aperture.axis.mean(axis=0)
        level = axis - self.up * (self.up @ axis)
        self.ahead = level / np.linalg.norm(level)
        self.out = aperture.side * np.cross(self.ahead, self.up)
        self._tilt = float(self.up @ axis) / float(np.linalg.norm(level))
        self._extent(float(height) - below)
        self._look_up()

    def _extent(self, above: float) -> None:
        """Rectangle on the level through the base: along the antenna, and out from it [m]."""
        aperture = self.aperture
        near, far = aperture.slant_range[[0, -1]]
        way = (aperture.r - self.center) @ np.stack([self.ahead, self.out], axis=1)
        turn = np.linalg.norm(aperture.axis - aperture.axis.mean(axis=0), axis=1).max()
        reach = (CUT * aperture.null + turn) * far
        lowest, highest = self._relief(reach + abs(self._tilt) * above + np.abs(way).max(), far)
        margin = MARGIN * aperture.radar.range_spacing
        inner = (near - margin) ** 2 - (above - lowest) ** 2
        outer = (far + margin) ** 2 - (above - highest) ** 2
        if not outer > 0:
            raise ValueError(
                f"a swath to {far:.0f} m does not reach the ground, {above - highest:.0f} m below"
            )
        tilt = sorted(h * self._tilt for h in (above - lowest, above - highest))
        self.along = (way[:, 0].min() - reach + tilt[0], way[:, 0].max() + reach + tilt[1])
        self.across = (
            np.sqrt(max(inner, 0.0)) + way[:, 1].min(),
            np.sqrt(outer) + way[:, 1].max(),
        )

    def _relief(self, reach: float, far: float) -> tuple[float, float]:
        """Lowest and highest ground within reach, relative to the base [m]."""
        p = self._plane(np.linspace(-reach, reach, 33)[:, None], np.linspace(0, far, 65)[None, :])
        latitude, longitude, _ = self.ground.geodetic(p)
        base = float(self.ground.geodetic(self.base)[2])
        height = self.scene.dem.at(latitude, longitude) - base
        return float(height.min()), float(height.max())

    def _plane(self, along: FloatArray, across: FloatArray) -> FloatArray:
        return np.asarray(self.base + along[..., None] * self.ahead + across[..., None] * self.out)

    def _look_up(self) -> None:
        """Rise above the level [m] and brightness [dB] on a grid of the rectangle."""
        x, y = (
            low + _SURFACE * np.arange(int(np.ceil((high - low) / _SURFACE)) + 2)
            for low, high in (self.along, self.across)
        )
        level = self._plane(x[:, None], y[None, :])
        latitude, longitude, own = self.ground.geodetic(level)
        rise = self.scene.dem.at(latitude, longitude) - own
        slopes = np.gradient(rise, _SURFACE)
        line = self.center - (level + rise[..., None] * self.up)
        line /= np.linalg.norm(line, axis=-1, keepdims=True)
        facing = line @ self.up - slopes[0] * (line @ self.ahead) - slopes[1] * (line @ self.out)
        cosine = facing / np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)
        db = 10 * np.log10(np.maximum(brightness(cosine), 1e-6))
        # a cell of the slant plane holds more of level ground the steeper it is seen
        db += 5 * np.log10(np.maximum(1 - cosine**2, 1e-6))
        above = float((self.center - self.base) @ self.up)
        self._seen = seen(np.arctan2(y, above - rise))
        db[~self._seen] = -60.0
        i, j = latitude / self.scene.cell, longitude / self.scene.cell
        rows, columns = (
            range(int(np.floor(a.min())) - 1, int(np.ceil(a.max())) + 2) for a in (i, j)
        )
        texture = self.scene.texture(rows, columns)
        x32, y32 = ((a - s.start).astype(np.float32) for a, s in ((j, columns), (i, rows)))
        db += cv2.remap(texture, x32, y32, cv2.INTER_LINEAR)
        self.cells = rows, columns
        self._surface = rise.astype(np.float32), db.astype(np.float32)

    def clutter(self, rng: np.random.Generator, per_cell: float = 8.0) -> Scatterers:
        """Scatterers strewn at random, of equal strength where the ground is equally bright.

        Their phases are random. Strengths that differ (complex normal ones, say) would give the
        echo twice the texture of its own.

        Parameters
        ----------
        rng : numpy.random.Generator
        per_cell : float
            Scatterers in a resolution cell of level ground in the middle of the swath.

        Raises
        ------
        ValueError
            If they are so few that the echo would have a texture of its own.
        """
        if not per_cell >= FEWEST:
            raise ValueError(
                f"{per_cell:g} scatterers in a resolution cell give the echo a texture of its own, "
                f"which a radar does not see: {FEWEST:g} at least, 8 are usual"
            )
        return self._strewn(rng, per_cell)

    def _strewn(self, rng: np.random.Generator, per_cell: float) -> Scatterers:
        distance = float(self.aperture.slant_range.mean())
        above = float((self.center - self.base) @ self.up)
        cell = self.aperture.cell_area / np.sqrt(1 - min(above / distance, 1.0) ** 2)
        (x0, x1), (y0, y1) = self.along, self.across
        n = int(per_cell * (x1 - x0) * (y1 - y0) / cell)
        # in order along the track, and as even across it as chance is
        x = (np.arange(n, dtype=np.float32) + rng.random(n, np.float32)) * np.float32((x1 - x0) / n)
        y = rng.random(n, np.float32) * np.float32(y1 - y0)
        rise, db = (_at(a, x / _SURFACE, y / _SURFACE) for a in self._surface)
        db -= np.float32(10 * np.log10(per_cell * self.aperture.cell_area / cell))
        x, y = x + np.float32(x0), y + np.float32(y0)
        offset = np.empty((3, n), np.float32)
        for k in range(3):
            np.multiply(x, np.float32(self.ahead[k]), out=offset[k])
            offset[k] += y * np.float32(self.out[k])
            offset[k] += rise * np.float32(self.up[k])
        near, far = self._window
        line = offset + (self.base - self.center).astype(np.float32)[:, None]
        square = np.einsum("in,in->n", line, line)
        heard = (square > near * near) & (square < far * far)
        offset, db = offset[:, heard], db[heard]
        reflection = unit_phasor(rng.random(len(db), np.float32))
        reflection *= np.exp(db * np.float32(np.log(10) / 20))
        return Scatterers(self.base, offset, reflection)

    @property
    def _window(self) -> tuple[float, float]:
        """Ranges that are summed [m]; the track moves by less than the sidelobes reach."""
        aperture = self.aperture
        margin = MARGIN * aperture.radar.range_spacing
        way = aperture.r - self.center
        drift = float(np.abs(way @ self.up).max() + np.abs(way @ self.out).max())
        near, far = aperture.slant_range[[0, -1]]
        return max(near - margin - drift, 0.0), far + margin + drift

    def points(self) -> Scatterers:
        """Bright points of the scene."""
        latitude, longitude, amplitude, phase = self.scene.points(*self.cells)
        height = self.scene.dem.at(latitude, longitude)
        p = self.ground.point(latitude, longitude, height)
        way = (p - self.base) @ np.stack([self.ahead, self.out], axis=1)
        i, j = (
            np.clip(np.rint((a - span[0]) / _SURFACE).astype(np.intp), 0, n - 1)
            for a, span, n in zip(way.T, (self.along, self.across), self._seen.shape, strict=True)
        )
        lit = self._seen[i, j]
        return scatterers_at(p[lit], (amplitude * np.exp(2j * np.pi * phase))[lit])


def _at(values: Single, i: Single, j: Single) -> Single:
    """Linear interpolation at fractional rows and columns, (n,)."""
    width = 4096
    padded = -(-len(i) // width) * width
    x, y = (
        np.pad(a.astype(np.float32, copy=False), (0, padded - len(a))).reshape(-1, width)
        for a in (j, i)
    )
    found = cv2.remap(values, x, y, cv2.INTER_LINEAR).ravel()[: len(i)]
    return np.asarray(found, np.float32)
