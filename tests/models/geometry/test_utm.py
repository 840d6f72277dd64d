"""UTM against published points, the length of the meridian and the scale of its middle."""

import numpy as np
import pytest
from scipy.integrate import quad

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.utm import central_meridian, utm_from_geodetic


def test_a_published_point():
    """The Eiffel Tower, 48.8582 N 2.2945 E: 31U 448251.8 E 5411932.7 N."""
    east, north = utm_from_geodetic(np.radians(48.8582), np.radians(2.2945), 31)
    assert (east, north) == (pytest.approx(448251.8, abs=0.05), pytest.approx(5411932.7, abs=0.05))


def test_the_middle_of_a_zone_is_the_meridian():
    """Northing is 0.9996 of the arc from the equator, to a micrometer; negative in the south."""
    e2 = EARTH.flattening * (2 - EARTH.flattening)

    def radius(latitude):
        return EARTH.radius * (1 - e2) / (1 - e2 * np.sin(latitude) ** 2) ** 1.5

    for latitude in (-0.9, 0.4, 1.3):
        arc = quad(radius, 0.0, latitude, epsabs=1e-6, epsrel=1e-13)[0]
        east, north = utm_from_geodetic(latitude, central_meridian(21), 21)
        assert east == pytest.approx(500e3, abs=1e-9)
        assert north == pytest.approx(0.9996 * arc, abs=1e-5)


def test_it_is_conformal():
    """Steps to the north and to the east have one scale, and stay perpendicular."""
    latitude, off, step = np.radians(-25.2), np.radians(2.2), 1e-6
    here = central_meridian(21) + off
    e2 = EARTH.flattening * (2 - EARTH.flattening)
    w = 1 - e2 * np.sin(latitude) ** 2
    meridian, parallel = (
        EARTH.radius * (1 - e2) / w**1.5,
        EARTH.radius / np.sqrt(w) * np.cos(latitude),
    )
    ends = [
        np.subtract(
            utm_from_geodetic(latitude + a, here + b, 21),
            utm_from_geodetic(latitude - a, here - b, 21),
        )
        / (2 * step * r)
        for a, b, r in ((step, 0, meridian), (0, step, parallel))
    ]
    assert np.hypot(*ends[0]) == pytest.approx(np.hypot(*ends[1]), rel=1e-8)
    assert np.dot(*ends) == pytest.approx(0.0, abs=1e-8)


def test_a_zone_that_is_none_is_refused():
    with pytest.raises(ValueError, match="zones of UTM are 1 to 60, got 61"):
        utm_from_geodetic(0.0, 0.0, 61)
