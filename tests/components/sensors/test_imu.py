"""The inertial sensor with every error of a data sheet: grades, statistics, what is refused."""

from pathlib import Path

import allantools
import numpy as np
import pytest
from scipy.stats import chi2

from terrafix import read_system, write_system
from terrafix.components.sensors.imu import Imu
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import TerrafixError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.models.sensors.grades import GRADES
from terrafix.models.sensors.imu_full import FLICKER

FAR = 5.0  # normal quantile whose two tails hold 6e-7: never crossed by chance in this file
STEP = "0.1"
DT = float(STEP)
FORCE, TURN = np.array([0.3, -0.2, 9.8]), np.array([0.1, -0.2, 0.3])
G, DEG, HOUR = 9.80665, np.pi / 180, 3600.0
EVERYTHING = {
    "grade": "STIM300",
    "bias": "both",
    "accel_bias_walk": 1e-5,
    "accel_bias_sigma": 1e-3,
    "gyro_bias_walk": 1e-7,
    "gyro_bias_sigma": 1e-5,
    "accel_quadratic": 1e-6,
    "accel_quantum": 1e-4,
    "gyro_quantum": 1e-6,
    "time_jitter": 1e-5,
    "latency": 2.5e-3,
    "lever_arm_b": [1.0, 0.5, -0.2],
}


class Steady(Component):
    """Increments of a constant specific force and rate."""

    default_rate = Rate(STEP)
    force, turn = FORCE, TURN
    delta_v_b = Output((3,), unit="m/s", frame="b")
    delta_theta_b = Output((3,), unit="rad", frame="b")

    def _initialize_impl(self):
        self.delta_v_b, self.delta_theta_b = 0.0, 0.0

    def _step_impl(self, t, dt):
        self.delta_v_b, self.delta_theta_b = self.force * dt, self.turn * dt


class Still(Steady):
    """Nothing to be measured."""

    force, turn = np.zeros(3), np.zeros(3)


def aboard(truth=Steady, *, step=STEP, **settings):
    system = System("imu")
    true = system.add(truth(rate=Rate(step)), "truth")
    imu = system.add(Imu(rate=Rate(step), **settings), "imu")
    system.connect(true["delta_v_b"], imu["delta_v_b_true"])
    system.connect(true["delta_theta_b"], imu["delta_theta_b_true"])
    system.record("all", [imu[n] for n in imu.outputs()], period=f"{step} s")
    return system, imu


def fly(duration, members, truth=Steady, *, seed=0, **settings):
    """Increments over the step, with the first row, of t = 0, left out."""
    system, _ = aboard(truth, **settings)
    found = simulate(system, members=members, duration=duration, seed=seed).dataset
    return {str(n).removeprefix("imu."): v.to_numpy()[1:] for n, v in found.data_vars.items()}


def assert_sigma(samples, sigma):
    """Scatter of normal samples of mean zero, within 5 sigma of its own sampling error."""
    low, high = chi2.ppf([3e-7, 1 - 3e-7], samples.size)
    assert low < np.sum(samples**2) / sigma**2 < high


# ------------------------------------------------------------------------- Allan deviations

MEMBERS, STEPS = 12, 40_000


def allan(increments, times):
    """Allan deviation of the rate at averaging times [s], from all members and axes together."""
    series = increments.reshape(len(increments), -1).T / DT
    variance = [
        allantools.oadev(x, rate=1 / DT, data_type="freq", taus=times)[1] ** 2 for x in series
    ]
    return np.sqrt(np.mean(variance, axis=0))


def assert_allan(increments, times, expected):
    """Within 5 sigma: 1 / sqrt(2 (K - 1)) for K clusters in a series (IEEE Std 952, annex C).

    Overlapping clusters only add to what is known.
    """
    times = np.asarray(times)
    clusters = len(increments) * DT / times
    n = increments[0].size
    error = allan(increments, times) / expected - 1
    assert (np.abs(error) < FAR / np.sqrt(2 * n * (clusters - 1))).all(), error


def markov(times, sigma, tau):
    """Allan deviation of a Gauss-Markov process (IEEE Std 952, annex C)."""
    x = np.asarray(times) / tau
    return sigma * np.sqrt(2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x)))


TERMS = {
    # coefficient, settings (of both triads), averaging times, Allan deviation
    "white": ({"random_walk": 2e-3}, [1.0, 10.0], lambda T: 2e-3 / np.sqrt(T)),
    "walk": ({"bias_walk": 1e-4}, [10.0, 30.0], lambda T: 1e-4 * np.sqrt(T / 3)),
    "correlated": (
        {"bias_sigma": 1e-3, "bias_time": 10.0},
        [2.0, 18.9, 80.0],
        lambda T: markov(T, 1e-3, 10.0),
    ),
    "instability": (
        {"bias_instability": 1e-3, "bias_instability_time": 10.0},
        [2.0, 18.9, 80.0],
        lambda T: FLICKER * np.sqrt(sum(markov(T, 1e-3, 10.0**k) ** 2 for k in range(3))),
    ),
}


@pytest.mark.parametrize("term", TERMS)
def test_each_random_term_has_its_allan_deviation(term):
    given, times, deviation = TERMS[term]
    settings = {
        {"random_walk": {"accel": "velocity_random_walk", "gyro": "angle_random_walk"}}.get(
            name, {}
        ).get(kind, f"{kind}_{name}"): value
        for name, value in given.items()
        for kind in ("accel", "gyro")
    }
    found = fly("4000", MEMBERS, Still, grade="custom", bias="both", **settings)
    times = np.array(times)
    for name in ("delta_v_b", "delta_theta_b"):
        assert_allan(found[name], times, deviation(times))
    if term == "correlated":  # 0.437 K sqrt(tau) at 1.89 tau, with K = sigma sqrt(2 / tau)
        assert deviation(18.9) == pytest.approx(0.437 * np.sqrt(2) * 1e-3, rel=2e-3)
    if term == "instability":  # the setting is the floor; three processes reach 0.988 of it
        assert deviation(18.9) == pytest.approx(0.988e-3, rel=1e-3)


def test_quantization_falls_as_one_over_time():
    """sqrt(3) Q / T with Q = q / sqrt(12), of what quantization alone changes."""
    quanta = {"accel_quantum": 2e-3, "gyro_quantum": 1e-3}
    white = {"velocity_random_walk": 2e-2, "angle_random_walk": 1e-2, "grade": "custom"}
    plain, stepped = (fly("4000", MEMBERS, **white, **more) for more in ({}, quanta))
    times = np.array([0.1, 1.0, 5.0])
    for name, q in (("delta_v_b", 2e-3), ("delta_theta_b", 1e-3)):
        expected = np.sqrt(3) * q / np.sqrt(12) / times
        assert_allan(stepped[name] - plain[name], times, expected)


def test_jitter_scatters_increments_and_never_their_sum():
    """Variance 2 r^2 sigma^2 of an increment, r^2 sigma^2 of the sum at any time."""
    sigma = 1e-4
    found = fly("20", 4000, grade="custom", time_jitter=sigma)
    for name, rate in (("delta_v_b", FORCE), ("delta_theta_b", TURN)):
        error = (found[name] - rate * DT) / rate
        total = np.cumsum(error, axis=0)
        # the axes share a clock: one of them holds all there is to know
        np.testing.assert_allclose(error[..., 0], error[..., 2], rtol=1e-6, atol=1e-12)
        assert_sigma(error[10, :, 0], np.sqrt(2) * sigma)
        assert_sigma(total[5, :, 0], sigma)
        assert_sigma(total[-1, :, 0], sigma)


def test_a_correlated_bias_and_a_walk_add():
    """sigma0^2 + K^2 t + sigma^2: turn-on, walk and a process in its steady state."""
    settings = {"accel_bias_sigma0": 1e-3, "accel_bias_walk": 2e-4, "accel_bias_sigma": 7e-4}
    bias = fly("20", 3000, bias="both", accel_bias_time=5.0, **settings)["accel_bias_b"]
    for row in (0, 99, 199):
        t = (row + 1) * DT
        assert_sigma(bias[row], np.sqrt(1e-6 + 4e-8 * t + 4.9e-7))


def test_errors_of_scale_and_axes_are_drawn_once_for_each_member_and_axis():
    found = fly(
        "1",
        4000,
        grade="custom",
        accel_scale_factor_sigma=[1e-3, 2e-3, 0.0],
        gyro_misalignment_sigma=1e-3,
        gyro_g_sensitivity_sigma=1e-4,
    )
    np.testing.assert_allclose(found["delta_v_b"], found["delta_v_b"][:1].repeat(10, 0), rtol=1e-14)
    scale = found["delta_v_b"][0] / (FORCE * DT) - 1
    assert_sigma(scale[:, 0], 1e-3)
    assert_sigma(scale[:, 1], 2e-3)
    assert not scale[:, 2].any()
    assert abs(np.corrcoef(scale[:, 0], scale[:, 1])[0, 1]) < FAR / np.sqrt(4000)
    turned = found["delta_theta_b"][0] / DT - TURN
    felt = 1e-4 * np.linalg.norm(FORCE)
    for axis in range(3):
        leaning = 1e-3 * np.linalg.norm(np.delete(TURN, axis))
        assert_sigma(turned[:, axis], np.hypot(leaning, felt))


# ------------------------------------------------------------------------- nothing for nothing


def drawn(imu):
    """Normals that the kernel of the last simulation takes."""
    return {a.name for a in imu._kept[2].noise}


def test_zero_terms_draw_nothing_and_are_not_in_the_kernel():
    system, imu = aboard(grade="custom")
    simulate(system, members=2, duration="1")
    assert drawn(imu) == set()
    zero = imu._kept[2].function.n_instructions()
    for settings, streams in (
        ({"gyro_bias_instability": 1e-6}, {f"gyro_flicker_{k}_noise" for k in range(3)}),
        ({"time_jitter": 1e-6}, {"clock_noise"}),
        ({"accel_misalignment_sigma": 1e-3}, {"accel_misalignment_noise"}),
        ({"accel_quantum": 1e-3}, set()),
        ({"gyro_scale_factor": 1e-3}, set()),
        ({"lever_arm_b": [1.0, 0.0, 0.0]}, set()),
    ):
        system, imu = aboard(grade="custom", **settings)
        simulate(system, members=2, duration="1")
        assert drawn(imu) == streams
        at_start = settings.keys() == {"accel_misalignment_sigma"}
        assert at_start or imu._kept[2].function.n_instructions() > zero


def test_a_simple_sensor_has_no_part_of_a_full_one():
    _, imu = aboard()
    assert set(imu.model.states) == {"accel_bias_b", "gyro_bias_b"}
    assert len(imu.model.noise) == 4


def test_a_linear_analysis_sees_through_quantization():
    """Its stairs have no slope: with quanta, the quiet model passes increments as without them."""
    system, imu = aboard(**EVERYTHING)
    Simulation(system, members=1, quiet=True, recording=False)
    assert not imu.model.uses("accel_quantum")
    assert not imu.model.uses("gyro_quantum")
    assert imu.model.uses("gyro_range")


# ------------------------------------------------------------------------- ensembles


def same(one, member, other, place=0):
    for name, values in one.items():
        np.testing.assert_array_equal(values[:, member], other[name][:, place])


def test_a_member_with_every_error_is_the_same_alone():
    whole = fly("3", 40, **EVERYTHING)
    assert np.ptp(whole["delta_theta_b"][0, :, 0]) > 0
    for member in (0, 7, 39):
        same(whole, member, fly("3", [member], **EVERYTHING))


def test_a_term_that_is_zero_for_some_members_changes_no_other():
    """Members with and without a full range, quanta and jitter: as when flown alone."""
    settings = EVERYTHING | {"gyro_range": 0.0, "gyro_nonlinearity": 0.0, "time_jitter": 0.0}

    def flown(members):
        system, _ = aboard(**settings)
        system.disperse(Dispersion("end", ("imu.gyro_range",), [0.0, 0.15], kind="list"))
        system.disperse(Dispersion("clock", ("imu.time_jitter",), [1e-5, 0.0], kind="list"))
        found = simulate(system, members=members, duration="2").dataset
        return {n: v.to_numpy()[1:] for n, v in found.data_vars.items() if n.startswith("imu.")}

    both = flown(2)
    assert both["imu.saturated"][:, 0].sum() == 0
    assert both["imu.saturated"][:, 1, 4:].all()
    for member in range(2):
        same(both, member, flown([member]))


def test_a_state_set_back_goes_on_to_the_same_bytes():
    whole, _ = aboard(**EVERYTHING)
    expected = simulate(whole, members=3, duration="4").dataset["imu.delta_theta_b"].to_numpy()
    halted = Simulation(aboard(**EVERYTHING)[0], members=3, duration="4")
    halted.run_until("2")
    again = Simulation(aboard(**EVERYTHING)[0], members=3, duration="4")
    again.set_state(halted.get_state())
    again.run_until("4")
    rest = again.result(wall_s=0.0).dataset["imu.delta_theta_b"].to_numpy()
    np.testing.assert_array_equal(rest, expected[-len(rest) :])
    assert len(rest) == 20


# ------------------------------------------------------------------------- grades

SI = {
    "HG1700": {
        "velocity_random_walk": 0.065 * 0.3048 / 60,
        "accel_bias_sigma0": 1e-3 * G,
        "angle_random_walk": 0.125 * DEG / 60,
        "gyro_bias_sigma0": DEG / HOUR,
    },
    "iMAR-FSAS": {
        "velocity_random_walk": 0.0198 / 60,
        "accel_bias_sigma0": 1e-3 * G,
        "accel_scale_factor_sigma": 300e-6,
        "angle_random_walk": 0.1 * DEG / 60,
        "gyro_bias_sigma0": 0.75 * DEG / HOUR,
        "gyro_scale_factor_sigma": 300e-6,
    },
    "CPT7": {
        "velocity_random_walk": 1e-3,
        "accel_bias_sigma0": 0.3e-3 * G,
        "accel_bias_instability": 75e-6 * G,
        "angle_random_walk": 1e-3 * DEG,
        "gyro_bias_sigma0": DEG / HOUR,
        "gyro_bias_instability": 0.45 * DEG / HOUR,
    },
    "STIM300": {
        "velocity_random_walk": 1e-3,
        "accel_bias_sigma0": 0.75e-3 * G,
        "accel_bias_instability": 50e-6 * G,
        "accel_scale_factor_sigma": 300e-6,
        "accel_misalignment_sigma": 1e-3,
        "accel_nonlinearity": 100e-6,
        "accel_range": 10 * G,
        "angle_random_walk": 0.15 * DEG / 60,
        "gyro_bias_sigma0": 4 * DEG / HOUR,
        "gyro_bias_instability": 0.5 * DEG / HOUR,
        "gyro_scale_factor_sigma": 500e-6,
        "gyro_misalignment_sigma": 1e-3,
        "gyro_nonlinearity": 50e-6,
        "gyro_range": 400 * DEG,
        "gyro_g_sensitivity_sigma": DEG / HOUR / G,
    },
    "HG9900": {
        "accel_bias_sigma0": 25e-6 * G,
        "accel_scale_factor_sigma": 100e-6,
        "angle_random_walk": 0.002 * DEG / 60,
        "gyro_bias_sigma0": 0.0035 * DEG / HOUR,
        "gyro_scale_factor_sigma": 5e-6,
    },
}


@pytest.mark.parametrize("grade", GRADES)
def test_a_grade_is_its_data_sheet_in_si(grade):
    """Unit by unit by hand: g is 9.80665 m/s^2, a foot 0.3048 m, sqrt(h) 60 sqrt(s)."""
    imu, plain = Imu(grade=grade), Imu(grade="custom")
    for name in imu.settings():
        if name == "grade":
            continue
        expected = SI[grade].get(name, plain.setting(name))
        if isinstance(expected, str):
            assert imu.setting(name) == expected
        else:
            np.testing.assert_allclose(imu.setting(name), expected, rtol=1e-12, err_msg=name)
        assert imu.is_default(name)
    assert not imu.is_default("grade")
    assert GRADES[grade].source


def test_data_sheets_are_read_in_their_own_units():
    """The two of the order, HG1700 and iMAR-FSAS, as anyone would type them."""
    imu = Imu(
        grade="custom",
        velocity_random_walk="0.065 ft/s/sqrt(h)",
        accel_bias_sigma0="1 mg_0",
        gyro_bias_sigma0="[0.75, 1, 2] deg/h",
        angle_random_walk="0.0028 deg/sqrt(h)",
        gyro_scale_factor_sigma="300 ppm",
        gyro_g_sensitivity="1 deg/h/g_0",
        latency="2.5 ms",
    )
    np.testing.assert_allclose(imu.setting("velocity_random_walk"), 3.302e-4, rtol=1e-12)
    np.testing.assert_allclose(imu.setting("accel_bias_sigma0"), 9.80665e-3, rtol=1e-12)
    np.testing.assert_allclose(
        imu.setting("gyro_bias_sigma0"), np.array([0.75, 1, 2]) * 4.84813681e-6, rtol=1e-9
    )
    np.testing.assert_allclose(imu.setting("angle_random_walk"), 8.14486984e-7, rtol=1e-8)
    np.testing.assert_allclose(imu.setting("gyro_scale_factor_sigma"), 3e-4, rtol=1e-12)
    np.testing.assert_allclose(imu.setting("gyro_g_sensitivity"), 4.9437237e-7, rtol=1e-8)
    assert imu.setting("latency") == 2.5e-3


def test_what_is_set_by_hand_stands_before_the_grade_whichever_came_first():
    first, last = Imu(gyro_bias_sigma0="3 deg/h"), Imu(grade="HG1700")
    first.grade = "HG1700"
    last.gyro_bias_sigma0 = "3 deg/h"
    for imu in (first, last, Imu(grade="HG1700", gyro_bias_sigma0="3 deg/h")):
        np.testing.assert_allclose(imu.setting("gyro_bias_sigma0"), 3 * DEG / HOUR, rtol=1e-12)
        np.testing.assert_allclose(imu.setting("accel_bias_sigma0"), 1e-3 * G, rtol=1e-12)
        assert not imu.is_default("gyro_bias_sigma0")
    last.grade = "HG9900"  # nothing of the grade before is left
    np.testing.assert_allclose(imu.setting("gyro_bias_sigma0"), 3 * DEG / HOUR, rtol=1e-12)
    assert not last.setting("velocity_random_walk").any()


def test_a_system_with_a_grade_is_written_and_read_back(tmp_path):
    """What the file of an example sets itself stands before the grade."""
    path = Path(__file__).parents[3] / "examples" / "spacecraft_sar_open_loop.toml"
    chosen = [("imu.grade", "CPT7"), ("imu.gyro_bias_sigma0", "3 deg/h")]
    system = read_system(path, chosen)
    write_system(system, tmp_path / "again.toml")
    imu, again = system.nodes["imu"], read_system(tmp_path / "again.toml").nodes["imu"]
    np.testing.assert_allclose(imu.setting("velocity_random_walk"), 5.916079783099616e-6)
    np.testing.assert_allclose(imu.setting("angle_random_walk"), 1e-3 * DEG, rtol=1e-12)
    for name in imu.settings():
        np.testing.assert_array_equal(again.setting(name), imu.setting(name))


# ------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"grade": "CPT9"}, r"'grade' is 'CPT9'; it takes .*\"HG1700\" or \"iMAR-FSAS\".*'CPT7'"),
        ({"grade": "custom", "time_jitter": -1e-6}, "must be at least 0 s"),
        ({"gyro_bias_sigma0": [1e-6, -1e-6, 0]}, "must be at least 0 rad/s"),
        ({"accel_bias_sigma0": "1 mg"}, "g is gram; for standard gravity write mg_0"),
        ({"gyro_misalignment": [1e-3, 0, 0]}, r"has shape \(3,\)"),
        ({"lever_arm_b": 1.0}, "one for each axis of frame 'b'"),
        (
            {"grade": "custom", "accel_misalignment": np.eye(3) * 1e-3},
            "on its diagonal\n  .*accel_scale_factor",
        ),
        (
            {"grade": "custom", "gyro_misalignment": [[0, 1, 0], [1, 0, 0], [0, 0, 0]]},
            "cannot tell its axes apart",
        ),
        ({"grade": "custom", "accel_scale_factor": -1.0}, "cannot tell its axes apart"),
        ({"grade": "custom", "gyro_nonlinearity": 1e-4}, "no gyro_range\n  set gyro_range"),
        (
            {"grade": "custom", "accel_nonlinearity": [1e-4, 0, 0], "accel_range": [0, 1, 1]},
            "no accel_range",
        ),
        ({"grade": "custom", "latency": 0.25}, "more than a step of 0.1 s\n  delay"),
        ({"grade": "custom", "time_jitter": 0.25}, "more than a step of 0.1 s"),
    ],
)
def test_what_cannot_be_is_refused_before_the_first_step(settings, said):
    with pytest.raises(TerrafixError, match=f"(?s){said}"):
        Simulation(aboard(**settings)[0])


@pytest.mark.parametrize(
    ("fixed", "name"),
    [
        ({}, "gyro_range"),
        ({}, "accel_misalignment_sigma"),
        ({"grade": "custom"}, "gyro_bias_sigma"),
        ({"grade": "custom"}, "accel_bias_time"),
    ],
)
def test_what_would_change_nothing_is_said(fixed, name):
    """Also of a dispersion, which would not be applied."""
    system, imu = aboard(**fixed)
    grade = fixed.get("grade", "simple")
    said = f"does not take '{name}' with bias = 'walk', grade = '{grade}'"
    assert said in imu.idle(name)
    system.disperse(Dispersion("d", (f"imu.{name}",), 1e-3, kind="uniform"))
    with pytest.raises(TerrafixError, match=said):
        Simulation(system)
