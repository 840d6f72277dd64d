"""Keplerian elements."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.kepler import (
    KeplerianElements,
    coasted,
    coasting,
    elements_of_state,
)

turn = st.floats(0.01, 6.27)


@given(st.floats(6.6e6, 4e7), st.floats(1e-3, 0.8), st.floats(0.01, 3.13), turn, turn, turn)
def test_elements_survive_the_round_trip(a, e, i, node, perigee, anomaly):
    """Angles of a nearly circular or equatorial orbit amplify rounding by 1/e or 1/sin i."""
    elements = KeplerianElements(a, e, i, node, perigee, anomaly)
    back = elements_of_state(*elements.state(EARTH.mu), EARTH.mu)
    assert back.semi_major_axis == pytest.approx(a, rel=1e-12)
    assert back.eccentricity == pytest.approx(e, abs=1e-13)
    assert back.inclination == pytest.approx(i, abs=1e-13)
    for name in ("node", "argument_of_perigee", "true_anomaly"):
        difference = getattr(back, name) - getattr(elements, name)
        assert abs((difference + np.pi) % (2 * np.pi) - np.pi) < 1e-9


def test_perigee_and_apogee_are_where_they_should_be():
    r, v = KeplerianElements(1e7, 0.2, 0.0, 0.0, 0.0, 0.0).state(EARTH.mu)
    np.testing.assert_allclose(r, [8e6, 0, 0], atol=1e-8)
    speed = np.sqrt(EARTH.mu * (2 / 8e6 - 1 / 1e7))  # vis viva
    np.testing.assert_allclose(v, [0, speed, 0], atol=1e-11)


def test_undefined_angles_are_put_on_the_x_axis_or_the_node():
    circular = elements_of_state([0, 7e6, 0], [-np.sqrt(EARTH.mu / 7e6), 0, 0], EARTH.mu)
    assert (circular.node, circular.argument_of_perigee, circular.eccentricity) == (0, 0, 0)
    assert circular.true_anomaly == pytest.approx(np.pi / 2, abs=1e-15)


def test_what_is_no_ellipse_is_refused():
    with pytest.raises(ValueError, match="not on an ellipse"):
        elements_of_state([7e6, 0, 0], [0, 12e3, 0], EARTH.mu)
    with pytest.raises(ValueError, match="eccentricity must be in"):
        KeplerianElements(7e6, 1.0, 0, 0, 0, 0)
    with pytest.raises(ValueError, match="semi-major axis must be positive"):
        KeplerianElements(-7e6, 0.1, 0, 0, 0, 0)


COASTED = over_members(lambda r, v, t: coasted(r, v, t, EARTH.mu), (3,), (3,), ())
COASTING = over_members(lambda r, v, t: coasting(r, v, t, EARTH.mu), (3,), (3,), ())


def at(a, e, mean):
    """State where the mean anomaly is this: Kepler's equation by bisection."""
    half = brentq(lambda E: E - e * np.sin(E) - mean, mean - 1, mean + 1, xtol=1e-15) / 2
    anomaly = 2 * np.arctan2(np.sqrt(1 + e) * np.sin(half), np.sqrt(1 - e) * np.cos(half))
    return KeplerianElements(a, e, 1.7, 0.3, 0.5, anomaly).state(EARTH.mu)


@pytest.mark.parametrize("e", [0.0, 1e-3, 0.1, 0.5])
def test_an_orbit_coasts_as_its_elements_say(e):
    """Forward and backward, up to two revolutions, in eight places of the orbit."""
    a = 7e6
    n = np.sqrt(EARTH.mu / a**3)
    for mean in np.arange(8.0):
        start = at(a, e, mean)
        for time in np.linspace(-11e3, 11e3, 9):
            r, v = COASTED(*start, time)
            expected = at(a, e, mean + n * time)
            np.testing.assert_allclose(r, expected[0], rtol=0, atol=1e-5)
            np.testing.assert_allclose(v, expected[1], rtol=0, atol=1e-8)
            back = COASTED(r, v, -time)
            np.testing.assert_allclose(back[0], start[0], rtol=0, atol=2e-5)


def test_the_derivative_of_coasting_is_that_of_differences_and_symplectic():
    r, v = at(7e6, 0.05, 1.0)
    J = COASTING(r, v, 5000.0)
    for k in range(6):
        step = np.eye(6)[k] * (1.0 if k < 3 else 1e-3)
        ahead, behind = (
            np.concatenate(COASTED(r + s[:3], v + s[3:], 5000.0)) for s in (step, -step)
        )
        column = (ahead - behind) / (2 * step[k])
        np.testing.assert_allclose(J[:, k], column, atol=2e-6 * np.abs(column).max())
    form = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.eye(3), np.zeros((3, 3))]])
    np.testing.assert_allclose(J.T @ form @ J, form, atol=1e-8)


def test_what_escapes_moves_for_a_short_time_as_everything_does():
    """A hyperbola is taken for an ellipse of 50 distances: half g t^2 all the same."""
    r, v = np.array([7e6, 0.0, 0.0]), np.array([0.0, 12e3, 0.0])
    g = EARTH.mu / 7e6**2
    moved, speed = COASTED(r, v, 0.5)
    np.testing.assert_allclose(moved, [7e6 - g / 8, 6e3, 0.0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(speed, [-g / 2, 12e3, 0.0], rtol=0, atol=2e-3)
