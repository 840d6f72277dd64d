"""Where a satellite starts, in whatever frame it is known, and what is refused."""

import sys

import brahe
import numpy as np
import pytest

import terrafix as tf
from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.models.core.timescales import parse_epoch
from terrafix.models.geometry.celestial import earth_fixed_from_frame, frame_from_earth_fixed
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.kepler import KeplerianElements
from terrafix.models.motion.tle import TwoLines

EPOCH = "2022-09-18T07:49:21.5 UTC"
R = [-1104646.3, -6096830.4, 3395727.4]
V = [-560.1, 3729.6, 6497.9]
# of "Revisiting Spacetrack Report #3", AIAA 2006-6753, with states of SGP4 (tcppver.out)
VANGUARD = (
    "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n"
    "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667"
)
AFTER_360_MINUTES = (
    np.array([-7154.03120202, -3783.17682504, -3536.19412294]) * 1e3,
    np.array([4.741887409, -4.151817765, -2.093935425]) * 1e3,
)


class Told(tf.Component):
    """Keeps the start it was told."""

    default_rate = tf.Rate(times=["0"])
    start = tf.MessageInput(fields=tf.components.orbit_start.start.fields)

    def _initialize_impl(self):
        self.told = self.start.r_e.copy(), self.start.v_e.copy(), self.start.fresh.copy()


def start(epoch=EPOCH, **settings):
    system = tf.System("start", epoch=epoch, duration=1)
    made = system.add(tf.components.orbit_start(**settings), "start")
    system.add(Told(), "told")
    system.connect("start.start", "told.start")
    system.record("inertial", [made["r_i"], made["v_i"]], period=1)
    return system


def flown(system, members=1):
    """Earth-fixed and inertial position and velocity of the members at t = 0."""
    data = simulate(system, members=members).dataset
    r_e, v_e, fresh = system.find("told").told
    assert fresh.all()
    return r_e, v_e, *(data[f"start.{n}"].to_numpy()[0] for n in ("r_i", "v_i"))


@pytest.mark.parametrize("frame", ["gcrf", "j2000", "teme", "tod", "itrf"])
def test_a_state_is_told_earth_fixed_and_in_gcrf(frame):
    instant = parse_epoch(EPOCH)
    r_e, v_e, r_i, v_i = flown(start(frame=frame, r0=R, v0=V))
    expected = earth_fixed_from_frame(frame, instant, R, V)
    np.testing.assert_array_equal([r_e[0], v_e[0]], expected)
    np.testing.assert_array_equal(
        [r_i[0], v_i[0]], frame_from_earth_fixed("gcrf", instant, *expected)
    )


def test_frames_differ_by_what_the_issue_is_about():
    """The same numbers in another frame are another place: kilometers, silently."""
    place = {f: flown(start(frame=f, r0=R, v0=V))[2][0] for f in ("gcrf", "j2000", "teme")}
    assert np.linalg.norm(place["j2000"] - place["gcrf"]) == pytest.approx(0.72, abs=0.1)
    # 22.71 years of precession at 50.29'' a year about the pole of the ecliptic, and nutation, 17''
    turn = np.radians(22.71 * 50.29 / 3600) * np.array([0, -0.3978, 0.9175])
    moved = np.linalg.norm(np.cross(turn, R))
    assert np.linalg.norm(place["teme"] - place["gcrf"]) == pytest.approx(moved, rel=0.015)


def test_elements_are_a_state():
    angles = {"inclination": 1.71, "node": 0.35, "argument_of_perigee": 1.2, "true_anomaly": 0.5}
    elements = {"semi_major_axis": 7.0696e6, "eccentricity": 0.00118}
    found = flown(start(frame="gcrf", kind="keplerian", **elements, **angles))
    state = KeplerianElements(*elements.values(), *angles.values()).state(EARTH.mu)
    np.testing.assert_allclose([found[2][0], found[3][0]], state, rtol=1e-15, atol=2e-9)
    e = 0.00118
    eccentric = 2 * np.arctan(np.sqrt((1 - e) / (1 + e)) * np.tan(0.25))
    theirs = np.array([*elements.values(), *angles.values()])
    theirs[5] = eccentric - e * np.sin(eccentric)  # brahe takes the mean anomaly
    other = brahe.state_koe_to_eci(theirs, brahe.AngleFormat.RADIANS)
    # its gravitational parameter is 3.986004415e14 m^3/s^2, 8e-10 less than ours
    np.testing.assert_allclose(np.concatenate(state), other, rtol=5e-10, atol=1e-6)


def test_a_place_and_a_velocity_over_it():
    """Quito's meridian on the equator: east is y after a quarter turn."""
    settings = {"latitude": 0.0, "longitude": np.pi / 2, "height": 5e5}
    for epoch in (EPOCH, None):
        r_e, v_e, *_ = flown(start(epoch, kind="geodetic", **settings, v0_n=[7000, 100, -3]))
        np.testing.assert_allclose(r_e[0], [0, EARTH.radius + 5e5, 0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(v_e[0], [-100, 3, 7000], rtol=0, atol=1e-12)


def test_two_line_elements_are_where_sgp4_puts_them():
    """360 minutes after their epoch, in TEME, against the paper's output: 1e-8 km printed."""
    lines = TwoLines.read(VANGUARD)
    later = lines.epoch.plus(360 * 60.0)
    for found, printed in zip(lines.state(later), AFTER_360_MINUTES, strict=True):
        np.testing.assert_allclose(found, printed, rtol=0, atol=1e-3)
    r_e, v_e, *_ = flown(start(later.text("TAI", 9), kind="tle", tle="VANGUARD 1\n" + VANGUARD))
    r, v = frame_from_earth_fixed("teme", later, r_e[0], v_e[0])
    np.testing.assert_allclose(r, AFTER_360_MINUTES[0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(v, AFTER_360_MINUTES[1], rtol=0, atol=1e-5)


def test_the_epoch_of_two_line_elements():
    """Day 179.78495062 of 2000 is 27 June, 18:50:19.73 UTC."""
    assert TwoLines.read(VANGUARD).epoch.text(digits=3) == "2000-06-27T18:50:19.734 UTC"


def test_without_an_epoch_the_frame_is_that_of_type_orbit():
    r_e, _, r_i, v_i = flown(start(None, r0=R, v0=V, earth_angle0=0.3))
    np.testing.assert_allclose(r_i[0], R, rtol=0, atol=3e-9)
    np.testing.assert_allclose(v_i[0], V, rtol=0, atol=3e-12)
    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_allclose(r_e[0, :2], [c * R[0] + s * R[1], c * R[1] - s * R[0]], rtol=1e-14)


def test_every_member_has_its_own_start():
    system = start(frame="gcrf", r0=R, v0=V)
    system.disperse(tf.Dispersion("start", ("start.r0",), "[100, 100, 100] m"))
    r_i = flown(system, members=50)[2]
    assert np.std(r_i, axis=0) == pytest.approx([100] * 3, rel=0.3)


def test_a_member_that_starts_inside_the_earth_fails_and_the_others_fly():
    system = start(frame="gcrf", r0=[6.5e6, 0, 0], v0=V)
    system.disperse(tf.Dispersion("start", ("start.r0",), "[1e5, 0, 0] m"))
    excluded = simulate(system, members=50).excluded
    assert 0 < len(excluded) < 25  # 1.2 sigma above the ground: 11 %
    assert {e["reason"] for e in excluded} == {"starts inside the Earth"}


# ------------------------------------------------------------------------- what is refused

STATE = {"r0": R, "v0": V}
OLD = {"kind": "tle", "tle": VANGUARD}


@pytest.mark.parametrize(
    ("epoch", "settings", "said"),
    [
        (EPOCH, STATE, "a state without a frame, in a system with the epoch '2022-09-18T07:49:21"),
        (None, STATE | {"frame": "gcrf"}, "a state in the frame 'gcrf', which says nothing about"),
        (None, OLD, "two-line elements, which say nothing about the Earth without a date"),
        (EPOCH, OLD, "at the epoch 8.12e.03 days old; it takes them up to 3 days"),
        ("2000-06-20T00:00:00 UTC", OLD, "at the epoch 7.78 days ahead of it; it takes"),
        (EPOCH, {"frame": "gcrf", "r0": R}, "needs a value for 'v0' with kind = \"cartesian\""),
        (EPOCH, {"kind": "geodetic", "v0_n": [1, 0, 0]}, "needs a value for 'height'"),
        (EPOCH, STATE | {"frame": "gcrf", "r0": [7e3, 0, 0]}, "starts inside the Earth: 7000 m"),
        (
            EPOCH,
            {"kind": "keplerian", "frame": "itrf", "semi_major_axis": 7e6},
            "'itrf', which turns with the Earth",
        ),
        (
            "2099-01-01T00:00:00 TAI",
            STATE | {"frame": "gcrf"},
            "reaches from 1973-01-02 to the start of 20",
        ),
        ("noon", STATE | {"frame": "gcrf"}, "'noon' is no epoch"),
        (EPOCH, {"kind": "tle", "tle": VANGUARD[:69]}, "have two lines, and a name before them"),
        (EPOCH, {"kind": "tle", "tle": VANGUARD.replace("4753", "4754")}, "checksum is 4, that of"),
        (EPOCH, {"kind": "tle", "tle": VANGUARD[:-1]}, "has 69 characters; got"),
    ],
)
def test_what_is_refused_before_the_first_step(epoch, settings, said):
    with pytest.raises(SystemCheckError, match=said):
        start(epoch, **settings).check()


def test_older_elements_are_taken_where_it_is_said():
    start(EPOCH, **OLD, tle_age="8122 day").check()


def test_a_parameter_of_another_kind_is_noted():
    notes = start(None, **STATE, height=1e5).check().notes
    assert any("does not take 'height'" in note for note in notes)


def test_an_orbit_of_the_uniform_frame_is_refused_in_a_system_with_an_epoch():
    system = tf.System("orbit", epoch=EPOCH, duration=1)
    system.add(tf.components.orbit(r0_i=R, v0_i=V), "orbit")
    with pytest.raises(SystemCheckError, match=r"(?s)'orbit.r0_i'.*no frame.*orbit_start"):
        system.check()


def test_without_the_extra_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sgp4.api", None)
    later = TwoLines.read(VANGUARD).epoch.text("TAI", 9)
    with pytest.raises(SystemCheckError, match=r"'sgp4'.*\n.*pip install 'terrafix\[truth\]'"):
        start(later, **OLD).check()
