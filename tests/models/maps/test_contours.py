"""Profiles matched with an elevation model: a known shift, and what must be refused."""

import numpy as np
import pytest

from terrafix.models.maps.charts import scales_of
from terrafix.models.maps.contours import REASONS, match_profile
from terrafix.models.maps.dem import Dem, read_jacksboro

DEM = read_jacksboro()
LAT0, LON0 = np.radians(36.3), np.radians(-84.25)
POINTS, SPEED = 60, 70.0  # one a second
SEARCH = {"sigma": 5.0, "height_sigma": 5.0, "reach": 600.0, "step": 45.0}


def profile(course, shift, rng, *, height=3.0, noise=5.0, dem=DEM):
    """Track as estimated, and heights of the ground where it was flown, off by noise and height."""
    along = SPEED * np.arange(POINTS)
    meridian, parallel = scales_of(np.array(LAT0))
    latitude = LAT0 + along * np.cos(course) / meridian
    longitude = LON0 + along * np.sin(course) / parallel
    ground = dem.at(latitude + shift[0] / meridian, longitude + shift[1] / parallel)
    return latitude, longitude, ground + height + noise * rng.standard_normal(POINTS)


def test_shifts_are_found_and_errors_are_as_large_as_said():
    """80 profiles of any course, off by up to 500 m: normalized squares of 2 within 99.9 %.

    The mean of 80 chi-squares of 2 is N(2, 0.22^2): bounds of five sigma. Cells of 90 m are
    bilinear, so that L is not quite normal.
    """
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(80):
        shift = rng.uniform(-500, 500, 2)
        match = match_profile(DEM, *profile(rng.uniform(0, 2 * np.pi), shift, rng), **SEARCH)
        assert REASONS[match.reason] == "matched"
        off = match.shift - shift
        assert np.linalg.norm(off) < 60.0
        squares.append(off @ np.linalg.solve(match.covariance, off))
    assert np.mean(squares) == pytest.approx(2.0, abs=1.1)


def test_a_plain_fits_everywhere():
    rng = np.random.default_rng(5)
    flat = Dem(np.full((401, 401), 300.0, np.float32), LAT0 - 0.003, LON0 - 0.003, 1.5e-5, 1.5e-5)
    match = match_profile(flat, *profile(0.3, (0.0, 0.0), rng, dem=flat), **SEARCH)
    assert REASONS[match.reason] == "several places fit"


def test_a_profile_from_elsewhere_fits_nowhere():
    """2 km off with a search of 600 m."""
    rng = np.random.default_rng(5)
    match = match_profile(DEM, *profile(0.3, (0.0, 2000.0), rng), **SEARCH)
    assert REASONS[match.reason] == "no place fits"


def test_a_place_at_the_edge_of_the_search_is_not_trusted():
    rng = np.random.default_rng(5)
    match = match_profile(DEM, *profile(0.3, (0.0, 600.0), rng), **SEARCH)
    assert REASONS[match.reason] == "at the edge of the search"


def test_a_track_off_the_map_fits_nowhere():
    rng = np.random.default_rng(5)
    latitude, longitude, ground = profile(0.3, (0.0, 0.0), rng)
    match = match_profile(DEM, latitude + 0.01, longitude, ground, **SEARCH)
    assert REASONS[match.reason] == "no place fits"
    assert np.isfinite(match.shift).all()
