"""The air about a satellite: MSIS itself, and what is made of it between publications."""

import numpy as np
import pymsis
import pytest

from terrafix.components.truth.atmosphere import Atmosphere
from terrafix.components.truth.environment import SpaceEnvironment
from terrafix.components.truth.satellite_orbit import SatelliteOrbit
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.system.system import System
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.geodesy import ecef, geodetic_from_ecef_array
from terrafix.models.motion.air import air_about
from terrafix.models.motion.forces import density_near

EPOCH = np.datetime64("2022-09-18T07:49:21", "ns")
ACTIVITY = {"f107": 140.0, "f107a": 130.0, "ap": 12.0}
R_E = np.array([-1104646.3, -6096830.4, 3395727.4])  # [m], an orbit of 700 km
V_E = np.array([-1004.7, 3648.9, 6498.0])  # [m/s]


def msis(r_e, utc=EPOCH):
    latitude, longitude, height = geodetic_from_ecef_array(r_e)
    found = pymsis.calculate(
        utc,
        np.degrees(longitude),
        np.degrees(latitude),
        height / 1e3,
        140.0,
        130.0,
        [[12.0] * 7],
    )
    return float(np.asarray(found).reshape(-1)[pymsis.Variable.MASS_DENSITY])


def test_the_density_is_that_of_msis():
    """At two places at once, each as if alone; 3e-14 kg/m^3 at 700 km at medium activity."""
    places = np.array([R_E, ecef(0.3, 1.0, 400e3)])
    logs, _ = air_about(places, EPOCH, 140.0, 130.0, 12.0)
    expected = [msis(p) for p in places]
    np.testing.assert_allclose(np.exp(logs), expected, rtol=1e-6)
    assert 1e-14 < expected[0] < 1e-13
    assert 1e-12 < expected[1] < 1e-11


def test_it_holds_until_the_next_publication():
    """Ten seconds on, 75 km along the orbit, within 2 %; held still it would be no better than 4 %
    in the steep gradient of 400 km at dawn."""
    place = ecef(0.3, 1.0, 400e3)
    ahead = place + np.array([0.0, 0.0, 75e3])
    ahead *= np.linalg.norm(place) / np.linalg.norm(ahead)
    logs, gradient = air_about(place, EPOCH, 140.0, 130.0, 12.0)
    near = over_members(density_near, (3,), (3,), (), (3,))(ahead, place, logs[0], gradient[0])
    expected = msis(ahead)
    assert abs(near / expected - 1) < 0.02
    assert abs(near / expected - 1) < 0.5 * abs(np.exp(logs[0]) / expected - 1)


def falling(epoch="2022-09-18T07:49:21 UTC"):
    system = System("falling", duration="60 s", epoch=epoch)
    begin = {"start_from": "parameters", "r0_e": R_E, "v0_e": V_E, "gravity": "j2"}
    air = system.add(Atmosphere(**ACTIVITY), "air")
    begin |= {"surrounded": True, "drag": "atmosphere", "ballistic_coefficient": 0.02}
    orbit = system.add(SatelliteOrbit(rate=Rate(hz=10), **begin), "orbit")
    sky = system.add(SpaceEnvironment(), "sky")
    system.connect(sky["surroundings"], orbit["surroundings"])
    system.connect(orbit["r_e"], air["r_e"])
    system.connect(air["air"], orbit["atmosphere"])
    system.record("all", ["orbit.delta_v_e", "orbit.r_e"])
    return system


def test_a_satellite_feels_the_air_that_is_there():
    """delta_v = rho CdA/m v^2 / 2 dt against the velocity, at the density of MSIS there."""
    flown = simulate(falling(), members=2).dataset
    for k in (1, 95, 600):
        felt = flown["orbit.delta_v_e"].values[k, 0]
        place = flown["orbit.r_e"].values[k, 0]
        density = msis(place, EPOCH + np.timedelta64(100 * k, "ms"))
        speed = np.linalg.norm(V_E)
        assert np.linalg.norm(felt) == pytest.approx(
            0.5 * density * 0.02 * speed**2 * 0.1, rel=0.03
        )


def test_the_date_is_that_of_the_system():
    """GPS is 18 s ahead of UTC: the same instant, the same bits."""
    same = [falling(), falling("2022-09-18T07:49:39 GPS")]
    felt = [simulate(s, duration="10").dataset["orbit.delta_v_e"].values for s in same]
    assert felt[0].tobytes() == felt[1].tobytes()
    with pytest.raises(SystemCheckError, match="'air' needs to know what time it is"):
        simulate(falling(None))


def test_a_place_that_is_none_has_no_air_and_leaves_the_others_theirs():
    logs, gradients = air_about([[np.nan] * 3, R_E], EPOCH, 140.0, 130.0, 12.0)
    alone = air_about(R_E, EPOCH, 140.0, 130.0, 12.0)
    assert np.isnan(logs[0])
    np.testing.assert_array_equal(logs[1], alone[0][0])
    np.testing.assert_array_equal(gradients[1], alone[1][0])


def test_there_is_no_density_without_indices():
    system = System("bare", duration="1 s", epoch="2022-09-18T07:49:21 UTC")
    system.add(Atmosphere(f107=140.0, f107a=130.0), "air")
    with pytest.raises(SystemCheckError, match="'ap'"):
        simulate(system)
