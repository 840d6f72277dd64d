"""Flight truth in a system: plans in files, members of their own air, tracks, what is refused."""

import numpy as np
import pytest

import terrafix as tf
from terrafix.components.truth.flight import Flight, RecordedFlight
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.files.writing import write_system
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.system.system import System
from terrafix.models.motion.strapdown import strapdown_model

PLAN = """
segments = [
  { duration = "5 s" },
  { turn = "-45 deg", bank = "25 deg" },
  { duration = "20 s", climb = "60 m", speed = "160 kn" },
]
"""
FILE = """
schema = "terrafix-system/1"
name = "fly"
duration = "30 s"

[component.aircraft]
type = "flight"
latitude = "47 deg"
longitude = "8 deg"
course = "30 deg"
{plan}

[component.view]
type = "level_view"

[wiring]
connect = [
  "aircraft.r_e -> view.r_e",
  "aircraft.v_e -> view.v_e",
  "aircraft.q_be -> view.q_be",
]

[record.view]
ports = ["view.height", "view.latitude", "view.v_n", "view.roll", "view.heading"]
rate = "10 Hz"
"""


class Free(SymbolicComponent):
    """Free inertial navigation from the truth's start, on the increments that it is given."""

    default_rate = tf.Rate(hz=100)
    r0_e = tf.Parameter(shape=(3,), unit="m", frame="e", doc="start")
    v0_e = tf.Parameter(shape=(3,), unit="m/s", frame="e", doc="start")
    q0_be = tf.Parameter(shape=(4,), doc="start")
    delta_v_b = tf.Input((3,), unit="m/s", frame="b")
    delta_theta_b = tf.Input((3,), unit="rad", frame="b")
    r_e = tf.Output((3,), unit="m", frame="e")
    v_e = tf.Output((3,), unit="m/s", frame="e")
    q_be = tf.Output((4,), unit="1", frame="b")

    def build_model(self):
        return strapdown_model("wgs84")


def flown(members=1, seed=1, duration="10", record=("r_e", "v_e", "q_be"), **settings):
    """Records of a flight by port."""
    system = System("flown")
    aircraft = system.add(Flight(**settings), "aircraft")
    system.record("all", [aircraft[n] for n in record], rate=tf.Rate(hz=10))
    data = simulate(system, members=members, seed=seed, duration=duration).dataset
    return {n: data[f"aircraft.{n}"].to_numpy() for n in record}


def test_a_plan_in_a_file_is_flown(tmp_path):
    """45 degrees to the left, 60 m higher, 160 knots: after 5 s, 11.9 s and 20 s."""
    path = tmp_path / "fly.toml"
    path.write_text(FILE.format(plan=PLAN))
    data = simulate(read_system(path), duration="40").dataset
    north, east, _ = data["view.v_n"].to_numpy()[-1, 0]
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(-15.0, abs=1e-6)
    assert np.hypot(north, east) == pytest.approx(160 * 1852 / 3600, abs=1e-6)
    assert data["view.height"].to_numpy()[-1, 0] == pytest.approx(1060.0, abs=1e-3)
    assert np.degrees(data["view.roll"].to_numpy().min()) == pytest.approx(-25.0, abs=0.01)


@pytest.mark.parametrize(
    "plan",
    [
        PLAN,
        'waypoints = [{ at = "[47, 8] deg", height = "1 km", speed = "70 m/s" }, '
        '{ at = "[47.1, 8.1] deg", height = "4000 ft", bank = "15 deg" }]',
    ],
)
def test_a_plan_is_written_as_it_was_read(tmp_path, plan):
    top = FILE.format(plan=plan)
    if "waypoints" in plan:
        for line in ('latitude = "47 deg"', 'longitude = "8 deg"', 'course = "30 deg"'):
            top = top.replace(line, "")
    first, again = tmp_path / "fly.toml", tmp_path / "again.toml"
    first.write_text(top)
    system = read_system(first)
    write_system(system, again)
    name = "waypoints" if "waypoints" in plan else "segments"
    one, two = (s.nodes["aircraft"].setting(name) for s in (system, read_system(again)))
    assert len(one) == len(two) > 1
    for a, b in zip(one, two, strict=True):
        assert a.keys() == b.keys()
        for key, value in a.items():
            np.testing.assert_allclose(value, b[key], rtol=1e-15)


def test_ideal_increments_lead_to_the_truth_in_compiled_kernels():
    """A minute in turbulence: the kernels differ from each other by rounding, 1e-7 m."""
    plan = [{"duration": "10 s"}, {"turn": "120 deg", "bank": "30 deg"}, {"duration": "20 s"}]
    settings = {"segments": plan, "latitude": 0.8, "turbulence": "dryden"}
    start = flown(duration="1", **settings)
    system = System("free")
    aircraft = system.add(Flight(**settings), "aircraft")
    names = {"r0_e": "r_e", "v0_e": "v_e", "q0_be": "q_be"}
    free = system.add(Free(**{k: start[n][0, 0] for k, n in names.items()}), "free")
    for name in ("delta_v_b", "delta_theta_b"):
        system.connect(aircraft[name], free[name])
    both = [p[n] for p in (aircraft, free) for n in ("r_e", "v_e", "q_be")]
    system.record("all", both, rate=tf.Rate(hz=1))
    data = simulate(system, members=1, seed=1, duration="60").dataset
    for name, bound in (("r_e", 1e-7), ("v_e", 1e-9), ("q_be", 1e-12)):
        off = data[f"aircraft.{name}"].to_numpy() - data[f"free.{name}"].to_numpy()
        assert np.abs(off).max() < bound


def test_each_member_has_its_own_air_and_still_air_is_the_same_for_all():
    """Sigmas of the first gusts over 300 members: three standard errors are 12 percent."""
    gust = flown(300, turbulence="dryden", gust_sigma="[1.5, 1.0, 0.5] m/s", record=("gust",))
    first = gust["gust"][0]
    np.testing.assert_allclose(first.std(axis=0), [1.5, 1.0, 0.5], rtol=0.13)
    assert np.abs(np.corrcoef(first.T)[np.triu_indices(3, 1)]).max() < 0.18
    still = flown(3, turbulence="dryden", gust_sigma="0 m/s")
    calm = flown(3)
    for name, rows in still.items():
        assert np.ptp(rows, axis=1).max() == 0.0
        np.testing.assert_allclose(rows, calm[name], atol=1e-9)


def test_gusts_of_the_specification_are_those_of_height_above_ground_and_wind():
    """30 kn at 1500 ft: 3 kn each, scales of 1375 ft; the first gusts of 300 members."""
    settings = {"turbulence": "mil-f-8785c", "wind_20ft": "30 kn"}
    above = flown(300, height="500 ft", ground="-1000 ft", record=("gust",), **settings)
    np.testing.assert_allclose(above["gust"][0].std(axis=0), 3 * 1852 / 3600, rtol=0.13)
    same = {"turbulence": "dryden", "gust_sigma": "3 kn", "gust_length": "1375 ft"}
    told = flown(2, record=("gust",), **same)
    np.testing.assert_allclose(told["gust"], above["gust"][:, :2], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("still", [("dryden", "gust_sigma"), ("mil-f-8785c", "wind_20ft")])
def test_still_air_draws_nothing(still):
    made = Flight(turbulence=still[0], **{still[1]: "0 m/s"})
    assert made.whole_model.noise
    assert not made.whole_model.without_noise_of([still[1]]).noise


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"segments": "[{]"}, "it takes a list of"),
        ({"segments": [{"duration": 3.0}]}, None),
        ({"segments": [{"lasts": "3 s"}]}, r"segments'\[1\] has no 'lasts'"),
        ({"segments": [{"duration": "3 m"}]}, r"segments'\[1\].duration is given in m"),
        ({"waypoints": [{"at": "[47, 8] deg"}]}, r"waypoints'\[1\] needs 'height'"),
        ({"waypoints": [{"at": "47 deg", "height": "1 m"}]}, r"waypoints'\[1\].at"),
    ],
)
def test_rows_that_cannot_be_read_are_refused(settings, said):
    if said is None:
        assert Flight(**settings).setting("segments") == ({"duration": 3.0},)
        return
    with pytest.raises(ConfigurationError, match=said):
        Flight(**settings)


ONE = {"at": "[47, 8] deg", "height": "1 km", "speed": "70 m/s"}
TWO = {"at": "[47.1, 8] deg", "height": "1 km"}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"segments": [{"turn": "1 rad"}]}, "segment 1: it has a duration, or a turn with a bank"),
        ({"segments": [{"duration": "1 s"}]}, "segment 1 lasts 1 s; the first lasts 2 s or more"),
        ({"waypoints": [ONE]}, "two waypoints or more, got 1"),
        ({"waypoints": [TWO, ONE]}, "first waypoint has no speed"),
        ({"waypoints": [ONE, ONE]}, "waypoints 1 and 2 are in one place"),
        ({"waypoints": [ONE, TWO], "segments": [{"duration": "9 s"}]}, "segments and waypoints"),
    ],
)
def test_plans_that_cannot_be_flown_are_refused_before_the_run(settings, said):
    with pytest.raises((ConfigurationError, SystemCheckError), match=said):
        flown(**settings)


def test_settings_that_would_change_nothing_are_refused():
    """A start where waypoints say it, gusts in still air, an origin on the real Earth."""
    assert "would change nothing" in Flight(waypoints=[ONE, TWO]).idle("course")
    assert "would change nothing" in Flight().idle("gust_sigma")
    assert Flight(turbulence="dryden").idle("gust_sigma") is None
    assert Flight().idle("course") is None


# ------------------------------------------------------------------ recorded


@pytest.fixture
def track(tmp_path):
    """North at 60 m/s, then a turn: a row each second for 40 s."""
    t = np.arange(41.0)
    turned = np.radians(3.0) * np.maximum(t - 15, 0)
    north = 60 * np.minimum(t, 15) + 60 / np.radians(3.0) * np.sin(turned)
    east = 60 / np.radians(3.0) * (1 - np.cos(turned))
    rows = np.column_stack([t + 100, 47 + north / 111160, 8 + east / 76040, 900 + 0 * t])
    path = tmp_path / "track.csv"
    np.savetxt(path, rows, "%.12f", ",", header="time,latitude,longitude,height", comments="")
    return path


def recorded(track, duration="30", **settings):
    system = System("recorded")
    aircraft = system.add(RecordedFlight(track_file=track, **settings), "aircraft")
    names = ("r_e", "v_e", "q_be", "delta_v_b", "delta_theta_b")
    system.record("all", [aircraft[n] for n in names], rate=tf.Rate(hz=100))
    data = simulate(system, members=3, duration=duration).dataset
    return {n: data[f"aircraft.{n}"].to_numpy() for n in names}


def test_a_recorded_track_is_flown_and_its_increments_lead_along_it(track):
    found = recorded(track, start="5 s")
    for rows in found.values():
        assert np.ptp(rows, axis=1).max() == 0.0
    step = strapdown_model("wgs84").step_function()
    state = {n: found[n][0, 0] for n in ("r_e", "v_e", "q_be")}
    for dv, dtheta in zip(found["delta_v_b"][1:, 0], found["delta_theta_b"][1:, 0], strict=True):
        out = step(delta_v_b=dv, delta_theta_b=dtheta, **state, step=0.01)
        state = {n: out[f"next_{n}_"].full().ravel() for n in state}
    np.testing.assert_allclose(state["r_e"], found["r_e"][-1, 0], atol=1e-7)
    np.testing.assert_allclose(state["v_e"], found["v_e"][-1, 0], atol=1e-9)
    assert np.linalg.norm(found["v_e"][-1, 0]) == pytest.approx(60.0, abs=0.2)


def test_tracks_that_cannot_be_flown_are_refused(track, tmp_path):
    with pytest.raises(SystemCheckError, match=r"is to fly until 50 s .* which covers 40 s"):
        recorded(track, duration="50")
    with pytest.raises(SystemCheckError, match=r"start' is 40 s, but 'track\.csv' covers"):
        recorded(track, duration="1", start="40 s")
    with pytest.raises(SystemCheckError, match=r"cannot fly its track: .*no such file"):
        recorded(tmp_path / "none.csv")
    lines = track.read_text().splitlines()
    lines[20] = lines[20].replace("900.0", "999.0")
    track.write_text("\n".join(lines))
    with pytest.raises(SystemCheckError, match=r"a step at line 21 \(t = 119 s\): .* 99 m off"):
        recorded(track)
