"""Passes over a place, and images of it made from the scatterers: for measuring matchers.

Much quicker than from echo: an ideal processor's images, with speckle and noise of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.geometry.ground import EllipsoidGround
from terrafix.models.images.matching import Match, Searchable, matched
from terrafix.models.images.placing import View, predicted
from terrafix.models.images.reference import Reference
from terrafix.models.maps.dem import Dem
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.echo import ideal_image
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.multilook import detected, full_index
from terrafix.models.radar.scene import Scene

PALSAR = Radar(1269.768992e6, 2160.0, 16e6, -14e6 / 27e-6, 27e-6, 1513.0)
EARTH = EllipsoidGround()
LOOKS = (2, 1)
PRIOR, PRIOR_SPEED = 300.0, 1.0
"""Standard errors of position [m] and velocity [m/s] along each axis, in searching."""
SPEED = 7599.0
"""Earth-fixed [m/s]."""
HEADING, INCIDENCE = float(np.radians(-10.0)), float(np.radians(38.7))
"""Of the passes of the closed loop [rad]."""


def footprint(
    dem: Dem,
    place: tuple[float, float],
    shape: tuple[int, int],
    *,
    heading: float = HEADING,
    incidence: float = INCIDENCE,
    altitude: float = 692e3,
    off: FloatArray | None = None,
) -> Footprint:
    """Grid of a right-looking pass, of pixels of `LOOKS` about a place, seen broadside.

    Parameters
    ----------
    dem : Dem
        Terrain.
    place : tuple of float
        Latitude and longitude of its middle [rad].
    shape : tuple of int
        Rows and columns of its image.
    heading, incidence : float
        Of the track at the place, from north to east, and of the radar on level ground [rad].
    altitude : float
        [m]
    off : ndarray, shape (3,)
        What the orbit is displaced by [m], Earth-fixed.
    """
    p = EARTH.point(*place, float(dem.at(*place)))
    north, east, down = EARTH.axes(p)
    azimuth = heading - np.pi / 2
    toward = np.sin(incidence) * (np.cos(azimuth) * north + np.sin(azimuth) * east)
    toward -= np.cos(incidence) * down
    radius = np.linalg.norm(p) + altitude
    along = float(toward @ p)
    R = -along + np.sqrt(along**2 + radius**2 - p @ p)
    r = p + R * toward
    v = np.cross(r, p - r)
    v *= SPEED / np.linalg.norm(v)
    n_lines, n_cells = (n * k for n, k in zip(shape, LOOKS, strict=True))
    reach = n_lines / PALSAR.prf + 2.0
    r = r if off is None else r + off
    return Footprint(
        OrbitArc(r, v, 0.0, reach, reach),
        PALSAR,
        -(n_lines - 1) / 2 / PALSAR.prf,
        n_lines,
        R - (n_cells - 1) / 2 * PALSAR.range_spacing,
        n_cells,
        0.0,
    )


@dataclass(frozen=True, eq=False)
class Seen:
    """An image, and where its middle is.

    Parameters
    ----------
    amplitude : ndarray of float32, shape (n_rows, n_columns)
    grid : Footprint
        Of it before looks were averaged.
    reference : Reference
        The same, geocoded with the true terrain.
    middle : tuple of float
        Row and column of its middle.
    place : ndarray, shape (3,)
        True latitude, longitude [rad] and height [m] of it.
    """

    amplitude: Single
    grid: Footprint
    reference: Reference
    middle: tuple[float, float]
    place: FloatArray


def seen(scene: Scene, grid: Footprint, rng: np.random.Generator, snr_db: float = 10.0) -> Seen:
    """Image of a scene."""
    terrain = TerrainGrid(grid, scene)
    amplitude = detected(ideal_image(scene, terrain, rng, snr_db=snr_db), LOOKS)
    rows, columns = ((a - (n - 1) / 2) / n for a, n in zip(terrain.ties, LOOKS, strict=True))
    places = terrain.latitude, terrain.longitude, terrain.height
    reference = Reference(amplitude, rows, columns, *places)
    row, column = ((n - 1) / 2 for n in amplitude.shape)
    line, cell = (full_index(k, n) for k, n in zip((row, column), LOOKS, strict=True))
    t = grid.first_time + line / PALSAR.prf
    R = grid.near_range + cell * PALSAR.range_spacing
    height = float(reference.place(row, column)[2])
    for _ in range(60):
        latitude, longitude, _ = EARTH.geodetic(grid.points(t, R, np.array(height)))
        height += 0.5 * (float(scene.dem.at(latitude, longitude)) - height)
    place = np.array([float(latitude), float(longitude), height])
    return Seen(amplitude, grid, reference, (row, column), place)


def found(
    image: Seen, reference: Reference, dem: Dem, rng: np.random.Generator
) -> tuple[Match, View]:
    """Where the matcher finds an image on a reference, and the orbit that errs by which it looks.

    Parameters
    ----------
    image : Seen
    reference : Reference
    dem : Dem
        The terrain as it is known.
    rng : numpy.random.Generator
        Of the orbit's error.
    """
    grid, (row, column) = image.grid, image.middle
    line, cell = (full_index(k, n) for k, n in zip((row, column), LOOKS, strict=True))
    t = grid.first_time + line / PALSAR.prf
    view = View(
        grid.arc.position(t) + PRIOR * rng.standard_normal(3),
        grid.arc.velocity(t) + PRIOR_SPEED * rng.standard_normal(3),
        *(row, column, LOOKS[0] / PALSAR.prf),
        *(float(grid.near_range + cell * PALSAR.range_spacing), PALSAR.range_spacing * LOOKS[1]),
        sine=0.0,
    )
    P = np.diag(np.repeat([PRIOR**2, PRIOR_SPEED**2], 3))
    where = predicted(view, P, reference, dem.known_at, image.amplitude.shape)
    one, other = (Searchable(a) for a in (image.amplitude, reference.amplitude))
    return matched(one, other, where, image.middle), view
