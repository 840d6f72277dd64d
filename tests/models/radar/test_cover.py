"""Kinds of land cover: one pattern from whatever window, and what each is said to be."""

import numpy as np
import pytest

from terrafix.models.maps.dem import flat_dem
from terrafix.models.radar.cover import BUILT, COVERS, SEA_DB, districts, fields
from terrafix.models.radar.scene import CELL, Scene

ROWS, COLUMNS = range(297_600, 297_870), range(-953_700, -952_900)
"""3 by 8 km about 29.8 N, 95.3 W."""


def scene(cover, **settings):
    return Scene(flat_dem(0.0), cover=cover, **{"seed": 3} | settings)


@pytest.mark.parametrize("cover", COVERS)
def test_any_window_shows_the_same(cover):
    """A part by itself, far from the corner of the whole, and across borders of blocks."""
    one = scene(cover, points_per_km2=50.0)
    rows, columns = range(ROWS.start + 77, ROWS.stop), range(COLUMNS.start + 301, COLUMNS.stop)
    whole, part = one.texture(ROWS, COLUMNS), one.texture(rows, columns)
    np.testing.assert_allclose(part, whole[77:, 301:], rtol=0, atol=1e-4)  # [dB], of rounding
    latitude, longitude, *rest = one.points(ROWS, COLUMNS)
    inside = (latitude >= rows.start * CELL) & (longitude >= columns.start * CELL)
    for found, expected in zip(
        one.points(rows, columns), (latitude, longitude, *rest), strict=True
    ):
        np.testing.assert_array_equal(np.sort(found), np.sort(expected[inside]))
    other = scene(cover, seed=4).texture(ROWS, COLUMNS)
    assert np.abs(other - whole).mean() > 0.2


def test_a_texture_has_four_decibels_and_no_points():
    one = scene("texture")
    assert one.texture(ROWS, COLUMNS).std() == pytest.approx(4.0, rel=0.1)
    assert not len(one.points(ROWS, COLUMNS)[0])


def test_a_town_has_points_on_a_250th_of_its_cells_and_none_on_streets():
    one = scene("urban", smooth_db=0.0, fine_db=0.0, parcels_db=0.0)
    latitude, longitude, *_ = one.points(ROWS, COLUMNS)
    squares = len(ROWS) * len(COLUMNS) * np.cos(ROWS.start * CELL)
    n = 0.004 * squares
    assert len(latitude) == pytest.approx(n, abs=5 * np.sqrt(n))
    texture = one.texture(ROWS, COLUMNS)
    assert (texture < -7.9).mean() == pytest.approx(1 - BUILT, abs=0.04)
    i = np.rint(latitude / CELL).astype(int) - ROWS.start
    j = np.rint(longitude / CELL).astype(int) - COLUMNS.start
    inside = (i < len(ROWS)) & (j < len(COLUMNS))
    assert (texture[i[inside], j[inside]] == 0.0).all()


def test_the_sea_is_dark_and_calm_and_every_image_has_some():
    one = scene("coast", points_per_km2=30.0, parcels_db=0.0, smooth_db=0.0, seed=5)
    texture = one.texture(ROWS, COLUMNS)
    land = one._land(ROWS, COLUMNS) > 0
    # means of 20,000 cells and more that differ by 1.5 dB, correlated over a few
    assert np.mean(texture[land]) - np.mean(texture[~land]) == pytest.approx(-SEA_DB, abs=0.1)
    assert np.std(scene("coast", seed=5).texture(ROWS, COLUMNS)[~land]) < 0.4
    for k in range(8):
        rows = range(100_000 * k, 100_000 * k + len(ROWS))
        assert 0.03 < scene("coast", seed=k)._land(rows, COLUMNS).mean() < 0.97
    latitude, longitude, *_ = one.points(ROWS, COLUMNS)
    i = np.rint(latitude / CELL).astype(int) - ROWS.start
    j = np.rint(longitude / CELL).astype(int) - COLUMNS.start
    inside = (i < len(ROWS)) & (j < len(COLUMNS))
    side = CELL * 6371.0  # [km]
    n = 30.0 * land.sum() * side**2 * np.cos(ROWS.start * CELL)
    assert inside.sum() == pytest.approx(n, abs=5 * np.sqrt(n))
    assert land[i[inside], j[inside]].all()


def test_a_causeway_is_30_to_60_m_wide_and_every_image_has_one():
    """At 60 deg, too, where a cell is half as wide: its width is in meters."""
    for north in (ROWS.start, 600_000):
        rows = range(north, north + 40)
        share = scene("causeway")._land(rows, range(5400))
        lines = share.sum(axis=1)[0] * 11.12 / 10 * np.cos(north * CELL)
        assert 30.0 < lines < 60.0 / np.cos(np.radians(35.0))
        assert np.diff(np.flatnonzero(share[0])).max() < 540 + 1
    assert share.mean() < 0.02


def test_fields_are_of_five_kinds():
    one = scene("fields", smooth_db=0.0, fine_db=0.0)
    kinds, count = np.unique(one.texture(ROWS, COLUMNS), return_counts=True)
    np.testing.assert_allclose(kinds, 2.5 * np.sqrt(2) * np.array([-1, -0.5, 0, 0.5, 1]), atol=2e-3)
    assert (count > 0.1 * len(ROWS) * len(COLUMNS)).all()


@pytest.mark.parametrize("cover", ["parcels", "texture"])
def test_what_time_changes_is_a_mixture(cover):
    old, other = (scene(cover, seed=k).texture(ROWS, COLUMNS) for k in (3, 8))
    new = scene(cover, correlation=0.6, change_seed=8).texture(ROWS, COLUMNS)
    np.testing.assert_allclose(new, 0.6 * old + 0.8 * other, atol=1e-5)


def test_fields_keep_their_borders_and_change_their_crops():
    """Some 300 fields: a correlation of 0.6 within four standard errors of 0.04."""
    plain = {"smooth_db": 0.0, "fine_db": 0.0}
    old = scene("fields", **plain).texture(ROWS, COLUMNS)
    new = scene("fields", **plain, correlation=0.6, change_seed=8).texture(ROWS, COLUMNS)
    assert np.corrcoef(old.ravel(), new.ravel())[0, 1] == pytest.approx(0.6, abs=0.16)
    field = fields(districts(3, ROWS, COLUMNS, CELL))
    assert not (np.diff(new)[field[:, 1:] == field[:, :-1]]).any()


def test_as_many_points_are_new_as_are_gone():
    """Binomial: within four standard errors."""
    old, new = (
        scene("parcels", points_per_km2=100.0, correlation=c, change_seed=8) for c in (1.0, 0.7)
    )
    before, after = (set(s.points(ROWS, COLUMNS)[2]) for s in (old, new))
    n = len(before)
    assert len(after) == pytest.approx(n, abs=4 * np.sqrt(2 * 0.3 * n))
    assert len(before & after) == pytest.approx(0.7 * n, abs=4 * np.sqrt(0.21 * n))


def test_a_shore_stays_where_it_is():
    old, new = (scene("coast", correlation=c, change_seed=8) for c in (1.0, 0.0))
    np.testing.assert_array_equal(old._land(ROWS, COLUMNS), new._land(ROWS, COLUMNS))


def test_covers_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"one of parcels, texture, .*, not 'snow'"):
        scene("snow")
    with pytest.raises(ValueError, match=r"correlation of a scene is 0 to 1, not 1\.1"):
        scene("parcels", correlation=1.1)
