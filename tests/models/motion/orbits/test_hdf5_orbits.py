"""State vectors in HDF5: those of NISAR's products."""

import numpy as np
import pytest
from l0b_files import T0, beam, circular, codes, write
from netCDF4 import Dataset

from terrafix.models.motion.orbits.files import read_orbit

TIME = "science/LSAR/RRSD/lowRateTelemetry/orbit/time"


@pytest.fixture
def product(tmp_path):
    return write(tmp_path / "a.h5", codes(beam(64, 8)))


def test_states_are_read_with_their_epochs(product):
    """Twelve states of a circular orbit, 60 s apart; its closed form in the middle of them."""
    orbit = read_orbit(product)
    assert orbit.tags[0] == np.datetime64("2011-01-13T02:25:00")
    np.testing.assert_array_equal(orbit.t, 60.0 * np.arange(12))
    r, v = orbit.at(330.0)
    true_r, true_v = circular(np.array([T0 - 300 + 330.0]))
    assert np.linalg.norm(r - true_r[0]) < 1e-7  # (9/16)^2 r (n h)^8 / 8! = 1.5e-8 m
    assert np.linalg.norm(v - true_v[0]) < 1e-8


@pytest.mark.parametrize(
    ("units", "message"),
    [
        ("seconds since 2011-01-13 00:00:00.5", "not from a whole second"),
        ("days since 2011-01-13", "not seconds since an epoch"),
    ],
)
def test_epochs_that_are_not_read_are_refused(product, units, message):
    with Dataset(product, "a") as file:
        file[TIME].units = units
    with pytest.raises(ValueError, match=message) as raised:
        read_orbit(product)
    assert str(raised.value).startswith(f"{product}: ")


def test_what_ends_a_text_of_a_fixed_length_is_not_read(product):
    with Dataset(product, "a") as file:
        file[TIME].units = "seconds since 2011-01-13 00:00:00a\x03\x04"
    assert read_orbit(product).tags[0] == np.datetime64("2011-01-13T02:25:00")


def test_hdf5_without_states_is_refused(tmp_path):
    with Dataset(tmp_path / "a.h5", "w") as file:
        file.createGroup("orbit")
    with pytest.raises(ValueError, match="it is HDF5 without a group 'orbit' of state vectors"):
        read_orbit(tmp_path / "a.h5")
