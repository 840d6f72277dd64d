"""Orbit files of others flown as truth: epochs, gaps, and how densely states must lie."""

from pathlib import Path

import numpy as np
import pytest
from orbit_files import FIRST, HEAD, oem, sp3, states, table

from terrafix import components
from terrafix.components.truth.playback import Recording
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.system.system import System
from terrafix.models.core.timescales import parse_epoch
from terrafix.models.geometry.celestial import frame_from_earth_fixed

MINUTE = np.arange(0.0, 3601.0, 60.0)


def system_of(path, **settings):
    system = System("orbit", duration="60")
    orbit = system.add(
        components.recorded_orbit(orbit_file=path, rate=Rate("1"), **settings), "orbit"
    )
    system.record("orbit", [orbit["r_e"], orbit["v_e"]])
    return system


@pytest.mark.parametrize(
    ("name", "text", "satellite", "r_error", "v_error"),
    [
        ("a.oem", HEAD + oem(MINUTE, scale="GPS"), "", 5e-5, 5e-6),
        ("a.sp3", sp3(MINUTE, satellites=("L51", "L52")), "L52", 1.5e-3, 1e-4),
        ("a.csv", table(MINUTE), "", 5e-5, 5e-6),
    ],
)
def test_a_file_of_any_format_is_flown(tmp_path, name, text, satellite, r_error, v_error):
    path = tmp_path / name
    path.write_text(text)
    found = simulate(system_of(path, satellite=satellite, start="601.5 s"), members=2).dataset
    t = found["orbit.r_e"][found["orbit.r_e"].dims[0]].to_numpy() + 601.5
    r, v = states(t)
    for member in (0, 1):
        assert np.abs(found["orbit.r_e"][:, member] - r).max() < r_error
        assert np.abs(found["orbit.v_e"][:, member] - v).max() < v_error


def refusal(system, **run):
    with pytest.raises(SystemCheckError) as caught:
        simulate(system, **run)
    (problem,) = caught.value.problems
    return str(problem)


def test_a_gap_is_refused_where_it_is_flown_over(tmp_path):
    path = tmp_path / "a.sp3"
    path.write_text(sp3(MINUTE, lost={20, 21, 22}))
    simulate(system_of(path, start="1080 s"))  # ends where the gap begins
    simulate(system_of(path, start="1380 s"))
    assert refusal(system_of(path, start="1081 s")) == (
        "'orbit' is to play from 1081 s to 1141 s after the first state of 'a.sp3', which has none "
        "between 1140 s and 1380 s (2022-09-18T05:50:55.500 GPS to 2022-09-18T05:54:55.500 GPS)\n"
        "  fly before or after that gap, or use another file"
    )


def test_states_too_far_apart_are_refused(tmp_path):
    """At 900 s the eighth order errs by some 70 m in a low orbit (docs/recorded_orbit.md)."""
    path = tmp_path / "a.oem"
    path.write_text(HEAD + oem(np.arange(0.0, 10801.0, 900.0)))
    text = refusal(system_of(path, start="4000 s"))
    assert text.startswith("'orbit' interpolates the states of 'a.oem' to ")
    assert text.endswith("or with velocities, or allow more")
    simulate(system_of(path, start="4000 s", interpolation_error="200 m"))


def test_a_run_begins_at_the_epoch_of_its_system(tmp_path):
    """Ten minutes after the first state of a file in GPS time, told in UTC, which is 18 s behind.

    Inertial states are those of GCRF, by the whole chain.
    """
    path = tmp_path / "a.oem"
    path.write_text(HEAD + oem(MINUTE, scale="GPS"))
    system = system_of(path)
    system.epoch = f"{FIRST + np.timedelta64(600 - 18, 's')} UTC"
    system.record("inertial", [system.nodes["orbit"][n] for n in ("r_i", "v_i")])
    found = simulate(system).dataset
    t = found["orbit.r_e"][found["orbit.r_e"].dims[0]].to_numpy()
    r, v = states(600.0 + t)
    assert np.abs(found["orbit.r_e"][:, 0] - r).max() < 5e-5
    instants = parse_epoch(system.epoch).plus(t)
    r_i, v_i = frame_from_earth_fixed("gcrf", instants, r, v)
    assert np.abs(found["orbit.r_i"][:, 0] - r_i).max() < 5e-5
    assert np.abs(found["orbit.v_i"][:, 0] - v_i).max() < 5e-6


def _check(orbit, epoch):
    """As a system is checked."""
    orbit.validate_epoch(epoch)
    orbit.validate_duration(60.0)


@pytest.mark.parametrize(
    ("epoch", "settings", "message"),
    [
        ("2022-09-18T06:31:30 GPS", {}, "covers 2022-09-18T05:31:55.500 GPS to 2022-09-18T06:31:5"),
        ("2022-09-18T05:31:50 GPS", {}, "is to play 0 s from 2022-09-18T05:31:50 GPS on"),
        ("2022-09-18T05:40:00 GPS", {"start": "1 s"}, "'orbit.start' is 1 s, but the run begins"),
        ("2022-09-18T05:40:00", {}, "the epoch '2022-09-18T05:40:00' has no time scale"),
        ("2022-09-18T23:59:60 UTC", {}, "does not exist: there was no leap second"),
        ("2022-09-18T05:40:00 GPS", {"earth_angle0": 0.1}, "of axes that turn uniformly"),
    ],
)
def test_an_epoch_that_cannot_be_is_refused(tmp_path, epoch, settings, message):
    path = tmp_path / "a.oem"
    path.write_text(HEAD + oem(MINUTE, scale="GPS"))
    orbit = components.recorded_orbit(orbit_file=path, rate=Rate("1"), **settings)
    orbit.name = "orbit"
    with pytest.raises(ConfigurationError, match=message):
        _check(orbit, epoch)


def test_a_recording_has_the_epoch_of_its_run():
    """A result without one cannot be at any; with one it is as many seconds into its run."""
    recording = Recording.__new__(Recording)
    recording.path, recording.epoch = Path("run.nc"), "2022-09-18T05:40:00 GPS"
    assert recording.since_start(parse_epoch("2022-09-18T05:40:02.5 UTC")) == 20.5
    recording.epoch = None
    with pytest.raises(ValueError, match=r"'run\.nc' was recorded without an epoch"):
        recording.since_start(parse_epoch("2022-09-18T05:40:02.5 UTC"))


def test_settings_that_a_file_does_not_take_are_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(table(MINUTE))
    assert "holds one satellite: 'L51'" in refusal(system_of(path, satellite="L51"))
    orbit = components.recorded_orbit(orbit_file=path)
    assert "does not take 'source'" in orbit.idle("source")
    assert orbit.idle("interpolation_error") is None
    orbit.orbit_file = tmp_path / "a.nc"
    assert orbit.idle("source") is None
    assert "does not take 'satellite'" in orbit.idle("satellite")
