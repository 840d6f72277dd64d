"""Polygons: moments and their noise by closed forms and Monte Carlo, clipping, distances."""

import os
from pathlib import Path

import numpy as np
import pytest
import shapely

from terrafix.models.images.polygons import (
    clip_to_frame,
    distances,
    moment_noise,
    moments,
    outline,
    split_rings,
)

DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))


def bay(shift=(0.0, 0.0)):
    """A concave outline with a bay and a cape, 24 vertices, some 60 x 12 px."""
    x = np.linspace(0, 60, 12)
    north = 4 + 3 * np.sin(x / 7) + 0.02 * x
    south = -4 + 3 * np.sin(x / 9 + 1)
    ring = np.concatenate([np.stack([x, south], 1), np.stack([x, north], 1)[::-1]])
    return ring + np.array([80.0, 60.0]) + np.array(shift)


def seneca():
    """The outline of Lake Seneca as the camera of the notes sees it, by an affine map."""
    file = DATA / "lakes_gshhg" / "seneca_full.csv"
    if not file.is_file():
        pytest.skip(f"no real data: {file} is absent (set TERRAFIX_DATA)")
    ring = np.loadtxt(file, delimiter=",")[:-1, ::-1]
    ring = ring / np.ptp(ring, axis=0) * np.array([175.9, 32.636])
    return ring - (ring.max(axis=0) + ring.min(axis=0)) / 2 + np.array([160.0, 128.0])


def turned(ring, angle):
    c, s = np.cos(angle), np.sin(angle)
    return ring @ np.array([[c, s], [-s, c]])


# ------------------------------------------------------------------------------------- moments


def test_moments_of_a_rectangle():
    """b^2/12 and h^2/12 about the middle; the closed form, turned by 30 deg too."""
    ring = np.array([[0, 0], [6, 0], [6, 2], [0, 2]], float)
    m, _ = moments(ring + np.array([10, 20]))
    np.testing.assert_allclose(m, [12, 13, 21, 3, 1 / 3, 0], atol=1e-13)
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    m, _ = moments(turned(ring, np.pi / 6))
    expected = [3 * c**2 + s**2 / 3, 3 * s**2 + c**2 / 3, (3 - 1 / 3) * c * s]
    np.testing.assert_allclose(m[3:], expected, atol=1e-13)


def test_moments_of_a_regular_polygon_tend_to_the_ellipse():
    """An affine regular n-gon: a b n sin(2 pi / n) / 2, a^2 (2 + cos(2 pi / n)) / 12; exact."""
    for n in (3, 5, 200):
        t = 2 * np.pi * np.arange(n) / n
        m, _ = moments(np.stack([9 * np.cos(t), 4 * np.sin(t)], 1))
        area = 36 * n / 2 * np.sin(2 * np.pi / n)
        second = (2 + np.cos(2 * np.pi / n)) / 12
        np.testing.assert_allclose(m, [area, 0, 0, 81 * second, 16 * second, 0], atol=1e-12)
    np.testing.assert_allclose(m[3:5], [81 / 4, 16 / 4], rtol=1e-3)


def test_moments_do_not_depend_on_orientation_first_vertex_or_place():
    """A million pixels off, sums about the origin would keep no digit of the second moments."""
    m, J = moments(bay())
    back, J_back = moments(bay()[::-1])
    np.testing.assert_allclose(back, m, rtol=1e-12)
    np.testing.assert_allclose(J_back[:, ::-1], J, atol=1e-12)
    np.testing.assert_allclose(moments(np.roll(bay(), 7, axis=0))[0], m, rtol=1e-12)
    far, _ = moments(bay((2.0**20, -(2.0**21))))
    np.testing.assert_allclose(far - m, [0, 2**20, -(2**21), 0, 0, 0], atol=1e-6)


def test_area_and_centroid_are_those_of_shapely():
    polygon = shapely.Polygon(bay())
    m, _ = moments(bay())
    np.testing.assert_allclose(
        m[:3], [polygon.area, polygon.centroid.x, polygon.centroid.y], rtol=1e-12
    )


def test_moments_take_leading_axes():
    stack = np.stack([bay(), bay((3, 4)), bay()[::-1]])[:, None]
    m, J = moments(stack)
    assert m.shape == (3, 1, 6)
    assert J.shape == (3, 1, 6, 24, 2)
    P, bias = moment_noise(stack, np.array([[0.1], [0.2], [0.3]]))
    for k in range(3):
        one, J_one = moments(stack[k, 0])
        np.testing.assert_array_equal(m[k, 0], one)
        np.testing.assert_array_equal(J[k, 0], J_one)
        P_one, bias_one = moment_noise(stack[k, 0], 0.1 * (k + 1))
        np.testing.assert_allclose(P[k, 0], P_one, rtol=1e-12)
        np.testing.assert_allclose(bias[k, 0], bias_one, rtol=1e-12, atol=1e-18)


def ringed():
    """The bay and two islands, the other way round, and where the rings start."""
    square = np.array([[0, 0], [0, 3], [4, 3], [4, 0]], float)
    rings = [bay(), square + np.array([92, 59]), square / 2 + np.array([120, 61])]
    for ring in rings[1:]:
        assert shapely.Polygon(rings[0]).contains(shapely.Polygon(ring))
    return np.concatenate(rings), (0, len(rings[0]), len(rings[0]) + 4)


def test_islands_are_no_part_of_the_moments():
    """Of the sum A m: the shore's less those of the islands; shapely's area and centroid."""
    points, starts = ringed()
    m, _ = moments(points, starts)
    shore, *islands = np.split(points, starts[1:])
    polygon = shapely.Polygon(shore, islands)
    np.testing.assert_allclose(m[0], polygon.area, rtol=1e-13)
    np.testing.assert_allclose(m[1:3], [polygon.centroid.x, polygon.centroid.y], rtol=1e-13)

    def about_origin(ring):
        area, x, y, xx, yy, xy = moments(ring)[0]
        return area * np.array([1, xx + x * x, yy + y * y, xy + x * y])

    area, *second = about_origin(shore) - sum(about_origin(ring) for ring in islands)
    x, y = m[1:3]
    expected = np.array(second) / area - [x * x, y * y, x * y]
    np.testing.assert_allclose(m[3:], expected, atol=1e-9)


def test_derivatives_and_noise_of_rings_are_those_of_differences_and_of_draws():
    """Jacobian by central differences; covariance and bias by 40,000 draws of 0.25 px."""
    points, starts = ringed()
    m, J = moments(points, starts)
    h = 1e-5
    for k in (0, 5, len(points) - 3):
        for axis in (0, 1):
            ends = []
            for sign in (1, -1):
                moved = points.copy()
                moved[k, axis] += sign * h
                ends.append(moments(moved, starts)[0])
            np.testing.assert_allclose(J[:, k, axis], (ends[0] - ends[1]) / (2 * h), atol=1e-6)
    draws = np.random.default_rng(1).normal(size=(40_000, *points.shape))
    found = moments(points + 0.25 * draws, starts)[0] - m
    P, bias = moment_noise(points, 0.25, starts)
    spread = np.sqrt(np.diag(P))
    np.testing.assert_allclose(found.std(axis=0), spread, rtol=0.02)
    np.testing.assert_array_less(np.abs(found.mean(axis=0) - bias), 4.5 * spread / 200)
    assert bias[4] > 20 * spread[4] / 200


def test_rings_are_split_where_a_row_is_not_a_number():
    points, starts = ringed()
    told = np.insert(np.stack([points, points + 1]), starts[1:], np.nan, axis=1)
    found, begins = split_rings(told)
    assert begins == starts
    np.testing.assert_array_equal(found, [points, points + 1])
    alone, begins = split_rings(points)
    assert begins == (0,)
    assert alone is points


@pytest.mark.parametrize("turn", [1, -1])
def test_the_jacobian_is_the_derivative(turn):
    """Central differences: their error is h^2 times the third derivatives, and eps/h."""
    ring = bay()[::turn]
    _, J = moments(ring)
    h = 1e-4
    for k in range(len(ring)):
        for axis in range(2):
            step = np.zeros_like(ring)
            step[k, axis] = h
            slope = (moments(ring + step)[0] - moments(ring - step)[0]) / (2 * h)
            np.testing.assert_allclose(J[:, k, axis], slope, atol=1e-7)


def test_the_bias_is_half_the_trace_of_the_hessian():
    """By second differences of every coordinate: exact to h^2 and eps m/h^2 = 1e-9 each."""
    ring, sigma, h = bay(), 0.3, 1e-2
    m, _ = moments(ring)
    trace = np.zeros(6)
    for k in range(ring.size):
        step = np.zeros(ring.size)
        step[k] = h
        step = step.reshape(ring.shape)
        trace += (moments(ring + step)[0] - 2 * m + moments(ring - step)[0]) / h**2
    _, bias = moment_noise(ring, sigma)
    np.testing.assert_allclose(bias, sigma**2 / 2 * trace, atol=1e-6)


def test_noise_of_moments_is_that_of_monte_carlo():
    """Means and covariances of 40 000 draws, within 4.5 standard errors of each."""
    ring, sigma, n = bay(), 0.25, 40_000
    rng = np.random.default_rng(7)
    m, _ = moments(ring)
    P, bias = moment_noise(ring, sigma)
    drawn, _ = moments(ring + sigma * rng.standard_normal((n, *ring.shape)))
    error = np.sqrt(np.diag(P) / n)
    assert np.all(np.abs(drawn.mean(axis=0) - m - bias) < 4.5 * error)
    assert np.abs(bias[3:5] / error[3:5]).max() > 9, "the bias must be seen to be tested"
    C = np.cov(drawn.T)
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    # covariances of the fourth order: sigma^2 / extent^2 of the first, below 1 percent here
    np.testing.assert_allclose(C / scale, P / scale, atol=4.5 * np.sqrt(2 / n) + 0.01)


def test_the_bias_of_seneca_is_that_of_the_notes():
    """+0.039 px^2 at 0.25 px and +0.155 at 0.5 px of a perspective view, by Monte Carlo.

    The map is affine here: moments within half a percent, the bias within what was printed.
    """
    ring = seneca()
    m, _ = moments(ring)
    np.testing.assert_allclose(m[[0, 3, 4, 5]], [1691, 2083.6, 61.05, -281.1], rtol=5e-3)
    for sigma, expected in ((0.25, 0.039), (0.5, 0.155)):
        P, bias = moment_noise(ring, sigma)
        assert bias[0] == 0
        np.testing.assert_allclose(bias[4], expected, rtol=0.035)
    np.testing.assert_allclose(np.sqrt(np.diag(P)[:3]), [13.5, 0.40, 0.073], rtol=0.02)


# ------------------------------------------------------------------------------------- clipping


def test_a_polygon_within_the_frame_stays_whole():
    clipped = clip_to_frame(bay(), 160, 128)
    assert clipped.whole
    np.testing.assert_allclose(moments(clipped.rings[0])[0], moments(bay())[0], rtol=1e-12)


def test_a_concave_polygon_falls_apart_at_the_frame():
    """An M from above: its legs stay, its roof is cut off at the frame's lower border, y = 9.5."""
    letter = [[0, 4], [2, 4], [2, 14], [6, 14], [6, 4], [8, 4], [8, 18], [0, 18]]
    clipped = clip_to_frame(letter, 20, 10)
    assert len(clipped.rings) == 2
    assert not clipped.whole
    for ring, on in zip(clipped.rings, clipped.on_frame, strict=True):
        assert moments(ring)[0][0] == pytest.approx(2 * 5.5)
        assert on.sum() == 1
        (k,) = np.flatnonzero(on)
        np.testing.assert_allclose([ring[k, 1], ring[(k + 1) % len(ring), 1]], 9.5)


def test_a_polygon_around_the_frame_shows_the_frame():
    clipped = clip_to_frame(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 900.0, 32, 16)
    assert clipped.on_frame[0].all()
    np.testing.assert_allclose(
        moments(clipped.rings[0])[0], [512, 15.5, 7.5, 32**2 / 12, 16**2 / 12, 0], atol=1e-9
    )


def test_a_corner_of_the_frame_joins_two_edges_that_lie_on_it():
    clipped = clip_to_frame([[-5, -5], [4, -5], [4, 4], [-5, 4]], 20, 10)
    assert clipped.on_frame[0].sum() == 2
    assert moments(clipped.rings[0])[0][0] == pytest.approx(4.5**2)


@pytest.mark.parametrize("shift", [(500, 0), (0, -500), (-80.5 - 60, -60)])
def test_nothing_is_left_outside_the_frame(shift):
    """The last only touches the border."""
    assert clip_to_frame(bay(shift), 160, 128).rings == ()


# ------------------------------------------------------------------------------------- distances


def test_distances_to_a_square():
    square = [[0, 0], [4, 0], [4, 4], [0, 4]]
    points = [[2, -1], [2, 1], [-3, -4], [4, 2], [5, 3]]
    for ring in (square, square[::-1]):
        near = distances(points, ring)
        np.testing.assert_allclose(near.distance, [1, 1, 5, 0, 1], atol=1e-15)
        np.testing.assert_allclose(near.signed, [1, -1, 5, 0, 1], atol=1e-15)
        np.testing.assert_allclose(near.normal[[0, 1, 3, 4]], [[0, -1], [0, -1], [1, 0], [1, 0]])
        np.testing.assert_allclose(near.normal[2], [-0.6, -0.8])
        np.testing.assert_allclose(near.foot, [[2, 0], [2, 0], [0, 0], [4, 2], [4, 3]])
    near = distances(points, square)
    assert near.segment.tolist() == [0, 0, 0, 1, 1]
    np.testing.assert_allclose(near.parameter, [0.5, 0.5, 0, 0.5, 0.75])


def test_distances_are_those_of_shapely():
    points = np.random.default_rng(3).uniform([60, 40], [160, 80], (4000, 2))
    near = distances(points, bay())
    polygon = shapely.Polygon(bay())
    places = shapely.points(points)
    np.testing.assert_allclose(
        near.distance, shapely.distance(polygon.exterior, places), atol=1e-12
    )
    np.testing.assert_array_equal(near.signed < 0, shapely.contains(polygon, places))
    q, q1 = bay()[near.segment], np.roll(bay(), -1, axis=0)[near.segment]
    np.testing.assert_allclose(near.foot, q + near.parameter[:, None] * (q1 - q), atol=1e-12)


def test_the_normal_is_the_gradient_of_the_signed_distance():
    """Away from where two feet are as near, where it has none."""
    points = np.random.default_rng(4).uniform([70, 45], [150, 75], (300, 2))
    near, h = distances(points, bay()), 1e-6
    slope = np.stack(
        [
            (distances(points + d, bay()).signed - distances(points - d, bay()).signed) / (2 * h)
            for d in (np.array([h, 0]), np.array([0, h]))
        ],
        axis=1,
    )
    np.testing.assert_allclose(near.normal, slope, atol=1e-4)
    np.testing.assert_allclose(
        near.signed, ((points - near.foot) * near.normal).sum(axis=1), atol=1e-12
    )


def test_many_points_are_taken_in_parts():
    points = np.random.default_rng(5).uniform(0, 150, (100_000, 2))
    near = distances(points, bay())
    some = slice(99_000, None)
    np.testing.assert_array_equal(near.signed[some], distances(points[some], bay()).signed)
    assert distances(np.empty((0, 2)), bay()).distance.shape == (0,)


def test_a_repeated_vertex_does_no_harm():
    ring = np.insert(bay(), 5, bay()[5], axis=0)
    points = bay() + 0.3
    np.testing.assert_allclose(
        distances(points, ring).signed, distances(points, bay()).signed, atol=1e-12
    )


# ------------------------------------------------------------------------------------- bad input


def test_an_outline_loses_a_last_vertex_that_repeats_the_first():
    closed = np.vstack([bay(), bay()[:1]])
    np.testing.assert_array_equal(outline(closed), bay())


BAD = {
    "crosses": ([[0, 0], [2, 2], [2, 0], [0, 2]], "does not cross itself; got Self-intersection"),
    "two": ([[0, 0], [2, 2]], "has three vertices or more, got 2"),
    "closed two": ([[0, 0], [2, 2], [0, 0]], "has three vertices or more, got 2"),
    "nan": ([[0, 0], [2, np.nan], [2, 0]], "finite coordinates, got a NaN or infinity in vertex 1"),
    "flat": ([[0, 0], [1, 1], [2, 2]], "does not cross itself; got"),
    "3-d": (np.zeros((5, 3)), r"\(K, 2\), got \(5, 3\)"),
    "stacked": (np.zeros((2, 5, 2)), r"\(K, 2\), got \(2, 5, 2\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_outline_is_refused(case):
    vertices, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        outline(vertices)
    with pytest.raises(ValueError, match=message):
        clip_to_frame(vertices, 20, 20)


@pytest.mark.parametrize("function", [moments, lambda v: distances([[0, 0]], v)])
def test_what_cannot_be_measured_is_refused(function):
    for case in ("two", "nan", "3-d"):
        with pytest.raises(ValueError, match=BAD[case][1]):
            function(BAD[case][0])
    with pytest.raises(ValueError, match="encloses an area, got one of 0 px"):
        function(BAD["flat"][0])


def test_other_bad_input_is_refused():
    with pytest.raises(ValueError, match=r"one pixel or more along each side, got 0 x 5"):
        clip_to_frame(bay(), 0, 5)
    with pytest.raises(ValueError, match=r"0 px or more, got -1"):
        moment_noise(bay(), -1.0)
    with pytest.raises(ValueError, match=r"set of points has finite .* vertex 1"):
        distances([[0, 0], [np.inf, 0]], bay())
