"""Forces besides gravity, each against brahe at the same places; the tide against SciPy."""

import brahe
import casadi as ca
import numpy as np
import pytest
from scipy.special import lpmv

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef
from terrafix.models.geometry.quaternion import rotation_matrix_array
from terrafix.models.motion.forces import (
    MOON_MU,
    SOLAR_PRESSURE,
    SUN_MU,
    air_drag_acceleration,
    density_near,
    exponential_density,
    radiation_pressure_acceleration,
    solid_tide_acceleration,
    sunlight,
    third_body_acceleration,
)
from terrafix.models.motion.gravity_field import shipped_field
from terrafix.models.motion.surroundings import SIZES, orientation_at, surroundings_at

RATE = EARTH.rotation_rate
EPOCH = brahe.Epoch.from_datetime(2022, 9, 18, 7, 49, 21.0, 0.0, brahe.TimeSystem.UTC)
SUN, MOON = brahe.sun_position(EPOCH), brahe.moon_position(EPOCH)
PLACE = np.array([-1104646.3, -6096830.4, 3395727.4])


@pytest.fixture(scope="module")
def places():
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return directions * rng.uniform(6.6e6, 4.3e7, (40, 1))


def test_third_bodies_against_brahe(places):
    """Battin's form does not lose the eleven digits that a difference of two pulls loses."""
    battin = over_members(third_body_acceleration, (3,), (3,), ())
    for body, mu, theirs in (
        (SUN, SUN_MU, brahe.accel_third_body_sun),
        (MOON, MOON_MU, brahe.accel_third_body_moon),
    ):
        expected = np.array([theirs(EPOCH, p) for p in places])
        error = np.linalg.norm(battin(places, body, mu) - expected, axis=1)
        # theirs is a difference of two pulls of this size
        assert error.max() < 1e-15 * mu / (body @ body)


def test_a_third_body_against_its_tidal_term():
    """Far away only the gradient is left, mu/s^3 (3 (r.s) s - r), which rounding must not bury."""
    s = np.array([3e13, -2e13, 1e13])
    distance = np.linalg.norm(s)
    along = s / distance
    expected = SUN_MU / distance**3 * (3 * (PLACE @ along) * along - PLACE)
    ours = over_members(third_body_acceleration, (3,), (3,), ())(PLACE, s, SUN_MU)
    np.testing.assert_allclose(ours, expected, rtol=2e-6)


def tide_coefficients(sun, moon, field):
    """Equations (6.6) and (6.7) of the IERS conventions, by SciPy's Legendre functions."""
    from math import factorial

    real = {2: (0.30190, 0.29830, 0.30102), 3: (0.093, 0.093, 0.093, 0.094)}
    imaginary = {2: (0.0, -0.00144, -0.00130), 3: (0.0,) * 4}
    change = np.zeros((5, 5), complex)
    for body, mu in ((sun, SUN_MU), (moon, MOON_MU)):
        distance = np.linalg.norm(body)
        longitude = np.arctan2(body[1], body[0])

        def term(n, m, k, distance=distance, longitude=longitude, body=body, mu=mu):
            norm = np.sqrt((2 - (m == 0)) * (2 * n + 1) * factorial(n - m) / factorial(n + m))
            p = (-1) ** m * lpmv(m, n, body[2] / distance) * norm  # SciPy has Condon's sign
            size = mu / field.mu * (field.radius / distance) ** (n + 1) * p
            return k / (2 * n + 1) * size * np.exp(-1j * m * longitude)

        for n in (2, 3):
            for m in range(n + 1):
                change[n, m] += term(n, m, real[n][m] + 1j * imaginary[n][m])
        for m, k in enumerate((-0.00089, -0.00080, -0.00057)):
            change[4, m] += term(2, m, k)
    return change.real, -change.imag


def test_the_tide_is_that_of_the_conventions(places, tmp_path):
    """The coefficients by SciPy; their pull by brahe, from a field that has these alone."""
    field = shipped_field()
    sun, moon = SUN, MOON  # as if in axes of the Earth
    C, S = tide_coefficients(sun, moon, field)
    lines = [
        f"gfc {n} {m} {C[n, m]:.16e} {S[n, m]:.16e}" for n in range(2, 5) for m in range(n + 1)
    ]
    path = tmp_path / "tide.gfc"
    path.write_text(
        "modelname tide\nproduct_type gravity_field\nearth_gravity_constant 3.986004415e14\n"
        "radius 6378136.3\nmax_degree 4\nerrors no\nnorm fully_normalized\ntide_system tide_free\n"
        "end_of_head\ngfc 0 0 0.0 0.0\ngfc 1 0 0.0 0.0\ngfc 1 1 0.0 0.0\n" + "\n".join(lines)
    )
    model = brahe.GravityModel.from_file(str(path))
    expected = np.array(
        [brahe.accel_gravity_spherical_harmonics(p, np.eye(3), model, 4, 4) for p in places]
    )
    ours = over_members(
        lambda r, s, m: solid_tide_acceleration(r, s, m, field.mu, field.radius), (3,), (3,), (3,)
    )(places, sun, moon)
    size = np.linalg.norm(ours, axis=1)
    assert 1e-8 < size.max() < 2e-6
    np.testing.assert_allclose(ours, expected, atol=1e-15)


def shadow_places():
    """From light through the penumbra into the umbra behind the Earth, at two heights."""
    axis = SUN / np.linalg.norm(SUN)
    side = np.cross(axis, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    found = []
    for radius in (6.9e6, 4.2e7):
        edge = np.arcsin(6378136.3 / radius)
        for angle in (*np.linspace(edge - 0.006, edge + 0.006, 25), 0.0, 1.5, np.pi):
            found.append(radius * (-np.cos(angle) * axis + np.sin(angle) * side))
    return np.array(found)


def test_sunlight_against_brahe():
    r = shadow_places()
    ours = over_members(sunlight, (3,), (3,))(r, SUN)
    expected = [brahe.eclipse_conical(p, SUN) for p in r]
    np.testing.assert_allclose(ours, expected, atol=2e-9)
    partly = (ours > 0.01) & (ours < 0.99)
    assert partly.sum() > 10
    assert set(ours[~partly].round(2)) == {0.0, 1.0}


def test_radiation_pressure_against_brahe():
    r = shadow_places()
    ours = over_members(radiation_pressure_acceleration, (3,), (3,), ())(r, SUN, 1.3 * 20 / 1000)
    expected = np.array(
        [
            brahe.eclipse_conical(p, SUN)
            * brahe.accel_solar_radiation_pressure(p, SUN, 1000.0, 1.3, 20.0, SOLAR_PRESSURE)
            for p in r
        ]
    )
    np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=2e-9 * 1.2e-7)


def test_the_derivative_of_sunlight_is_finite_everywhere():
    """Filters and linear covariance derive it; at full light and full shadow it is zero."""
    r, s = ca.SX.sym("r", 3), ca.SX.sym("s", 3)
    slope = ca.Function("slope", [r, s], [ca.jacobian(sunlight(r, s), r)])
    axis = SUN / np.linalg.norm(SUN)
    for place in (7e6 * axis, -7e6 * axis, *shadow_places()):
        assert np.isfinite(slope(place, SUN).full()).all()
    assert np.abs(slope(7e6 * axis, SUN).full()).max() == 0.0


def test_drag_against_brahe():
    """Axes that coincide with inertial ones: the air turns with the Earth."""
    v_i = np.array([-1500.0, 3500.0, 6500.0])
    omega = np.array([0, 0, brahe.OMEGA_EARTH])
    v_e = v_i - np.cross(omega, PLACE)
    expected = brahe.accel_drag(np.concatenate([PLACE, v_i]), 3e-13, 1000.0, 20.0, 2.2, np.eye(3))
    drag = over_members(air_drag_acceleration, (3,), (3,), (3,), (), ())
    np.testing.assert_allclose(
        drag(PLACE, v_e, omega, 3e-13, 2.2 * 20 / 1000), expected, rtol=1e-14
    )
    still = over_members(
        lambda *a: air_drag_acceleration(*a, wind="none"), (3,), (3,), (3,), (), ()
    )(PLACE, v_e, omega, 3e-13, 2.2 * 20 / 1000)
    speed = np.linalg.norm(v_i)
    np.testing.assert_allclose(still, -0.5 * 3e-13 * 0.044 * speed * v_i, rtol=1e-14)
    with pytest.raises(ValueError, match="wind must be one of"):
        air_drag_acceleration(*(ca.SX(3, 1),) * 3, 1.0, 1.0, wind="west")


def test_densities():
    r = ecef([0.7, -0.2], [1.0, 2.0], [700e3, 760e3])
    exponential = over_members(exponential_density, (3,), (), (), ())(r, 3e-14, 700e3, 60e3)
    np.testing.assert_allclose(exponential, [3e-14, 3e-14 / np.e], rtol=1e-12)
    # at the same height 75 km further on it is the same, and up by a scale height less by e
    up, ahead = PLACE / np.linalg.norm(PLACE), np.array([0.98, -0.1776, 0.0])
    ahead -= (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    radius, angle = np.linalg.norm(PLACE), 0.0106
    further = radius * (np.cos(angle) * up + np.sin(angle) * ahead)
    near = over_members(density_near, (3,), (3,), (), (3,))
    here = near([PLACE, further, PLACE + 60e3 * up], PLACE, np.log(3e-14), -up / 60e3)
    np.testing.assert_allclose(here, [3e-14, 3e-14, 3e-14 / np.e], rtol=1e-9)


def test_surroundings_are_turned_to_the_time_asked():
    """Axes that turn uniformly: what stands still in inertial space goes the other way round."""
    published = {name: ca.SX.sym(name, size) for name, size in SIZES.items()}
    time = ca.SX.sym("t")
    around = surroundings_at(published, time)
    function = ca.Function(
        "around",
        [*published.values(), time],
        [around.sun_e, around.moon_e, orientation_at(published, time)],
    )
    omega = np.array([1e-10, -2e-10, RATE])
    q = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])
    still, moving = np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, -6.0])
    velocity = np.array([1e-3, 2e-3, -1e-3])
    sun, moon, turned = (
        x.full().ravel()
        for x in function(100.0, omega, q, still, np.zeros(3), moving, velocity, 160.0)
    )
    angle = np.linalg.norm(omega) * 60.0
    n = omega / np.linalg.norm(omega)
    cross = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    C = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    np.testing.assert_allclose(sun, C @ still, atol=1e-15)
    np.testing.assert_allclose(moon, C @ (moving + 60 * velocity), atol=2e-15)
    # components of an inertial vector, by the orientation then and now
    np.testing.assert_allclose(
        rotation_matrix_array(turned), C @ rotation_matrix_array(q), atol=1e-15
    )
