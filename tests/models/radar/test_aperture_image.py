"""Images of apertures: points of exact geometry must appear where the geometry puts them."""

import numpy as np
import pytest

from terrafix.models.radar.aperture_image import AZIMUTH_LOOKS, RANGE_OVERSAMPLING, aperture_image
from terrafix.models.radar.compensation import straight_line

FLIGHTS = {
    "straight": {},
    "crab": {"crab": np.radians(5.0)},
    "turn of 3 deg/s": {"acceleration": (0.0, 3.66, 0.0)},
    "faster": {"acceleration": (1.0, 0.0, 0.0)},
    "wander": {"acceleration": (0.2, -0.7, 1.2)},
    "east": {"heading": np.radians(90.0), "r": (0.0, 0.0, -1000.0)},
}


def place_in_beam(aircraft, r, axis, across, along, side=1):
    """On the level ground, `across` out from the middle of the track, along the antenna."""
    out = side * np.array([-axis[0, 1], axis[0, 0], 0.0])
    center = r[len(r) // 2] * [1, 1, 0]
    return center + across * out + along * axis[0]


@pytest.mark.parametrize(("name", "side"), [*((name, 1) for name in FLIGHTS), ("crab", -1)])
def test_a_point_is_seen_where_the_estimate_expects_it(name, side, aircraft, points):
    """To 1.5 cm along and across: a twentieth of the resolution, of 1/32 pixel of interpolation.

    Whatever the track, left and right; its peak is that of the straight track within 5 %.
    """
    flight = FLIGHTS[name]
    t, r, axis = aircraft.track(**flight)
    own = aircraft.aperture(t, r, axis, side)
    reached = []
    for across, along in ((1200.0, 0.0), (1120.0, 15.0)):
        p = place_in_beam(aircraft, r, axis, across, along, side)
        echo = aircraft.point_echo(p[None], own)
        image = aperture_image(aircraft.seen_by(echo, t, r, axis, side=side))
        row, column = (float(a) for a in image.grid.pixel(*image.grid.predicted(p)))
        line = image.image.rows.start + AZIMUTH_LOOKS * row + (AZIMUTH_LOOKS - 1) / 2
        cell = image.image.columns.start + column / RANGE_OVERSAMPLING
        peak = points.Peak(image.image.data)
        assert (peak.row - line) * aircraft.SPEED / 600 == pytest.approx(0.0, abs=0.015)
        assert (peak.column - cell) * aircraft.RADAR.range_spacing == pytest.approx(0.0, abs=0.015)
        reached.append(peak.height)
    # the beam's pattern: 0.95 in the middle, 0.92 at 15 m
    np.testing.assert_allclose(reached, [13.44, 13.05], rtol=0.05)


def test_without_compensation_a_turn_blurs(aircraft):
    """3.66 m/s^2 are 0.46 m off the line at the ends of the aperture, some 300 rad of phase."""
    t, r, axis = aircraft.track(acceleration=(0.0, 3.66, 0.0))
    echo = aircraft.point_echo(np.zeros((1, 3)), aircraft.aperture(t, r, axis))
    heights = [
        np.abs(aperture_image(aircraft.seen_by(echo, t, r, axis, compensate=c)).image.data).max()
        for c in (True, False)
    ]
    assert heights[1] < 0.5 * heights[0]


def test_in_a_turn_the_height_of_a_place_focuses_it(aircraft, points):
    """7 m higher, at 1562 m, a place lies 5.8 m farther out, and 3.66 m/s^2 pull that much more.

    R / (2 V) a 5.8 / 1562 = 0.15 m/s: by what another height than its own misleads map drift.
    """
    t, r, axis = aircraft.track(acceleration=(0.0, 3.66, 0.0))
    out = np.sqrt(aircraft.RANGE**2 - (aircraft.HEIGHT - 7.0) ** 2)
    p = np.array([0.0, r[300, 1] + out, -7.0])
    echo = aircraft.point_echo(p[None], aircraft.aperture(t, r, axis))
    best = []
    for terrain in (None, lambda latitude, _: 7.0 + 0 * latitude):
        seen = aircraft.seen_by(echo, t, r, axis, terrain=terrain)
        v = aircraft.SPEED + np.array([-0.3, 0.0, 0.3])
        heights = [points.Peak(aperture_image(seen, x).image.data).height for x in v]
        a, b, _ = np.polyfit(v - aircraft.SPEED, heights, 2)
        best.append(-b / (2 * a))
    assert best[1] == pytest.approx(0.0, abs=0.02)
    assert abs(best[0]) == pytest.approx(0.15, abs=0.03)


def test_pixels_are_places_again(aircraft):
    """`pixel` undoes `seen`, with another velocity, too; `predicted` undoes `places`."""
    t, r, axis = aircraft.track(crab=0.05)
    echo = aircraft.point_echo(np.zeros((1, 3)), aircraft.aperture(t, r, axis))
    seen = aircraft.seen_by(echo, t, r, axis)
    rows, columns = np.array([3.0, 80.0, 150.0]), np.array([10.0, 333.3, 600.0])
    for velocity in (None, 71.3):
        image = aperture_image(seen, velocity).grid
        rho, ahead = image.seen(rows, columns)
        np.testing.assert_allclose(image.pixel(rho, ahead), [rows, columns], rtol=0, atol=1e-6)
        p = image.places(rows, columns, aircraft.HILLS.at)
        np.testing.assert_allclose(image.predicted(p), [rho, ahead], rtol=0, atol=1e-6)
        height = aircraft.HILLS.at(*aircraft.GROUND.geodetic(p)[:2])
        np.testing.assert_allclose(-p[:, 2], height, atol=2e-3)


def test_a_straight_line_is_fitted_to_a_track():
    t = np.linspace(-0.5, 0.5, 101)
    line = straight_line(t + 7.0, np.outer(t, [70.0, 3.0, -1.0]) + np.array([5.0, 6.0, 7.0]))
    assert line.t == pytest.approx(7.0)
    np.testing.assert_allclose(line.v, [70.0, 3.0, -1.0])
    np.testing.assert_allclose(line.r, [5.0, 6.0, 7.0])
