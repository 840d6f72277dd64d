"""Every error of an inertial measurement unit, one at a time, by hand calculation."""

import numpy as np
import pytest

from terrafix.models.sensors.imu import imu_model
from terrafix.models.sensors.imu_full import FLICKER, full_imu_model

MODEL = full_imu_model()
DT = 0.01  # [s]
FORCE, RATE = np.array([1.0, -2.0, 9.8]), np.array([0.2, -0.1, 0.3])


def run(delta_v, delta_theta, *, step=DT, noise=None, start=None, **parameters):
    """Outputs of each step, stacked, for rows of increments; noise by name has a row each."""
    states = {k: np.zeros(MODEL.shape(k)) for k in MODEL.states} | (start or {})
    rows = []
    for k, (v, theta) in enumerate(zip(delta_v, delta_theta, strict=True)):
        drawn = {name: values[k] for name, values in (noise or {}).items()}
        outputs, states = MODEL.advance(
            delta_v_b_true=v, delta_theta_b_true=theta, step=step, **parameters, **states, **drawn
        )
        rows.append(outputs)
    return {name: np.array([row[name] for row in rows]) for name in MODEL.outputs}


def one(force=FORCE, rate=RATE, **extra):
    """One step at constant specific force and rate: (mean specific force, mean rate, saturated)."""
    found = run([force * DT], [rate * DT], **extra)
    return found["delta_v_b"][0] / DT, found["delta_theta_b"][0] / DT, found["saturated"][0]


def test_a_perfect_sensor_passes_the_truth():
    found = run([FORCE * DT] * 3, [RATE * DT] * 3)
    np.testing.assert_array_equal(found["delta_v_b"], [FORCE * DT] * 3)
    np.testing.assert_array_equal(found["delta_theta_b"], [RATE * DT] * 3)
    assert not found["saturated"].any()


@pytest.mark.parametrize("bias", ["walk", "gauss-markov", "both"])
def test_with_the_parameters_of_the_simple_sensor_it_is_the_simple_sensor(bias):
    """Two models of one thing: every parameter and all noise of the simple one, at random."""
    simple, full = imu_model(bias), full_imu_model(bias)
    rng = np.random.default_rng(1)
    parameters = {k: rng.uniform(0.1, 1.0, simple.shape(k)) for k in simple.parameters}
    values = {
        k: rng.normal(size=simple.shape(k)) for k in (*simple.inputs, *simple.states, *simple.noise)
    }
    outputs, states = simple.advance(**parameters, **values, step=DT)
    # the instability's time divides, as one that is not zero
    times = {f"{k}_bias_instability_time": 1.0 for k in ("accel", "gyro")}
    again, after = full.advance(**parameters, **values, **times, step=DT)
    for name in outputs:
        np.testing.assert_allclose(again[name], outputs[name], rtol=1e-14, atol=1e-16)
    for name in states:
        np.testing.assert_allclose(after[name], states[name], rtol=1e-14, atol=1e-16)


def test_scale_and_axes_by_hand():
    """[1, 2, 3] through diag(1.01, 1, 0.98) and leans of 0.001 (x to y) and -0.002 (z to x)."""
    lean = np.zeros((3, 3))
    lean[0, 1], lean[2, 0] = 1e-3, -2e-3
    x = np.array([1.0, 2.0, 3.0])
    force, rate, _ = one(
        x,
        x,
        accel_scale_factor=[0.01, 0.0, -0.02],
        accel_misalignment=lean,
        gyro_scale_factor=[0.01, 0.0, -0.02],
        gyro_misalignment=lean,
    )
    by_hand = [1.01 + 0.002, 2.0, 2.94 - 0.002]
    np.testing.assert_allclose(force, by_hand, rtol=1e-14)
    np.testing.assert_allclose(rate, by_hand, rtol=1e-14)


@pytest.mark.parametrize("kind", ["accel", "gyro"])
def test_drawn_errors_of_scale_and_axes_add_to_what_is_fixed(kind):
    """The draws at the start, one by one, in the place of the matrix where they belong."""
    start = MODEL.initial_function()(
        **{f"{kind}_scale_factor_noise": [1.0, 2.0, 3.0]},
        **{f"{kind}_misalignment_noise": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]},
        **{f"{kind}_scale_factor_sigma": 0.01, f"{kind}_misalignment_sigma": 0.001},
    )
    errors = {
        f"{kind}_{what}_error": start[f"next_{kind}_{what}_error_"].full()[:, 0]
        for what in ("scale_factor", "misalignment")
    }
    found = np.array([one(axis, axis, start=errors)[kind == "gyro"] for axis in np.eye(3)]).T
    by_hand = [[1.01, 0.001, 0.002], [0.003, 1.02, 0.004], [0.005, 0.006, 1.03]]
    np.testing.assert_allclose(found, by_hand, rtol=1e-14)


@pytest.mark.parametrize("kind", ["accel", "gyro"])
def test_nonlinearity_reaches_its_figure_at_full_range(kind):
    """300 ppm at 20: 300 ppm of the rate there, half of that at half of it, and odd."""
    settings = {f"{kind}_nonlinearity": 3e-4, f"{kind}_range": 20.0}
    x = np.array([20.0, 10.0, -10.0]) * (1 - 1e-3)
    found = one(x, x, **settings)[kind == "gyro"] - x
    np.testing.assert_allclose(found, 3e-4 * np.abs(x) * x / 20.0, rtol=1e-9)
    assert found[1] == pytest.approx(3e-4 * 0.5 * 10.0 * (1 - 1e-3) ** 2, rel=1e-9)


def test_the_quadratic_of_an_accelerometer_is_even():
    """IEEE 1293's K2: 10 ug/g^2 at 3 g is 90 ug, of either sign of the input."""
    g = 9.80665
    force, _, _ = one(np.array([3 * g, -3 * g, 0.0]), accel_quadratic=10e-6 / g)
    np.testing.assert_allclose(force - [3 * g, -3 * g, 0.0], [90e-6 * g, 90e-6 * g, 0], rtol=1e-9)


def test_a_gyroscope_shows_specific_force_through_its_sensitivity():
    """0.5 along y on x, drawn errors by row: element 3 i + j is of sensor i and axis j."""
    matrix = np.zeros((3, 3))
    matrix[0, 1] = 0.5
    errors = {"gyro_g_sensitivity_error": np.arange(9.0) / 10}
    force, rate, _ = one(gyro_g_sensitivity=matrix, start=errors)
    # rows of 0.1 * [0 1 2; 3 4 5; 6 7 8] times [1, -2, 9.8] are 1.76, 4.40, 7.04
    np.testing.assert_allclose(rate - RATE, [1.76 + 0.5 * -2.0, 4.4, 7.04], rtol=1e-12)
    np.testing.assert_array_equal(force, FORCE)


def test_full_range_is_clipped_and_said_for_each_axis():
    force, rate, saturated = one(
        np.array([11.0, -11.0, 9.0]),
        np.array([0.5, -3.0, 1.5]),
        accel_range=10.0,
        gyro_range=[1.0, 2.0, 0.0],
    )
    np.testing.assert_allclose(force, [10.0, -10.0, 9.0], rtol=1e-15)
    np.testing.assert_allclose(rate, [0.5, -2.0, 1.5], rtol=1e-15)  # z has no end
    np.testing.assert_array_equal(saturated, [1, 1, 0, 0, 1, 0])


def test_bias_and_noise_count_toward_the_full_range():
    found = run(
        [[0.0999, 0, 0]], [np.zeros(3)], accel_range=10.0, start={"accel_bias_b": [0.02, 0, 0]}
    )
    np.testing.assert_allclose(found["delta_v_b"][0], [0.1, 0, 0], rtol=1e-14)
    assert found["saturated"][0, 0] == 1


def test_quanta_carry_what_is_left():
    """Increments are whole quanta, and their sum stays within half of one of the truth's."""
    rng = np.random.default_rng(2)
    v, theta = rng.normal(size=(2, 200, 3))
    found = run(v, theta, accel_quantum=0.7, gyro_quantum=[0.3, 0.5, 0.0])
    for name, true, quanta in (
        ("delta_v_b", v, [0.7] * 3),
        ("delta_theta_b", theta, [0.3, 0.5, 0.0]),
    ):
        for axis, q in enumerate(quanta):
            made, given = found[name][:, axis], true[:, axis]
            if q == 0.0:
                np.testing.assert_array_equal(made, given)
                continue
            np.testing.assert_allclose(made / q, np.round(made / q), atol=1e-12)
            off = np.cumsum(made) - np.cumsum(given)
            assert q / 4 < np.abs(off).max() <= q / 2 * (1 + 1e-12)


def test_jitter_moves_the_ends_of_intervals_and_nothing_is_lost():
    """At constant rate r the increments are r (h + d_k - d_(k-1)); one clock for both triads."""
    ends = np.random.default_rng(3).normal(size=(20, 1))
    found = run([FORCE * DT] * 20, [RATE * DT] * 20, time_jitter=1e-4, noise={"clock_noise": ends})
    spans = DT + 1e-4 * np.diff(ends, axis=0, prepend=0.0)
    np.testing.assert_allclose(found["delta_v_b"], spans * FORCE, rtol=1e-13)
    np.testing.assert_allclose(found["delta_theta_b"], spans * RATE, rtol=1e-13)


def test_latency_leaves_the_sum_at_what_it_was_then():
    """A rate that grows as t: at t the sum is that of t - 2.5 ms, on the line through the step."""
    t = DT * np.arange(31)
    theta = np.diff(t**2)[:, None] * RATE
    found = run(0 * theta, theta, latency=2.5e-3)
    total = np.cumsum(found["delta_theta_b"], axis=0)
    # within a step the angle is taken as linear in time: interpolated exactly so
    np.testing.assert_allclose(
        total, np.interp(t[1:] - 2.5e-3, t, t**2)[:, None] * RATE, rtol=1e-12
    )


# ------------------------------------------------------------------------- lever arm

ARM = np.array([0.8, -0.3, 0.2])


def test_on_a_turntable_the_lever_arm_feels_the_centripetal_force():
    """omega^2 r inward at constant rate, from the first step on: 2 rad/s about z."""
    found = run([FORCE * DT] * 5, [[0, 0, 2.0 * DT]] * 5, lever_arm_b=ARM)
    felt = found["delta_v_b"] / DT - FORCE
    np.testing.assert_allclose(felt, [[-4 * 0.8, 4 * 0.3, 0.0]] * 5, rtol=1e-12, atol=1e-13)


def test_gyroscopes_feel_the_force_where_they_are():
    """At 1 m from the axis and 2 rad/s: 4 m/s^2 inward, times 0.01, on the rate about x."""
    matrix = np.zeros((3, 3))
    matrix[0, 0] = 0.01
    _, rate, _ = one(
        0 * FORCE, np.array([0, 0, 2.0]), lever_arm_b=[1, 0, 0], gyro_g_sensitivity=matrix
    )
    np.testing.assert_allclose(rate, [-0.04, 0, 2.0], rtol=1e-12)


def test_in_a_spin_up_the_lever_arm_gains_the_speed_of_its_place():
    """The tangential part sums to (change of rate) x arm; at linear rates each step is exact."""
    alpha = np.array([0.5, -0.4, 3.0])
    t = DT * np.arange(52)
    theta = np.diff(alpha * (t**2)[:, None] / 2, axis=0)
    whole = run(0 * theta, theta, lever_arm_b=ARM)["delta_v_b"]
    mean = theta / DT
    tangential = whole - DT * np.cross(mean, np.cross(mean, ARM))
    steady = np.cross(alpha, ARM) * DT
    np.testing.assert_allclose(tangential[2:], np.tile(steady, (49, 1)), rtol=1e-9)
    # the first step knows no change; the second makes up for it, to the rate at its start
    np.testing.assert_allclose(tangential[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(tangential[1], 1.5 * steady, rtol=1e-9)


def test_the_centripetal_part_is_of_second_order():
    """Rate sin t about z from 0 to 1: the integral of its square is 1/2 - sin(2)/4."""
    errors = []
    for n in (25, 50, 100):
        t = np.linspace(0.0, 1.0, n + 1)
        theta = np.zeros((n, 3))
        theta[:, 2] = -np.diff(np.cos(t))
        found = run(0 * theta, theta, step=1.0 / n, lever_arm_b=[1.0, 0.0, 0.0])
        errors.append(found["delta_v_b"][:, 0].sum() + 0.5 - np.sin(2.0) / 4)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.02)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.02)


# ------------------------------------------------------------------------- instability


def markov_variance(time, tau):
    """Allan variance of a Gauss-Markov process of sigma one (IEEE Std 952, annex C)."""
    x = time / tau
    return 2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))


def test_the_sum_of_markov_processes_stays_at_the_floor():
    """0.988 of it at 1.89 tau, at least 0.90 from 0.2 to 19 tau; an endless sum is the floor."""
    times = np.geomspace(0.2, 19, 200)

    def floor(times, decades):
        return FLICKER * np.sqrt(sum(markov_variance(times, 10.0**k) for k in decades))

    assert floor(1.89, (-1, 0, 1)) == pytest.approx(0.988, abs=5e-4)
    assert floor(times, (-1, 0, 1)).min() > 0.90
    assert floor(times, (-1, 0, 1)).max() < 0.99
    # processes of four decades to each side: what is left is the ripple of their spacing
    np.testing.assert_allclose(floor(times, range(-4, 5)), 1.0, atol=0.012)


def test_each_process_has_the_sigma_of_the_decade_it_stands_for():
    """sigma = B sqrt(ln 10 / pi) = 0.8561 B, and the floor is B sqrt(2 ln 2 / pi) = 0.6643 B."""
    assert pytest.approx(0.8561 / 0.6643, rel=1e-4) == FLICKER
    start = MODEL.initial_function()(accel_flicker_1_noise=[1, -1, 2], accel_bias_instability=3.0)
    drawn = start["next_accel_flicker_1_"].full()[:, 0]
    np.testing.assert_allclose(drawn, 3.0 * FLICKER * np.array([1, -1, 2]), rtol=1e-14)


def test_unknown_bias_process_is_refused():
    with pytest.raises(ValueError, match=r"bias must be one of .*got 'constant'"):
        full_imu_model("constant")
