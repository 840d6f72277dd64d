"""The start of the papers' pass, against independently computed geometry."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.geometry.antenna import nominal_antenna
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.geometry.geodesy import ellipsoid_intersection_array, geodetic_from_ecef_array
from terrafix.models.geometry.quaternion import IDENTITY
from terrafix.models.motion.attitude import lvlh_quaternion_array
from terrafix.models.motion.kepler import elements_of_state
from terrafix.models.motion.orbit import orbit_model
from terrafix.models.motion.start import ALOS, boresight_direction_array, boresight_start

LOOK = np.radians(34.3)
HOUSTON = np.radians([29.76, -95.37])


def degrees(r_e):
    latitude, longitude, height = geodetic_from_ecef_array(r_e)
    return np.degrees(latitude), np.degrees(longitude), height


def view(r_e, v_e):
    """Boresight point, slant range [m] and incidence [deg] of a level, yaw-steered body."""
    q_sb = ca.DM(nominal_antenna(LOOK, 0.0)).full().ravel()
    direction = boresight_direction_array(lvlh_quaternion_array(r_e, v_e), q_sb, IDENTITY)
    point, hit = ellipsoid_intersection_array(r_e, direction)
    assert hit == 1
    latitude, longitude, _ = geodetic_from_ecef_array(point)
    cos = np.cos(latitude)
    up = np.array([cos * np.cos(longitude), cos * np.sin(longitude), np.sin(latitude)])
    incidence = np.degrees(np.arccos(-direction @ up))
    return point, np.linalg.norm(point - r_e), incidence


def test_start_over_houston_is_that_of_the_shared_fixture(start_i):
    r, v = boresight_start(ALOS, *HOUSTON, LOOK)
    np.testing.assert_allclose(r, start_i[0], atol=1e-6)  # the solution is good to 1e-13 rad
    np.testing.assert_allclose(v, start_i[1], atol=1e-9)


def test_start_is_on_the_orbit_and_looks_at_houston(start_i):
    elements = elements_of_state(*start_i, EARTH.mu)
    assert elements.eccentricity == pytest.approx(0.00118, abs=1e-12)
    assert np.degrees(elements.inclination) == pytest.approx(98.16, abs=1e-10)
    assert np.degrees(elements.argument_of_perigee) == pytest.approx(90, abs=1e-8)
    p = elements.semi_major_axis * (1 - elements.eccentricity**2)
    assert p == pytest.approx(7_069_637, abs=1e-6)  # the radius 90 degrees before perigee
    assert elements.period(EARTH.mu) / 60 == pytest.approx(98.6, abs=0.05)
    r_e, v_e = earth_fixed_from_inertial_array(*start_i, 0.0, EARTH.rotation_rate)
    point, _, _ = view(r_e, v_e)
    np.testing.assert_allclose(degrees(point)[:2], [29.76, -95.37], atol=1e-10)
    # computed independently, to the digits quoted
    latitude, longitude, height = degrees(r_e)
    np.testing.assert_allclose([latitude, longitude], [28.87, -100.27], atol=0.005)
    assert height == pytest.approx(692_400, abs=50)
    assert np.linalg.norm(v_e) == pytest.approx(7599.3, abs=0.05)
    assert start_i[1][2] > 0  # ascending


@pytest.mark.parametrize(
    ("time", "satellite", "pixel", "slant", "incidence"),
    [
        (8.2, None, None, 861_013, 38.70),
        (590.4, (63.94, -115.18), (65.17, -105.31), 871_985, None),
    ],
)
def test_pass_geometry(constants, start_i, time, satellite, pixel, slant, incidence):
    """Independently computed, to the digits quoted."""
    model, states, n = orbit_model(), {"r_i": start_i[0], "v_i": start_i[1]}, round(time / 0.2)
    for k in range(n):
        outputs, states = model.advance(**states, step=0.2, time=(k + 1) * 0.2, **constants)
    point, distance, angle = view(outputs["r_e"], outputs["v_e"])
    assert distance == pytest.approx(slant, abs=0.5)
    if incidence:
        assert angle == pytest.approx(incidence, abs=0.005)
    if satellite:
        np.testing.assert_allclose(degrees(outputs["r_e"])[:2], satellite, atol=0.005)
        np.testing.assert_allclose(degrees(point)[:2], pixel, atol=0.005)


def test_a_place_out_of_reach_is_refused():
    with pytest.raises(ValueError, match=r"latitude 89.9000.*out of reach at inclination 98.16"):
        boresight_start(ALOS, np.radians(89.9), 0.0, LOOK)


@pytest.mark.parametrize("longitude", [180.0, 179.999, -179.999, 185.0, -540.0, 359.0])
def test_a_start_is_found_about_the_date_line_too(longitude):
    """The boresight meets the place: the same point on Earth, whatever turn it is counted in."""
    r, v = boresight_start(ALOS, np.radians(20.0), np.radians(longitude), LOOK)
    r_e, v_e = earth_fixed_from_inertial_array(r, v, 0.0, EARTH.rotation_rate)
    found = degrees(view(r_e, v_e)[0])
    assert found[0] == pytest.approx(20.0, abs=1e-9)
    assert (found[1] - longitude + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)
