r"""Strapdown inertial measurement unit: increments with scale error, drifting bias, white noise.

For each triad, with :math:`n_1, n_2` standard normal,

.. math::
    \Delta\tilde v = (1 + s)\, \Delta v + b^+ \Delta t + N \sqrt{\Delta t}\, n_1, \qquad
    b^+ = \Phi\, b + K \sqrt{\Delta t_\Phi}\, n_2, \qquad b_0 = \sigma_0 n_2.

For a random walk :math:`\Phi = 1`, :math:`\Delta t_\Phi = \Delta t`; for a Gauss-Markov bias of
time constant :math:`\tau`, :math:`\Phi = e^{-\Delta t / \tau}` and
:math:`\Delta t_\Phi = \tfrac{\tau}{2}(1 - \Phi^2)`, both exact at any step. It keeps the variance
:math:`K^2 \tau / 2`; where no drive :math:`K` is given it is that which keeps the variance of the
start, :math:`K = \sigma_0 \sqrt{2 / \tau}`. With both, the bias is the sum of a walk from the
turn-on bias and a Gauss-Markov process of a sigma of its own, in its steady state from the start.

The Allan deviation of the rate is :math:`N / \sqrt{T}` for the white noise and
:math:`K \sqrt{T / 3}` for the walk at averaging time :math:`T`. That of a Gauss-Markov process
peaks at :math:`T = 1.89\, \tau` with :math:`0.437\, K \sqrt{\tau} = 0.618\, \sigma`.

The sensor with everything that a data sheet names is `imu_full`.

References
----------
.. [1] IEEE Std 952, annexes B and C (Allan variance of rate random walk, angle random walk and
       Markov noise).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.sensors.altimeter import wandering

BIASES = ("walk", "gauss-markov", "both")
"""Names of the bias processes."""
TRIADS = {
    "accel": ("delta_v_b", "velocity_random_walk"),
    "gyro": ("delta_theta_b", "angle_random_walk"),
}
"""Increment and white noise of each triad of sensors."""


def imu_model(bias: str = "walk") -> Model:
    """Accelerometer and gyroscope triads on common body axes.

    Parameters
    ----------
    bias : {"walk", "gauss-markov", "both"}
        Process of both biases; the second adds the parameters ``accel_bias_time`` and
        ``gyro_bias_time`` [s], positive, and takes a walk of zero as the one that keeps sigma; the
        third adds these and the ``accel_bias_sigma`` and ``gyro_bias_sigma`` of its correlated
        part.

    Returns
    -------
    Model
        Inputs ``delta_v_b_true`` [m/s] and ``delta_theta_b_true`` [rad]; outputs ``delta_v_b``,
        ``delta_theta_b``, ``accel_bias_b`` [m/s^2] and ``gyro_bias_b`` [rad/s]; (3,) each; and
        ``saturated`` (6,), zero. Parameters, (3,), ``velocity_random_walk`` [m/s/sqrt(s)],
        ``accel_bias_sigma0`` [m/s^2], ``accel_bias_walk`` [m/s^2/sqrt(s)],
        ``accel_scale_factor`` [-], and for the gyroscopes ``angle_random_walk`` [rad/sqrt(s)],
        ``gyro_bias_sigma0`` [rad/s], ``gyro_bias_walk`` [rad/s/sqrt(s)], ``gyro_scale_factor``
        [-]. The noise that drives a bias is its initial draw at the start.

    Raises
    ------
    ValueError
        If `bias` is not a known process.
    """
    draft = Draft()
    for kind, (increment, walk) in TRIADS.items():
        true = draft.input(f"{increment}_true", 3)
        now, _ = add_bias(draft, kind, bias)
        scaled = (1 + draft.parameter(f"{kind}_scale_factor", 3)) * true
        draft.outputs[increment] = scaled + now * draft.dt + white_noise(draft, kind, walk)
        draft.outputs[f"{kind}_bias_b"] = now
    draft.outputs["saturated"] = ca.SX.zeros(6)
    return draft.model("imu")


@dataclass
class Draft:
    """A model while its parts declare what they need."""

    dt: Any = field(default_factory=lambda: ca.SX.sym("dt"))
    inputs: dict[str, Any] = field(default_factory=dict)
    states: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    noises: dict[str, Any] = field(default_factory=dict)
    next: dict[str, Any] = field(default_factory=dict)
    initial: dict[str, Any] = field(default_factory=dict)
    outputs: dict[str, Any] = field(default_factory=dict)

    def input(self, name: str, size: int) -> Any:
        """Declare an input."""
        return self.inputs.setdefault(name, ca.SX.sym(name, size))

    def parameter(self, name: str, rows: int = 1, columns: int = 1) -> Any:
        """Declare a parameter, or take it again."""
        return self.parameters.setdefault(name, ca.SX.sym(name, rows, columns))

    def noise(self, name: str, size: int) -> Any:
        """Declare noise."""
        return self.noises.setdefault(name, ca.SX.sym(name, size))

    def state(self, name: str, size: int) -> Any:
        """Declare a state; `next` and `initial` are filled by who declares it."""
        return self.states.setdefault(name, ca.SX.sym(name, size))

    def model(self, name: str) -> Model:
        """Make the model."""
        return Model(
            name,
            inputs=self.inputs,
            states=self.states,
            parameters=self.parameters,
            noise=self.noises,
            next=self.next,
            initial=self.initial,
            outputs=self.outputs,
            step=self.dt,
        )


def white_noise(draft: Draft, kind: str, walk: str) -> Any:
    """Random walk of the integral over a step; `walk` names its parameter."""
    return draft.parameter(walk, 3) * ca.sqrt(draft.dt) * draft.noise(f"{kind}_white", 3)


def add_bias(draft: Draft, kind: str, bias: str) -> tuple[Any, Any]:
    """Add the bias of a triad: its value now, and that at the end of the step.

    Raises
    ------
    ValueError
        If `bias` is not a known process.
    """
    if bias not in BIASES:
        raise ValueError(f"bias must be one of {BIASES}, got '{bias}'")
    b, drive = draft.state(f"{kind}_bias_b", 3), draft.noise(f"{kind}_bias_noise", 3)
    sigma0 = draft.parameter(f"{kind}_bias_sigma0", 3)
    walk = draft.parameter(f"{kind}_bias_walk", 3)
    draft.initial[f"{kind}_bias_b"] = sigma0 * drive
    if bias == "gauss-markov":
        tau = draft.parameter(f"{kind}_bias_time")
        driven = walk * ca.sqrt(tau / 2)
        following = wandering(b, ca.if_else(walk > 0, driven, sigma0), tau, drive, draft.dt)
    else:
        following = b + walk * ca.sqrt(draft.dt) * drive
    draft.next[f"{kind}_bias_b"] = following
    if bias != "both":
        return b, following
    sigma, tau = draft.parameter(f"{kind}_bias_sigma", 3), draft.parameter(f"{kind}_bias_time")
    part = add_markov(draft, f"{kind}_bias_correlated", sigma, tau)
    return b + part[0], following + part[1]


def add_markov(draft: Draft, name: str, sigma: Any, tau: Any) -> tuple[Any, Any]:
    """Add a Gauss-Markov process in its steady state: its value now, and at the end of the step."""
    x, drive = draft.state(name, 3), draft.noise(f"{name}_noise", 3)
    draft.initial[name] = sigma * drive
    draft.next[name] = following = wandering(x, sigma, tau, drive, draft.dt)
    return x, following
