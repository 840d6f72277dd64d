r"""Strapdown inertial measurement unit: increments with scale error, drifting bias, white noise.

For each triad, with :math:`n_1, n_2` standard normal,

.. math::
    \Delta\tilde v = (1 + s)\, \Delta v + b^+ \Delta t + N \sqrt{\Delta t}\, n_1, \qquad
    b^+ = \Phi\, b + K \sqrt{\Delta t_\Phi}\, n_2, \qquad b_0 = \sigma_0 n_2.

For a random walk :math:`\Phi = 1`, :math:`\Delta t_\Phi = \Delta t`; for a Gauss-Markov bias of
time constant :math:`\tau`, :math:`\Phi = e^{-\Delta t / \tau}` and
:math:`\Delta t_\Phi = \tfrac{\tau}{2}(1 - \Phi^2)`, both exact at any step. It keeps the variance
:math:`K^2 \tau / 2`; where no drive :math:`K` is given it is that which keeps the variance of the
start, :math:`K = \sigma_0 \sqrt{2 / \tau}`.

The Allan deviation of the rate is :math:`N / \sqrt{T}` for the white noise and
:math:`K \sqrt{T / 3}` for the walk at averaging time :math:`T`.

References
----------
.. [1] IEEE Std 952, annex C (Allan variance of rate random walk and angle random walk).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.model import Model

BIASES = ("walk", "gauss-markov")
"""Names of the bias processes."""


def imu_model(bias: str = "walk") -> Model:
    """Accelerometer and gyroscope triads on common body axes.

    Parameters
    ----------
    bias : {"walk", "gauss-markov"}
        Process of both biases; the second adds the parameters ``accel_bias_time`` and
        ``gyro_bias_time`` [s], positive, and takes a walk of zero as the one that keeps sigma.

    Returns
    -------
    Model
        Inputs ``delta_v_b_true`` [m/s] and ``delta_theta_b_true`` [rad]; outputs ``delta_v_b``,
        ``delta_theta_b``, ``accel_bias_b`` [m/s^2] and ``gyro_bias_b`` [rad/s]; (3,) each.
        Scalar parameters ``velocity_random_walk`` [m/s/sqrt(s)], ``accel_bias_sigma0`` [m/s^2],
        ``accel_bias_walk`` [m/s^2/sqrt(s)], ``accel_scale_factor`` [-], and for the gyroscopes
        ``angle_random_walk`` [rad/sqrt(s)], ``gyro_bias_sigma0`` [rad/s], ``gyro_bias_walk``
        [rad/s/sqrt(s)], ``gyro_scale_factor`` [-]. The noise that drives a bias is its initial
        draw at the start.

    Raises
    ------
    ValueError
        If `bias` is not a known process.
    """
    if bias not in BIASES:
        raise ValueError(f"bias must be one of {BIASES}, got '{bias}'")
    dt = ca.SX.sym("dt")
    triads = (
        _triad("delta_v_b", "accel", "velocity_random_walk", bias, dt),
        _triad("delta_theta_b", "gyro", "angle_random_walk", bias, dt),
    )
    fields = ("inputs", "states", "parameters", "noise", "next", "initial", "outputs")
    merged: dict[str, Any] = {name: {**triads[0][name], **triads[1][name]} for name in fields}
    return Model("imu", step=dt, **merged)


def _triad(increment: str, kind: str, walk: str, bias: str, dt: Any) -> dict[str, dict[str, Any]]:
    """Fields of the model of one triad; `kind` and `walk` name its parameters."""
    true, b = ca.SX.sym(f"{increment}_true", 3), ca.SX.sym(f"{kind}_bias_b", 3)
    white, drive = ca.SX.sym(f"{kind}_white", 3), ca.SX.sym(f"{kind}_bias_noise", 3)
    names = [walk, f"{kind}_bias_sigma0", f"{kind}_bias_walk", f"{kind}_scale_factor"]
    parameters = {name: ca.SX.sym(name) for name in names}
    random_walk, sigma0, bias_walk, scale_factor = parameters.values()
    following = b + bias_walk * ca.sqrt(dt) * drive
    if bias == "gauss-markov":
        tau = parameters[f"{kind}_bias_time"] = ca.SX.sym(f"{kind}_bias_time")
        decay = ca.exp(-dt / tau)
        fresh = ca.sqrt(1 - decay * decay)
        driven = bias_walk * ca.sqrt(tau / 2)
        following = decay * b + ca.if_else(bias_walk > 0, driven, sigma0) * fresh * drive
    measured = (1 + scale_factor) * true + b * dt + random_walk * ca.sqrt(dt) * white
    return {
        "inputs": {f"{increment}_true": true},
        "states": {f"{kind}_bias_b": b},
        "parameters": parameters,
        "noise": {f"{kind}_white": white, f"{kind}_bias_noise": drive},
        "next": {f"{kind}_bias_b": following},
        "initial": {f"{kind}_bias_b": sigma0 * drive},
        "outputs": {increment: measured, f"{kind}_bias_b": b},
    }
