"""The artificial scene: one texture for every place, wherever it is counted from."""

import numpy as np
import pytest

from terrafix.models.maps.dem import flat_dem
from terrafix.models.radar.scene import CELL, Scene

TURN = 3_600_000
"""Cells of 1e-4 deg in 360 degrees."""
SCENE = Scene(flat_dem(0.0), seed=5, points_per_km2=200.0)


def test_texture_goes_on_across_the_date_line():
    """Cells about 180 degrees are the same counted from the west, from the east, and in parts."""
    rows = range(1000, 1040)
    east = range(TURN // 2 - 30, TURN // 2 + 50)
    west = range(east.start - TURN, east.stop - TURN)
    whole = SCENE.texture(rows, east)
    np.testing.assert_array_equal(whole, SCENE.texture(rows, west))
    parts = [SCENE.texture(rows, range(TURN // 2 - 30, TURN // 2))]
    parts += [SCENE.texture(rows, range(-TURN // 2, -TURN // 2 + 50))]
    np.testing.assert_array_equal(whole, np.hstack(parts))


def test_bright_points_go_on_across_the_date_line():
    rows, east = range(600), range(TURN // 2 - 300, TURN // 2 + 300)
    west = range(east.start - TURN, east.stop - TURN)
    one, other = SCENE.points(rows, east), SCENE.points(rows, west)
    assert len(one[0]) > 100
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_allclose(one[1] - other[1], 2 * np.pi, atol=1e-12)
    np.testing.assert_array_equal(one[2:], other[2:])
    assert (one[1] >= east.start * CELL).all()
    assert (one[1] < east.stop * CELL).all()


def test_a_scene_next_to_the_pole_is_refused_by_name():
    """At 89.9 deg ten kilometers are 51 deg of longitude: 513,000 cells."""
    rows = range(899_000, 899_900)
    width = round(10e3 / (6371e3 * np.cos(np.radians(89.9))) / CELL)
    with pytest.raises(ValueError, match=r"about latitude 89.90 deg takes 51\d\d\d\d cells"):
        SCENE.texture(rows, range(width))


def test_bright_points_are_as_bright_and_as_many_as_they_are_said_to_be():
    """Median 25 dB, 4 dB rms, 3 a square kilometer: each within 5 of its own standard errors."""
    scene = Scene(flat_dem(0.0), seed=2, points_per_km2=3.0, points_db=25.0)
    side = 3000  # cells of 1e-4 deg
    latitude, _, amplitude, phase = scene.points(range(-side // 2, side // 2), range(side))
    n = len(latitude)
    area = (side * CELL * 6371.0) ** 2  # [km^2], at the equator
    assert n == pytest.approx(3.0 * area, abs=5 * np.sqrt(3.0 * area))
    north = range(600_000, 600_000 + side)  # at 60 deg cells are half as wide
    halved = 3.0 * area * np.cos(np.radians(60.0 + side * 1e-4 / 2))
    assert len(scene.points(north, range(side))[0]) == pytest.approx(halved, abs=0.1 * halved)
    db = 20 * np.log10(amplitude)
    assert db.std() == pytest.approx(4.0, abs=5 * 4.0 / np.sqrt(2 * n))
    assert db.mean() == pytest.approx(25.0, abs=5 * 4.0 / np.sqrt(n))
    assert phase.mean() == pytest.approx(0.5, abs=5 / np.sqrt(12 * n))
