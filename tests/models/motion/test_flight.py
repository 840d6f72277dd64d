"""Flown plans: increments that lead where they say, turns, climbs, wind, gusts, waypoints."""

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.geometry.quaternion import angle_between_array, rotation_matrix_array
from terrafix.models.motion.flight import BLEND, Segment, Start, flight_model, planned, rates_of
from terrafix.models.motion.gravity import STANDARD_GRAVITY
from terrafix.models.motion.strapdown import EARTHS, Motion, level_view, strapdown_model
from terrafix.models.motion.waypoints import Waypoint, plan_through

DT = 0.01
START = Start(np.radians(47.0), np.radians(8.0), 1000.0, 0.5, 70.0)
CALM = {"wind_n": np.zeros(3)}
AIR = {
    "gust_sigma": np.array([1.5, 1.5, 1.0]),
    "gust_length": np.array([300.0, 300.0, 200.0]),
    "response_time": 1.0,
    "hold_time": 30.0,
    "attitude_response": 1.0,
}
TOUR = (
    Segment(20.0),
    Segment(turn=np.radians(90.0), bank=np.radians(25.0)),
    Segment(40.0, climb=150.0, speed=80.0),
    Segment(60.0, turn=np.radians(-180.0)),
    Segment(30.0, climb=-100.0, speed=65.0),
)


def fly(model, n, dt=DT, *, noise=None, start=None, inputs=(), **parameters):
    """Step a model n times: arrays (n + 1, size) of its states by name, the start first."""
    sizes = [s.numel() for s in model.states.values()]
    given = [np.asarray(parameters[k], float) for k in model.parameters]
    n_noise = sum(s.numel() for s in model.noise.values())
    noise = np.zeros((n + 1, n_noise)) if noise is None else noise
    clock = [s for s in (model.step, model.time) if s is not None]
    step = model.step_function()
    x, w, t = ca.SX.sym("x", sum(sizes)), ca.SX.sym("w", n_noise), ca.SX.sym("t")
    u = ca.SX.sym("u", sum(s.numel() for s in model.inputs.values()))
    states = ca.vertsplit(x, np.cumsum([0, *sizes]).tolist())
    told = ca.vertsplit(u, np.cumsum([0, *(s.numel() for s in model.inputs.values())]).tolist())
    arguments = [*(told if model.inputs else []), *states, *given, *([w] if n_noise else [])]
    results = step(*arguments, *[dt, t][: len(clock)])[-len(sizes) :]
    one = ca.Function("one", [x, u, w, t], [ca.vertcat(*results)])
    if start is None:
        begun = model.initial_function()(*given, *([noise[0]] if n_noise else []), 0, 0)
        start = np.concatenate([r.full().ravel() for r in begun[-len(sizes) :]])
    inputs = np.zeros((n, 0)) if not len(inputs) else inputs
    rows = one.mapaccum(n)(start, inputs.T, noise[1:].T, dt * np.arange(1, n + 1)[None]).full().T
    rows = np.vstack([start, rows])
    return dict(zip(model.states, np.split(rows, np.cumsum(sizes)[:-1], axis=1), strict=True))


def view(flown, earth, start=START):
    """Local-level view of what was flown, by name."""
    names = ("latitude", "longitude", "height", "v_n", "angles")
    see = over_members(
        lambda r, v, q: tuple(
            level_view(Motion(r, v, q), earth, (start.latitude, start.longitude)).values()
        ),
        *((3,), (3,), (4,)),
    )
    return dict(zip(names, see(flown["r_e"], flown["v_e"], flown["q_be"]), strict=True))


@pytest.mark.parametrize(
    ("earth", "n"),
    [pytest.param("wgs84", 60000, marks=pytest.mark.campaign), ("wgs84", 9000), ("flat", 9000)],
)
def test_increments_lead_to_the_truth_after_ten_minutes(earth, n):
    """Turns, climbs and turbulence at 100 Hz: to rounding, which may add up to 1e-6 m.

    That the mechanization is right is for test_strapdown to say; that the increments are those of
    the step, in its axes and in time, is said here.
    """
    rng = np.random.default_rng(3)
    plan = TOUR * 3
    model = flight_model(plan, earth, "dryden", START)
    truth = fly(model, n, noise=rng.standard_normal((n + 1, 5)), **CALM, **AIR)
    assert np.ptp(view(truth, earth)["angles"][:, 0]) > 0.8  # banked to both sides
    keys = ("r_e", "v_e", "q_be")
    mechanization = strapdown_model(earth)
    start = np.concatenate([truth[k][0] for k in keys])
    inputs = np.hstack([truth["delta_v_b"][1:], truth["delta_theta_b"][1:]])
    zeros = {"r0_e": np.zeros(3), "v0_e": np.zeros(3), "q0_be": np.zeros(4)}
    told = fly(mechanization, n, start=start, inputs=inputs, **zeros)
    assert np.abs(told["r_e"] - truth["r_e"]).max() < 1e-6
    assert np.abs(told["v_e"] - truth["v_e"]).max() < 1e-8
    assert angle_between_array(told["q_be"], truth["q_be"]).max() < 1e-11


def test_held_increments_may_be_told_in_parts():
    """At 1 kHz a tenth each, for 120 s: gravitation within a step, and no drift by rounding."""
    n = 12000
    truth = fly(flight_model(TOUR, "wgs84", "none", START), n, **CALM)
    start = np.concatenate([truth[k][0] for k in ("r_e", "v_e", "q_be")])
    inputs = np.hstack([truth["delta_v_b"][1:], truth["delta_theta_b"][1:]])
    zeros = {"r0_e": np.zeros(3), "v0_e": np.zeros(3), "q0_be": np.zeros(4)}
    tenths = np.repeat(inputs / 10, 10, axis=0)
    told = fly(strapdown_model("wgs84"), 10 * n, DT / 10, start=start, inputs=tenths, **zeros)
    assert np.abs(told["r_e"][-1] - truth["r_e"][-1]).max() < 2e-6
    assert np.abs(told["v_e"][-1] - truth["v_e"][-1]).max() < 2e-9
    np.testing.assert_allclose(np.linalg.norm(told["q_be"], axis=1), 1, rtol=0, atol=1e-15)


@pytest.mark.parametrize("earth", EARTHS)
def test_a_plan_changes_what_it_says(earth):
    """Course, height and speed after each segment, to rounding."""
    rates = rates_of(TOUR, START.speed)
    n = round((rates[-1].end + 10.0) / DT)
    flown = view(fly(flight_model(TOUR, earth, "none", START), n, **CALM), earth)
    course = np.unwrap(np.arctan2(flown["v_n"][:, 1], flown["v_n"][:, 0]))
    speed = np.hypot(flown["v_n"][:, 0], flown["v_n"][:, 1])
    # 90 deg at 70 m/s with 25 deg of bank
    assert rates[1].end - rates[0].end == pytest.approx(
        70 * np.pi / 2 / (STANDARD_GRAVITY * np.tan(np.radians(25)))
    )
    for t, turned, climbed, fast in (
        (15.0, 0.0, 0.0, 70.0),
        (rates[-1].end + 5.0, -90.0, 50.0, 65.0),
    ):
        k = round(t / DT)
        assert np.degrees(course[k] - START.course) == pytest.approx(turned, abs=1e-6)
        assert flown["height"][k] - START.height == pytest.approx(climbed, abs=2e-4)
        assert speed[k] == pytest.approx(fast, abs=1e-6)
        np.testing.assert_allclose(flown["angles"][k, 0], 0.0, rtol=0, atol=1e-6)


def test_a_plan_accelerates_as_its_velocity_changes():
    """The acceleration that banks and pitches the aircraft is the derivative of its velocity."""
    t = ca.SX.sym("t")
    plan = (Segment(5.0), Segment(6.0, turn=0.5, climb=20.0, speed=75.0), Segment(5.0, climb=-9.0))
    said = planned(rates_of(plan, 70.0), 0.5, 70.0, t)
    both = ca.Function("a", [t], [said.a_n, ca.jacobian(said.v_n, t)])
    for at in np.linspace(0.1, 19.9, 67):
        told, derived = (a.full() for a in both(at))
        np.testing.assert_allclose(told, derived, rtol=0, atol=1e-12)
    assert np.abs(both(11.0)[0].full()).min() > 0.5  # it climbs, turns and slows down there


def test_a_flight_is_its_plan_to_the_error_of_the_trapezoidal_rule():
    """Flat: the integral of the planned velocity, to h^2 / 12 times the change of acceleration."""
    n = 18000
    flown = fly(flight_model(TOUR, "flat", "none", START), n, **CALM)
    t = ca.SX.sym("t")
    velocity = ca.Function("v", [t], [planned(rates_of(TOUR, 70.0), START.course, 70.0, t).v_n])
    fine = np.arange(10 * n + 1) * DT / 10
    v = velocity(fine[None]).full().T
    whole = (v[:-1] + v[1:]).sum(axis=0) * DT / 20
    np.testing.assert_allclose(flown["r_e"][-1] - flown["r_e"][0], whole, rtol=0, atol=3e-5)
    np.testing.assert_allclose(flown["v_e"][-1], v[-1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("earth", EARTHS)
def test_turns_are_coordinated(earth):
    """The force has no part to the side; bank is atan(V rate / g), 25 degrees.

    But for Coriolis and centripetal accelerations that the plan leaves out, 2 omega V = 1e-2 m/s^2.
    """
    flown = fly(flight_model(TOUR, earth, "none", START), 3500, **CALM)
    sideways = np.abs(flown["delta_v_b"][1:, 1] / DT).max()
    assert sideways < (0.02 if earth == "wgs84" else 2e-3)
    bank = view(flown, earth)["angles"][2600, 0]  # 6 s into the turn
    assert np.degrees(bank) == pytest.approx(25.0, abs=1e-3)


def test_wind_turns_the_nose_and_not_the_course():
    """A crab of 5 degrees: the nose to the left of a course with wind from the left."""
    across = 70.0 * np.tan(np.radians(5.0))
    c, s = np.cos(START.course), np.sin(START.course)
    wind = across * np.array([-s, c, 0.0])
    flown = view(fly(flight_model([], "wgs84", "none", START), 500, wind_n=wind), "wgs84")
    course = np.arctan2(flown["v_n"][:, 1], flown["v_n"][:, 0])
    np.testing.assert_allclose(course, START.course, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        flown["angles"][:, 2], START.course - np.radians(5.0), rtol=0, atol=1e-7
    )


def test_the_change_of_velocity_at_the_end_is_turned_by_the_step():
    """C(end) times the change by specific force, where the IMU integrates in turning axes."""
    model = flight_model(TOUR, "flat", "none", START)
    flown = fly(model, 3000, **CALM)
    outputs = ca.Function(
        "o",
        [model.states["delta_v_b"], model.states["delta_theta_b"]],
        [model.outputs["delta_v_end_b"]],
    )
    k = slice(2500, 3000)
    found = outputs(flown["delta_v_b"][1:][k].T, flown["delta_theta_b"][1:][k].T).full().T
    change = np.diff(flown["v_e"], axis=0) - [0, 0, STANDARD_GRAVITY * DT]
    C_be = rotation_matrix_array(flown["q_be"][1:])
    np.testing.assert_allclose(found, np.einsum("nij,nj->ni", C_be, change)[k], rtol=0, atol=1e-13)
    assert np.abs(found - flown["delta_v_b"][1:][k]).max() > 1e-5


# ------------------------------------------------------------------ pyins

SAMPLES = (100, 200, 300, 400, 500, 600)  # [s]
KEYS = ("lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading")
FLOWN_BY_PYINS = (
    Segment(40.0),
    Segment(turn=np.radians(90.0), bank=np.radians(25.0)),
    Segment(100.0, climb=300.0, speed=80.0),
    Segment(60.0, turn=np.radians(-180.0)),
    Segment(100.0),
    Segment(turn=np.radians(270.0), bank=np.radians(30.0)),
    Segment(100.0, climb=-200.0, speed=60.0),
)
REFERENCE = (  # made by pyins_reference.py, which says how
    (
        47.01481039203476,
        8.066592149314348,
        1107.864867835885,
        -35.283554183918035,
        64.5861485117782,
        -2.999997501730898,
        -6.749697066133895e-07,
        2.334275669548709,
        118.64788983703522,
    ),
    (
        47.00310087673132,
        8.15270203754654,
        1299.99959673212,
        78.58746167583433,
        14.967038448466603,
        -4.957799796034834e-06,
        -23.129154962877266,
        -2.5917649282769386e-07,
        10.78287529815297,
    ),
    (
        47.04393869060269,
        8.072466534007713,
        1300.0012388091195,
        38.35404035851798,
        -70.20656222715408,
        -1.81031147500621e-05,
        6.123725420110228e-07,
        5.956954752887217e-07,
        -61.3521101269783,
    ),
    (
        47.050439076353335,
        8.065803989253604,
        1281.2607011641942,
        -68.5618621577179,
        -37.45546148363119,
        1.9999829057955036,
        2.4279561844065864e-07,
        -1.4664362336206231,
        -151.35210993010602,
    ),
    (
        46.99660103612559,
        8.022793742488517,
        1100.0040952388738,
        -52.65494639192012,
        -28.765480810618747,
        -1.800377301454381e-05,
        2.752750866256398e-07,
        -2.7479444120217703e-07,
        -151.35210987494628,
    ),
    (
        46.94924499812165,
        7.984997885060185,
        1100.0059869343545,
        -52.654948770038644,
        -28.76548766508069,
        -1.9915891593273727e-05,
        3.0336701779419813e-07,
        -2.9655267938916253e-07,
        -151.35210983305055,
    ),
)


def test_ten_minutes_agree_with_pyins():
    """Flown and integrated here at 100 Hz, there at 400 Hz, where it is off by 0.02 m by its order.

    Between them lie a local-level mechanization with transport rate and one in Earth-fixed axes,
    another quaternion, and every sign of roll, pitch and heading.
    """
    model = flight_model(FLOWN_BY_PYINS, "wgs84", "none", START)
    truth = fly(model, 100 * SAMPLES[-1], **CALM)
    at = [100 * t for t in SAMPLES]
    level = view({name: rows[at] for name, rows in truth.items()}, "wgs84")
    expected = dict(zip(KEYS, np.transpose(REFERENCE), strict=True))
    north = 6.37e6 * (level["latitude"] - np.radians(expected["lat"]))
    east = 4.36e6 * (level["longitude"] - np.radians(expected["lon"]))
    for off in (north, east, level["height"] - expected["alt"]):
        assert np.abs(off).max() < 0.03  # [m]
    velocity = np.transpose([expected[k] for k in ("VN", "VE", "VD")])
    assert np.abs(level["v_n"] - velocity).max() < 1e-4  # [m/s]
    angles = np.transpose([expected[k] for k in ("roll", "pitch", "heading")])
    assert np.abs(np.degrees(level["angles"]) - angles).max() * 3600 < 0.01  # [arc seconds]


# ------------------------------------------------------------------ turbulence


def covariance(model, n, **parameters):
    """Covariance of the states of the air and of the deviation after 2^n steps, by its matrices."""
    names = ("air", "off_p", "off_v", "off_angles")
    x = ca.vertcat(*(model.states[k] for k in names))
    w = model.noise["air_noise"]
    after = ca.vertcat(*(model.next[k] for k in names))
    F, G = ca.jacobian(after, x), ca.jacobian(after, w)
    given = [model.parameters[k] for k in parameters]
    F, G = ca.Function("m", [*given, model.step], [F, G])(*parameters.values(), DT)
    F, G = F.full(), G.full()
    P = G @ G.T
    for _ in range(n):
        P, F = P + F @ P @ F.T, F @ F
    return P


def test_the_aircraft_follows_the_air_as_a_lag():
    """Along the flight, without a pilot: exp(-t/T) through a lag tau has s^2 T / (T + tau).

    Across, of correlation exp(-t/T) (1 - t/2T): s^2 T (T + tau / 2) / (T + tau)^2.
    """
    model = flight_model([], "flat", "dryden", START)
    air = AIR | {"hold_time": 1e15}
    P = covariance(model, 17, **air)
    T = air["gust_length"] / START.speed
    tau, s = air["response_time"], air["gust_sigma"]
    expected = s**2 * T / (T + tau) * np.array([1.0, *((T + tau / 2) / (T + tau))[1:]])
    np.testing.assert_allclose(np.diag(P)[8:11], expected, rtol=2e-4)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_gust_moves_the_aircraft_in_its_own_direction(axis):
    """Along a course of 0.5 rad, to its right, or down: the other two stay as planned."""
    only = AIR | {"gust_sigma": 2.0 * (np.arange(3) == axis)}
    noise = np.random.default_rng(1).standard_normal((1001, 5))
    flown = fly(flight_model([], "flat", "dryden", START), 1000, noise=noise, **CALM, **only)
    c, s = np.cos(START.course), np.sin(START.course)
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    off = (flown["v_e"] - flown["v_e"][0]) @ axes.T
    np.testing.assert_allclose(off[:, axis], flown["off_v"][:, axis], rtol=0, atol=1e-11)
    assert np.ptp(off[:, axis]) > 0.1
    np.testing.assert_allclose(np.delete(off, axis, axis=1), 0.0, rtol=0, atol=1e-11)


def test_a_deviation_dies_out_as_a_lag():
    """In still air without a pilot: v exp(-t / tau), and the place has gained tau v (1 - exp)."""
    model = flight_model([], "flat", "dryden", START)
    still = AIR | {"hold_time": 1e15, "gust_sigma": np.zeros(3), "response_time": 2.0}
    given = [model.parameters[k] for k in still]
    after = [model.next["off_p"], model.next["off_v"]]
    step = ca.Function(
        "s",
        [model.states["off_v"], *given, model.step],
        [
            ca.substitute(
                a,
                ca.vertcat(model.states["air"], model.states["off_p"], model.noise["air_noise"]),
                ca.SX.zeros(13),
            )
            for a in after
        ],
    )
    v = np.array([1.0, -2.0, 3.0])
    place, speed = (r.full().ravel() for r in step(v, *still.values(), 0.5))
    left = np.exp(-0.5 / 2.0)
    np.testing.assert_allclose(speed, left * v, rtol=1e-14)
    np.testing.assert_allclose(place, 2.0 * (1 - left) * v, rtol=1e-13)


def test_a_pilot_holds_the_track():
    """The displacement stays below s sqrt(2 T h): a lag of the hold time on slow air."""
    model = flight_model([], "flat", "dryden", START)
    free = covariance(model, 17, **(AIR | {"hold_time": 1e15}))
    P = covariance(model, 17, **AIR)
    assert np.sqrt(np.diag(free)[5:8]).min() > 50
    T, h = AIR["gust_length"] / START.speed, AIR["hold_time"]
    # (g - p / h - v) / tau = v', p' = v with tau << T << h: p lags the gust: h^2 s^2 T / (T + h)
    along = h * AIR["gust_sigma"][0] * np.sqrt(T[0] / (T[0] + h))
    assert np.sqrt(P[5, 5]) == pytest.approx(along, rel=0.02)


def test_the_nose_turns_into_gusts_by_some_milliradians():
    model = flight_model([], "flat", "dryden", START)
    sigma = np.sqrt(np.diag(covariance(model, 17, **AIR))[11:14])
    assert np.all((sigma > 2e-3) & (sigma < 2e-2))
    # a gust from the left rolls to the right and yaws to the left, one from above pitches up
    P = covariance(model, 17, **AIR)
    gust = ca.Function(
        "g", [model.states["air"]], [ca.jacobian(model.outputs["gust"], model.states["air"])]
    )
    with_angles = gust(np.zeros(5)).full() @ P[:5, 11:14]
    assert with_angles[1, 0] > 0
    assert with_angles[2, 1] > 0
    assert with_angles[1, 2] < 0
    still = covariance(model, 17, **(AIR | {"attitude_response": 0.0}))
    np.testing.assert_array_equal(still[11:14, 11:14], 0.0)


# ------------------------------------------------------------------ waypoints

CORNERS = (
    Waypoint(np.radians(47.0), np.radians(8.0), 1000.0, 70.0),
    Waypoint(np.radians(47.1), np.radians(8.02), 1000.0),
    Waypoint(np.radians(47.05), np.radians(8.2), 1500.0, 80.0),
    Waypoint(np.radians(46.95), np.radians(8.1), 1200.0),
)


def test_legs_lead_through_the_waypoints():
    """Rhumb lines on the ellipsoid: half way along each leg, and at the end, to half a meter."""
    start, plan = plan_through(CORNERS, "wgs84")
    lasting = sum(s.duration for s in plan)
    flown = fly(flight_model(plan, "wgs84", "none", start), round(lasting / DT), **CALM)
    last = CORNERS[-1]
    end = ecef(last.latitude, last.longitude, last.height)
    assert np.linalg.norm(flown["r_e"][-1] - end) < 0.5 + 0.4  # a step is 0.8 m long
    latitude, longitude, height = geodetic(flown["r_e"])
    for a, b in pairwise(CORNERS):
        # legs of 10 km: a rhumb line is straight in latitude and longitude to a meter
        middle = (a.latitude + b.latitude) / 2
        k = np.argmin(
            np.hypot(latitude - middle, 0.7 * (longitude - (a.longitude + b.longitude) / 2))
        )
        scale = np.array([6.37e6, 6.39e6 * np.cos(middle)])
        leg = scale * [b.latitude - a.latitude, b.longitude - a.longitude]
        off = scale * [latitude[k] - a.latitude, longitude[k] - a.longitude]
        assert abs(leg[0] * off[1] - leg[1] * off[0]) / np.hypot(*leg) < 2.0
        assert height[k] == pytest.approx((a.height + b.height) / 2, abs=40.0)


def test_waypoints_of_the_flat_earth_are_met():
    start, plan = plan_through(CORNERS, "flat")
    lasting = sum(s.duration for s in plan)
    flown = view(
        fly(flight_model(plan, "flat", "none", start), round(lasting / DT), **CALM), "flat", start
    )
    off = [flown[k][-1] - getattr(CORNERS[-1], k) for k in ("latitude", "longitude", "height")]
    assert np.hypot(6.37e6 * off[0], 4.36e6 * off[1]) < 0.9
    assert abs(off[2]) < 1e-3


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (CORNERS[:1], "two waypoints or more"),
        (CORNERS[1:], "first waypoint has no speed"),
        ((CORNERS[0], CORNERS[0], CORNERS[2]), "waypoints 1 and 2 are in one place"),
        ((CORNERS[0], CORNERS[1], CORNERS[0]), "at waypoint 2 the track turns by 180 deg"),
        (
            (CORNERS[0], CORNERS[1], Waypoint(np.radians(47.1), np.radians(8.03), 1000.0)),
            "waypoints 2 and 3 are 759 m apart; with the turns at its ends a leg needs",
        ),
        ((CORNERS[0], Waypoint(np.nan, 0.1, 1000.0)), "waypoint 2 has a number that is none"),
    ],
)
def test_waypoints_that_cannot_be_flown_are_refused(points, said):
    with pytest.raises(ValueError, match=said):
        plan_through(points, "wgs84")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "a duration, or a turn with a bank"),
        ({"duration": 10.0, "bank": 0.3, "turn": 1.0}, "one of them"),
        ({"bank": 0.3}, "of a turn"),
        ({"bank": 1.5, "turn": 1.0}, "at most 75 deg"),
        ({"duration": -1.0}, "must be positive"),
        ({"duration": 1.0, "speed": 0.0}, "its speed is 0"),
        ({"duration": 1.0, "climb": np.nan}, "its climb is nan"),
    ],
)
def test_segments_that_cannot_be_flown_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        Segment(**given)


def test_a_first_segment_without_time_to_change_is_refused():
    with pytest.raises(ValueError, match=f"lasts 1 s; the first lasts {BLEND / 2:g} s or more"):
        rates_of([Segment(1.0), Segment(10.0, turn=1.0)], 70.0)
