"""Looks to both sides of the track, in every hemisphere, across 180 degrees and about a pole."""

import numpy as np
import pytest

from terrafix.models.geometry.antenna import steered_array
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.maps.dem import Dem, flat_dem
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.boresight import boresight_on_terrain
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.scene import Scene

LOOK = float(np.radians(34.3))
ALIGNED = np.array([0.0, 0.0, 0.0, 1.0])
MIRRORS = {"east": np.array([1.0, -1.0, 1.0]), "south": np.array([1.0, 1.0, -1.0])}
PLAIN = {"parcels_db": 0.0, "smooth_db": 0.0, "fine_db": 0.0, "points_per_km2": 0.0}


def level(r, v):
    """Quaternion, Earth-fixed to x ahead, y right, z to the center."""
    down = -r / np.linalg.norm(r)
    right = np.cross(down, v)
    right /= np.linalg.norm(right)
    rows = np.array([np.cross(right, down), right, down])
    w = np.sqrt(max(1 + np.trace(rows), 1e-12)) / 2
    if w > 0.1:
        x = np.array([rows[1, 2] - rows[2, 1], rows[2, 0] - rows[0, 2], rows[0, 1] - rows[1, 0]])
        return np.append(x / (4 * w), w)
    k = int(np.argmax(np.diag(rows)))
    i, j = (k + 1) % 3, (k + 2) % 3
    s = 2 * np.sqrt(1 + rows[k, k] - rows[i, i] - rows[j, j])
    q = np.zeros(4)
    q[k], q[i], q[j] = s / 4, (rows[k, i] + rows[i, k]) / s, (rows[k, j] + rows[j, k]) / s
    q[3] = (rows[i, j] - rows[j, i]) / s
    return q


def flight(latitude, longitude, heading=-13.0, height=692e3):
    """Position and velocity over a place [deg], toward a heading [deg] east of north."""
    lat, lon, h = np.radians([latitude, longitude, heading])
    r = ecef(lat, lon, 0.0) * (1 + height / 6371e3)
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return r, 7560.0 * (np.cos(h) * north + np.sin(h) * east)


def beam(r, v, look, squint=0.0, height=250.0):
    return boresight_on_terrain(r, v, level(r, v), ALIGNED, look, squint, flat_dem(height))


@pytest.mark.parametrize("mirror", MIRRORS)
@pytest.mark.parametrize("squint", [0.0, 0.05])
def test_a_mirrored_orbit_that_looks_left_sees_the_mirrored_place(mirror, squint):
    r, v = flight(29.0, -90.0)
    right = beam(r, v, LOOK, squint)
    left = beam(MIRRORS[mirror] * r, MIRRORS[mirror] * v, -LOOK, squint)
    assert (right.side, left.side) == (1, -1)
    np.testing.assert_allclose(left.point, MIRRORS[mirror] * right.point, atol=1e-3)
    assert left.slant_range == pytest.approx(right.slant_range, abs=1e-3)
    assert left.closing == pytest.approx(right.closing, abs=1e-6)


def test_who_flies_backward_has_the_place_to_the_other_side():
    r, v = flight(29.0, -90.0)
    one, other = beam(r, v, LOOK), beam(r, -v, -LOOK)
    np.testing.assert_allclose(other.point, one.point, atol=1e-3)
    assert (one.side, other.side) == (1, -1)


def test_a_boresight_in_the_plane_of_the_track_is_refused():
    r, v = flight(29.0, -90.0)
    with pytest.raises(ValueError, match="set a look angle, positive to the right or negative"):
        beam(r, v, np.radians(1.0))


def test_an_antenna_that_is_steered_looks_where_a_mounted_one_does():
    r, v = flight(29.0, -90.0)
    for look, squint in ((0.6, 0.0), (-0.5, 0.03)):
        mounted = boresight_on_terrain(r, v, level(r, v), ALIGNED, look, squint, flat_dem())
        turned = steered_array(level(r, v), look, squint)
        steered = boresight_on_terrain(r, v, turned, ALIGNED, 0.0, 0.0, flat_dem())
        np.testing.assert_allclose(steered.point, mounted.point, atol=1e-6)


def hills(center, step_deg=2e-3, n=300):
    """Waves of 100 m about a place [rad], whichever way its longitude is written."""
    i, j = np.mgrid[:n, :n]
    height = (200 + 100 * np.sin(i / 9) * np.cos(j / 7)).astype(np.float32)
    step = np.radians(step_deg)
    stretch = 1 / max(np.cos(center[0]), 0.02)
    return Dem(
        *(height, center[0] - n / 2 * step, center[1] - n / 2 * step * stretch),
        *(step, step * stretch),
    )


@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [(29.0, -90.0), (-35.0, 140.0), (10.0, 179.98), (-10.0, -179.98), (84.0, 30.0), (-84.0, 5.0)],
)
@pytest.mark.parametrize("side", [1, -1])
def test_the_terrain_under_a_footprint_lies_where_it_is_seen(points, latitude, longitude, side):
    """To 0.3 m of range and of the track, whatever side, hemisphere or meridian."""
    r, v = flight(latitude, longitude)
    arc = OrbitArc(r, v, 0.0, 6.0, 6.0)
    seen = beam(r, v, side * LOOK)
    lat, lon, _ = geodetic(seen.point)
    radar = points.PALSAR
    near = seen.slant_range - 100 * radar.range_spacing
    grid = Footprint(arc, radar, -0.1, 433, near, 201, 0.0, side=side)
    dem = hills((float(lat), float(lon)))
    terrain = TerrainGrid(grid, Scene(dem, **PLAIN))
    p = ecef(terrain.latitude, terrain.longitude, terrain.height)
    line, cell = grid.place(p.reshape(-1, 3))
    rows, columns = terrain.ties
    assert np.abs(line.reshape(p.shape[:2]) - rows[:, None]).max() < 0.1
    assert np.abs(cell.reshape(p.shape[:2]) - columns).max() < 0.03
    np.testing.assert_allclose(
        terrain.height, dem.at(terrain.latitude, terrain.longitude), atol=0.06
    )
    east = np.cross(v, r) @ (p.reshape(-1, 3) - r).T
    assert (east * side > 0).all()


def test_a_footprint_about_a_pole_is_refused(points):
    """Looking 4.3 deg to the left from 85.7 N, at the pole itself."""
    r, v = flight(85.7, 10.0, heading=90.0)
    seen = beam(r, v, -LOOK)
    near = seen.slant_range - 1500 * points.PALSAR.range_spacing
    arc = OrbitArc(r, v, 0.0, 6.0, 6.0)
    grid = Footprint(arc, points.PALSAR, -1.0, 4320, near, 3001, 0.0, side=-1)
    with pytest.raises(ValueError, match="its footprint lies about a pole: its longitudes span"):
        TerrainGrid(grid, Scene(flat_dem(), **PLAIN))
