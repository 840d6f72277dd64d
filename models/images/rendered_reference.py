r"""A reference that no radar has seen: rendered from an elevation model and a map of land cover.

Every pixel has the amplitude that is expected there, without speckle: by the local angle of
incidence of the terrain as it is known, by its class of cover, and by the noise of the radar,

.. math:: a = \sqrt{\overline{10^{(b + c) / 10}} + n},

with :math:`b` the brightness of the terrain and :math:`c` that of the class [dB], and :math:`n` the
noise, relative to a mean cell. Pixels lie where the terrain, as known, puts them in the slant
geometry of the flight that is expected.

What is wrong with it. A height that is off by :math:`\delta h` moves what is rendered by
:math:`-\delta h \cos\theta` in slant range; :math:`\theta` is the angle of incidence. Over an image
the matcher takes the mean of these shifts, and what they have in common (a datum) leaves the place
of the center right and its height wrong by :math:`\delta h`. What is left at the center itself, the
error :math:`\delta h` of the height that is its own, lets its pixel be taken for a place that is
:math:`\delta h / \tan\theta` too far and :math:`\delta h` too high: at the right range. Where map
and elevation model lie beside where they should, so do all places.
"""

from __future__ import annotations

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.geometry.ground import Ground
from terrafix.models.images.reference import Reference
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.multilook import detected, multilook_index
from terrafix.models.radar.scene import Scene


def rendered(
    cover: Scene,
    footprint: Footprint,
    looks: tuple[int, int],
    snr_db: float = 10.0,
    *,
    displaced: tuple[float, float] = (0.0, 0.0),
) -> Reference:
    """Reference rendered for a footprint.

    Parameters
    ----------
    cover : Scene
        The terrain as it is known, and what is known of its cover: of a `CoverMap` its classes.
    footprint : Footprint
        Grid of the flight that is expected.
    looks : tuple of int
        Pixels averaged in azimuth and range.
    snr_db : float
        Ratio of mean clutter to noise [dB].
    displaced : tuple of float
        How far to the north and to the east of where they are, places are taken to be [m].
    """
    grid = TerrainGrid(footprint, cover)
    amplitude, _ = grid.pixels(0, footprint.n_lines)
    amplitude = np.sqrt(amplitude**2 + np.float32(10 ** (-snr_db / 10)))
    rows, columns = (multilook_index(a, n) for a, n in zip(grid.ties, looks, strict=True))
    latitude, longitude = _moved(footprint.ground, grid, displaced)
    return Reference(detected(amplitude, looks), rows, columns, latitude, longitude, grid.height)


def _moved(
    ground: Ground, grid: TerrainGrid, displaced: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    if not any(displaced):
        return grid.latitude, grid.longitude
    p = ground.point(grid.latitude, grid.longitude, grid.height)
    north, east, _ = np.moveaxis(ground.axes(p), -2, 0)
    latitude, longitude, _ = ground.geodetic(p + displaced[0] * north + displaced[1] * east)
    return latitude, longitude
