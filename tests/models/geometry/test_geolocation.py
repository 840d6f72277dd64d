"""Arcs of orbits, and the way between image coordinates and places."""

import numpy as np
import pymap3d
import pytest

from terrafix.models.geometry.geodesy import ecef, geodetic, local_axes
from terrafix.models.geometry.geolocation import ground_point, ground_point_on_terrain, track_axes
from terrafix.models.maps.dem import Dem, flat_dem
from terrafix.models.motion.arc import OrbitArc, seen_at
from terrafix.models.motion.gravity import earth_fixed_acceleration
from terrafix.models.radar.boresight import boresight_on_terrain

LOOK = np.radians(34.3)
ALIGNED = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def arc(start_e):
    return OrbitArc(start_e[0], start_e[1], 100.0, 6.0, 9.0)


def test_an_arc_passes_through_its_state(arc, start_e):
    assert arc.position(100.0) == pytest.approx(start_e[0], abs=1e-6)
    assert arc.velocity(100.0) == pytest.approx(start_e[1], abs=1e-6)


def test_derivatives_of_an_arc_are_those_of_the_motion(arc, constants):
    """Acceleration against the equations of motion, jerk and snap against differences of it."""
    import casadi as ca

    r, v = ca.SX.sym("r", 3), ca.SX.sym("v", 3)
    a = ca.Function("a", [r, v], [earth_fixed_acceleration(r, v, *constants.values())])
    for t in (95.0, 100.0, 108.0):
        expected = a(arc.position(t), arc.velocity(t)).full().ravel()
        assert arc.derivative(t, 2) == pytest.approx(expected, abs=1e-6)
        for order in (3, 4):
            h = 0.1
            change = arc.derivative(t + h, order - 1) - arc.derivative(t - h, order - 1)
            assert arc.derivative(t, order) == pytest.approx(change / (2 * h), abs=1e-5)


def test_an_arc_says_what_it_covers(arc):
    with pytest.raises(ValueError, match=r"the arc covers 94\.000 to 109\.000 s, asked for 93\.0"):
        arc.position(93.0)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (([np.nan] * 3, [0.0] * 3), "finite position and velocity"),
        (([1.0, 0.0, 0.0], [0.0] * 3), "inside the Earth"),
    ],
)
def test_impossible_states_are_refused(state, message):
    with pytest.raises(ValueError, match=message):
        OrbitArc(*state, 0.0, 1.0, 1.0)


def test_geodetic_coordinates_agree_with_another_library():
    rng = np.random.default_rng(0)
    latitude, longitude = rng.uniform(-1.55, 1.55, 50), rng.uniform(-3.1, 3.1, 50)
    height = rng.uniform(-400, 9000, 50)
    p = ecef(latitude, longitude, height)
    other = pymap3d.geodetic2ecef(np.degrees(latitude), np.degrees(longitude), height)
    assert p == pytest.approx(np.stack(other, axis=-1), abs=1e-8)
    back = geodetic(p)
    assert back[0] == pytest.approx(latitude, abs=1e-13)
    assert back[2] == pytest.approx(height, abs=1e-6)


def test_local_axes_are_east_north_up():
    p = ecef(0.7, -1.2, 500.0)
    east, north, up = local_axes(p)
    assert ecef(0.7, -1.2, 501.0) - p == pytest.approx(up, abs=1e-6)
    d = 1e-6
    assert (ecef(0.7, -1.2 + d, 500.0) - p) @ east == pytest.approx(
        6371e3 * d * np.cos(0.7), rel=1e-2
    )
    assert (ecef(0.7 + d, -1.2, 500.0) - p) @ north == pytest.approx(6371e3 * d, rel=1e-2)


@pytest.mark.parametrize("sine", [0.0, 0.02, -0.03])
def test_a_ground_point_satisfies_the_range_doppler_equations(start_e, sine):
    r, v, _ = start_e
    R, h = np.array([845e3, 861e3, 880e3]), np.array([0.0, 300.0, 2500.0])
    p = ground_point(r, v, R, sine, h)
    line = p - r
    assert np.linalg.norm(line, axis=1) == pytest.approx(R, abs=1e-6)
    closing = line @ v / np.linalg.norm(v) / R
    assert closing == pytest.approx(np.full(3, sine), abs=1e-12)
    assert geodetic(p)[2] == pytest.approx(h, abs=1e-5)
    right = np.cross(v, r)  # against the orbit normal
    assert (line @ right > 0).all()


def test_seeing_a_point_inverts_finding_it(arc):
    t, R = np.array([98.0, 100.5, 107.0]), np.array([845e3, 861e3, 880e3])
    for doppler in (0.0, 400.0, -2000.0):
        r, v = arc.position(t), arc.velocity(t)
        sine = 0.2361 * doppler / (2 * np.linalg.norm(v, axis=1))
        p = ground_point(r, v, R, sine, 120.0)
        when, distance = seen_at(arc, p, doppler, 0.2361)
        assert when == pytest.approx(t, abs=1e-9)
        assert distance == pytest.approx(R, abs=1e-5)


def test_a_point_that_is_not_seen_is_refused(arc):
    p = ecef(0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="is not seen at a Doppler frequency of 0 Hz between 94"):
        seen_at(arc, p, 0.0, 0.2361)


def test_a_range_that_falls_short_is_refused(start_e):
    with pytest.raises(ValueError, match="do not all reach the ground"):
        ground_point(start_e[0], start_e[1], 500e3, 0.0)


def test_on_terrain_the_height_is_that_of_the_place(start_e):
    """A slope toward the radar, for which the point lies nearer than on level ground."""
    r, v, _ = start_e

    def slope(latitude, longitude):
        return 1000.0 + 0.2 * 6371e3 * np.cos(0.5194) * (longitude + 1.664)

    R = np.linspace(855e3, 870e3, 5)
    p = ground_point_on_terrain(r, v, R, 0.0, slope)
    latitude, longitude, height = geodetic(p)
    assert height == pytest.approx(slope(latitude, longitude), abs=2e-3)
    assert np.linalg.norm(p - r, axis=1) == pytest.approx(R, abs=1e-6)


def test_track_axes_are_orthonormal_and_follow_the_track(start_e):
    r, v, _ = start_e
    p = ground_point(r, v, 861e3, 0.0)
    along, across, up = track_axes(p, v)
    assert np.stack([along, across, up]) @ np.stack([along, across, up]).T == pytest.approx(
        np.eye(3)
    )
    assert along @ v > 0.99 * np.linalg.norm(v)
    assert across @ (p - r) > 0  # to the right, where the radar looks
    assert up @ p > 0


def test_the_boresight_meets_the_terrain_it_sees(start_e):
    r, v, q = start_e
    sea = boresight_on_terrain(r, v, q, ALIGNED, LOOK, 0.0, flat_dem())
    assert np.degrees(geodetic(sea.point)[:2]) == pytest.approx([29.76, -95.37], abs=1e-6)
    assert sea.doppler(0.2361) == pytest.approx(0.0, abs=60)  # yaw steering leaves some
    hill = boresight_on_terrain(r, v, q, ALIGNED, LOOK, 0.0, flat_dem(800.0))
    assert geodetic(hill.point)[2] == pytest.approx(800.0, abs=1e-3)
    assert np.cross(hill.point - r, sea.point - r) == pytest.approx(np.zeros(3), abs=1e3)
    assert sea.slant_range - hill.slant_range == pytest.approx(
        800 / np.cos(np.radians(38.7)), rel=2e-3
    )


def test_a_boresight_into_space_or_beyond_the_map_is_refused(start_e):
    r, v, q = start_e
    with pytest.raises(ValueError, match="misses the Earth"):
        boresight_on_terrain(r, v, q, ALIGNED, np.radians(80), 0.0, flat_dem())
    small = Dem(np.zeros((3, 3), np.float32), 0.0, 0.0, 1e-4, 1e-4, "a small map")
    with pytest.raises(ValueError, match=r"a small map does not cover latitude 29\.76"):
        boresight_on_terrain(r, v, q, ALIGNED, LOOK, 0.0, small)
