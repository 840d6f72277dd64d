"""The atmosphere of the thesis' Table 3.4, right: converged numbers, and what is printed beside."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp, trapezoid

from terrafix.models.sensors.atmosphere import (
    bufton_wind,
    fried_parameter,
    ground_motion,
    hufnagel_valley,
    image_motion,
    isoplanatic_angle,
    path_moment,
    pressure,
    printed_refraction,
    refraction,
    refractive_index,
    rms_wind,
    temperature,
    tilt,
    uplink_moment,
)

RED, APERTURE, FOCAL, RADIUS = 675e-9, 0.60, 10.0, 6.378e6  # [m]
LOW, HIGH = 598e3, 38_900e3  # heights of the thesis [m]
WIDE = {LOW: np.radians(25.0), HIGH: np.radians(5.0)}
PIXEL = {LOW: 100.0, HIGH: 1000.0}  # [m]


def test_it_is_the_five_seven_model():
    """5 cm and 7 microradians at 500 nm, from which it has its name: 4.96 cm, 6.89 microradians."""
    assert path_moment(0) == pytest.approx(2.2354e-12, rel=1e-4)
    assert fried_parameter(path_moment(0), 500e-9) == pytest.approx(0.0496, rel=0.01)
    assert isoplanatic_angle(500e-9) == pytest.approx(6.89e-6, rel=0.01)
    assert fried_parameter(path_moment(0), RED) == pytest.approx(0.0714, rel=0.01)


@pytest.mark.parametrize("power", [0.0, 5 / 3])
def test_moments_have_converged(power):
    """Against adaptive quadrature that is split where the profile changes."""
    borders = [0.0, 1e3, 5e3, 3e4, 2e5]
    parts = [
        quad(lambda h: hufnagel_valley(h) * h**power, a, b, epsabs=0, epsrel=1e-12, limit=400)[0]
        for a, b in pairwise(borders)
    ]
    assert path_moment(power) == pytest.approx(sum(parts), rel=1e-9)


@pytest.mark.parametrize(("height", "moment"), [(LOW, 2.050e-16), (HIGH, 1.949e-19)])
def test_moments_of_the_way_up(height, moment):
    assert uplink_moment(height) == pytest.approx(moment, rel=0.01)


@pytest.mark.parametrize(
    ("height", "zenith", "width", "angle", "plane", "pixels"),
    [
        (LOW, 0.0, 18.9, 2.660e-8, 2.66e-7, 1.59e-4),
        (LOW, 25.0, 17.8, 2.794e-8, 2.79e-7, 1.84e-4),
        (HIGH, 0.0, 1229.0, 8.20e-10, 8.2e-9, 3.2e-5),
        (HIGH, 5.0, 1226.0, 8.21e-10, 8.2e-9, 3.2e-5),
    ],
)
def test_coherence_and_image_motion(height, zenith, width, angle, plane, pixels):
    """The table in the place of 3.4, to 1 percent: 1e-4 pixels, printed 1e-12 and 1e-34."""
    z = np.radians(zenith)
    assert fried_parameter(uplink_moment(height), RED, z) == pytest.approx(width, rel=0.01)
    assert tilt(height, APERTURE, z) == pytest.approx(angle, rel=0.01)
    assert image_motion(height, APERTURE, FOCAL, z) == pytest.approx(plane, rel=0.01)
    moved = ground_motion(height, APERTURE, z) / PIXEL[height]
    assert moved == pytest.approx(pixels, rel=0.01)


def test_the_printed_image_motion_of_the_high_orbit_is_of_its_steps():
    """A trapezoid of 200 steps, 195 km each: 1e-34 m, and any other number with other steps."""
    found = {}
    for n in (100, 201, 500):
        h = np.linspace(0.0, HIGH, n)
        moment = trapezoid(hufnagel_valley(h) * (h / HIGH) ** (5 / 3), h)
        found[n] = FOCAL * np.sqrt(2.91 * moment * APERTURE ** (-1 / 3))
    assert found[201] == pytest.approx(1.1e-34, rel=0.1)
    assert found[100] < 1e-60 < found[500] < 1e-16
    assert image_motion(HIGH, APERTURE, FOCAL) > 1e-9


def test_the_wind_of_the_model_is_a_definition():
    """Bufton's wind from 5 to 20 km: 23.5 m/s as printed, 21 only with other constants."""
    assert rms_wind(5.0, 12.5e3) == pytest.approx(23.47, rel=1e-3)
    assert rms_wind(5.0, 9.4e3) == pytest.approx(22.96, rel=1e-3)
    assert rms_wind(2.8, 9.4e3) == pytest.approx(21.04, rel=1e-3)
    assert bufton_wind(9.4e3) == pytest.approx(35.0)


def test_air_at_three_heights():
    h = np.array([0.0, 11e3, 20e3])
    np.testing.assert_allclose(pressure(h), [1000.0, 218.6, 40.8], rtol=1e-3)
    np.testing.assert_allclose(temperature(h), [293.0, 218.1, 218.1], rtol=1e-3)
    expected = [2.692e-4, 7.91e-5, 1.48e-5]
    np.testing.assert_allclose(refractive_index(h, RED) - 1, expected, rtol=5e-3)
    assert pressure(60e3) == 0.0


@pytest.mark.parametrize(("height", "metres", "printed"), [(LOW, 53.0, 0.54), (HIGH, 547.0, 0.56)])
def test_the_printed_refraction_is_reproduced(height, metres, printed):
    """By its definition: 53.0 and 547 m, within 4 percent of the printed half pixel."""
    found = printed_refraction(height, WIDE[height], RED)
    assert found == pytest.approx(metres, rel=0.01)
    assert found / PIXEL[height] == pytest.approx(printed, rel=0.04)


@pytest.mark.parametrize(("height", "metres"), [(LOW, 1.40), (HIGH, 2.69)])
def test_a_line_of_sight_is_displaced_by_a_meter(height, metres):
    """Ray trace in a spherical atmosphere; 40 and 200 times less than what is printed."""
    found = refraction(RADIUS + height, WIDE[height], RED)
    assert found == pytest.approx(metres, rel=0.03)
    assert found < printed_refraction(height, WIDE[height], RED) / 30


def test_refraction_is_that_of_the_ray_equation():
    """An independent trace: d/ds (n dr/ds) = grad n, integrated from 44 km down to the ground."""

    def rate(_, y):
        r, n_t = y[:2], y[2:]
        distance = np.hypot(*r)
        h = distance - RADIUS
        n, step = refractive_index(h, RED), 1.0
        slope = (refractive_index(h + step, RED) - refractive_index(h - step, RED)) / (2 * step)
        return np.concatenate([n_t / n, slope * r / distance])

    def ground(_, y):
        return np.hypot(*y[:2]) - RADIUS

    ground.terminal = True
    nadir = WIDE[LOW]
    start, along = np.array([0.0, RADIUS + LOW]), np.array([np.sin(nadir), -np.cos(nadir)])
    b = start @ along
    enter = start + along * (-b - np.sqrt(b * b - start @ start + (RADIUS + 44e3) ** 2))
    options = {"rtol": 1e-12, "atol": 1e-6, "events": ground, "max_step": 500.0}
    ray = solve_ivp(rate, (0.0, 1e5), np.concatenate([enter, along]), **options)
    foot = ray.y_events[0][0][:2]
    straight = start + along * (-b - np.sqrt(b * b - start @ start + RADIUS**2))
    off = RADIUS * (np.arctan2(*straight) - np.arctan2(*foot))
    assert refraction(RADIUS + LOW, nadir, RED) == pytest.approx(off, rel=2e-3)


def test_a_line_of_sight_that_misses_the_earth_is_refused():
    with pytest.raises(ValueError, match=r"80\.00 deg off the nadir misses the Earth"):
        refraction(RADIUS + LOW, np.radians(80.0), RED)


def test_angles_at_the_ground_are_not_those_at_the_satellite():
    """sin z = r / R sin n: 25 degrees at 598 km are 27.5 at the ground, 5 at 38 900 km are 38."""
    for height, degrees in ((LOW, 27.53), (HIGH, 38.22)):
        sine = (RADIUS + height) / RADIUS * np.sin(WIDE[height])
        assert np.degrees(np.arcsin(sine)) == pytest.approx(degrees, abs=0.02)
