"""Grounds: the flat one and the ellipsoid are the same functions, and agree where they should."""

import numpy as np
import pytest

from terrafix.models.geometry.ground import EllipsoidGround, FlatGround, seen_on_terrain
from terrafix.models.maps.charts import geodetic_of

LATITUDE, LONGITUDE = 0.65, 0.2
GROUNDS = [FlatGround(LATITUDE, LONGITUDE), EllipsoidGround()]
AWAY = np.array([[0.0, 0.0, -1000.0], [800.0, -300.0, -20.0]])
"""North, east, down of the place [m]."""


def frame(ground):
    origin = ground.point(LATITUDE, LONGITUDE, 0.0)
    return origin, ground.axes(origin)


@pytest.mark.parametrize("ground", GROUNDS)
def test_places_come_back(ground):
    latitude, longitude, height = ground.geodetic(frame(ground)[0] + AWAY @ frame(ground)[1])
    p = ground.point(latitude, longitude, height)
    np.testing.assert_allclose(p, frame(ground)[0] + AWAY @ frame(ground)[1], rtol=0, atol=2e-8)
    # 1 km of curvature lifts by 6 cm
    np.testing.assert_allclose(height, -AWAY[:, 2], atol=0.1)


@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize("side", [1, -1])
def test_a_point_is_seen_at_its_range_and_sine_and_on_its_side(ground, side):
    origin, axes = frame(ground)
    r, v = origin + AWAY[0] @ axes, np.array([60.0, 30.0, -5.0]) @ axes
    p = ground.seen(r, v, [1500.0, 1600.0], [0.05, -0.1], [10.0, 50.0], side)
    line = p - r
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), [1500.0, 1600.0], rtol=0, atol=1e-6)
    sine = line @ v / np.linalg.norm(v) / [1500.0, 1600.0]
    np.testing.assert_allclose(sine, [0.05, -0.1], atol=1e-9)
    np.testing.assert_allclose(ground.geodetic(p)[2], [10.0, 50.0], atol=1e-5)
    right = np.array([-30.0, 60.0, 0.0]) @ axes
    assert (np.sign(line @ right) == side).all()


def test_both_see_nearly_the_same():
    """Within 0.3 m at 1.2 km: the curvature of the Earth, 0.11 m, over the sine of the view."""
    places = []
    for ground in GROUNDS:
        origin, axes = frame(ground)
        p = ground.seen(origin + AWAY[0] @ axes, [70.0, 0, 0] @ axes, 1562.0, 0.0, 0.0)
        places.append(axes @ (p - origin))
    np.testing.assert_allclose(places[0], places[1], atol=0.3)


def test_a_place_of_the_flat_earth_has_one_latitude_and_longitude():
    """To rounding those that clearances are read at, and those of the ellipsoid but for curvature.

    1 km north and east of the origin meridians have drawn together by tan(latitude) n e / R,
    0.12 m. On a sphere of the equator's radius the place is 3.0 m and 1.2 m away.
    """
    away = np.array([[1000.0, 1000.0, 0.0]])
    flat, ellipsoid = GROUNDS
    origin, axes = frame(ellipsoid)
    place = np.concatenate(flat.geodetic(away))
    expected = np.concatenate(ellipsoid.geodetic(origin + away @ axes))
    meters = (place - expected)[:2] * 6.37e6 * [1.0, np.cos(LATITUDE)]
    assert np.abs(meters).max() < 0.15
    read = geodetic_of(away, "flat", (np.array([LATITUDE]), np.array([LONGITUDE])))
    np.testing.assert_allclose(place, np.concatenate(read), rtol=1e-14)


@pytest.mark.parametrize("ground", GROUNDS)
def test_terrain_is_met_where_it_is(ground):
    def slope(latitude, longitude):
        return 30.0 + 5e6 * (longitude - LONGITUDE) * 0.1

    origin, axes = frame(ground)
    r, v = origin + AWAY[0] @ axes, np.array([70.0, 0.0, 0.0]) @ axes
    p = seen_on_terrain(ground, r, v, [1450.0, 1600.0], 0.02, slope)
    latitude, longitude, height = ground.geodetic(p)
    np.testing.assert_allclose(height, slope(latitude, longitude), atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(p - r, axis=1), [1450.0, 1600.0], rtol=0, atol=1e-6)


def test_a_range_that_does_not_reach_the_ground_is_refused():
    for ground in GROUNDS:
        origin, axes = frame(ground)
        with pytest.raises(ValueError, match="do not all reach the ground"):
            ground.seen(origin + AWAY[0] @ axes, [70.0, 0, 0] @ axes, 900.0, 0.0, 0.0)
