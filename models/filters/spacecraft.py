r"""Multiplicative extended Kalman filter of a spacecraft in Earth-fixed axes.

State: position and velocity, Earth-fixed, and the quaternion of the antenna's misalignment. Error
state, truth minus estimate: :math:`(\delta r, \delta v, \delta\mu)`, with
:math:`q_\mu = \delta q(\delta\mu) \otimes \hat q_\mu`. Its dynamics between fixes are

.. math::
    \dot v = g(r) - \omega \times (\omega \times r) - 2\, \omega \times v + C_{eb} f_b, \qquad
    A = \begin{bmatrix} 0 & I \\ G & -2 [\omega \times] \end{bmatrix}, \quad
    G = \frac{\partial}{\partial r} \bigl( g - \omega \times (\omega \times r) \bigr),

with white acceleration of density :math:`Q_a` and a misalignment that walks with :math:`Q_m`.

References
----------
.. [1] B. S. Pogorelsky, R. Zanetti, J. Chen, S. Jenkins, "Synthetic Aperture Radar Based
       Spacecraft Terrain Relative Navigation", eqs. (8)-(15), (33)-(43). We differ: the state is
       integrated by Runge-Kutta instead of eqs. (10)-(11), whose error is 7.7 m after 600 s at
       100 Hz; the transition is the exponential of :math:`A` instead of eq. (13), which lacks
       the Coriolis block; the process noise is that of a white acceleration, while eqs. (12) and
       (15) together count the step twice.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.batch import over_members
from terrafix.models.core.model import Model, rk4
from terrafix.models.core.symmetric import mirrored
from terrafix.models.filters.updates import Measurement, update_rule
from terrafix.models.geometry.antenna import nominal_antenna
from terrafix.models.geometry.frames import earth_rate_cross
from terrafix.models.geometry.quaternion import (
    from_rotation_vector,
    inverse,
    normalized,
    product,
    rotation_matrix,
    rotation_vector,
)
from terrafix.models.motion.gravity import gravity_acceleration
from terrafix.models.sensors.sar import predicted_measurement

TRANSITIONS = ("exact", "printed")
"""Names of the transition matrices."""

JACOBIANS = ("exact", "wrong-sign")
"""Names of the derivatives of the measurement; the second is a negative control."""

REASONS = (
    "accepted",
    "gate",
    "innovation covariance not positive definite",
    "nothing measured",
    "not of this instant",
)
"""What became of a fix, indexed by ``innovation.reason``."""

_SAME_INSTANT = 1e-6
"""Largest difference of time between a fix and the prior that it corrects [s]."""

ESTIMATE_FIELDS = {"r_e": (3, 1), "v_e": (3, 1), "q_mu": (4, 1), "P": (9, 9)}
"""Shapes of the fields of an estimate."""


def estimate_symbols(message: str) -> dict[str, Any]:
    """Symbols of an estimate, keyed by field; named for `message`."""
    return {k: ca.SX.sym(f"{message}_{k}", *shape) for k, shape in ESTIMATE_FIELDS.items()}


def mekf_predict_model(gravity: str = "j2", transition: str = "exact") -> Model:
    """Dead reckoning between fixes, and the covariance of its error.

    Parameters
    ----------
    gravity : {"j2", "two-body"}
        Gravity field of the filter.
    transition : {"exact", "printed"}
        Transition matrix: the exponential of A, or eq. (13) of [1]_, without Coriolis block, which
        makes the filter inconsistent and is kept as a negative control.

    Returns
    -------
    Model
        Inputs ``delta_v_b`` (3,) [m/s], ``q_be`` (4,); ``posterior.r_e``, ``.v_e``, ``.q_mu``,
        ``.P`` (9, 9) and the flag ``posterior.fresh``, which makes the step begin there; for the
        start alone ``start.r_e``, ``start.v_e``, ``start.P`` (6, 6). Parameters ``mu``, ``radius``,
        ``j2``, ``rotation_rate``, ``accel_psd`` [m^2/s^3], ``misalignment_psd`` [rad^2/s],
        ``misalignment_sigma0`` [rad]. Outputs ``prior.r_e``, ``.v_e``, ``.q_mu``, ``.P``.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    gravity_field = gravity_acceleration(gravity)
    own, posterior = estimate_symbols("own"), estimate_symbols("posterior")
    fresh, dt = ca.SX.sym("posterior_fresh"), ca.SX.sym("dt")
    delta_v_b, q_be = ca.SX.sym("delta_v_b", 3), ca.SX.sym("q_be", 4)
    names = ("mu", "radius", "j2", "rotation_rate")
    constants = {name: ca.SX.sym(name) for name in names}
    mu, radius, j2, rate = constants.values()
    noise_names = ("accel_psd", "misalignment_psd", "misalignment_sigma0")
    noise = {name: ca.SX.sym(name) for name in noise_names}

    def local_gravity(r: Any) -> Any:
        """Gravity and centrifugal acceleration, eq. (9)."""
        return gravity_field(r, mu, radius, j2) + rate * rate * ca.vertcat(r[0], r[1], 0)

    begin = {k: ca.if_else(fresh > 0.5, posterior[k], own[k]) for k in own}
    r_end, v_end = _mechanized(
        begin["r_e"], begin["v_e"], _earth_from_body(q_be, delta_v_b), local_gravity, rate, dt
    )
    r_middle = ca.SX.sym("r_middle", 3)
    gradient = ca.Function(
        "gradient",
        [r_middle, *constants.values()],
        [mirrored(ca.jacobian(local_gravity(r_middle), r_middle))],
    )
    G = gradient((begin["r_e"] + r_end) / 2, *constants.values())
    phi = transition_matrix(G, rate, dt, transition)
    P_end = _propagated(begin["P"], phi, noise["accel_psd"], noise["misalignment_psd"], dt)
    start = {
        "start.r_e": ca.SX.sym("start_r_e", 3),
        "start.v_e": ca.SX.sym("start_v_e", 3),
        "start.P": ca.SX.sym("start_P", 6, 6),
    }
    variance0 = noise["misalignment_sigma0"] ** 2
    return Model(
        "mekf_predict",
        inputs={
            "delta_v_b": delta_v_b,
            "q_be": q_be,
            **{f"posterior.{k}": s for k, s in posterior.items()},
            "posterior.fresh": fresh,
            **start,
        },
        states=own,
        parameters={**constants, **noise},
        next={"r_e": r_end, "v_e": v_end, "q_mu": begin["q_mu"], "P": P_end},
        initial={
            "r_e": start["start.r_e"],
            "v_e": start["start.v_e"],
            "q_mu": ca.SX([0, 0, 0, 1]),
            "P": ca.diagcat(mirrored(start["start.P"]), variance0 * ca.SX.eye(3)),
        },
        outputs={f"prior.{k}": s for k, s in own.items()},
        step=dt,
    )


def _earth_from_body(q_be: Any, vector_b: Any) -> Any:
    return ca.mtimes(rotation_matrix(q_be).T, vector_b)


def _mechanized(r: Any, v: Any, delta_v_e: Any, gravity: Any, rate: Any, dt: Any) -> Any:
    """Advance position and velocity, two (3,), over a step.

    Half the sensed increment is applied before and half after a Runge-Kutta step of eq. (8)
    without it: of second order in the sensed acceleration, and no division by the step.
    """

    def derivative(_: Any, x: Any) -> Any:
        return ca.vertcat(x[3:], gravity(x[:3]) - 2 * earth_rate_cross(rate, x[3:]))

    end = rk4(derivative, ca.vertcat(r, v + delta_v_e / 2), dt)
    return end[:3], end[3:] + delta_v_e / 2


def transition_matrix(G: Any, rate: Any, dt: Any, transition: str = "exact") -> Any:
    r"""Transition (6, 6) of position and velocity errors over a step.

    "exact" is the series of :math:`e^{A \Delta t}` for a constant gradient :math:`G` (3, 3), block
    by block to where the next term is below 1e-12 in SI units at steps up to 1 s in Earth orbits:

    .. math::
        \Phi_{rr} = I + \tfrac{\Delta t^2}{2} G + \tfrac{\Delta t^3}{6} \Omega G, \qquad
        \Phi_{vr} = \Delta t\, G + \tfrac{\Delta t^2}{2} \Omega G, \\
        \Phi_{rv} = \Delta t\, I + \tfrac{\Delta t^2}{2} \Omega
            + \tfrac{\Delta t^3}{6} (G + \Omega^2)
            + \tfrac{\Delta t^4}{24} (G \Omega + \Omega G + \Omega^3), \qquad
        \Phi_{vv} = \tfrac{d}{d \Delta t} \Phi_{rv}, \qquad \Omega = -2 [\omega \times].

    "printed" is eq. (13) of the paper.

    Raises
    ------
    ValueError
        If `transition` is not a known choice.
    """
    eye = ca.SX.eye(3)
    if transition == "printed":
        return ca.blockcat([[eye + dt * dt / 2 * G, dt * eye], [dt * G, eye]])
    if transition != "exact":
        raise ValueError(f"transition must be one of {TRANSITIONS}, got '{transition}'")
    omega = ca.SX(3, 3)
    omega[0, 1], omega[1, 0] = 2 * rate, -2 * rate
    turned = ca.mtimes(omega, G)
    second = G + ca.mtimes(omega, omega)
    third = ca.mtimes(G, omega) + turned + ca.mtimes(omega, ca.mtimes(omega, omega))
    rr = eye + dt * dt / 2 * (G + dt / 3 * turned)
    rv = dt * (eye + dt / 2 * (omega + dt / 3 * (second + dt / 4 * third)))
    vr = dt * (G + dt / 2 * turned)
    vv = eye + dt * (omega + dt / 2 * (second + dt / 3 * third))
    return ca.blockcat([[rr, rv], [vr, vv]])


def _propagated(P: Any, phi: Any, accel_psd: Any, misalignment_psd: Any, dt: Any) -> Any:
    """Covariance (9, 9) after a step: white acceleration, walking misalignment."""
    P = mirrored(P)
    moved = ca.mtimes(phi, P[:6, :])
    eye = ca.SX.eye(3)
    cross = accel_psd * dt * dt / 2 * eye
    Q = ca.blockcat([[accel_psd * dt**3 / 3 * eye, cross], [cross, accel_psd * dt * eye]])
    state = ca.mtimes(moved[:, :6], phi.T) + Q
    mount = P[6:, 6:] + misalignment_psd * dt * eye
    return mirrored(ca.blockcat([[state, moved[:, 6:]], [moved[:, 6:].T, mount]]))


def mekf_correct_model(
    update: str = "ekf", in_track: str = "speed", jacobian: str = "exact"
) -> Model:
    r"""Correction of the prior by a fix: update, underweighting, gate.

    The reported position of the pixel has covariance D; it enters the innovation as
    :math:`B = \tilde H D \tilde H^T`, with :math:`\tilde H` the derivative by that position,
    eqs. (33)-(34) of [1]_.

    Parameters
    ----------
    update : {"ekf", "iterated", "unscented"}
        How the measurement is weighed. The paper's update leaves the covariance centered on the
        prior misalignment, an error of second order; the other two center it on the estimate.
    in_track : {"speed", "effective"}
        What the fix's fourth element is: see `terrafix.models.sensors.sar`.
    jacobian : {"exact", "wrong-sign"}
        Derivative of the measurement; with the misalignment's part reversed as a negative control.

    Returns
    -------
    Model
        Inputs ``prior.r_e``, ``.v_e``, ``.q_mu``, ``.P``; ``fix.y`` (4,), ``fix.r_f_e`` (3,),
        ``fix.R`` (4, 4), ``fix.D`` (3, 3), ``fix.present`` (4,), 1 where an element was measured,
        the flag ``fix.fresh`` and the time ``fix.t`` [s], which must be that of the prior; ``q_be``
        (4,). Parameters ``look``, ``squint`` [rad],
        ``underweighting``, the factor applied to the first ``underweighted_updates`` fixes,
        accepted or not; ``gate`` (4,), the largest normalized innovation squared accepted with 1
        to 4 elements (infinity: all). Outputs ``estimate.r_e``, ``.v_e``, ``.q_mu``, ``.P``: the
        posterior where there is one, else the prior; ``posterior.*``, the same and
        ``posterior.valid``; ``innovation.residual`` (4,), ``innovation.sigma`` (4,),
        ``innovation.nis``, ``innovation.dof``, the number of elements present,
        ``innovation.accepted``, ``innovation.valid``, and ``innovation.reason``, one of
        `REASONS`. Residual and sigma are zero and one for absent elements and without a fix; the
        normalized innovation squared is that of the covariance without underweighting.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    if jacobian not in JACOBIANS:
        raise ValueError(f"jacobian must be one of {JACOBIANS}, got '{jacobian}'")
    rule = update_rule(update)
    prior = estimate_symbols("prior")
    shapes = {"y": (4, 1), "r_f_e": (3, 1), "R": (4, 4), "D": (3, 3), "present": (4, 1)}
    fix = {k: ca.SX.sym(f"fix_{k}", *shape) for k, shape in shapes.items()}
    fresh, q_be = ca.SX.sym("fix_fresh"), ca.SX.sym("q_be", 4)
    fix_t, time = ca.SX.sym("fix_t"), ca.SX.sym("time")
    names = ("look", "squint", "underweighting", "underweighted_updates")
    parameters = {name: ca.SX.sym(name) for name in names}
    look, squint, underweighting, underweighted_updates = parameters.values()
    gate, n_updates = ca.SX.sym("gate", 4), ca.SX.sym("n_updates")
    inputs = {
        **{f"prior.{k}": s for k, s in prior.items()},
        **{f"fix.{k}": s for k, s in fix.items()},
        "fix.fresh": fresh,
        "fix.t": fix_t,
        "q_be": q_be,
    }

    q_sb = nominal_antenna(look, squint)
    beta = ca.if_else(n_updates <= underweighted_updates, underweighting, 0.0)
    arrived = fresh > 0.5
    fix["present"] = ca.if_else(arrived, fix["present"], 0.0)
    measurement = _measurement(prior, fix, q_be, q_sb, in_track, jacobian)
    outcome = rule(mirrored(prior["P"]), measurement, beta)
    dof = ca.sum1(fix["present"] > 0.5)
    threshold = sum(ca.if_else(dof == k + 1, gate[k], 0.0) for k in range(4))
    reason = ca.if_else(
        dof < 0.5,
        REASONS.index("nothing measured"),
        ca.if_else(
            ca.logic_not(outcome.positive),
            REASONS.index("innovation covariance not positive definite"),
            ca.if_else(outcome.nis <= threshold, 0, REASONS.index("gate")),
        ),
    )
    # between a pixel and a prior of another instant lie meters per millisecond
    reason = ca.if_else(
        ca.fabs(fix_t - time) <= _SAME_INSTANT, reason, REASONS.index("not of this instant")
    )
    accepted = ca.logic_and(arrived, reason == 0)
    corrected = {
        "r_e": prior["r_e"] + outcome.correction[:3],
        "v_e": prior["v_e"] + outcome.correction[3:6],
        "q_mu": normalized(product(from_rotation_vector(outcome.correction[6:]), prior["q_mu"])),
        "P": outcome.P if update == "ekf" else _recentered(outcome.P, outcome.correction[6:]),
    }
    posterior = {k: ca.if_else(accepted, corrected[k], prior[k]) for k in prior}
    return Model(
        f"mekf_correct_{update}_{in_track}" + ("" if jacobian == "exact" else "_wrong"),
        inputs=inputs,
        states={"n_updates": n_updates},
        parameters={**parameters, "gate": gate},
        next={"n_updates": n_updates + arrived},
        initial={"n_updates": ca.if_else(arrived, 1.0, 0.0)},
        outputs={
            **{f"estimate.{k}": s for k, s in posterior.items()},
            **{f"posterior.{k}": s for k, s in posterior.items()},
            "posterior.valid": accepted,
            "innovation.residual": outcome.residual,
            "innovation.sigma": ca.sqrt(ca.fmax(ca.diag(outcome.S), 0.0)),
            "innovation.nis": outcome.nis,
            "innovation.dof": dof,
            "innovation.accepted": accepted,
            "innovation.valid": arrived,
            "innovation.reason": reason,
        },
        time=time,
    )


def _recentered(P: Any, dmu: Any) -> Any:
    r"""Express a covariance (9, 9) about the corrected misalignment instead of the prior one.

    The error :math:`\delta` about the prior and :math:`\eta` about the estimate are related by
    :math:`\delta q(\delta\mu + \delta) = \delta q(\eta) \otimes \delta q(\delta\mu)`.
    """
    delta = ca.SX.sym("delta", 3)
    corrected = from_rotation_vector(dmu)
    turn = rotation_vector(product(from_rotation_vector(dmu + delta), inverse(corrected)))
    by_delta = ca.substitute(ca.jacobian(turn, delta), delta, ca.SX.zeros(3))
    J = ca.diagcat(ca.SX.eye(6), by_delta)
    return mirrored(ca.mtimes(J, ca.mtimes(P, J.T)))


def _measurement(
    prior: Any, fix: Any, q_be: Any, q_sb: Any, in_track: str, jacobian: str
) -> Measurement:
    """Express the fix as a measurement of the error of the prior."""
    error, pixel = ca.SX.sym("error", 9), ca.SX.sym("pixel", 3)
    y = predicted_measurement(
        prior["r_e"] + error[:3],
        prior["v_e"] + error[3:6],
        prior["q_mu"],
        error[6:],
        q_be,
        q_sb,
        pixel,
        in_track,
    )
    by_error, by_pixel = ca.jacobian(y, error), ca.jacobian(y, pixel)
    if jacobian == "wrong-sign":
        by_error = ca.horzcat(by_error[:, :6], -by_error[:, 6:])

    def at(expression: Any) -> Any:
        return lambda e: ca.substitute(
            expression, ca.vertcat(error, pixel), ca.vertcat(e, fix["r_f_e"])
        )

    H_pixel = at(by_pixel)

    def noise(e: Any) -> Any:
        H = H_pixel(e)
        return fix["R"] + ca.mtimes(H, ca.mtimes(fix["D"], H.T))

    return Measurement(fix["y"], at(y), at(by_error), noise, fix["present"])


def navigation_error(
    r_e: Any, v_e: Any, q_mu: Any, r_e_hat: Any, v_e_hat: Any, q_mu_hat: Any
) -> Any:
    """Error of an estimate as reported, estimate minus truth, in the coordinates of P.

    Parameters
    ----------
    r_e, v_e : SX, shape (3,)
        True position [m] and velocity [m/s].
    q_mu : SX, shape (4,)
        True misalignment.
    r_e_hat, v_e_hat, q_mu_hat : SX
        The estimates.

    Returns
    -------
    SX, shape (9,)
        Position [m], velocity [m/s], misalignment [rad]; the last is the rotation vector that
        takes the true to the estimated antenna axes.
    """
    turn = rotation_vector(product(q_mu_hat, inverse(q_mu)))
    return ca.vertcat(r_e_hat - r_e, v_e_hat - v_e, turn)


navigation_error_array = over_members(navigation_error, (3,), (3,), (4,), (3,), (3,), (4,))
