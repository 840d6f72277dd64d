"""Sensors of the sky in a satellite on a recorded orbit, at an epoch: they see what is there."""

import numpy as np
import pytest
from orbit_files import FIRST, HEAD, oem

import terrafix as tf
from terrafix import components
from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.models.core.timescales import parse_epoch
from terrafix.models.geometry.celestial import terrestrial_rotation
from terrafix.models.geometry.quaternion import rotation_matrix_array
from terrafix.models.motion.bodies import environment_at


@pytest.fixture
def sky(tmp_path):
    """A system of 25 s: an environment every 10 s, what it surrounds, and sensors without noise."""
    path = tmp_path / "a.oem"
    path.write_text(HEAD + oem(np.arange(0.0, 601.0, 60.0)))
    quiet = {"cross_sigma": 0.0, "roll_sigma": 0.0, "sun_exclusion": 0.0, "moon_exclusion": 0.0}
    with tf.System("sky", duration="25") as system:
        system.epoch = f"{FIRST + np.timedelta64(60, 's')} UTC"
        around = system.add(components.environment(), "environment")
        orbit = system.add(components.recorded_orbit(orbit_file=path), "orbit")
        attitude = system.add(components.lvlh_attitude(), "attitude")
        star = system.add(components.star_tracker(**quiet), "star")
        sun = system.add(components.sun_sensor(sigma=0.0, half_angle=np.pi), "sun")
        for n in ("r_e", "v_e", "delta_v_e"):
            system.connect(orbit[n], attitude[n])
        for sensor in (star, sun):
            system.connect(orbit["r_e"], sensor["r_e"])
            system.connect(attitude["q_be"], sensor["q_be"])
            system.connect(around["surroundings"], sensor["surroundings"])
        system.record("star", [star["fix"]])
        system.record("sun", [sun["fix"], sun["lit"]])
        system.record("truth", [attitude["q_be"], orbit["r_e"]], period="0.25")
    return system


def test_sensors_of_the_sky_see_what_is_there(sky):
    """Attitude relative to GCRF by the whole chain at each instant, the Sun to a meter of it."""
    found = tf.simulate(sky).dataset
    start, q_be = parse_epoch(sky.epoch), found["attitude.q_be"]
    t = q_be[q_be.dims[0]].to_numpy()
    C_be = rotation_matrix_array(q_be.to_numpy()[:, 0])
    seen = found["star.fix.q_bi"]
    for when in (0.25, 9.75, 10.0, 24.75):
        C = C_be[t == when][0] @ terrestrial_rotation(start.plus(when))
        row = seen[seen[seen.dims[0]].to_numpy() == when, 0].to_numpy()[0]
        np.testing.assert_allclose(rotation_matrix_array(row), C, atol=1e-12)
    lit, y = found["sun.lit"], found["sun.fix.y"]
    for when in (9.0, 24.0):
        sun = (
            environment_at(start.plus(when))["sun_e"]
            - found["orbit.r_e"].to_numpy()[t == when, 0][0]
        )
        expected = C_be[t == when][0] @ (sun / np.linalg.norm(sun))
        assert lit[lit[lit.dims[0]].to_numpy() == when, 0] == 1.0
        row = y[y[y.dims[0]].to_numpy() == when, 0].to_numpy()[0]
        np.testing.assert_allclose(row, expected, atol=1e-11)


def test_a_star_tracker_wants_an_epoch(sky):
    sky.epoch = None
    with pytest.raises(SystemCheckError, match="the system has no epoch"):
        tf.simulate(sky)
