r"""How an inertial navigator moves, and its error: what every filter on an IMU is built on.

State: position and velocity, attitude, and the biases of both triads. The estimate is mechanized
(`terrafix.models.motion.strapdown`) with increments less the biases. Error, truth minus estimate:
:math:`(\delta r, \delta v, \theta, \delta b_a, \delta b_g)`, with :math:`\theta` in e axes,

.. math::
    q_{be} = \hat q_{be} \otimes \delta q(\theta), \qquad
    C_{eb} = (I + [\theta \times])\, \hat C_{eb}.

It moves, with :math:`\hat f` the specific force in e axes and :math:`G` the gradient of gravity, by

.. math::
    \dot{\delta r} = \delta v, \qquad
    \dot{\delta v} = G\, \delta r - 2\, \omega \times \delta v - [\hat f \times]\, \theta
        - \hat C_{eb} (\delta b_a + n_a), \qquad
    \dot\theta = -\omega \times \theta - \hat C_{eb} (\delta b_g + n_g).

The signs of [1]_, :math:`+[f \times]` and :math:`+C n_g`, belong to the opposite angle,
:math:`C_{true} = (I - [\delta\theta \times])\, \hat C`. What increments measure is truth plus bias
plus noise.

References
----------
.. [1] The aircraft paper (`docs/aircraft.md`), eqs. (25)-(36) and (44).
.. [2] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems",
       2nd edition, 2013, section 14.2.3 (ECEF-frame state propagation).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from terrafix.models.filters.error_state import ErrorState, Values, rotation, vector
from terrafix.models.filters.process import Process
from terrafix.models.filters.spacecraft import transition_matrix
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import rotation_matrix
from terrafix.models.motion.strapdown import Motion, mechanized, rotation_rate

TRANSITIONS = ("closed", "derived")
"""Names of the transitions."""

INERTIAL = (
    vector("r_e", unit="m", frame="e"),
    vector("v_e", unit="m/s", frame="e"),
    rotation("q_be", side="right", frame="b"),  # as ports have it; its error is in e axes
    vector("accel_bias_b", unit="m/s^2", frame="b"),
    vector("gyro_bias_b", unit="rad/s", frame="b"),
)
"""Blocks that an inertial navigator begins with: position, velocity, attitude, biases."""


def inertial_process(
    state: ErrorState,
    earth: str = "wgs84",
    *,
    walks: Mapping[str, str] | None = None,
    decays: Mapping[str, tuple[str, str]] | None = None,
    transition: str = "closed",
) -> Process:
    """Strapdown mechanization of an estimate, and how its error moves.

    Parameters
    ----------
    state : ErrorState
        Begins with `INERTIAL`; blocks after those drive themselves, or stay.
    earth : {"wgs84", "flat"}
    walks, decays : mapping
        As of `Process`: blocks that are random walks or Gauss-Markov processes, the biases of the
        IMU among them.
    transition : {"closed", "derived"}
        The closed form below, or the derivative of the step, which it is compared with.

    Returns
    -------
    Process
        Reads ``delta_v_b`` [m/s] and ``delta_theta_b`` [rad]; parameters
        ``velocity_random_walk`` [m/s/s^0.5] and ``angle_random_walk`` [rad/s^0.5].

    Raises
    ------
    ValueError
        If a choice is not known, or the state begins otherwise.

    Notes
    -----
    The closed form takes the middle of the attitudes at both ends of the step and the gradient of
    a sphere; what it leaves out is of the second order in the rotation of a step.
    """
    rotation_rate(earth)
    if transition not in TRANSITIONS:
        raise ValueError(f"transition must be one of {TRANSITIONS}, got '{transition}'")
    first = tuple(state)[: len(INERTIAL)]
    if first != INERTIAL:
        names = ", ".join(block.name for block in INERTIAL)
        raise ValueError(f"an inertial state begins with {names}; this one is {state.text}")
    walks, decays = dict(walks or {}), dict(decays or {})

    def step(values: Values, given: Values, dt: Any, _: Any) -> dict[str, Any]:
        dv, dtheta = _unbiased(values, given, dt)
        return mechanized(_motion(values), dv, dtheta, dt, earth).named

    def closed(values: Values, end: Values, given: Values, dt: Any) -> Any:
        kept = [ca.SX.eye(b.size) for b in state]
        for k, block in enumerate(state):
            if block.name in decays:
                kept[k] *= ca.exp(-dt / given[decays[block.name][0]])
        phi = ca.diagcat(ca.SX(9, 9), *kept[3:])
        phi[:9, :15] = _moved(values, end, given, dt, earth)
        return phi

    def spread(values: Values, end: Values, given: Values, dt: Any) -> Any:
        rest = state.size - 9
        return ca.diagcat(_spread(values, end, given, dt), ca.SX(rest, rest))

    return Process(
        step=step,
        walks=walks,
        decays=decays,
        inputs={"delta_v_b": 3, "delta_theta_b": 3},
        parameters={"velocity_random_walk": 1, "angle_random_walk": 1},
        transition=closed if transition == "closed" else None,
        spread=spread,
    )


def _motion(values: Values) -> Motion:
    return Motion(values["r_e"], values["v_e"], values["q_be"])


def _unbiased(values: Values, given: Values, dt: Any) -> tuple[Any, Any]:
    """Increments less what the biases add to them."""
    dv = given["delta_v_b"] - dt * values["accel_bias_b"]
    return dv, given["delta_theta_b"] - dt * values["gyro_bias_b"]


def _middle(values: Values, end: Values, given: Values, dt: Any) -> tuple[Any, Any]:
    """Body to e in the middle of a step, and the cross product matrix of the increment in e."""
    C = (rotation_matrix(values["q_be"]) + rotation_matrix(end["q_be"])).T / 2
    return C, ca.skew(ca.mtimes(C, _unbiased(values, given, dt)[0]))


def _moved(values: Values, end: Values, given: Values, dt: Any, earth: str) -> Any:
    """Transition (9, 15) of position, velocity and attitude errors."""
    rate = rotation_rate(earth)
    C, u = _middle(values, end, given, dt)
    motion = transition_matrix(_gradient(values["r_e"], earth), rate, dt)
    zero = ca.SX(3, 3)
    by_attitude = ca.vertcat(-dt / 2 * u, -u)
    by_accel = ca.vertcat(-dt * dt / 2 * C, -dt * C)
    by_gyro = ca.vertcat(zero, dt / 2 * ca.mtimes(u, C))
    turned = ca.SX.eye(3)
    if rate:
        turned[0, 1], turned[1, 0] = ca.sin(rate * dt), -ca.sin(rate * dt)
        turned[0, 0] = turned[1, 1] = ca.cos(rate * dt)
    return ca.vertcat(
        ca.horzcat(motion, by_attitude, by_accel, by_gyro),
        ca.horzcat(zero, zero, turned, zero, -dt * C),
    )


def _gradient(r_e: Any, earth: str) -> Any:
    """Gradient (3, 3) of gravity [1/s^2]: a sphere's, and the centrifugal part."""
    rate = rotation_rate(earth)
    if not rate:
        return ca.SX(3, 3)
    up = r_e / ca.norm_2(r_e)
    schuler = EARTH.mu / ca.norm_2(r_e) ** 3
    return schuler * (3 * ca.mtimes(up, up.T) - ca.SX.eye(3)) + ca.diag([rate**2, rate**2, 0])


def _spread(values: Values, end: Values, given: Values, dt: Any) -> Any:
    """Covariance (9, 9) that the white noise of the increments adds."""
    _, u = _middle(values, end, given, dt)
    accel, gyro = given["velocity_random_walk"] ** 2, given["angle_random_walk"] ** 2
    eye, squared = ca.SX.eye(3), gyro * ca.mtimes(u, u.T)
    rr = dt**3 * (accel / 3 * eye + squared / 20)
    rv = dt**2 * (accel / 2 * eye + squared / 8)
    vv = dt * (accel * eye + squared / 3)
    rt, vt = -dt * dt / 6 * gyro * u, -dt / 2 * gyro * u
    return ca.blockcat([[rr, rv, rt], [rv, vv, vt], [rt.T, vt.T, dt * gyro * eye]])
