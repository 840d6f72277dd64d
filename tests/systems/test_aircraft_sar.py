"""An aircraft that navigates by images that it forms: from the echo of its true track to the fix.

A few apertures each, but for what is marked as a campaign. The errors of an image are 0.05 m across
and along the track (benchmarks/aircraft_flights.py).
"""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import terrafix as tf
from terrafix.cosim.basics.errors import TerrafixError
from terrafix.cosim.engine.simulation import Simulation
from terrafix.models.images.aperture_matching import REASONS

ROOT = Path(__file__).parents[2]
SYSTEM = ROOT / "examples" / "aircraft_sar.toml"
RECORDED = {
    "flight": ("r_e", "v_e"),
    "matcher": ("fix", "reason", "quality", "residual"),
    "former": ("image",),
    "radar": ("lost",),
}
BARE = [
    *(("terrain.source", "flat"), ("map.source", "flat"), ("terrain.point_density", "0")),
    *((f"terrain.{name}", "0") for name in ("parcels", "smooth", "fine")),
]
"""A field without relief, texture or points."""
FEWEST = ("radar.scatterers", "5")
"""In a resolution cell: as few as the radar takes."""


def system_of(*settings):
    system = tf.read_system(SYSTEM, settings)
    for name, ports in RECORDED.items():
        system.record(name, [system.find(name)[port] for port in ports], period="0.5")
    return system


def flown(*settings, seconds=2, members=1):
    return tf.simulate(system_of(*settings), members=members, duration=str(seconds)).dataset


def payload(data, member):
    """Bytes of a member, but for which of the echoes or images that were there is its own."""
    own = data.sel(member=[member]).variables
    return {str(n): v.values.tobytes() for n, v in own.items() if not str(n).endswith("index")}


def measured_less_true(data):
    """Errors (n_fixes, 2) of range and cross-range of the first member's fixes [m]."""
    get = {n: data[n].values[:, 0] for n in data if "member" in data[n].dims}
    ends = 2 * np.arange(1, (len(get["flight.r_e"]) - 1) // 2 + 1)
    assert (get["matcher.reason"][ends] == 0).all()
    d = get["matcher.fix.p_t_e"][ends] - get["flight.r_e"][ends - 1]
    along = -np.einsum("ij,ij->i", d, get["flight.v_e"][ends - 1])
    true = [np.linalg.norm(d, axis=1), along / get["matcher.fix.speed"][ends, 0]]
    return get["matcher.fix.y"][ends, :2] - np.stack(true, axis=1)


@pytest.fixture(scope="module")
def flight():
    return flown(seconds=2)


def test_images_measure_the_true_track_and_correct_the_navigator(flight):
    """Off by 3, 1, 3 m (1 sigma) at the start, the images still say where the aircraft was.

    0.3 m is five sigmas of an image. The second was formed with what the first had corrected:
    what it is off by is that, no longer the start's 5.5 m along the track.
    """
    assert np.abs(measured_less_true(flight)).max() < 0.3
    residual = flight["matcher.residual"].values[[2, 4], 0]
    assert np.abs(residual[0]).max() > 3.0
    assert np.abs(residual[1]).max() < 0.5
    assert (flight["evaluation.radar_accepted"].values[1:, 0] == 1).all()
    assert (flight["evaluation.radar_nis_dof"].values[1:, 0] == 3).all()


def test_map_drift_reads_what_the_track_is_off_by(flight):
    """Within 0.2 m/s (five sigmas) of what the true velocity is, of which 0.1 was not known."""
    drift = flight["former.image.drift"].values[[2, 4], 0]
    line = np.linalg.norm(flight["former.image.v_e"].values[[2, 4], 0], axis=1)
    assert (flight["former.image.focused"].values[[2, 4], 0] == 1).all()
    assert np.abs(line + drift - 70.0).max() < 0.2


@pytest.mark.campaign
@pytest.mark.parametrize("settings", [[("earth", "wgs84")], [("looks", "in-turn")]])
def test_the_real_earth_and_both_sides(settings):
    data = flown(*settings)
    assert np.abs(measured_less_true(data)).max() < 0.3
    sides = [1, -1] if settings[0][0] == "looks" else [1, 1]
    assert data["former.image.side"].values[[2, 4], 0].tolist() == sides


def test_a_member_alone_is_the_member_of_the_ensemble():
    """Two tracks in gusts, echoes and images of their own; the second one alone: the same bytes."""
    settings = [("air", "gusts"), FEWEST]
    both = flown(*settings, seconds=1, members=2)
    alone = flown(*settings, seconds=1, members=[1])
    assert (both["matcher.reason"].values[-1] == 0).all()
    assert payload(both, 1) == payload(alone, 1)
    r, fix = (both[f"{n}"].values[-1] for n in ("flight.r_e", "matcher.fix.y"))
    assert not np.array_equal(r[0], r[1])
    assert not np.array_equal(fix[0], fix[1])


@pytest.mark.campaign
def test_a_run_taken_up_again_goes_on_to_the_same_bytes():
    """From within an aperture: what was flown of it is part of the state."""
    whole = flown(seconds=2)
    halted = Simulation(system_of(), members=1)
    halted.run_until("1.7")
    saved = halted.get_state()
    again = Simulation(system_of(), members=1)
    again.set_state(saved)
    again.run_until("2")
    rest = again.result(wall_s=0.0).dataset
    for name in ("matcher.fix.y", "former.image.drift", "evaluation.position_error"):
        np.testing.assert_array_equal(rest[name].values[-1], whole[name].values[-1])


def test_nothing_is_found_on_a_featureless_field():
    """No fix, and no map drift: the navigator flies on with what it has."""
    data = flown(*BARE, FEWEST, seconds=1)
    assert REASONS[int(data["matcher.reason"].values[2, 0])] != "accepted"
    assert data["former.image.focused"].values[2, 0] == 0
    assert np.isnan(data["evaluation.radar_nis"].values[:, 0]).all()


def test_a_radar_that_is_off_sends_nothing():
    data = flown(("radar.on", "false"), seconds=1)
    assert np.isnan(data["evaluation.radar_accepted"].values).all()


TURN = '[{duration = "40 s", turn = "160 deg"}]'
BRIEF = ("radar.length", "0.3 s")
"""An echo that is made sooner, where it is not what is refused."""
MISTAKES = {
    "radar on the other Earth": (
        [("radar.earth", "wgs84")],
        "'radar.earth' is wgs84, but the position that it reads is 1 km from the origin",
    ),
    "matcher on the other Earth": (
        [BRIEF, ("earth", "wgs84"), ("matcher.earth", "flat")],
        "'matcher.earth' is flat, but the position that it reads is 6,379 km from the origin",
    ),
    "repetition frequency that aliases": (
        [("radar.prf", "300 Hz"), ("radar.doppler_bandwidth", "200 Hz")],
        "holds 391 Hz of Doppler at 70.0 m/s, and 300 pulses a second sample less",
    ),
    "aperture longer than the interval": (
        [("radar.length", "1.2 s")],
        "'radar' has apertures of 1.2 s, and makes one every 1 s",
    ),
    "aperture without its ends": (
        [("radar.length", "0.998 s")],
        "needs the motion at its begin and its end",
    ),
    "few scatterers": ([("radar.scatterers", "2")], "set radar.scatterers to 5 at least"),
    "reference elsewhere": (
        [BRIEF, ("earth", "wgs84"), ("earlier.longitude", "0.5 deg")],
        "m from the reference's middle",
    ),
    "reference of other pixels": (
        [BRIEF, ("reference.azimuth_looks", "60")],
        "are 7.01 by 0.92 m on the ground, those of its images 0.35 m",
    ),
    "other sides": (
        [BRIEF, ("reference.looks", "left")],
        "to the right of the track, and the reference to its left",
    ),
    "beam off the reference": (
        [BRIEF, ("radar.squint", "20 deg")],
        "point the beam at it, or use a reference of this place",
    ),
    "bank that lifts the beam": (
        [("flight.segments", TURN)],
        "deg below the wings, and the beam lights 25 to 55 deg",
    ),
    "heights that do not cover the track": (
        [("map.source", "jacksboro")],
        "the elevation model does not cover",
    ),
    "antenna under the ground": (
        [("terrain.source", "flat"), ("terrain.flat_height", "1200 m")],
        "an antenna 1000 m high is not above the ground, 1200 m",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_bad_input_is_refused_in_words(name):
    settings, said = MISTAKES[name]
    with pytest.raises(TerrafixError) as caught:
        flown(*settings, seconds=1)
    assert said in str(caught.value)
    assert "Traceback" not in str(caught.value)


# ------------------------------------------------------------------ campaigns


@pytest.fixture(scope="module")
def flights():
    path = ROOT / "benchmarks" / "aircraft_flights.py"
    spec = importlib.util.spec_from_file_location("aircraft_flights", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.campaign
def test_twenty_flights(flights):
    """The numbers of the order: 20 flights of 50 s, each with scene, speckle and noise of its own.

    3 sigma of a sample of 20 are uncertain by 16 %.
    """
    found = [flights.fly(k, 50.0, []) for k in range(201, 221)]
    error, claim = (np.concatenate([f[n] for f in found]) for n in ("error", "claim"))
    assert len(error) >= 0.97 * 1000
    assert np.abs(error[:, :2]).max() < 3.0
    rms = np.sqrt((error[:, :2] ** 2).mean(axis=0))
    assert (rms <= [0.10, 0.12]).all()
    ratio = rms / np.sqrt((claim[:, :2] ** 2).mean(axis=0))
    assert ((ratio > 0.8) & (ratio < 1.25)).all()
    end = np.array([f["position_error"][-1] for f in found])
    assert (3 * np.sqrt((end**2).mean(axis=0)) <= [0.6, 3.5, 3.5]).all()
    nees = np.mean([f["nees"][-1] for f in found])
    assert 13.6 < nees < 18.6  # 95 % of chi-square with 320 degrees, over 20


@pytest.mark.campaign
def test_without_compensation_gusts_mislead_map_drift(flights):
    """Wrong by over 1 m/s rms in turbulence of 1.5 m/s."""
    settings = [("air", "gusts"), ("former.compensated", "false"), ("former.largest_drift", "8")]
    found = flights.fly(1, 20.0, settings)
    assert np.sqrt(np.mean(found["speed"] ** 2)) > 1.0
