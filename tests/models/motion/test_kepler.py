"""Keplerian elements."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.kepler import KeplerianElements, elements_of_state

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
