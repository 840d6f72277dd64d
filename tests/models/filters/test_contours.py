"""Clearance over an elevation model: a plane by hand, finite differences, the unknown."""

import numpy as np
import pytest

from terrafix.models.filters.contours import clearance_observation
from terrafix.models.filters.navigator import DRIFTING
from terrafix.models.geometry.geodesy import ecef_from_geodetic_array
from terrafix.models.maps.charts import level_axes_of
from terrafix.models.maps.dem import Dem
from terrafix.models.motion.strapdown import EARTHS

STEP = np.radians(3 / 3600)
LAT0, LON0 = np.radians(46.0), np.radians(8.0)
METERS = 6.37e6 * STEP


def plane(rise_north, rise_east):
    """A tilted plane of 101 x 101 points, 500 m at the first."""
    i, j = np.mgrid[0:101, 0:101]
    height = 500 + METERS * (rise_north * i + rise_east * np.cos(LAT0) * j)
    return Dem(height.astype(np.float32), LAT0, LON0, STEP, STEP)


def told(dem, n=1):
    grid = np.array([dem.latitude0, dem.longitude0, dem.latitude_step, dem.longitude_step, 0.0])
    origin = {"latitude0": np.full((n, 1), LAT0), "longitude0": np.full((n, 1), LON0)}
    return {"height": dem.height, "grid": grid} | origin


def position(earth, latitude, longitude, height):
    if earth == "wgs84":
        return ecef_from_geodetic_array(latitude, longitude, height)
    north, east = 6367e3 + 0 * latitude, 6388e3 * np.cos(LAT0)  # radii of curvature, to 0.1 %
    return np.array([north * (latitude - LAT0), east * (longitude - LON0), -height])


@pytest.mark.parametrize("earth", EARTHS)
def test_slopes_of_a_plane_are_the_derivative(earth):
    """20 % to the north and -10 % to the east; radii of curvature differ by 0.4 % from 6.37e6 m."""
    seen = clearance_observation(DRIFTING, earth)
    r = position(earth, LAT0 + 50.3 * STEP, LON0 + 40.7 * STEP, 2000.0)[None]
    H = seen.derivative({"r_e": r}, told(plane(0.2, -0.1)))[0, 0]
    axes = level_axes_of(r, earth)[0]
    assert axes @ H[:3] == pytest.approx([-0.2, 0.1, -1.0], abs=1e-3)
    assert not H[3:].any()


@pytest.mark.parametrize("earth", EARTHS)
def test_prediction_and_derivative_agree(earth):
    """Central differences over a tenth of a cell."""
    dem, seen = plane(0.13, 0.21), clearance_observation(DRIFTING, earth)
    r = position(earth, LAT0 + 50.5 * STEP, LON0 + 40.5 * STEP, 2000.0)
    H = seen.derivative({"r_e": r[None]}, told(dem))[0, 0, :3]
    off = 9.0 * np.concatenate([np.eye(3), -np.eye(3)])
    y = seen.predict({"r_e": r + off}, told(dem, 6))[:, 0]
    assert (y[:3] - y[3:]) / 18 == pytest.approx(H, abs=1e-4)


def test_clearance_is_height_less_that_of_the_ground():
    dem, seen = plane(0.2, -0.1), clearance_observation(DRIFTING, "wgs84")
    r = position("wgs84", LAT0 + 10 * STEP, LON0 + 20 * STEP, 2000.0)
    y = seen.predict({"r_e": r[None]}, told(dem))
    assert y == pytest.approx(2000.0 - float(dem.height[10, 20]), abs=1e-6)


def test_what_is_not_known_is_no_number():
    """Beyond the model, and next to a void."""
    height = plane(0.0, 0.0).height.copy()
    height[30, 30] = np.nan
    dem = Dem(height, LAT0, LON0, STEP, STEP)
    places = LAT0 + STEP * np.array([50.0, 120.0, 30.5, -3.0])
    found = dem.known_at(places, LON0 + 30.5 * STEP)
    assert np.isfinite(found).tolist() == [True, False, False, False]
    assert found[0] == pytest.approx(500.0)
