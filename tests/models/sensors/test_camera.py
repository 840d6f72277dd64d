"""A pinhole camera over the Earth: closed forms, a rotation, distortion, the paper's lake."""

import os
from pathlib import Path

import casadi as ca
import cv2
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.filters.lake import CONSIDERED, ORBIT, lake_observation
from terrafix.models.geometry.geodesy import ecef
from terrafix.models.images.polygons import moments
from terrafix.models.motion.attitude import lvlh_quaternion_array
from terrafix.models.sensors.camera import (
    POINTINGS,
    Seen,
    focal_length,
    ground_in_view,
    in_view,
    lens_grows,
    mounted,
    nadir_axes,
    nearest_to_axis,
    pixel,
    turned,
    vertical,
)

DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))
R0 = np.array([3477.4e3, -3719.3e3, 4698.1e3])  # of the paper [m]
V0 = np.array([5540.7, 5180.3, 0.0])  # [m/s]
FOCAL = 1828.81


def numbers(expression):
    return np.array(ca.DM(ca.evalf(expression)))


def test_the_focal_length_is_that_of_the_angle_across():
    """320 px and 10 degrees: 320 / (2 tan 5 deg) = 1828.81 px, half of what is printed."""
    assert focal_length(320.0, np.radians(10.0)) == pytest.approx(1828.8084, abs=1e-3)


def test_camera_axes_are_a_rotation_with_the_flight_upward():
    axes = numbers(nadir_axes(ca.SX(R0), ca.SX(V0)))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(axes[2], -R0 / np.linalg.norm(R0), rtol=1e-14)
    assert axes[1] @ V0 < -0.999 * np.linalg.norm(V0)  # ahead is up, where v is smaller
    # right of a flight to the east over the north is the south
    assert axes[0] @ [0.0, 0.0, 1.0] < -0.6


def test_a_point_on_the_axis_is_at_the_principal_point_and_others_by_similar_triangles():
    center = ca.SX([160.0, 128.0])
    np.testing.assert_allclose(numbers(pixel(ca.SX([0, 0, 5.0]), FOCAL, center))[:, 0], [160, 128])
    found = numbers(pixel(ca.SX([1.0, -2.0, 100.0]), FOCAL, center))[:, 0]
    np.testing.assert_allclose(found, [160 + FOCAL / 100, 128 - 2 * FOCAL / 100], rtol=1e-14)


def test_brown_s_distortion_is_his_polynomial():
    """At (0.1, -0.2), rho^2 = 0.05: 1 + 0.1 0.05 + 0.2 0.0025 + 0.3 0.000125 = 1.0055375."""
    lens = ca.SX([0.1, 0.2, 0.3, 0.01, 0.02])
    found = numbers(pixel(ca.SX([0.1, -0.2, 1.0]), 1.0, ca.SX([0.0, 0.0]), lens))[:, 0]
    x = 0.1 * 1.0055375 + 2 * 0.01 * 0.1 * -0.2 + 0.02 * (0.05 + 2 * 0.01)
    y = -0.2 * 1.0055375 + 0.01 * (0.05 + 2 * 0.04) + 2 * 0.02 * 0.1 * -0.2
    np.testing.assert_allclose(found, [x, y], rtol=1e-14)


LENS = [-0.3, 0.1, -0.02, 0.004, -0.003]


def test_a_lens_bends_as_opencv_s_does():
    """cv2.projectPoints, whose coefficients stand in another order: to 1e-9 px over 30 degrees."""
    d = np.random.default_rng(1).uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.1], (200, 3))
    k1, k2, k3, p1, p2 = LENS
    matrix = np.array([[FOCAL, 0, 160.0], [0, FOCAL, 128.0], [0, 0, 1]])
    none = np.zeros(3)
    theirs, _ = cv2.projectPoints(d, none, none, matrix, np.array([k1, k2, p1, p2, k3]))
    ours = over_members(pixel, (3,), (), (2,), (5,))(d, FOCAL, np.array([160.0, 128.0]), LENS)
    np.testing.assert_allclose(ours, theirs[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("k1", "reach", "grows"), [(-0.3, 1.05, True), (-0.3, 1.06, False), (0.3, 5.0, True)]
)
def test_a_lens_folds_beyond_the_top_of_its_polynomial(k1, reach, grows):
    """x + k1 x^3 grows up to 1 / sqrt(-3 k1) = 1.054."""
    assert lens_grows(np.array([k1, 0, 0, 0, 0]), reach) == grows


@pytest.mark.parametrize(
    ("angles", "axis"),
    [
        ([0.1, 0, 0], [-np.sin(0.1), 0, np.cos(0.1)]),  # roll: to the left
        ([0, 0.1, 0], [0, -np.sin(0.1), np.cos(0.1)]),  # pitch: ahead, which is up in the frame
        ([0, 0, 0.1], [0, 0, 1]),
        ([0.3, 0.2, 0.0], [-np.sin(0.3), -np.cos(0.3) * np.sin(0.2), np.cos(0.3) * np.cos(0.2)]),
    ],
)
def test_a_mounting_tilts_the_axis(angles, axis):
    """The third row: where the axis is, in right, back, down of a camera that looks down."""
    turn = numbers(mounted(ca.SX(angles)))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(turn[2], axis, atol=1e-15)


def test_the_vertical_is_the_normal_of_the_ellipsoid():
    """At 45 deg, 550 km: the line down meets the ellipsoid at the latitude it started from."""
    r = ecef(np.radians(45.0), np.radians(-76.0), 550e3)
    down = numbers(vertical(ca.SX(r)))[:, 0]
    np.testing.assert_allclose(
        r + 550e3 * down, ecef(np.radians(45.0), np.radians(-76.0), 0.0), atol=1e-6
    )
    off = np.degrees(np.arccos(-down @ r / np.linalg.norm(r)))
    assert off == pytest.approx(0.177, abs=0.001)  # 0.1924 on the ground, less a Re / r of it


def test_an_attitude_that_is_level_sees_what_the_law_sees():
    """A body that flies level by the inertial velocity, to 1e-7 px."""
    points = ellipse()
    told = given(rate=7.292e-5, t=100.0)
    angle = np.radians(30.0) + 7.292e-5 * 100.0
    turn = np.array(
        [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )
    q_be = lvlh_quaternion_array(turn @ R0, turn @ V0)[None]
    values = {"r": R0[None], "v": V0[None]}
    law = Seen(values, told, points, points.mean(axis=0)).pixels
    pointing = np.full((1, 1), POINTINGS.index("given"))
    own = Seen(values, told | {"pointing": pointing, "q_be": q_be}, points, points.mean(axis=0))
    np.testing.assert_allclose(own.pixels, law, rtol=0, atol=1e-7)


def test_a_misalignment_turns_the_camera_about_its_own_axes():
    """A turn to the right about the axis down: what was ahead is to the left."""
    axes = numbers(turned(ca.SX.eye(3), ca.SX([0.0, 0.0, 1e-3])))
    np.testing.assert_allclose(axes @ [0.0, -1.0, 0.0], [-1e-3, -1.0, 0.0], atol=1e-15)


def given(k=1, *, t=0.0, rate=0.0):
    return {
        "earth_angle0": np.full((k, 1), np.radians(30.0)),
        "rotation_rate": np.full((k, 1), rate),
        "t": np.full((k, 1), t),
        "focal": np.full((k, 1), FOCAL),
        "principal": np.tile([160.0, 128.0], (k, 1)),
        "lake": np.zeros((k, 1)),
    }


def ellipse(n=90):
    """Vertices on the ground near 42.6 N, 76.9 W, Earth-fixed [m]."""
    t = 2 * np.pi * np.arange(n) / n
    latitude = np.radians(42.6) + np.radians(0.2) * np.sin(t)
    longitude = np.radians(-76.9) + np.radians(0.05) * np.cos(t)
    return ecef(latitude, longitude, np.zeros(n))


def catalog(points):
    return {
        "vertices": points,
        "starts": np.array([0, len(points)]),
        "center": points.mean(axis=0)[None],
    }


@pytest.fixture(scope="module")
def seneca():
    file = DATA / "lakes_gshhg" / "seneca_full.csv"
    if not file.is_file():
        pytest.skip(f"no outline: {file} is absent (set TERRAFIX_DATA)")
    table = np.genfromtxt(file, delimiter=",")
    table = np.radians(table[np.isfinite(table).all(axis=1)][:-1])
    return ecef(table[:, 1], table[:, 0], np.zeros(len(table)))


def test_seneca_lake_in_the_paper_s_first_frame(seneca):
    """Independent values, in bars of 0.05 px and 0.05 %, and rows of H by three digits."""
    told = given() | catalog(seneca)
    values = {"r": R0[None], "v": V0[None]}
    pixels = Seen(values, told, seneca, told["center"][0]).pixels[0]
    np.testing.assert_allclose(pixels.min(axis=0), [165.145, 109.509], atol=0.05)
    np.testing.assert_allclose(pixels.max(axis=0), [341.045, 142.145], atol=0.05)
    area, x, y, xx, yy, xy = moments(pixels)[0]
    np.testing.assert_allclose([x, y], [252.130, 124.971], atol=0.05)
    np.testing.assert_allclose([area, xx, yy, xy], [1691.20, 2083.63, 61.05, -281.13], rtol=5e-4)
    H = lake_observation(ORBIT).derivative(values, told)[0] * 1e3  # per km, per km/s
    np.testing.assert_allclose(H[0], [-3.013, 3.225, -4.127, 0, 0, 0], atol=6e-4)
    np.testing.assert_allclose(H[1], [-1.473, 1.575, 2.095, -0.185, 0.198, 0.294], atol=6e-4)
    np.testing.assert_allclose(H[2], [2.196, 2.048, 0.004, -5.625, 6.017, 8.927], atol=6e-4)
    # higher by a height is smaller by twice its share: dA / dh = -2 A / h
    up = R0 / np.linalg.norm(R0)
    height = 550e3
    assert H[0, :3] @ up * 1e-3 == pytest.approx(-2 * area / height, rel=0.02)


@pytest.mark.parametrize("law", POINTINGS)
@pytest.mark.parametrize("trial", range(3))
def test_derivatives_are_those_of_differences(trial, law):
    """By central differences, to 1e-6 of the largest of each column; through a lens, mounted."""
    rng = np.random.default_rng(trial)
    told = given(rate=7.292e-5, t=100.0) | catalog(ellipse())
    q = np.array([[0.3, -0.9, 0.2, 0.2]])
    told |= {"lens": np.array([LENS]), "mounting": 0.1 * rng.normal(size=(1, 3))}
    told |= {"pointing": np.full((1, 1), POINTINGS.index(law)), "q_be": q / np.linalg.norm(q)}
    observation = lake_observation(CONSIDERED)
    values = {
        "r": R0[None] + 20e3 * rng.normal(size=(1, 3)),
        "v": V0[None] + 50 * rng.normal(size=(1, 3)),
        "attitude": 1e-3 * rng.normal(size=(1, 3)),
        "scale": 0.01 * rng.normal(size=(1, 1)),
        "outline": np.zeros((1, 6)),  # its factor is not differentiated
    }
    H = observation.derivative(values, told)[0]
    steps = {"r": 10.0, "v": 0.1, "attitude": 1e-5, "scale": 1e-5, "outline": 1.0}
    columns = []
    for name, h in steps.items():
        for i in range(values[name].shape[1]):
            ends = []
            for sign in (1, -1):
                moved = {n: v.copy() for n, v in values.items()}
                moved[name][0, i] += sign * h
                ends.append(observation.predict(moved, told)[0])
            columns.append((ends[0] - ends[1]) / (2 * h))
    numeric = np.stack(columns, axis=1)
    scale = np.maximum(np.abs(numeric).max(axis=0), 1e-9)  # a given attitude knows no velocity
    np.testing.assert_allclose(H / scale, numeric / scale, atol=1e-6)


@pytest.mark.campaign
def test_the_factor_of_an_outline_is_that_of_vertices_that_are_drawn():
    """Of moments of 20,000 outlines off by 1 m; for a smooth ellipse 30 m are not small."""
    points, told = ellipse(), given() | catalog(ellipse())
    values = {"r": R0[None], "v": V0[None], "outline": np.zeros((1, 6))}
    L = lake_observation(CONSIDERED).derivative(values, told)[0, :, -6:]
    draws = np.random.default_rng(1).normal(size=(20_000, *points.shape))
    many = {n: np.repeat(v, 20_000, axis=0) for n, v in values.items()}
    seen = Seen(many, given(20_000), points + draws, points.mean(axis=0))
    whitened = np.linalg.solve(L, np.cov(moments(seen.pixels)[0].T))
    np.testing.assert_allclose(np.linalg.solve(L, whitened.T), np.eye(6), atol=0.05)


def test_the_ground_turns_under_the_camera():
    """At 42.6 N in 7 s by 465 cos(42.6 deg) 7 = 2.4 km, 0.3 km a pixel: 8 px to the east."""
    points = ellipse()
    values = {"r": R0[None], "v": V0[None]}
    still, turned_on = (
        Seen(values, given(t=7.0, rate=rate), points, points.mean(axis=0)).pixels[0]
        for rate in (0.0, 7.292115e-5)
    )
    moved = (turned_on - still).mean(axis=0)
    assert np.linalg.norm(moved) == pytest.approx(2.40e3 / 300.7, rel=0.02)


def test_rows_of_several_lakes_are_those_of_each():
    far = ellipse() + np.array([10e3, 0.0, 0.0])
    near = ellipse(40)
    told = given(3) | {
        "vertices": np.concatenate([near, far]),
        "starts": np.array([0, 40, 130]),
        "center": np.array([near.mean(axis=0), far.mean(axis=0)]),
        "lake": np.array([[1.0], [0.0], [1.0]]),
    }
    values = {"r": np.tile(R0, (3, 1)), "v": np.tile(V0, (3, 1))}
    both = lake_observation(ORBIT).predict(values, told)
    for row, points in ((0, far), (1, near), (2, far)):
        alone = given() | catalog(points)
        one = {n: v[:1] for n, v in values.items()}
        np.testing.assert_allclose(
            both[row], lake_observation(ORBIT).predict(one, alone)[0], rtol=1e-13
        )


def looking_down(r, earth_angle=0.0):
    """What cameras over the equator, whose flight is to the north, have below them."""
    k = len(r)
    values = {"r": r, "v": np.tile([0.0, 0.0, 7.5e3], (k, 1))}
    turned_by = np.full((k, 1), earth_angle)
    told = {"earth_angle0": turned_by, "rotation_rate": np.zeros((k, 1)), "t": np.zeros((k, 1))}
    return ground_in_view(values, told | {n: v for n, v in given(k).items() if n not in told})[:2]


RADIUS = 6_378e3
OFF = 100e3 / RADIUS
AROUND = RADIUS * np.array(
    [[1.0, 0, 0], [np.cos(OFF), np.sin(OFF), 0], [-1.0, 0, 0], [0, 1.0, 0]]
)  # below, 100 km off, the antipode, a quarter around
ABOVE = np.array([[RADIUS + 700e3, 0.0, 0.0]])


def test_what_may_be_in_view_is_near_the_axis_and_above_the_horizon():
    """From 700 km over the equator, reach 0.1: 100 km less a radius of 40 are within 70 km."""
    down = looking_down(ABOVE)
    seen, across = in_view(*down, AROUND, np.zeros(4), np.array([0.1]))
    assert seen.tolist() == [[True, False, False, False]]
    np.testing.assert_allclose(across[0, :2], [0.0, RADIUS * np.sin(OFF)], atol=1e-6)
    wide, _ = in_view(*down, AROUND, np.full(4, 40e3), np.array([0.1]))
    assert wide.tolist() == [[True, True, False, False]]
    whole, _ = in_view(*down, AROUND, np.zeros(4), np.array([np.inf]))
    assert whole.tolist() == [[True, True, False, False]]
    other, _ = in_view(*looking_down(ABOVE, np.pi), AROUND, np.zeros(4), np.array([0.1]))
    assert other.tolist() == [[False, False, True, False]]


def test_what_is_nearest_to_the_axis_is_told_with_its_angle_and_its_way_on_the_ground():
    """100 km off at 700 km: atan(R sin a / (700 km + R (1 - cos a))); below the horizon pi."""
    down = looking_down(ABOVE)
    index, angle, distance = nearest_to_axis(*down, AROUND[1:])
    assert index.tolist() == [0]
    depth = 700e3 + RADIUS * (1 - np.cos(OFF))
    np.testing.assert_allclose(angle, np.arctan2(RADIUS * np.sin(OFF), depth), rtol=1e-12)
    np.testing.assert_allclose(distance, 100e3, rtol=1e-9)
    index, angle, distance = nearest_to_axis(*down, AROUND[2:])
    assert index.tolist() == [1]
    np.testing.assert_allclose([angle[0], distance[0]], [np.pi, RADIUS * np.pi / 2], rtol=1e-12)
