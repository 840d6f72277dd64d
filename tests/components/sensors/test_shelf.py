"""Sensors of the shelf: what they measure against closed forms, and their errors against bounds.

Bounds of a mean square over N independent draws are those of chi-square, at five sigmas: never met
by chance, at any seed.
"""

import allantools
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import terrafix as tf
from terrafix import components
from terrafix.components.sensors.altimeter import RadarAltimeter
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef_from_geodetic_array
from terrafix.models.geometry.quaternion import (
    from_rotation_vector_array,
    inverse_array,
    product_array,
    rotation_matrix_array,
    rotation_vector_array,
)
from terrafix.models.maps.dem import Dem, flat_dem, rolling_dem
from terrafix.models.sensors.barometer import barometer_model
from terrafix.models.sensors.radar_altimeter import nearest_return

ARC_SECOND = np.pi / 180 / 3600
FAR = 5.0
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
LEO = np.array([7.0e6, 0.0, 0.0])  # body axes along e: z is to the north
LIMB = np.arcsin(EARTH.radius / 7.0e6)
SUN, MOON = 1.496e11, 3.84e8
AROUND = {
    "time": 0.0,
    "omega_e": np.zeros(3),
    "q_ei": IDENTITY,
    "sun_e": [0.0, SUN, 0.0],
    "sun_rate_e": np.zeros(3),
    "moon_e": [0.0, -MOON, 0.0],
    "moon_rate_e": np.zeros(3),
}


def squared(errors, covariance):
    """Squares of errors (n, k) by their covariance, (n,)."""
    return np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)


def assert_chi_square(squares, dof, n=None):
    """Squares of `dof` degrees of freedom each, n of them if they are sums of such."""
    n = n or len(squares)
    assert squares.sum() / n == pytest.approx(dof, abs=FAR * np.sqrt(2 * dof / n))


# ------------------------------------------------------------------------ star tracker


def tracked(steps=40, members=50, q_be=IDENTITY, around=None, r_e=LEO, **settings):
    settings = {"boresight_b": [0.0, 0.0, 1.0]} | settings
    inputs = {"r_e": r_e, "q_be": q_be}
    if settings.get("sky") != "none":
        inputs["surroundings"] = AROUND | (around or {})
    made = components.star_tracker(**settings)
    return tf.testing.drive(made, inputs, steps, members=members, seed=7)


def turn_of(q, reference):
    return rotation_vector_array(product_array(q, inverse_array(reference)))


def test_a_star_tracker_errs_as_it_says_more_about_its_boresight():
    """5 and 40 arc seconds about a slanted boresight: chi-square of 3, and each part alone."""
    b = np.array([2.0, -1.0, 2.0]) / 3
    fix = tracked(boresight_b=3 * b)["fix"]
    q, R = fix["q_bi"][1:].reshape(-1, 4), fix["R"][1, 0]
    errors = turn_of(q, np.tile(IDENTITY, (len(q), 1)))
    assert_chi_square(squared(errors, R), 3)
    assert_chi_square((errors @ b / (40 * ARC_SECOND)) ** 2, 1)
    across = errors - np.outer(errors @ b, b)
    assert_chi_square((across**2).sum(axis=1) / (5 * ARC_SECOND) ** 2, 2)
    np.testing.assert_allclose(R @ b, (40 * ARC_SECOND) ** 2 * b, rtol=1e-9)


def test_its_alignment_is_drawn_once_for_each_member():
    fix = tracked(
        steps=3, members=2000, cross_sigma=0.0, roll_sigma=0.0, alignment_sigma=20 * ARC_SECOND
    )["fix"]
    errors = turn_of(fix["q_bi"][1], np.tile(IDENTITY, (2000, 1)))
    np.testing.assert_allclose(fix["q_bi"][3], fix["q_bi"][1], atol=1e-15)
    assert_chi_square((errors**2).sum(axis=1) / (20 * ARC_SECOND) ** 2, 3)


def test_what_it_tells_is_of_a_latency_ago():
    """About a fixed axis at 1 deg/s, in inertial axes: exact at any latency up to a step."""
    rate = np.radians([0.6, -0.8, 0.0])

    def attitude(t):
        return from_rotation_vector_array(rate * t)

    quiet = {"cross_sigma": 0.0, "roll_sigma": 0.0, "latency": "0.1 s", "members": 1}
    fix = tracked(steps=8, q_be=attitude, **quiet)["fix"]
    for k in range(1, 9):
        assert fix["taken"][k, 0] == pytest.approx(0.25 * k - 0.1, abs=1e-12)
        expected = attitude(0.25 * k - 0.1)
        assert np.abs(turn_of(fix["q_bi"][k, 0], expected)).max() < 1e-12


def test_it_is_lost_above_its_largest_rate():
    def attitude(t):
        return from_rotation_vector_array(np.array([np.radians(t * t / 2), 0.0, 0.0]))

    found = tracked(steps=12, members=1, q_be=attitude, largest_rate="2 deg/s", sky="none")
    # mean rate of a step that ends at t: t - 1/8 deg/s, and the Earth's turn of 0.004 deg/s
    np.testing.assert_array_equal(found["blocked"][1:, 0] == 4, 0.25 * np.arange(1, 13) > 2.12)
    np.testing.assert_array_equal(found["fix"].fresh[1:, 0], found["blocked"][1:, 0] == 0)


def toward(angle, axis=(0.0, 1.0, 0.0)):
    """A boresight so far off +z, which is off the Earth, toward an axis."""
    return (np.cos(angle) * np.array([0, 0, 1.0]) + np.sin(angle) * np.array(axis)).tolist()


@pytest.mark.parametrize(
    ("boresight", "around", "expected"),
    [
        # Sun at +y, Moon at -y: exclusions of 35 and 15 deg
        (toward(np.radians(90 - 35.1)), {}, 0),
        (toward(np.radians(90 - 34.9)), {}, 1),
        (toward(-np.radians(90 - 15.1)), {}, 0),
        (toward(-np.radians(90 - 14.9)), {}, 2),
        # the Earth at -x, its limb 65.7 deg off it: to the limb 20 deg
        (toward(np.pi / 2 - LIMB - np.radians(20.1), (-1.0, 0.0, 0.0)), {}, 0),
        (toward(np.pi / 2 - LIMB - np.radians(19.9), (-1.0, 0.0, 0.0)), {}, 3),
        # a Sun behind the Earth blinds nobody: 1 deg within the limb, and 1 deg above it
        (
            toward(np.radians(3)),
            {"sun_e": SUN * np.array([-np.cos(LIMB - 0.02), 0.0, np.sin(LIMB - 0.02)])},
            0,
        ),
        (
            toward(np.radians(3)),
            {"sun_e": SUN * np.array([-np.cos(LIMB + 0.02), 0.0, np.sin(LIMB + 0.02)])},
            1,
        ),
    ],
)
def test_sun_moon_and_earth_blind_it(boresight, around, expected):
    found = tracked(steps=1, members=1, boresight_b=boresight, around=around)
    assert found["blocked"][1, 0] == expected
    assert found["fix"].fresh[1, 0] == (expected == 0)


def test_what_was_published_is_turned_to_now():
    """Ten seconds after publication, about a slanted axis: by SciPy's rotations."""
    omega = np.array([1e-3, -2e-3, 7e-3])
    around = {"omega_e": omega, "q_ei": from_rotation_vector_array([0.1, 0.2, 0.3])}
    fix = tracked(
        steps=40, members=1, around=around, cross_sigma=0.0, roll_sigma=0.0, sun_exclusion=0.0
    )["fix"]
    # T(q) of a rotation vector is the inverse of SciPy's matrix
    C = (
        Rotation.from_rotvec(-10 * omega).as_matrix()
        @ Rotation.from_rotvec([-0.1, -0.2, -0.3]).as_matrix()
    )
    np.testing.assert_allclose(rotation_matrix_array(fix["q_bi"][40, 0]), C, atol=1e-13)


def test_a_star_tracker_wants_its_surroundings_or_does_without():
    with tf.System("s", duration="1") as system:
        system.add(components.star_tracker(), "star")
    with pytest.raises(SystemCheckError, match=r"'star\.surroundings' is not connected"):
        tf.simulate(system)
    alone = components.star_tracker(sky="none")
    assert "does not take 'sun_exclusion' with sky = 'none'" in alone.idle("sun_exclusion")
    assert "does not take 'earth_angle0'" in components.star_tracker().idle("earth_angle0")
    assert "surroundings" in components.star_tracker().inputs()
    with pytest.raises(SystemCheckError, match="no direction"):
        tracked(boresight_b=[0.0, 0.0, 0.0])
    with pytest.raises(SystemCheckError, match=r"latency' is 0.3 s, more than a step of 0.25 s"):
        tracked(latency="0.3 s")


# ------------------------------------------------------------------------ directions


def test_a_sun_sensor_errs_about_the_sun_as_it_says():
    """White noise of 1 mrad and a bias of 2 mrad: two degrees of freedom of each."""
    made = components.sun_sensor(boresight_b=[0.0, 1.0, 0.0], sigma="1 mrad", bias_sigma="2 mrad")
    inputs = {"r_e": LEO, "q_be": IDENTITY, "surroundings": AROUND}
    fix = tf.testing.drive(made, inputs, 40, members=400, seed=1)["fix"]
    y = fix["y"][1:]
    sun = np.array([0.0, SUN, 0.0]) - LEO
    u = sun / np.linalg.norm(sun)
    np.testing.assert_allclose(np.linalg.norm(y, axis=-1), 1.0, atol=1e-14)
    off = (y - u)[..., [0, 2]]
    white = off - off.mean(axis=0)
    assert_chi_square((white**2).sum(axis=(0, 2)) / 1e-6, 2, n=400 * 39)
    total = (off.mean(axis=0) ** 2).sum(axis=1) / (4e-6 + 1e-6 / 40)
    assert_chi_square(total, 2)
    R = fix["R"][1, 0]
    np.testing.assert_allclose(R, 5e-6 * (np.eye(3) - np.outer(y[0, 0], y[0, 0])), atol=1e-18)


def test_a_direction_drifts_as_a_gauss_markov_process():
    """What is kept of a bias in 10 s is exp(-10 / 20)."""
    made = components.horizon_sensor(sigma=0.0, bias_sigma="2 mrad", bias_time="20 s")
    down = product_array(from_rotation_vector_array([0.0, -np.pi / 2, 0.0]), IDENTITY)
    found = tf.testing.drive(made, {"r_e": LEO, "q_be": down}, 11, members=4000, seed=1)
    off = found["fix"]["y"][1:] - np.array([0.0, 0.0, 1.0])
    one, other = off[0, :, 0], off[10, :, 0]
    assert_chi_square((one / 2e-3) ** 2, 1)
    kept = (one * other).mean() / 4e-6
    assert kept == pytest.approx(np.exp(-0.5), abs=FAR * np.sqrt(2 / 4000))


@pytest.mark.parametrize(
    ("sun", "lit", "fresh"),
    [
        ([0.0, 1.0, 0.0], 1, True),
        ([0.0, np.sin(0.5), np.cos(0.5)], 1, False),  # 61.4 deg off the boresight
        ([0.0, np.sin(0.55), np.cos(0.55)], 1, True),  # 58.5 deg
        ([-np.cos(LIMB - 0.01), np.sin(LIMB - 0.01), 0.0], 0, False),
        ([-np.cos(LIMB + 0.01), np.sin(LIMB + 0.01), 0.0], 1, True),
    ],
)
def test_a_sun_sensor_sees_the_sun_in_its_field_and_out_of_the_shadow(sun, lit, fresh):
    inputs = {"r_e": LEO, "q_be": IDENTITY, "surroundings": AROUND | {"sun_e": SUN * np.array(sun)}}
    made = components.sun_sensor(boresight_b=[0.0, 1.0, 0.0])
    found = tf.testing.drive(made, inputs, 1)
    assert (found["lit"][1, 0], found["fix"].fresh[1, 0]) == (lit, fresh)


def test_the_sun_moves_on_between_publications():
    """Published at -10 s; at t = 10 s it has moved for 20 s in axes that have turned for 20 s."""
    around = AROUND | {"time": -10.0, "omega_e": [0, 0, 1e-3], "sun_rate_e": [1e8, 0, 2e8]}
    inputs = {"r_e": LEO, "q_be": IDENTITY, "surroundings": around}
    made = components.sun_sensor(boresight_b=[0.0, 1.0, 0.0], sigma=0.0)
    y = tf.testing.drive(made, inputs, 10)["fix"]["y"][10, 0]
    moved = np.array([20e8, SUN, 40e8])
    sun = Rotation.from_rotvec([0, 0, -0.02]).apply(moved) - LEO
    np.testing.assert_allclose(y, sun / np.linalg.norm(sun), atol=1e-14)


@pytest.mark.parametrize(("tilt", "fresh"), [(59.9, True), (60.1, False)])
def test_a_horizon_sensor_sees_the_earth_in_its_field(tilt, fresh):
    q_be = from_rotation_vector_array([0.0, np.radians(-90 + tilt), 0.0])
    made = components.horizon_sensor(sigma=0.0)
    fix = tf.testing.drive(made, {"r_e": LEO, "q_be": q_be}, 1)["fix"]
    assert fix.fresh[1, 0] == fresh
    if fresh:
        expected = rotation_matrix_array(q_be) @ np.array([-1.0, 0.0, 0.0])
        np.testing.assert_allclose(fix["y"][1, 0], expected, atol=1e-15)


# ------------------------------------------------------------------------ barometer


@pytest.mark.parametrize(
    ("height", "pressure"),
    [  # geometric heights [m], U.S. Standard Atmosphere 1976, table I (in Pa, five figures)
        (0.0, 101325.0),
        (1000.0, 89876.0),
        (5000.0, 54048.0),
        (11019.0, 22632.0),
        (15000.0, 12111.0),
        (20063.0, 5474.9),
        (32162.0, 868.02),
        (47350.0, 110.91),
        (51413.0, 66.939),
        (71802.0, 3.9564),
        (80000.0, 1.0524),
    ],
)
def test_the_standard_atmosphere(height, pressure):
    p0, exact = 101325.0, {"sea_level_pressure": 101325.0}
    told = barometer_model("flat")(r_e=[0.0, 0.0, -height], **exact)
    assert told["pressure"][0] == pytest.approx(pressure, rel=2e-4 if height else 1e-12)
    assert told["fix_y" if "fix_y" in told else "fix.y"][0] == pytest.approx(height, abs=1e-5)
    assert p0 > 0


def test_a_warm_day_and_a_low_read_as_height():
    """In the lowest layer told = true T0 / (T0 + dT), geopotential; 1 hPa is 8.3 m at sea level."""
    warm = barometer_model("flat")(
        r_e=[0, 0, -1000.0], sea_level_pressure=101325.0, temperature_offset=20.0
    )
    H = 6356766.0 * 1000 / (6356766.0 + 1000) * 288.15 / 308.15
    assert warm["fix.y"][0] == pytest.approx(6356766.0 * H / (6356766.0 - H), abs=1e-6)
    low = barometer_model("flat")(r_e=[0, 0, 0.0], sea_level_pressure=101225.0)
    assert low["fix.y"][0] == pytest.approx(100 / (1.225 * 9.80665), rel=1e-3)


def test_a_barometer_errs_as_it_says():
    """Noise 5 Pa, bias 30 Pa, scale 1e-3 of 89.9 kPa at 1000 m: the variance of height told."""
    made = components.barometer(earth="flat", sigma=5.0, bias_sigma=30.0, scale_sigma=1e-3)
    found = tf.testing.drive(made, {"r_e": [0.0, 0.0, -1000.0]}, 20, members=2000, seed=2)
    p, fix = found["pressure"][1:], found["fix"]
    assert_chi_square(((p - p.mean(axis=0)) ** 2).sum(axis=0) / 25.0, 1, n=2000 * 19)
    off = (p[0] - 89876.28) ** 2 / (25.0 + 900.0 + 89.876**2)
    assert_chi_square(off, 1)
    height = fix["y"][1, :, 0] - 1000.0
    assert_chi_square(height**2 / fix["R"][1, :, 0, 0], 1)


def test_its_drift_is_a_random_walk():
    """Allan variance K^2 tau / 3 of a walk of K Pa per root second."""
    made = components.barometer(earth="flat", sigma=0.0, drift=2.0)
    found = tf.testing.drive(made, {"r_e": np.zeros(3)}, 4000, members=8, seed=2)
    taus = np.array([10.0, 30.0])
    variances = [
        allantools.oadev(found["pressure"][1:, m], 1.0, "freq", taus)[1] ** 2 for m in range(8)
    ]
    # 8 x 4000 s: 1000 pieces of 30 s, 5 sigma of a variance of walks, of which half is overlap
    np.testing.assert_allclose(np.mean(variances, axis=0), 4.0 * taus / 3, rtol=0.25)
    R, slope = found["fix"]["R"][100, :, 0, 0], 1 / (1.225 * 9.80665)
    np.testing.assert_allclose(R, slope**2 * 4.0 * 100, rtol=0.02)


# ------------------------------------------------------------------------ GNSS


def received(steps=20, members=1, **settings):
    r_e = ecef_from_geodetic_array(0.6, 0.3, 1000.0)
    made = components.gnss(**settings)
    inputs = {"r_e": r_e, "v_e": [10.0, 20.0, 30.0]}
    return tf.testing.drive(made, inputs, steps, members=members, seed=5), r_e


def level(vectors, latitude=0.6, longitude=0.3):
    """North, east, down of Earth-fixed vectors (..., 3)."""
    (sl, cl), (so, co) = ((np.sin(a), np.cos(a)) for a in (latitude, longitude))
    axes = np.array([[-sl * co, -sl * so, cl], [-so, co, 0.0], [-cl * co, -cl * so, -sl]])
    return vectors @ axes.T


def test_gnss_errs_as_it_says():
    found, r_e = received(steps=1, members=4000)
    y, R = found["fix"]["y"][1], found["fix"]["R"][1, 0]
    errors = y - np.concatenate([r_e, [10.0, 20.0, 30.0]])
    assert_chi_square(squared(errors, R), 6)
    position, velocity = level(errors[:, :3]), level(errors[:, 3:])
    for axis, (a, b) in enumerate(((3.25, 0.0025), (3.25, 0.0025), (13.0, 0.01))):
        assert_chi_square(position[:, axis] ** 2 / a, 1)
        assert_chi_square(velocity[:, axis] ** 2 / b, 1)


def test_gnss_may_tell_of_its_white_noise_alone():
    R = received(steps=1, told="white")[0]["fix"]["R"][1, 0]
    np.testing.assert_allclose(np.trace(R[:3, :3]), 1.0 + 1.0 + 4.0, rtol=1e-12)
    np.testing.assert_allclose(np.trace(R[3:, 3:]), 0.0025 + 0.0025 + 0.01, rtol=1e-12)


def test_what_lasts_of_its_errors_is_a_gauss_markov_process():
    """Allan variance of a process of sigma and T, IEEE Std 952-1997, eq. (C.17)."""
    sigma, T = 3.0, 20.0
    found, r_e = received(
        steps=6000,
        members=6,
        position_sigma=[0.0] * 3,
        bias_sigma=[sigma] * 3,
        bias_time=T,
    )
    north = level(found["fix"]["y"][1:, :, :3] - r_e)[..., 0]
    np.testing.assert_allclose(north, level(found["bias"][1:])[..., 0], atol=1e-8)
    taus = np.array([5.0, 20.0, 80.0])
    measured = np.mean(
        [allantools.oadev(north[:, m], 1.0, "freq", taus)[1] ** 2 for m in range(6)], axis=0
    )
    x = taus / T
    expected = 2 * sigma**2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))
    # samples of 1 s in place of averages: 4 % at 5 s; 450 pieces of 80 s: 7 % sigma
    np.testing.assert_allclose(measured, expected, rtol=0.3)


def test_nothing_is_received_in_an_outage():
    found, _ = received(outages=[{"start": "3 s", "stop": "6 s"}, {"start": "18", "stop": "99"}])
    fresh = np.flatnonzero(found["fix"].fresh[:, 0])
    np.testing.assert_array_equal(fresh, [1, 2, *range(6, 18)])


def test_a_spoofer_leads_away_and_the_receiver_does_not_tell():
    quiet = {"position_sigma": [0.0] * 3, "bias_sigma": [0.0] * 3, "velocity_sigma": [0.0] * 3}
    found, r_e = received(
        spoofed=True, spoof_from="5 s", spoof_velocity_n="[2, -1, 0.5] m/s", **quiet
    )
    y = found["fix"]["y"][1:, 0]
    t = np.arange(1.0, 21.0)
    led = np.maximum(t - 5, 0)[:, None] * [2.0, -1.0, 0.5]
    np.testing.assert_allclose(level(y[:, :3] - r_e), led, atol=1e-8)
    leading = level(y[:, 3:] - np.array([10.0, 20.0, 30.0]))
    np.testing.assert_allclose(leading, (t > 5)[:, None] * [2.0, -1.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(found["offset"][1:, 0], led, atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"outages": [{"start": "5", "stop": "2"}]}, "outage 1 is from 5 s to 2 s"),
        ({"spoofed": True}, "is spoofed, but led nowhere"),
        ({"outages": [{"start": "99", "stop": "120"}]}, "outage 1 of 'part' begins at 99 s"),
        (
            {"spoofed": True, "spoof_velocity_n": [1, 0, 0], "spoof_from": "60 s"},
            "the spoofer of 'part' begins at 60 s, but the run ends at 10 s",
        ),
    ],
)
def test_what_gnss_cannot_do_is_refused(settings, message):
    with tf.System("s", duration="10") as system:
        flight = system.add(components.flight(), "flight")
        part = system.add(components.gnss(**settings), "part")
        system.connect(flight["r_e"], part["r_e"])
        system.connect(flight["v_e"], part["v_e"])
    with pytest.raises((SystemCheckError, ConfigurationError), match=message):
        tf.simulate(system)
    assert "does not take 'spoof_from'" in components.gnss().idle("spoof_from")


# ------------------------------------------------------------------------ radar altimeter

STEP = 30.0 / EARTH.radius  # of 30 m


def slope_dem(rise, n=401):
    """A plane that rises to the north, by meters per 30 m of a sphere of the equator's radius."""
    rows = (np.arange(n) - n // 2) * 30.0 * rise
    height = np.repeat(rows[:, None], n, axis=1).astype(np.float32)
    first = -STEP * (n // 2)
    return Dem(height, first, first, STEP, STEP)


def nearest(dem, height, half_angle, axis=(0.0, 0.0, 1.0), flat=True):
    zero = np.zeros(1)
    where = (zero, zero, np.array([height]))
    return nearest_return(dem, where, np.array([half_angle]), np.array([axis]), flat=flat)[0]


@pytest.mark.parametrize("half_angle_deg", [5.0, 20.0, 40.0])
def test_over_a_slope_the_nearest_return_is_uphill(half_angle_deg):
    """c cos(s) where the foot of the perpendicular is in the beam, else c cos(s) / cos(s - a).

    On the ellipsoid a degree of latitude is shorter at the equator than on a sphere: by 0.67 %.
    """
    slope, half_angle = np.arctan(0.3 / (1 - EARTH.flattening) ** 2), np.radians(half_angle_deg)
    expected = 1000 * np.cos(slope) / np.cos(max(slope - half_angle, 0.0))
    assert nearest(slope_dem(0.3), 1000.0, half_angle) == pytest.approx(expected, abs=0.05)


def test_over_a_plain_it_is_the_height():
    assert nearest(flat_dem(200.0), 1500.0, np.radians(30)) == pytest.approx(1300.0, abs=1e-9)
    assert nearest(flat_dem(200.0), 1500.0, np.radians(30), flat=False) == pytest.approx(1300.0)


@pytest.mark.parametrize("seed", range(4))
def test_over_hills_the_nearest_of_all_points_answers(seed):
    """Against every point of a grid of 1 m, to what it misses."""
    dem, height, half_angle = rolling_dem(60.0, 150.0, seed), 700.0, np.radians(35)
    steps = np.arange(-500.0, 501.0)
    north, east = np.meshgrid(steps, steps, indexing="ij")
    meridian = EARTH.radius * (1 - EARTH.flattening) ** 2
    down = height - dem.at(north / meridian, east / EARTH.radius)
    inside = np.hypot(north, east) <= down * np.tan(half_angle)
    distance = np.sqrt(north**2 + east**2 + down**2)[inside].min()
    assert nearest(dem, height, half_angle) == pytest.approx(distance, abs=0.03)
    assert distance < down[500, 500] - 1.0  # of what is straight below


def test_a_tilted_beam_measures_along_its_edge():
    """Axis 30 deg off the vertical, half-angle 10: the nearest is 20 deg off, c / cos(20 deg)."""
    axis = (np.sin(np.radians(30)), 0.0, np.cos(np.radians(30)))
    expected = 1000 / np.cos(np.radians(20))
    assert nearest(flat_dem(), 1000.0, np.radians(10), axis) == pytest.approx(expected, abs=0.5)
    up = (0.0, 0.0, -1.0)
    assert nearest(flat_dem(), 1000.0, np.radians(10), up) == np.inf


def test_ground_that_is_not_known_in_the_beam_is_no_ground():
    dem = slope_dem(0.0)
    dem.height[:190] = np.nan  # from 300 m to the south on
    assert np.isnan(nearest(dem, 1000.0, np.radians(20)))
    assert nearest(dem, 1000.0, np.radians(10)) == pytest.approx(1000.0)


@pytest.mark.parametrize(("bank", "valid"), [(0.0, True), (40.0, True), (130.0, False)])
def test_a_radar_altimeter_with_a_beam_is_flown(bank, valid):
    """Fixed to the body: over the sea a bank within the beam changes nothing."""
    dem = flat_dem(0.0)
    q_be = from_rotation_vector_array([np.radians(bank), 0.0, 0.0])
    grid = [dem.latitude0, dem.longitude0, dem.latitude_step, dem.longitude_step, 1.0]
    made = RadarAltimeter(earth="flat", pointing="body", half_angle="45 deg", rate=Rate("1"))
    made.prepare()
    inputs = {"r_e": [0.0, 0.0, -800.0], "q_be": q_be, "height": dem.height, "grid": grid}
    fix = tf.testing.drive(made, inputs, 100, seed=3)["fix"]
    assert fix.fresh[1:].all() == valid
    if valid:
        assert_chi_square(((fix["y"][1:, 0, 0] - 800.0) / 5.0) ** 2, 1)


@pytest.mark.parametrize("bank", [30.0, -30.0])
def test_a_bank_to_the_right_looks_to_the_left(bank):
    """Northward, ground that rises to the east by 0.3: c cos(s) / cos(s - a) at the edge a.

    Right wing down, body z points west and down: the nearest is 20 deg off, downhill. Left wing
    down, 20 to 40 deg uphill: the perpendicular, 16.7 deg off, is not in the beam, 20 deg is.
    """
    dem = slope_dem(0.3)
    grid = [dem.latitude0, dem.longitude0, dem.latitude_step, dem.longitude_step, 0.0]
    made = RadarAltimeter(
        earth="flat", pointing="body", half_angle="10 deg", sigma=1e-6, rate=Rate("1")
    )
    made.prepare()
    q_be = from_rotation_vector_array([np.radians(bank), 0.0, 0.0])
    east = np.ascontiguousarray(dem.height.T)
    inputs = {"r_e": [0.0, 0.0, -1000.0], "q_be": q_be, "height": east, "grid": grid}
    y = tf.testing.drive(made, inputs, 1)["fix"]["y"][1, 0, 0]
    s, a = np.arctan(0.3), np.radians(-20.0 if bank > 0 else 20.0)
    assert y == pytest.approx(1000 * np.cos(s) / np.cos(s - a), abs=1.0)


def test_a_beam_that_is_fixed_to_the_body_has_a_width():
    made = RadarAltimeter(pointing="body")
    with pytest.raises(ConfigurationError, match="its beam has no width"):
        made.validate()
    assert "q_be" in RadarAltimeter(pointing="body", half_angle=0.1).inputs()
