"""Slips whose length is told by what is seen before and after them."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from terrafix.components.sensors.compiled import row_operations
from terrafix.models.radar.doppler import fractional_centroid, unwrapped_centroid
from terrafix.models.radar.recordings.arrays import ArrayLines
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.recordings.recording import Recording
from terrafix.models.radar.recordings.slips import Seen, without_slips

_spec = importlib.util.spec_from_file_location("points", Path(__file__).parents[1] / "points.py")
points = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(points)

V, NEAR = 7062.0, 400e3
RADAR = replace(points.RADARSAT, pulse_length=6e-6, chirp_rate=-4.5e12)
SEEN = Seen(RADAR, NEAR, 0.0, V)
LINES, CELLS = 900, 620


@pytest.fixture(scope="module")
def whole():
    """Points in noise, strewn over lines and cells; the beam sees each for 269 lines."""
    rng = np.random.default_rng(2)
    closest = NEAR + rng.uniform(100, 1900, 60)
    passed = rng.uniform(0, LINES, 60) / RADAR.prf
    targets = zip(closest, passed, strict=True)
    echo = points.point_echo(RADAR, NEAR, V, 0.0, (LINES, CELLS), targets)
    noise = rng.standard_normal((LINES, CELLS, 2)) @ [0.5, 0.5j]
    return (echo + noise).astype(np.complex64)


def slipped(echo, slips, **more):
    place = np.arange(len(echo))
    lost = np.zeros(0, np.intp)
    return Recording(Path("x"), ArrayLines((echo,), None), place, lost, slips=slips, **more)


@pytest.mark.parametrize("velocity", [V, V + 4.0])
@pytest.mark.parametrize("n_lost", [1, 3, 10])
def test_the_length_is_told_though_the_velocity_is_not_exact(whole, n_lost, velocity):
    """4 m/s are what looks of half a band's distance apart are displaced by half a line by."""
    torn = slipped(np.delete(whole, np.s_[420 : 420 + n_lost], axis=0), (420,))
    found = without_slips(torn, replace(SEEN, velocity=velocity))
    expected = whole.copy()
    expected[420 : 420 + n_lost] = 0
    np.testing.assert_array_equal(found.read(), expected)
    np.testing.assert_array_equal(found.lost, 421 + np.arange(n_lost))
    assert found.slips == ()


def test_two_slips_are_told(whole):
    torn = np.delete(whole, [300, 301, 302, 600, 601], axis=0)
    found = without_slips(slipped(torn, (300, 597)), SEEN)
    np.testing.assert_array_equal(found.lost, [301, 302, 303, 601, 602])


def test_what_is_not_alike_is_refused():
    """Speckle has nothing to be recognized by."""
    rng = np.random.default_rng(4)
    noise = (rng.standard_normal((LINES, CELLS, 2)) @ [1, 1j]).astype(np.complex64)
    with pytest.raises(ValueError, match="before line 421 is not told: what is seen before and"):
        without_slips(slipped(noise, (420,)), SEEN)


def test_no_slip_is_not_filled(whole):
    """Where lines are no neighbors for another reason, looks are not apart."""
    with pytest.raises(ValueError, match=r"looks before and after it are -?0\.\d+ lines apart"):
        without_slips(slipped(whole, (420,)), SEEN)


def test_too_little_beside_a_slip_is_refused(whole):
    with pytest.raises(ValueError, match=r"60 lines are seen beside line 61, and 13. are wanted"):
        without_slips(slipped(whole, (60,)), SEEN)


def test_times_and_other_slips_move_on():
    times = 5.0 + np.arange(200) / 100
    echo = np.ones((200, 4), np.complex64)
    found = slipped(echo, (100, 150), line_time=times).with_lost(100, 3)
    np.testing.assert_allclose(found.line_time, 5.0 + np.arange(203) / 100, atol=1e-12)
    assert found.slips == (153,)
    np.testing.assert_array_equal(found.lost, [101, 102, 103])
    with pytest.raises(ValueError, match="2% of them may be"):
        found.with_lost(153, 3)


@pytest.mark.parametrize(("name", "n_lost"), [("stanley_park", 10), ("ubc", 3)])
def test_slips_of_real_echo_are_put_right(tmp_path, data_folder, name, n_lost):
    """Of RADARSAT-1; benchmarks/lost_lines.py has all its chunks, at more places."""
    path = data_folder / "radarsat1_vancouver" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"no {path}")
    echo = read_recording(path).read()
    torn = np.delete(echo, np.s_[900 : 900 + n_lost], axis=0)
    np.savez(tmp_path / "a.npz", echo=torn, first_rg_line=1, first_rg_cell=1)
    recording = read_recording(tmp_path / "a.npz", slips=True)
    assert recording.slips == (900,)
    radar = points.RADARSAT
    fraction, _ = fractional_centroid(torn[:900], radar.prf)
    centroid = float(unwrapped_centroid(fraction, radar.prf, -6900.0))
    found = without_slips(recording, Seen(radar, 988647.462, centroid, V, row_operations()))
    np.testing.assert_array_equal(found.lost, 901 + np.arange(n_lost))
