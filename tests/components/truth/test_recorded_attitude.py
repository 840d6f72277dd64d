"""Attitude of a file of radar echo in the place of a simulated one."""

import ceos_files as ceos
import numpy as np
import pytest
from ceos_files import LOOK, T0, leader
from l0b_files import beam, circular, codes, write

from terrafix import components
from terrafix.components.truth.attitude import LvlhAttitude
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.system.system import System

FIRST = 300.0
"""Of the first line, after the first state [s]."""


def flown(path, look=LOOK, start=FIRST - 1, epoch=None, duration="2 s", **settings):
    """A level attitude along the inertial velocity of the same orbit, and the recorded one."""
    system = System("read", epoch=epoch)
    begin = {} if epoch else {"start": start}
    rate = Rate("0.5")
    system.add(components.recorded_orbit(orbit_file=path, rate=rate, **begin), "orbit")
    system.add(LvlhAttitude(velocity="inertial", rate=rate), "level")
    attitude = components.recorded_attitude(
        result_file=path, look=np.radians(look), rate=rate, **begin, **settings
    )
    system.add(attitude, "attitude")
    for name in ("r_e", "v_e", "delta_v_e"):
        system.connect(f"orbit.{name}", f"level.{name}")
    names = ("q_be", "delta_theta_b", "delta_v_b")
    ports = [f"{who}.{name}" for who in ("level", "attitude") for name in names]
    system.record("all", ports, rate=Rate("0.5"))
    return simulate(system, members=1, duration=duration).dataset


def levels(data, name):
    return data[f"level.{name}"].to_numpy(), data[f"attitude.{name}"].to_numpy()


def test_angles_of_zero_are_level_along_the_inertial_velocity(tmp_path):
    """A leader of CEOS: attitude and its turn of every step are those of `lvlh_attitude`.

    Turning evenly between points a second apart errs by less than 1e-8 rad.
    """
    t = T0 - 2 + np.arange(6.0)
    path = leader(tmp_path, attitudes=ceos.attitudes(t, np.zeros((6, 3))))
    data = flown(path)
    one, other = levels(data, "q_be")
    np.testing.assert_allclose(np.abs(np.sum(one * other, axis=-1)), 1.0, atol=1e-14)
    one, other = levels(data, "delta_theta_b")
    np.testing.assert_allclose(one[1:], other[1:], atol=2e-8)
    assert np.abs(one[1:]).max() > 4e-4
    assert not levels(data, "delta_v_b")[1].any()


def test_a_run_begins_at_the_systems_epoch(tmp_path):
    t = T0 - 2 + np.arange(6.0)
    path = leader(tmp_path, attitudes=ceos.attitudes(t, np.zeros((6, 3))))
    one, other = levels(flown(path, epoch="2011-01-13T02:29:59Z"), "q_be")
    np.testing.assert_allclose(np.abs(np.sum(one * other, axis=-1)), 1.0, atol=1e-14)


def test_roll_turns_the_body(tmp_path):
    t = T0 - 2 + np.arange(6.0)
    path = leader(tmp_path, attitudes=ceos.attitudes(t, np.tile([0.5, 0, 0], (6, 1))))
    one, other = levels(flown(path), "q_be")
    turn = 2 * np.arccos(np.abs(np.sum(one * other, axis=-1)))
    np.testing.assert_allclose(np.degrees(turn), 0.5, atol=1e-5)


def _to_the_right(t, look):
    """Quaternions, scalar first, of an antenna whose x axis is forward: not that of NISAR."""
    from scipy.spatial.transform import Rotation

    r, v = circular(t)
    down = -r / np.linalg.norm(r, axis=1)[:, None]
    right = np.cross(down, v + np.cross([0, 0, 7.2921151467e-5], r))
    right /= np.linalg.norm(right, axis=1)[:, None]
    z = np.cos(look) * down + np.sin(look) * right
    x = np.cross(right, down)
    q = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2)).as_quat()
    return np.roll(q, 1, axis=1)


@pytest.mark.parametrize("look", [LOOK, -LOOK])
def test_axes_of_the_antenna_are_told_by_where_they_lie(tmp_path, look):
    """NISAR's HDF5, here with x forward in place of y back, and looking to the left, too."""
    t = T0 - 2 + np.arange(6.0)
    samples = codes(beam(16, 8))
    quaternions = _to_the_right(t, np.radians(look))
    given = {"attitude/time": t, "attitude/quaternions": quaternions}
    path = write(tmp_path / "a.h5", samples, **given)
    one, other = levels(flown(path, look), "q_be")
    np.testing.assert_allclose(np.abs(np.sum(one * other, axis=-1)), 1.0, atol=1e-12)
    with pytest.raises(SystemCheckError, match=r"its boresight is 34\.30 deg off nadir to the"):
        flown(path, -look)


def test_a_run_outside_the_attitude_is_refused(tmp_path):
    with pytest.raises(SystemCheckError, match=r"attitude is known from 298.000000 s to 303.00"):
        flown(leader(tmp_path), duration="5 s")


def test_what_is_missing_is_asked_for(tmp_path):
    path = leader(tmp_path)
    alone = components.recorded_attitude(result_file=path)
    alone.name = "attitude"
    with pytest.raises(
        ConfigurationError, match=r"is not told how it is mounted\n  set attitude\.l"
    ):
        alone.validate()
    assert not alone.takes("source")
    assert alone.takes("start")
    other = tmp_path / "echo.npz"
    np.savez(other, i=np.zeros(3))
    alone = components.recorded_attitude(result_file=other, look=0.6)
    alone.name = "attitude"
    with pytest.raises(ConfigurationError, match="it is a zip archive; attitude is read from"):
        alone.validate()
