"""The Sun and the Moon, by an eclipse of theirs, and what turning them costs."""

import numpy as np
import pytest

from terrafix.models.core.timescales import parse_epoch
from terrafix.models.geometry.celestial import terrestrial_rotation
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ellipsoid_intersection_array, geodetic
from terrafix.models.geometry.quaternion import (
    angle_between_array,
    from_rotation_vector_array,
    product_array,
    rotation_matrix_array,
)
from terrafix.models.motion.bodies import environment_at, moon_position, sun_position

LIGHT = 299792458.0


def shadow(instant):
    """Where the axis of the Moon's shadow passes, in ITRF: the Moon, and its direction.

    Both as they were when the light left them.
    """
    found = environment_at(instant)
    sun, moon = (
        found[f"{body}_e"]
        - found[f"{body}_rate_e"] * np.linalg.norm(found[f"{body}_e"], axis=-1)[..., None] / LIGHT
        for body in ("sun", "moon")
    )
    away = moon - sun
    return moon, away / np.linalg.norm(away, axis=-1)[..., None]


def test_the_eclipse_of_21_august_2017_falls_where_nasa_put_it():
    """Espenak, Meeus, NASA: greatest at 18:25:31.8 UT1, 36 58.0 N, 87 40.3 W, gamma 0.4367.

    UT1, the turn of the Earth, Sun and Moon are all in it. 1 arc second of the Moon is 1.9 km, or
    0.03 deg where the Sun stands at 64 deg.
    """
    greatest = parse_epoch("2017-08-21T18:25:31.8 UT1")
    moon, direction = shadow(greatest)
    place, _ = ellipsoid_intersection_array(moon, direction)
    latitude, longitude, _ = geodetic(place)
    assert np.degrees(latitude) == pytest.approx(36 + 58.0 / 60, abs=0.03)
    assert np.degrees(longitude) == pytest.approx(-87 - 40.3 / 60, abs=0.03)
    t = np.arange(-120.0, 121.0)
    moon, direction = shadow(greatest.plus(t))
    distance = np.linalg.norm(np.cross(moon, direction), axis=1)
    assert distance.min() / EARTH.radius == pytest.approx(0.4367, abs=5e-4)
    assert t[distance.argmin()] == pytest.approx(0, abs=5)


@pytest.mark.parametrize("position", [sun_position, moon_position])
def test_velocities_are_derivatives(position):
    """That of the Moon lacks the turning of the equinox, 8e-12 rad/s: 3 mm/s."""
    instants = parse_epoch("2022-09-18T07:49:21 UTC").plus(np.arange(100) * 86400.0)
    late, early = (position(instants.plus(h))[0] for h in (60.0, -60.0))
    v = position(instants)[1]
    error = np.linalg.norm((late - early) / 120 - v, axis=1)
    assert (error / np.linalg.norm(v, axis=1)).max() < 5e-6


@pytest.mark.parametrize(
    ("s", "axes", "sun", "moon"), [(10.0, 7e-14, 0.30, 0.16), (60.0, 8e-13, 10.8, 5.5)]
)
def test_what_turning_costs_until_the_next_publication(s, axes, sun, moon):
    """At most over a month, every hour: angle [rad], and meters, at the distance of the bodies.

    The acceleration of the Moon is 0.003 m/s^2, of the Sun, seen from here, 0.006 m/s^2.
    """
    starts = parse_epoch("2022-09-18T07:49:21 UTC").plus(np.arange(0, 28 * 86400, 3600.0))
    a, b = environment_at(starts), environment_at(starts.plus(s))
    turn = from_rotation_vector_array(a["omega_e"] * s)
    assert angle_between_array(product_array(turn, a["q_ei"]), b["q_ei"]).max() < axes
    C = rotation_matrix_array(turn)
    for body, limit in (("sun", sun), ("moon", moon)):
        moved = a[f"{body}_e"] + s * a[f"{body}_rate_e"]
        error = np.linalg.norm(np.einsum("nij,nj->ni", C, moved) - b[f"{body}_e"], axis=1).max()
        assert 0.9 * limit < error < limit


def test_the_quaternion_is_that_of_the_chain():
    instant = parse_epoch("2022-09-18T07:49:21 UTC")
    C = rotation_matrix_array(environment_at(instant)["q_ei"])
    np.testing.assert_allclose(C, terrestrial_rotation(instant), rtol=0, atol=1e-15)
