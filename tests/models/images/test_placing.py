"""Where an orbit predicts an image on a reference, and the place and covariance of a match."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.geometry.geolocation import track_axes
from terrafix.models.images.matching import Match, Searchable
from terrafix.models.images.placing import View, _on_terrain, placed, predicted, recognized
from terrafix.models.images.reference import Reference

SHAPE = (480, 600)
R_E = np.array([-1104646.34, -6096830.39, 3395727.38])
V_E = np.array([-112.0, 3806.0, 6497.9])
VIEW = View(R_E, V_E, 200.5, 299.9, 2 / 2160, 861e3, 9.37, 9e-4)


def hills(latitude, longitude):
    """300 m of relief over some kilometers."""
    return 150 * (1 + np.sin(latitude * 6371 / 1.3) * np.cos(longitude * 5500 / 1.7))


def flat(latitude, longitude):
    return 0 * latitude


def reference(view, terrain=hills, margin=600, n=49):
    """What a view sees, as a reference in its own geometry: its row 0 is row -margin of it."""
    ties = [np.linspace(0, k + 2 * margin - 1, n) for k in SHAPE]
    rows, columns = (t - margin for t in ties)
    h = np.zeros((n, n))
    for _ in range(60):
        latitude, longitude, _ = geodetic(view.points(rows, columns, h))
        h = h + 0.6 * (terrain(latitude, longitude) - h)
    amplitude = np.ones([k + 2 * margin for k in SHAPE], np.float32)
    return Reference(amplitude, ties[0], ties[1], latitude, longitude, h)


@pytest.fixture(scope="module")
def known():
    return reference(VIEW)


def test_an_orbit_that_is_right_predicts_every_pixel(known):
    """On hills, between tie points: 0.05 pixels."""
    where = predicted(VIEW, np.zeros((6, 6)), known, hills, SHAPE)
    rows, columns = np.array([0.0, 200.5, 479.0]), np.array([0.0, 299.9, 599.0])
    true = np.stack(np.meshgrid(rows + 600, columns + 600, indexing="ij"), axis=-1)
    np.testing.assert_allclose(where.at(rows, columns), true, atol=0.05)
    np.testing.assert_allclose(where.slope(200.5, 299.9), np.eye(2), atol=1e-3)


@pytest.mark.parametrize("side", [1, -1])
def test_an_orbit_that_is_wrong_is_off_by_what_its_covariance_says(side):
    """40 orbits off by 300 m and 3 m/s: normalized squares of the shift have mean 2, of the four
    elements of the linear map 4; 3 sigma of their means either way."""
    view = replace(VIEW, side=side)
    known = reference(view, flat, n=9)
    P = np.diag([300.0**2] * 3 + [3.0**2] * 3)
    rng = np.random.default_rng(3)
    shifts, slopes = [], []
    for _ in range(40):
        off = np.sqrt(np.diag(P)) * rng.standard_normal(6)
        v = V_E + off[3:]
        sine = view.sine * np.linalg.norm(V_E) / np.linalg.norm(v)
        other = replace(view, r=R_E + off[:3], v=v, sine=sine)
        where = predicted(other, P, known, flat, SHAPE)
        # the true center is where the prediction puts center + shift
        A = where.slope(200.5, 299.9)
        shift = np.linalg.solve(A, [800.5, 899.9] - where.at([200.5], [299.9])[0, 0])
        shifts.append(shift @ np.linalg.solve(where.covariance, shift))
        linear = (np.linalg.inv(A) - np.eye(2)).ravel()
        slopes.append(linear @ np.linalg.solve(where.linear, linear))
    assert np.mean(shifts) == pytest.approx(2.0, abs=3 * np.sqrt(4 / 40))
    assert np.mean(slopes) < 4 + 3 * np.sqrt(8 / 40)  # with what tie points may have wrong: less


def test_time_and_range_are_in_the_shift(known):
    """1 ms is 1.08 rows of 2 / 2160 s, and 18.7 m are two columns of 9.37 m."""
    unsure = replace(VIEW, time_sigma=1e-3, range_sigma=18.74)
    where = predicted(unsure, np.zeros((6, 6)), known, hills, SHAPE)
    np.testing.assert_allclose(np.sqrt(np.diag(where.covariance)), [1.08, 2.0], rtol=1e-6)


@pytest.mark.parametrize(
    "mutation", [{"row_time": -2 / 2160}, {"column_range": -9.37}, {"side": -1}]
)
def test_a_sign_that_is_wrong_is_seen_in_what_is_predicted(known, mutation):
    where = predicted(replace(VIEW, **mutation), np.zeros((6, 6)), known, hills, SHAPE)
    corner = where.at([0.0], [0.0])[0, 0]
    assert np.abs(corner - 600).max() > 300


def test_what_sees_no_ground_is_refused(known):
    with pytest.raises(ValueError, match="do not all reach the ground"):
        predicted(replace(VIEW, r=4 * R_E), np.eye(6), known, hills, SHAPE)


@pytest.mark.parametrize("longitude", [-np.pi, 0.3])
def test_it_goes_on_across_the_date_line(longitude):
    """The same pass turned about the Earth's axis, tie points on both sides of 180 degrees."""
    c, s = np.cos(longitude), np.sin(longitude)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    _, own, _ = geodetic(VIEW.points(np.array([200.5]), np.array([299.9]), np.zeros((1, 1))))
    back = np.array(
        [
            [np.cos(own[0, 0]), np.sin(own[0, 0]), 0],
            [-np.sin(own[0, 0]), np.cos(own[0, 0]), 0],
            [0, 0, 1],
        ]
    )
    view = replace(VIEW, r=turn @ back @ R_E, v=turn @ back @ V_E)
    ties = reference(view, flat, n=9)
    wrapped = replace(ties, longitude=np.angle(np.exp(1j * ties.longitude)))
    where = predicted(view, np.zeros((6, 6)), wrapped, flat, SHAPE)
    np.testing.assert_allclose(where.at([200.5], [299.9])[0, 0], [800.5, 899.9], atol=0.05)


def match_at(row, column, covariance):
    return Match(row, column, np.asarray(covariance, float), True, "accepted")


def test_the_covariance_of_a_place_is_that_of_pixels_reference_and_heights(known):
    """On level ground at 38.7 deg: rows of 6.3 m along, columns of 9.37 m / sin(incidence) across,
    and a height that is off by 1 m moves the place by 1 / tan(incidence) m towards the radar."""
    level = reference(VIEW, flat, n=9)
    match = match_at(800.5, 899.9, np.diag([0.2**2, 0.1**2]))
    p, D = placed(level, flat, match, VIEW, np.zeros(3))
    true = VIEW.points(np.array([200.5]), np.array([299.9]), np.zeros((1, 1)))[0, 0]
    np.testing.assert_allclose(p, true, atol=0.02)
    axes = track_axes(p, V_E)
    line = (R_E - p) / np.linalg.norm(R_E - p)
    incidence = np.arccos(axes[2] @ line)
    own = axes @ D @ axes.T
    row = np.linalg.norm(
        np.diff(VIEW.points(np.array([200.0, 201.0]), np.array([299.9]), np.zeros((2, 1))), axis=0)
    )
    np.testing.assert_allclose(np.sqrt(own[0, 0]), 0.2 * row, rtol=0.01)
    np.testing.assert_allclose(np.sqrt(own[1, 1]), 0.1 * 9.37 / np.sin(incidence), rtol=0.01)
    assert abs(own[2, 2]) < 1e-4
    datum = (
        axes
        @ placed(
            level, flat, match_at(800.5, 899.9, np.zeros((2, 2))), VIEW, np.array([0, 0, 30.0])
        )[1]
        @ axes.T
    )
    np.testing.assert_allclose(np.sqrt(datum[2, 2]), 30.0, rtol=0.01)
    np.testing.assert_allclose(np.sqrt(datum[1, 1]), 30.0 / np.tan(incidence), rtol=0.02)
    assert abs(datum[1, 2]) < 1e-6


@pytest.mark.parametrize("terrain", [hills, flat])
def test_a_map_30_m_low_is_within_a_sigma_of_30_m(terrain):
    """Its place is 48 m off on level ground, with one height for reference and image."""

    def lower(latitude, longitude):
        return terrain(latitude, longitude) - 30.0

    row, column = np.array([200.5]), np.array([299.9])
    height = np.zeros((1, 1))
    for _ in range(60):
        true = VIEW.points(row, column, height)
        height = height + 0.5 * (terrain(*geodetic(true)[:2]) - height)
    match = match_at(800.5, 899.9, np.diag([0.05**2, 0.05**2]))
    p, D = placed(reference(VIEW, lower), lower, match, VIEW, np.array([0.1, 0.1, 30.0]))
    miss = true[0, 0] - p
    assert 30 < np.linalg.norm(miss) < 90
    assert miss @ np.linalg.solve(D, miss) < 2.1


def test_errors_of_places_are_along_and_across(known):
    p, D = placed(
        known, hills, match_at(800.5, 899.9, np.zeros((2, 2))), VIEW, np.array([2.0, 3.0, 0.0])
    )
    own = track_axes(p, V_E) @ D @ track_axes(p, V_E).T
    np.testing.assert_allclose(own, np.diag([4.0, 9.0, 0.0]), atol=1e-6)
    _, longitude, height = geodetic(p)
    assert height == pytest.approx(hills(geodetic(p)[0], longitude), abs=0.05)
    assert np.linalg.norm(ecef(*geodetic(p)) - p) < 1e-3


@pytest.mark.parametrize(("latitude", "side"), [(79.5, -1), (-79.5, 1), (84.0, 1)])
def test_high_latitudes_are_as_others(latitude, side):
    """Eastward at 80 degrees looking to the pole, and at 84: places at 84 to 85, and at 80."""
    phi = np.radians(latitude)
    r = 7.07e6 * np.array([0.0, np.cos(phi), np.sin(phi)])
    view = replace(VIEW, r=r, v=np.array([-7600.0, 0.0, 0.0]), sine=0.0, side=side)
    ties = reference(view, flat, n=33)
    assert np.degrees(np.abs(ties.latitude)).max() > 78
    where = predicted(view, np.zeros((6, 6)), ties, flat, SHAPE)
    np.testing.assert_allclose(where.at([200.5], [299.9])[0, 0], [800.5, 899.9], atol=0.05)


def ridges(latitude, longitude):
    """120 m of relief each kilometer: slopes of a fourth."""
    return 60 * (1 + np.sin(latitude * 6371 / 0.25) * np.cos(longitude * 5500 / 0.3))


def patterned(latitude, longitude, seed=5):
    """Amplitude of a ground that shows something everywhere: waves of 40 to 400 m."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.shape(latitude))
    for _ in range(60):
        k = 2 * np.pi / np.exp(rng.uniform(np.log(40.0), np.log(400.0)))
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        total += np.cos(
            k * 6371e3 * (np.cos(angle) * latitude + np.sin(angle) * 0.87 * longitude) + phase
        )
    return np.exp(total / np.sqrt(60)).astype(np.float32)


def test_an_image_of_relief_is_recognized_on_a_map_that_shows_none():
    """A map north up, 12 m a pixel, an estimate 1.2 km off, 120 m of relief each kilometer.

    Its relief is predicted node by node, and anew for the place that is found.
    """
    shape = (200, 160)
    view = replace(VIEW, row=99.5, column=79.5, row_time=4 / 2160, column_range=9.37)
    rows, columns = (np.arange(n, dtype=float) for n in shape)
    latitude, longitude, _ = _on_terrain(view, rows, columns, ridges)
    image = Searchable(patterned(latitude, longitude))
    true = (
        latitude[99, 79] / 2 + latitude[100, 80] / 2,
        longitude[99, 79] / 2 + longitude[100, 80] / 2,
    )
    step = 12 / 6371e3
    i, j = np.arange(-300, 301) * step, np.arange(-300, 301) * step / 0.87
    ties = np.linspace(0, 600, 41)
    lat, lon = np.meshgrid(true[0] - i, true[1] + j, indexing="ij")
    at = np.meshgrid(
        np.interp(ties, np.arange(601), true[0] - i),
        true[1] + np.interp(ties, np.arange(601), j),
        indexing="ij",
    )
    known = Reference(patterned(lat, lon), ties, ties, *at, ridges(*at))
    ahead = V_E / np.linalg.norm(V_E)
    wrong = replace(view, r=R_E + 1200.0 * ahead)
    P = np.diag([800.0**2] * 3 + [0.1**2] * 3)
    amplitude = Searchable(known.amplitude)
    where = predicted(wrong, P, known, ridges, shape)
    assert not where.slant
    match = recognized(image, amplitude, wrong, P, known, ridges)
    assert match.accepted
    # by nodes of relief as far apart as in slant geometry it is off by 1.6 columns, 19 m
    np.testing.assert_allclose([match.row, match.column], [300, 300], atol=0.06)


def test_in_slant_geometry_nothing_is_predicted_again(known):
    assert predicted(VIEW, np.diag([1e6] * 3 + [1e2] * 3), known, hills, SHAPE).slant


def test_a_place_on_a_slope_that_nearly_folds_is_on_it_and_one_that_folds_is_refused(known):
    """Slopes to 0.68 at 39 deg of incidence leave a tenth of the range; at 1.2 it runs backward."""

    def ridge(steep):
        def height(latitude, longitude):
            return 150 + 250 * steep * np.sin((longitude + 1.66) * 5.5e6 / 250)

        return height

    rows, columns = np.linspace(600, 700, 8), np.linspace(600, 1100, 60)
    for row in rows:
        for column in columns:
            found = known.place_on(ridge(0.62), row, column)
            assert ridge(0.62)(*found[:2]) == pytest.approx(found[2], abs=0.02)
            a, b = np.array([row - 600]), np.array([column - 600])
            p = VIEW.points(a, b, np.full((1, 1), found[2]))[0, 0]
            assert np.linalg.norm(ecef(*found) - p) < 0.5
    with pytest.raises(ValueError, match=r"[35] places of the terrain are seen at row 600\.0"):
        [known.place_on(ridge(1.2), rows[0], column) for column in columns]
