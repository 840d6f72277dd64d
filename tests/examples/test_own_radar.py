"""The page "bring your own radar": its system runs on ALOS PALSAR's raw echo."""

import os
import re
from pathlib import Path

import ceos_files
import numpy as np
import pytest

import terrafix as tf
from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.models.geometry.quaternion import rotation_matrix_array
from terrafix.models.radar.doppler import fractional_centroid
from terrafix.models.radar.recordings.attitude import read_body_attitude
from terrafix.models.radar.recordings.files import read_recording

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
ECHO = DATA / "alos_palsar" / "ALPSRP264757150-H1.0__A_HH_LINE4000-5000_RANGE0-2200.h5"


@pytest.fixture
def system(tmp_path, monkeypatch):
    if not ECHO.is_file():
        pytest.skip(f"no real data: {ECHO} is absent (set TERRAFIX_DATA)")
    monkeypatch.setenv("TERRAFIX_DATA", str(DATA))
    (block,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs/own_radar.md").read_text(), re.DOTALL)
    (tmp_path / "palsar.toml").write_text(block)
    return tf.read_system(tmp_path / "palsar.toml")


def test_the_system_of_the_page_hears_what_its_track_predicts(system):
    """Doppler of the beam by the file's orbit and attitude, against that of the lines' own phases.

    They are 11 Hz apart, which a squint of 0.01 degrees is; 1,000 lines tell it to some hertz.
    """
    data = tf.simulate(system, members=1).dataset

    def acquired(name):
        values = data[f"echo.acquired.{name}"].values
        return float(values[np.isfinite(values)][0])

    recording = read_recording(ECHO)
    found, _ = fractional_centroid(recording.read(), recording.sent.prf)
    assert acquired("beam_doppler") == pytest.approx(found, abs=15.0)
    assert acquired("near_range") == 847166.0
    assert acquired("time_sigma") == 0.0
    assert recording.start == pytest.approx(float(system.nodes["orbit"].setting("start")), abs=1e-9)
    assert recording.first_line == float(system.nodes["echo"].setting("start_line"))
    assert acquired("first_time") == pytest.approx(-0.23, abs=1e-9)
    # flat ground at 33.5 degrees off nadir, amid 847 to 868 km
    assert 857e3 < acquired("beam_range") < 860e3


def test_the_same_in_ceos_is_the_same(system, tmp_path):
    """The page's file as the CEOS that it was made of: orbit and attitude of the leader, its lines.

    Times are cut to a millisecond: lines are 0.2 m and the boresight's Doppler 0.01 Hz elsewhere.
    """
    lines = ceos_files.repackaged(tmp_path, ECHO, 1400)
    leader = tmp_path / f"LED{lines.name[6:]}"
    nodes = system.nodes
    nodes["orbit"].orbit_file, nodes["attitude"].result_file = leader, leader
    nodes["echo"].folder, nodes["echo"].files = tmp_path, lines.name
    found, original = read_recording(lines), read_recording(ECHO)
    assert found.start == pytest.approx(original.start, abs=30e-6)
    for name in ("carrier", "sample_rate", "chirp_rate", "pulse_length"):
        assert getattr(found.sent, name) == pytest.approx(getattr(original.sent, name), rel=1e-8)
    assert found.sent.prf == pytest.approx(original.sent.prf, rel=1e-6)
    data = tf.simulate(system, members=1).dataset

    def acquired(name):
        values = data[f"echo.acquired.{name}"].values
        return float(values[np.isfinite(values)][0])

    assert acquired("beam_doppler") == pytest.approx(49.1, abs=0.1)
    assert acquired("near_range") == 847166.0
    assert acquired("time_sigma") == pytest.approx(0.289e-3, rel=0.01)


def test_the_boresight_lies_off_nadir_as_the_file_says(system):
    """34.30 degrees, mounted as it is: the attitude of the file is level to a millidegree."""
    attitude = system.nodes["attitude"]
    body = read_body_attitude(ECHO, float(attitude.setting("look")))
    t = float(attitude.setting("start"))
    r, v = body.orbit.at(t)
    axes = rotation_matrix_array(body.at(t))
    nadir = -r / np.linalg.norm(r)
    assert np.degrees(np.arccos(axes[2] @ nadir)) < 0.005
    boresight = np.sin(np.radians(34.3)) * axes[1] + np.cos(np.radians(34.3)) * axes[2]
    assert np.degrees(np.arccos(boresight @ nadir)) == pytest.approx(34.3, abs=0.005)
    assert boresight @ np.cross(r, v) < 0


def test_a_radar_that_is_not_the_files_is_refused(system):
    system.nodes["echo"].prf = 2000.0
    with pytest.raises(SystemCheckError, match=r"'echo.prf' is 2000 Hz, but its files say 2150"):
        tf.simulate(system, members=1)
