"""References rendered from heights and cover: brightness, places, and what heights do to them."""

import numpy as np
import pytest

from terrafix.models.geometry.geodesy import ecef
from terrafix.models.images.rendered_reference import rendered
from terrafix.models.maps.dem import flat_dem
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.scene import CoverMap, Scene

PALSAR = Radar(1269.768992e6, 2160.0, 16e6, -14e6 / 27e-6, 27e-6, 1513.0)
INCIDENCE = np.radians(38.70)
"""Where a range of 861013 m meets the ground of the papers' first image."""


@pytest.fixture(scope="module")
def grid(start_e):
    arc = OrbitArc(start_e[0], start_e[1], 0.0, 3.0, 3.0)
    near = 861013.0 - 100 * PALSAR.range_spacing
    return Footprint(arc, PALSAR, -0.1, 400, near, 201, 0.0)


def test_level_ground_without_classes_is_as_bright_as_expected(grid):
    """At 38.7 deg backscatter is one by definition; noise 10 dB below adds a tenth to the power."""
    reference = rendered(CoverMap(flat_dem(0.0), cover="texture"), grid, (2, 1))
    assert reference.amplitude.shape == (200, 201)
    assert reference.amplitude[:, 100] == pytest.approx(np.sqrt(1.1), abs=2e-3)


@pytest.mark.parametrize("cover", ["parcels", "fields", "urban", "coast"])
def test_classes_are_as_bright_as_the_scene_where_it_varies_by_them_alone(cover):
    """And errors of brightness are one number for each class."""
    rows, columns = range(297_600, 297_800), range(-953_700, -953_400)
    plain = {"seed": 3, "smooth_db": 0.0, "fine_db": 0.0, "cover": cover}
    if cover == "urban":
        plain["parcels_db"] = 0.0  # the map tells no block from another
    true = Scene(flat_dem(0.0), **plain).texture(rows, columns)
    known = CoverMap(flat_dem(0.0), **plain).texture(rows, columns)
    land = true > -9.0  # waves are not on the map
    np.testing.assert_allclose(known[land], true[land], atol=1e-4)
    np.testing.assert_allclose(known[~land], true[~land], atol=1.0)
    off = CoverMap(flat_dem(0.0), **plain, class_sigma=2.0, map_seed=4).texture(rows, columns)
    errors = {
        (round(float(k), 3), round(float(e), 2))
        for k, e in zip(known[land], (off - known)[land], strict=True)
    }
    assert len(errors) <= 5
    assert len(errors) >= 2


def test_what_a_map_does_not_know_is_not_shown():
    rows, columns = range(297_600, 297_700), range(-953_700, -953_600)
    one, other = (
        CoverMap(flat_dem(0.0), seed=3, smooth_db=s, fine_db=s).texture(rows, columns)
        for s in (0.0, 5.0)
    )
    np.testing.assert_array_equal(one, other)
    assert len(CoverMap(flat_dem(0.0), points_per_km2=100.0).points(rows, columns)[0]) == 0


def test_places_lie_beside_by_what_they_are_displaced(grid):
    cover = CoverMap(flat_dem(0.0), cover="texture")
    here = rendered(cover, grid, (2, 1)).place(100.0, 100.0)
    there = rendered(cover, grid, (2, 1), displaced=(30.0, -40.0)).place(100.0, 100.0)
    moved = ecef(*there) - ecef(*here)
    assert np.linalg.norm(moved) == pytest.approx(50.0, abs=0.05)
    assert there[0] - here[0] == pytest.approx(30.0 / 6.3547e6, rel=0.01)  # meridian at 29.8 N
    assert there[1] < here[1]


def test_heights_that_are_off_move_what_is_rendered_in_range_alone(grid):
    """20 m too high: nearer by 20 cos(38.7 deg) m, and no place on the ground is another."""
    true = TerrainGrid(grid, Scene(flat_dem(0.0)))
    lines, cells = true.ties
    place = true.latitude[12, 25], true.longitude[12, 25]
    high = rendered(CoverMap(flat_dem(20.0), cover="texture"), grid, (1, 1))
    row, column, inside = high.pixel(*place)
    assert inside
    assert row == pytest.approx(lines[12], abs=0.02)
    shift = -20.0 * np.cos(INCIDENCE) / PALSAR.range_spacing
    assert column - cells[25] == pytest.approx(shift, abs=0.02)
