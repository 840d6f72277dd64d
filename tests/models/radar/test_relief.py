"""Layover and shadow of a ridge, whose closed form is plane geometry."""

import numpy as np
import pytest

from terrafix.models.geometry.ground import FlatGround
from terrafix.models.maps.dem import Dem
from terrafix.models.motion.sampled import SampledArc
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.relief import crossings, folded_share, seen
from terrafix.models.radar.scene import Scene, brightness

RADAR = Radar(1.27e9, 2000.0, 100e6, 90e6 / 1e-6, 1e-6, 100.0)  # cells of 1.5 m
PLAIN = {"parcels_db": 0.0, "smooth_db": 0.0, "fine_db": 0.0, "points_per_km2": 0.0}
UP, FAR = 5000.0, 5000.0  # of the track above the plain, and of the crest from below it [m]
STEP = 5.0


def ridge(height, half_width, side=1):
    """Triangle along the track, which goes north; the plain is at zero."""
    north, east = FlatGround()._scales
    y = STEP * np.arange(-600, 601)
    one = np.maximum(0.0, height * (1 - np.abs(y) / half_width)).astype(np.float32)
    return Dem(
        *(np.tile(one, (3, 1)), -3000.0 / north, (side * FAR + y[0]) / east),
        *(3000.0 / north, STEP / east),
    )


def terrain(dem, near=6700.0, n_cells=901, side=1):
    t = np.linspace(-2.0, 2.0, 41)
    track = SampledArc(t, np.stack([100.0 * t, 0 * t, np.full(41, -UP)], axis=1))
    grid = Footprint(track, RADAR, -0.02, 81, near, n_cells, 0.0, FlatGround(), side)
    return grid, TerrainGrid(grid, Scene(dem, **PLAIN))


@pytest.mark.parametrize("side", [1, -1])
def test_a_steep_ridge_is_laid_over_and_casts_a_shadow(side):
    """Its crest is nearer than its foot; behind it nothing is seen to where its ray lands."""
    height, half = 300.0, 150.0
    grid, found = terrain(ridge(height, half, side), side=side)
    crest = np.hypot(UP - height, FAR)
    foot = np.hypot(UP, FAR - half)
    end = np.hypot(UP, FAR * UP / (UP - height))
    assert crest < foot < end
    R = grid.near_range + np.arange(grid.n_cells) * RADAR.range_spacing
    power = found.pixels(16, 17)[0][0] ** 2
    cell = RADAR.range_spacing
    plain = brightness(UP / R)
    slope = np.arctan2(height, half)
    before, dark, after = crest - 2 * cell > R, (foot + cell < R) & (end - cell > R), end + cell < R
    np.testing.assert_allclose(power[before], plain[before], rtol=0.01)
    assert (power[dark] < 1e-5).all()
    np.testing.assert_allclose(power[after], plain[after], rtol=0.01)
    # layover: the plain before the foot, and the slope, seen from its other side
    both = (crest + 8 * cell < R) & (foot - 8 * cell > R)
    s = np.linspace(1.0, 0.0, 1000)
    y, z = FAR - half * (1 - s), height * s
    angle = np.interp(R[both], np.hypot(UP - z, y), np.arctan2(y, UP - z)) - slope
    np.testing.assert_allclose(power[both], plain[both] + brightness(np.cos(angle)), rtol=0.05)


def test_a_gentle_ridge_is_looked_up_as_ever():
    _, found = terrain(ridge(100.0, 400.0))
    assert not found._layers


def test_points_in_the_shadow_are_not_seen():
    """Behind the crest to 5319 m; 200 m above the ground there one is seen again."""
    _, found = terrain(ridge(300.0, 150.0))
    y = np.array([4700.0, 5150.0, 5300.0, 5340.0])
    p = np.stack([np.zeros(4), y, np.zeros(4)], axis=1)
    assert found.visible(p).tolist() == [True, False, False, True]


def test_crossings_of_a_folded_line_come_in_its_order():
    """Up to 3.5, back to 1.5, and out: cells 2 and 3 are crossed three times."""
    line = np.array([0.0, 3.5, 1.5, 5.0])
    found = crossings(line, np.ones(4, np.bool_))
    assert found.cell.tolist() == [0, 1, 2, 2, 2, 3, 3, 3, 4]
    assert found.rank.tolist() == [0, 0, 0, 1, 2, 0, 1, 2, 0]
    np.testing.assert_allclose(np.interp(found.place, np.arange(4), line), found.cell)
    hidden = crossings(line, np.array([True, True, False, True]))
    assert hidden.cell.tolist() == [0, 1, 2, 3]


def test_what_lies_below_a_ray_is_hidden():
    angle = np.array([[0.1, 0.3, 0.2, 0.25, 0.4], [0.1, 0.2, 0.3, 0.4, 0.5]])
    assert seen(angle)[0].tolist() == [True, True, False, False, True]
    outward = np.tile(np.arange(5.0), (2, 1))
    assert folded_share(outward, angle) == 2 / 8
    outward[1, 2] = 0.5
    assert folded_share(outward, angle) == 3 / 8
