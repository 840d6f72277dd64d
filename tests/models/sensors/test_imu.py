"""Inertial sensor errors, confirmed by their Allan deviation."""

import allantools
import numpy as np
import pytest

from terrafix.models.sensors.imu import imu_model

DT = 0.01  # [s]


def simulate(model, n, parameters, seed):
    """Increments and biases (n, 3) of an IMU at rest, and the first bias, by the model's step."""
    rng = np.random.default_rng(seed)
    step = model.step_function()
    names = step.name_in()
    series = {
        name: rng.normal(size=(n, 3))
        for name in ("accel_white", "accel_bias_noise", "gyro_white", "gyro_bias_noise")
    }
    start_noise = {k: rng.normal(size=3) for k in series}
    start = model.initial_function()(**start_noise, **parameters)
    state = ["accel_bias_b", "gyro_bias_b"]
    values = dict.fromkeys(names, 0.0) | parameters | {"step": DT}
    x = {s: start[f"next_{s}_"] for s in state}
    columns = [
        np.broadcast_to(values[k], (step.numel_in(i), n)) if k not in series else series[k].T
        for i, k in enumerate(names)
    ]
    order = [names.index(s) for s in state]
    folded = step.mapaccum("run", n, order, [step.name_out().index(f"next_{s}_") for s in state])
    for i, s in zip(order, state, strict=True):
        columns[i] = x[s]
    outputs = dict(zip(folded.name_out(), folded.call(columns), strict=True))
    return {k: outputs[f"{k}_"].full().T for k in model.outputs}, start_noise


NOISE_OF = {"delta_v_b": "velocity_random_walk", "delta_theta_b": "angle_random_walk"}
WALK_OF = {"delta_v_b": "accel_bias_walk", "delta_theta_b": "gyro_bias_walk"}


@pytest.mark.parametrize("increment", ["delta_v_b", "delta_theta_b"])
def test_white_noise_falls_with_slope_minus_one_half(increment):
    """sigma(T) = N / sqrt(T). 3 axes x 40,000 samples: 3 % at 1 s (120 s^-1 intervals, 3 sigma)."""
    outputs, _ = simulate(imu_model(), 40_000, {NOISE_OF[increment]: 2e-3}, seed=3)
    times = np.array([0.02, 0.1, 0.5, 2.0])
    sigma = np.sqrt(
        np.mean(
            [
                allantools.oadev(x / DT, rate=1 / DT, data_type="freq", taus=times)[1] ** 2
                for x in outputs[increment].T
            ],
            axis=0,
        )
    )
    # relative sigma of the deviation is about 1 / sqrt(2 x 3 x 400 s / T): 3 % at 2 s; 3 sigma
    np.testing.assert_allclose(sigma, 2e-3 / np.sqrt(times), rtol=0.09)
    slope = np.polyfit(np.log(times), np.log(sigma), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.03)


@pytest.mark.parametrize("increment", ["delta_v_b", "delta_theta_b"])
def test_bias_walk_rises_with_slope_one_half(increment):
    """sigma(T) = K sqrt(T / 3), where T is many samples."""
    outputs, _ = simulate(imu_model(), 40_000, {WALK_OF[increment]: 1e-4}, seed=4)
    times = np.array([0.5, 1.0, 2.0, 4.0])
    sigma = np.sqrt(
        np.mean(
            [
                allantools.oadev(x / DT, rate=1 / DT, data_type="freq", taus=times)[1] ** 2
                for x in outputs[increment].T
            ],
            axis=0,
        )
    )
    # relative sigma about 1 / sqrt(2 x 3 x 400 s / 4 s) = 4 % at 4 s; 3 sigma
    np.testing.assert_allclose(sigma, 1e-4 * np.sqrt(times / 3), rtol=0.12)
    slope = np.polyfit(np.log(times), np.log(sigma), 1)[0]
    assert slope == pytest.approx(0.5, abs=0.06)


def test_bias_is_drawn_at_the_start():
    outputs, noise = simulate(
        imu_model(), 10, {"accel_bias_sigma0": 1e-3, "gyro_bias_sigma0": 1e-5}, seed=5
    )
    expected = np.tile(1e-3 * noise["accel_bias_noise"], (10, 1))
    np.testing.assert_allclose(outputs["accel_bias_b"], expected, rtol=1e-15)
    np.testing.assert_allclose(outputs["delta_v_b"], expected * DT, rtol=1e-15)
    np.testing.assert_allclose(
        outputs["gyro_bias_b"], np.tile(1e-5 * noise["gyro_bias_noise"], (10, 1)), rtol=1e-15
    )


def test_scale_factor_and_perfect_sensor():
    true = np.array([1.0, -2.0, 3.0])
    outputs, _ = imu_model().advance(delta_v_b_true=true, delta_theta_b_true=true, step=DT)
    np.testing.assert_array_equal(outputs["delta_v_b"], true)
    np.testing.assert_array_equal(outputs["delta_theta_b"], true)
    outputs, _ = imu_model().advance(
        delta_v_b_true=true,
        delta_theta_b_true=true,
        accel_scale_factor=1e-4,
        gyro_scale_factor=-2e-4,
        step=DT,
    )
    np.testing.assert_allclose(outputs["delta_v_b"], 1.0001 * true, rtol=1e-15)
    np.testing.assert_allclose(outputs["delta_theta_b"], 0.9998 * true, rtol=1e-15)


def test_gauss_markov_bias_is_the_same_process_at_any_step():
    """Two half steps have the mean and variance of a whole one: the discretization is exact."""
    model = imu_model("gauss-markov")
    tau, walk, b0 = 3.0, 2e-3, 1e-2
    p = {"accel_bias_time": tau, "gyro_bias_time": tau, "accel_bias_walk": walk}

    def end(bias, noise, step):
        _, states = model.advance(accel_bias_b=bias, accel_bias_noise=noise, step=step, **p)
        return states["accel_bias_b"][0]

    whole_mean, half_mean = end(b0, 0.0, 2.0), end(end(b0, 0.0, 1.0), 0.0, 1.0)
    assert half_mean == pytest.approx(whole_mean, rel=1e-14) == pytest.approx(b0 * np.exp(-2 / tau))
    whole = end(0.0, 1.0, 2.0) ** 2
    halves = end(end(0.0, 1.0, 1.0), 0.0, 1.0) ** 2 + end(0.0, 1.0, 1.0) ** 2
    assert halves == pytest.approx(whole, rel=1e-13)
    assert end(0.0, 1.0, 1e4) ** 2 == pytest.approx(walk**2 * tau / 2)  # steady state


def test_unknown_bias_process_is_refused():
    with pytest.raises(ValueError, match=r"bias must be one of .*got 'constant'"):
        imu_model("constant")
