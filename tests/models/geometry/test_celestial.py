"""Celestial and terrestrial frames: SOFA's cookbook, brahe, Vallado's example, and closed forms."""

import brahe
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.core.iers import date_of, leap_seconds
from terrafix.models.core.timescales import Instant, parse_epoch, tai_from
from terrafix.models.geometry.celestial import (
    DATED,
    FRAMES,
    earth_fixed_from_frame,
    frame_from_earth_fixed,
    rotation_vector_of_earth,
    terrestrial_rotation,
)
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.geometry.orientation import EarthOrientation, earth_orientation
from terrafix.models.geometry.quaternion import from_rotation_vector_array, rotation_matrix_array
from terrafix.models.motion.kepler import coasted

ARC_SECOND = np.pi / (180 * 3600)
YEAR = 365.25 * 86400


def orientation(ut1_utc, offset, pole, *, lod=0.0, corrections=(0.0, 0.0)):
    """As examples print it: seconds, and arc seconds."""
    xp, yp, dx, dy = np.array([*pole, *corrections]) * ARC_SECOND
    return EarthOrientation(ut1_utc - offset, -lod / 86400, xp, yp, 0.0, 0.0, dx, dy, 0.0, 0.0)


@pytest.fixture(scope="module")
def epochs():
    """1000 in 30 years from 1994; of them 36 in leap seconds, before and after."""
    rng = np.random.default_rng(18)
    leaps = leap_seconds().day
    ends = leaps[leaps > 49353] - 1  # of days with a leap second, from 1994 on
    within = [86399.75, 86400.0, 86400.5, 86401.0]
    day, seconds = np.repeat(ends, 4), np.tile(within, len(ends))
    special = tai_from("UTC", day, seconds)
    others = parse_epoch("1994-01-01T00:00:00 UTC").plus(
        np.sort(rng.uniform(0, 30 * YEAR, 1000 - len(day)))
    )
    return Instant(
        np.concatenate([special.day, others.day]),
        np.concatenate([special.seconds, others.seconds]),
    )


@pytest.fixture(scope="module")
def states():
    rng = np.random.default_rng(5)
    r, v = rng.normal(size=(2, 1000, 3))
    return (
        7e6 * r / np.linalg.norm(r, axis=1, keepdims=True),
        7.5e3 * v / np.linalg.norm(v, axis=1, keepdims=True),
    )


@pytest.fixture
def restored_brahe():
    yield
    brahe.set_global_eop_provider_from_static_provider(brahe.StaticEOPProvider.from_zero())


def each_in_brahe(epochs, known):
    """Epochs of brahe, each with the orientation that is known then."""
    utc_day = epochs.to("UTC")[0]
    ut1_utc = known.ut1_tai + leap_seconds().at(utc_day)
    for k, day in enumerate(epochs.day):
        values = (known.xp[k], known.yp[k], ut1_utc[k], known.dx[k], known.dy[k], 0.0)
        provider = brahe.StaticEOPProvider.from_values(*values)
        brahe.set_global_eop_provider_from_static_provider(provider)
        year, month, of_month = map(int, date_of(day).split("-"))
        tai = brahe.TimeSystem.TAI
        yield brahe.Epoch.from_datetime(year, month, of_month, 0, 0, epochs.seconds[k], 0.0, tai)


# ------------------------------------------------------------------------- against others


def test_the_chain_is_that_of_the_cookbook():
    """SOFA Tools for Earth Attitude, 5.5: 5 April 2007, 12 h UTC (IAU 2006/2000A, CIO based)."""
    known = orientation(
        -0.072073685, 33, (0.0349282, 0.4833163), corrections=(0.1750e-3, -0.2259e-3)
    )
    C = terrestrial_rotation(parse_epoch("2007-04-05T12:00:00 UTC"), known)
    printed = [
        [+0.973104317697535, +0.230363826239128, -0.000703163482198],
        [-0.230363800456037, +0.973104570632801, +0.000118545366625],
        [+0.000711560162668, +0.000046626403995, +0.999999745754024],
    ]
    np.testing.assert_allclose(C, printed, rtol=0, atol=4e-15)


def test_a_thousand_epochs_of_thirty_years_as_brahe_has_them(epochs, states, restored_brahe):
    """Within 1 mm at 7000 km both ways, leap seconds among them: 0.17 mm (brahe 1.8.0).

    brahe keeps time in one number of days, 0.6 us. Its velocities know no precession and a
    constant length of day: 8e-12 rad/s at 7000 km, and 2e-12 rad/s.
    """
    known = earth_orientation(epochs)
    r_e, v_e = earth_fixed_from_frame("gcrf", epochs, *states, orientation=known)
    r_g, v_g = frame_from_earth_fixed("gcrf", epochs, *states, orientation=known)
    given = np.concatenate(states, axis=1)
    there, back = np.empty((2, 1000, 6))
    for k, epoch in enumerate(each_in_brahe(epochs, known)):
        there[k] = brahe.state_gcrf_to_itrf(epoch, given[k])
        back[k] = brahe.state_itrf_to_gcrf(epoch, given[k])
    assert np.linalg.norm(there[:, :3] - r_e, axis=1).max() < 0.5e-3
    assert np.linalg.norm(back[:, :3] - r_g, axis=1).max() < 0.5e-3
    assert np.linalg.norm(there[:, 3:] - v_e, axis=1).max() < 7e-5
    assert np.linalg.norm(back[:, 3:] - v_g, axis=1).max() < 7e-5


def test_j2000_is_a_constant_bias_from_gcrf(epochs, states):
    """As brahe has it; 23 mas, 0.8 m at 7000 km."""
    link = earth_fixed_from_frame("j2000", epochs, *states)
    r_g, v_g = frame_from_earth_fixed("gcrf", epochs, *link)
    other = np.array(
        [brahe.state_eme2000_to_gcrf(np.concatenate([r, v])) for r, v in zip(*states, strict=True)]
    )
    np.testing.assert_allclose(r_g, other[:, :3], rtol=0, atol=2e-4)
    np.testing.assert_allclose(v_g, other[:, 3:], rtol=0, atol=2e-7)
    assert 0.5 < np.linalg.norm(r_g - states[0], axis=1).max() < 0.9


def test_teme_is_that_of_spacetrack_report_3():
    """AIAA 2006-6753, appendix C: 6 April 2004, with its orientation of the Earth.

    Its Julian date in one number has steps of 40 us, 20 mm on the way of the satellite.
    """
    known = orientation(-0.4399619, 32, (-0.140682, 0.333309), lod=0.0015563)
    r_e, v_e = earth_fixed_from_frame(
        "teme",
        parse_epoch("2004-04-06T07:51:28.386009 UTC"),
        np.array([5094.18016210, 6127.64465950, 6380.34453270]) * 1e3,
        np.array([-4.746131487, 0.785818041, 5.531931288]) * 1e3,
        orientation=known,
    )
    printed_r = np.array([-1033.4793830, 7901.2952754, 6380.3565958]) * 1e3
    printed_v = np.array([-3.225636520, -2.872451450, 5.531924446]) * 1e3
    np.testing.assert_allclose(r_e, printed_r, rtol=0, atol=0.02)
    np.testing.assert_allclose(v_e, printed_v, rtol=0, atol=1e-4)


def test_true_of_date_is_that_of_brahe(epochs, states, restored_brahe):
    """The offsets of the celestial pole move the equinox too: by 11 mm on 1 March 1996."""
    few = slice(None, None, 10)
    chosen = Instant(epochs.day[few], epochs.seconds[few])
    r, v = (x[few] for x in states)
    known = earth_orientation(chosen)
    r_g, _ = frame_from_earth_fixed(
        "gcrf",
        chosen,
        *earth_fixed_from_frame("tod", chosen, r, v, orientation=known),
        orientation=known,
    )
    other = [
        brahe.position_tod_to_gcrf(epoch, r[k])
        for k, epoch in enumerate(each_in_brahe(chosen, known))
    ]
    np.testing.assert_allclose(r_g, other, rtol=0, atol=1e-3)


# ------------------------------------------------------------------------- by itself


def test_the_rotation_vector_is_the_derivative_of_the_chain(epochs):
    """Differences over a minute; within half a minute of midnight the pole's rate has a step."""
    quiet = np.abs((epochs.to("UTC")[1] + 43200) % 86400 - 43200) > 40
    inner = Instant(epochs.day[quiet], epochs.seconds[quiet])
    h = 30.0
    late, early = terrestrial_rotation(inner.plus(h)), terrestrial_rotation(inner.plus(-h))
    turn = late @ np.swapaxes(early, -1, -2)
    pairs = ((1, 2), (2, 0), (0, 1))
    half = np.stack([turn[:, i, j] - turn[:, j, i] for i, j in pairs], axis=-1) / 2
    sine = np.linalg.norm(half, axis=1, keepdims=True)
    omega = half * np.arcsin(sine) / sine / (2 * h)
    # ERA is rounded to 2e-14 rad
    np.testing.assert_allclose(rotation_vector_of_earth(inner), omega, rtol=0, atol=2e-15)


@pytest.mark.parametrize("frame", FRAMES)
def test_there_and_back(frame, epochs, states):
    few = Instant(epochs.day[::10], epochs.seconds[::10])
    r, v = (x[::10] for x in states)
    link = earth_fixed_from_frame(frame, few, r, v, angle=0.7)
    back = frame_from_earth_fixed(frame, few, *link, angle=0.7)
    np.testing.assert_allclose(back[0], r, rtol=0, atol=1e-8)
    np.testing.assert_allclose(back[1], v, rtol=0, atol=1e-11)


def test_uniform_is_the_frame_of_type_orbit(states):
    """And of no epoch."""
    found = earth_fixed_from_frame("uniform", None, *states, angle=0.3)
    np.testing.assert_array_equal(
        found, earth_fixed_from_inertial_array(*states, 0.3, EARTH.rotation_rate)
    )
    np.testing.assert_array_equal(earth_fixed_from_frame("itrf", None, *states), states)


@pytest.mark.parametrize("frame", DATED)
def test_a_frame_of_the_sky_needs_an_epoch(frame, states):
    with pytest.raises(ValueError, match=f"frame '{frame}' needs an epoch"):
        earth_fixed_from_frame(frame, None, *states)


def test_an_unknown_frame_is_refused(states):
    with pytest.raises(ValueError, match="'eci' is no frame; there are gcrf, j2000, teme, tod"):
        earth_fixed_from_frame("eci", None, *states)


def test_an_instant_outside_the_table_is_refused(states):
    with pytest.raises(ValueError, match="reaches from 1973-01-02 to the start of 20"):
        earth_fixed_from_frame("gcrf", parse_epoch("2099-01-01T00:00:00 TAI"), *states)


# ------------------------------------------------------------------------- what is left out

coast = over_members(lambda r, v, t: coasted(r, v, t, EARTH.mu), (3,), (3,), ())


def strayed(omega, r_e, v_e, t, end):
    """Distance [m] after `t` from `end` if the Earth turned about a constant vector."""
    r, _ = coast(r_e, v_e + np.cross(omega, r_e), t)  # inertial axes along those of the start
    return np.linalg.norm(rotation_matrix_array(from_rotation_vector_array(omega * t)) @ r - end)


def test_what_a_simpler_rotation_costs():
    """A two-body orbit like Sentinel-1's of 18 September 2022, against the full chain.

    Velocities about z alone, about the turning pole (xp, -yp, 1), about the chain's own vector of
    the start: meters after 10 and 100 minutes.
    """
    start = parse_epoch("2022-09-18T07:49:21 UTC")
    r_g, v_g = np.array([5.0e6, 5.0e6, 0.0]), np.array([0.75e3, -0.75e3, 7.42e3])
    r_e, v_e = earth_fixed_from_frame("gcrf", start, r_g, v_g)
    known = earth_orientation(start)
    simple = EARTH.rotation_rate * np.array([[0, 0, 1], [known.xp, -known.yp, 1]])
    found = []
    for t in (600.0, 6000.0):
        end, _ = earth_fixed_from_frame("gcrf", start.plus(t), *coast(r_g, v_g, t))
        vectors = [*simple, rotation_vector_of_earth(start)]
        found.append([strayed(omega, r_e, v_e, t, end) for omega in vectors])
    np.testing.assert_allclose(
        found, [[0.3806, 0.01191, 0.000289], [11.71, 0.5452, 0.0219]], rtol=0.02
    )


@pytest.mark.parametrize(("kept", "off"), [("inertial", 4.3e-5), ("earth-fixed", 0.0793)])
def test_where_the_vector_is_published_anew_the_inertial_velocity_continues(kept, off):
    """The same orbit for 100 minutes about the vector of every ten seconds.

    It changes by 4e-15 rad/s each time, for precession stays in the sky; who keeps the velocity
    relative to the Earth leaves out the acceleration -dw/dt x r, 4e-9 m/s^2.
    """
    start, h, n = parse_epoch("2022-09-18T07:49:21 UTC"), 10.0, 600
    r_g, v_g = np.array([5.0e6, 5.0e6, 0.0]), np.array([0.75e3, -0.75e3, 7.42e3])
    vectors = rotation_vector_of_earth(start.plus(h * np.arange(n + 1)))
    turns = rotation_matrix_array(from_rotation_vector_array(vectors * h))
    r, v = earth_fixed_from_frame("gcrf", start, r_g, v_g)
    u = v + np.cross(vectors[0], r)
    for k in range(n):
        r, u = (turns[k] @ x for x in coast(r, u, h))
        if kept == "earth-fixed":
            u += np.cross(vectors[k + 1] - vectors[k], r)
    end, _ = earth_fixed_from_frame("gcrf", start.plus(n * h), *coast(r_g, v_g, n * h))
    assert np.linalg.norm(r - end) == pytest.approx(off, rel=0.02)
