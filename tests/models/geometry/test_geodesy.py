"""Geodesy against an independent package, and the intersection against its own equation."""

import casadi as ca
import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import (
    ecef_from_geodetic_array,
    ellipsoid_intersection,
    ellipsoid_intersection_array,
    geodetic_from_ecef,
    geodetic_from_ecef_array,
)

HEIGHTS = [-11_000.0, 0.0, 700_000.0, 36_000_000.0]  # [m]: trench, ellipsoid, low orbit, high orbit


@pytest.mark.parametrize("height", HEIGHTS)
def test_round_trip_from_pole_to_pole(height):
    """Accurate to some roundings: floats are 1e-9 m apart at the Earth's radius."""
    latitude = np.radians(np.r_[np.linspace(-90, 90, 181), 89.9999999, 1e-9, -45.0])
    longitude = np.radians(np.linspace(-179.9, 180, latitude.size))
    r_e = ecef_from_geodetic_array(latitude, longitude, height)
    lat, lon, h = geodetic_from_ecef_array(r_e)
    spacing = np.spacing(np.linalg.norm(r_e, axis=-1))
    np.testing.assert_allclose(lat, latitude, atol=1e-12)
    np.testing.assert_allclose(h, height, atol=np.max(4 * spacing))
    inside = np.abs(latitude) < np.radians(89.99)
    np.testing.assert_allclose(lon[inside], longitude[inside], atol=1e-12)
    again = ecef_from_geodetic_array(lat, lon, h)
    assert np.all(np.linalg.norm(again - r_e, axis=-1) <= 8 * spacing)


def test_forward_agrees_with_pymap3d():
    rng = np.random.default_rng(2)
    latitude, longitude = rng.uniform(-90, 90, 200), rng.uniform(-180, 180, 200)
    height = rng.uniform(-1e4, 1e6, 200)
    theirs = np.stack(pymap3d.geodetic2ecef(latitude, longitude, height), axis=-1)
    ours = ecef_from_geodetic_array(np.radians(latitude), np.radians(longitude), height)
    np.testing.assert_allclose(ours, theirs, atol=4e-9)  # spacing of floats at 7e6
    lat, lon, h = geodetic_from_ecef_array(theirs)
    np.testing.assert_allclose(np.degrees(lat), latitude, atol=1e-10)
    np.testing.assert_allclose(np.degrees(lon), longitude, atol=1e-10)
    np.testing.assert_allclose(h, height, atol=4e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_poles_have_values_and_derivatives(sign):
    r_e = ca.SX.sym("r_e", 3)
    lat, lon, h = geodetic_from_ecef(r_e)
    derivative = ca.jacobian(ca.vertcat(lat, lon, h), r_e)
    f = ca.Function("f", [r_e], [lat, lon, h, derivative])
    lat, lon, h, derivative = (x.full() for x in f([0, 0, sign * (EARTH.polar_radius + 100)]))
    assert lat == pytest.approx(sign * np.pi / 2, abs=1e-15)
    assert (lon, h) == (0, pytest.approx(100, abs=2e-9))
    assert np.isfinite(derivative).all()
    np.testing.assert_allclose(derivative[2], [0, 0, sign], atol=1e-15)


unit = st.floats(-1, 1)


def ellipsoid_residual(point):
    """Distance from the ellipsoid [m], to first order."""
    a, b = EARTH.radius, EARTH.polar_radius
    return a / 2 * ((point[0] ** 2 + point[1] ** 2) / a**2 + point[2] ** 2 / b**2 - 1)


@given(unit, unit, unit, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(2e5, 4e7))
def test_rays_end_on_the_ellipsoid(x, y, z, off1, off2, height):
    up = np.array([x, y, z + 2.0])
    up /= np.linalg.norm(up)
    r_e = up * (EARTH.radius + height)
    target = np.array([off1, off2, 0.2]) * EARTH.radius  # inside, so every ray hits
    direction = target - r_e
    point, hit = ellipsoid_intersection_array(r_e, direction)
    assert hit == 1
    assert abs(ellipsoid_residual(point)) < 1e-6
    # the near side: the ray enters there
    normal = point / np.array([1, 1, (EARTH.polar_radius / EARTH.radius) ** 2])
    assert direction @ normal < 0


@pytest.mark.parametrize("direction", [[0, 0, 1], [1, 0, 0], [-0.1, 0, 1]])
def test_a_ray_that_misses_is_flagged_and_finite(direction):
    """Across, away, and past the limb; the derivatives stay finite as well."""
    r, d = ca.SX.sym("r", 3), ca.SX.sym("d", 3)
    point, hit = ellipsoid_intersection(r, d)
    f = ca.Function("f", [r, d], [point, hit, ca.jacobian(point, r), ca.jacobian(point, d)])
    point, hit, *derivatives = (x.full() for x in f([7.0e6, 0, 0], direction))
    assert hit == 0
    assert np.isfinite(point).all()
    assert all(np.isfinite(x).all() for x in derivatives)


def test_no_hit_from_inside():
    assert ellipsoid_intersection_array([6.0e6, 0, 0], [-1.0, 0, 0])[1] == 0


def test_point_is_continuous_at_the_limb():
    height = 7.0e6
    grazing = np.arcsin(EARTH.radius / height)
    for change, expected in ((-1e-9, 1), (1e-9, 0)):
        angle = grazing + change
        point, hit = ellipsoid_intersection_array(
            [height, 0, 0], [-np.cos(angle), np.sin(angle), 0]
        )
        assert hit == expected
        # 1e-9 rad is 2.9 mm at the limb; the root lies sqrt(2 R 2.9 mm) = 192 m before it
        tangent = EARTH.radius * np.array([np.sin(grazing), np.cos(grazing), 0])
        assert np.linalg.norm(point - tangent) < 200
