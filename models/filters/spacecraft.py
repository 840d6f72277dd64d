r"""Multiplicative extended Kalman filter of a spacecraft in Earth-fixed axes.

State: position and velocity, Earth-fixed, and the quaternion of the antenna's misalignment. Error
state, truth minus estimate: :math:`(\delta r, \delta v, \delta\mu)`, with
:math:`q_\mu = \delta q(\delta\mu) \otimes \hat q_\mu`. Its dynamics between fixes are

.. math::
    \dot v = g(r) - \omega \times (\omega \times r) - 2\, \omega \times v + C_{eb} f_b, \qquad
    A = \begin{bmatrix} 0 & I \\ G & -2 [\omega \times] \end{bmatrix}, \quad
    G = \frac{\partial}{\partial r} \bigl( g - \omega \times (\omega \times r) \bigr),

with white acceleration of density :math:`Q_a` and a misalignment that walks with :math:`Q_m`.

A field of higher degree adds its part beyond J2 (and Sun, Moon and tide, where they are chosen) as
one velocity increment over a step, taken at its middle: one evaluation of the field, an error of
second order in the step. The Earth then turns about the pole that is given. The gradient :math:`G`
stays that of central gravity and J2: what is beyond has 8e-11 / s^2 against 1.1e-6 / s^2, which
over ten minutes is a centimeter for an error of a kilometer.

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

from dataclasses import replace
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model, rk4
from terrafix.models.core.symmetric import mirrored
from terrafix.models.filters.error_state import ErrorState, Values, rotation, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.models import correct_model, predict_model
from terrafix.models.filters.process import Process
from terrafix.models.filters.updates import Measurement
from terrafix.models.geometry.antenna import nominal_antenna
from terrafix.models.geometry.frames import earth_rate_cross
from terrafix.models.geometry.quaternion import from_rotation_vector, rotation_matrix
from terrafix.models.motion.gravity import gravity_acceleration
from terrafix.models.motion.satellite import Forces, central_gravity, further_gravity
from terrafix.models.motion.surroundings import SIZES, Surroundings, surroundings_at
from terrafix.models.sensors.sar import predicted_measurement

TRANSITIONS = ("exact", "printed")
"""Names of the transition matrices."""

JACOBIANS = ("exact", "wrong-sign")
"""Names of the derivatives of the measurement; the second is a negative control."""

STATE = ErrorState(
    vector("r_e", unit="m", frame="e"),
    vector("v_e", unit="m/s", frame="e"),
    rotation("q_mu", side="left", frame="s"),
)
"""Position, velocity, and the antenna's misalignment: nominal to actual axes."""


def mekf_predict_model(
    gravity: str | Forces = "j2", transition: str = "exact", *, smoothed: bool = False
) -> Model:
    """Dead reckoning between fixes, and the covariance of its error.

    Parameters
    ----------
    gravity : {"j2", "two-body"} or Forces
        Gravity field of the filter, or a field of higher degree with Sun, Moon and tide: see
        `spacecraft_process`.
    transition : {"exact", "printed"}
        Transition matrix: the exponential of A, or eq. (13) of [1]_, without Coriolis block, which
        makes the filter inconsistent and is kept as a negative control.
    smoothed : bool
        Put out the transition of the error too, as `predict_model` does.

    Returns
    -------
    Model
        Inputs ``delta_v_b`` (3,) [m/s], ``q_be`` (4,); ``posterior.r_e``, ``.v_e``, ``.q_mu``,
        ``.P`` (9, 9) and the flag ``posterior.fresh``, which makes the step begin there; for the
        start alone ``start.r_e``, ``start.v_e``, ``start.P`` (6, 6). Parameters ``mu``, ``radius``,
        ``j2``, ``rotation_rate``, ``accel_psd`` [m^2/s^3], ``misalignment_psd`` [rad^2/s],
        ``misalignment_sigma0`` [rad], ``misalignment0`` (3,) [rad]: what it is taken for at the
        start, a rotation vector. Outputs ``prior.r_e``, ``.v_e``, ``.q_mu``, ``.P``.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    model = predict_model(
        "mekf_predict",
        STATE,
        spacecraft_process(gravity, transition),
        told=("r_e", "v_e"),
        sigmas={"q_mu": "misalignment_sigma0"},
        smoothed=smoothed,
    )
    known = ca.SX.sym("misalignment0", 3)
    return replace(
        model,
        parameters={**model.parameters, "misalignment0": known},
        initial={**model.initial, "q_mu": from_rotation_vector(known)},
    )


def spacecraft_process(gravity: str | Forces = "j2", transition: str = "exact") -> Process:
    """Dead reckoning in Earth-fixed axes, with a closed form of its transition.

    Parameters
    ----------
    gravity : {"j2", "two-body"} or Forces
        Gravity field of the filter. Of forces, gravity of the Earth, Sun, Moon and tide are taken:
        what is felt comes from the accelerometers. The constants of a field from a file are
        numbers, and there is a parameter ``pole`` (2,) [rad], its x and y; with Sun, Moon or tide
        there are inputs ``surroundings.*`` in the place of it and of ``rotation_rate``.
    transition : {"exact", "printed", "derived"}
        As of `transition_matrix`, or derived from the step: what the closed form is compared with.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    if isinstance(gravity, Forces):
        return _forced_process(gravity, transition)
    gravity_field = gravity_acceleration(gravity)
    names = ("mu", "radius", "j2", "rotation_rate")

    def local_gravity(r: Any, given: Values) -> Any:
        """Gravity and centrifugal acceleration, eq. (9)."""
        rate = given["rotation_rate"]
        plain = gravity_field(r, given["mu"], given["radius"], given["j2"])
        return plain + rate * rate * ca.vertcat(r[0], r[1], 0)

    def step(values: Values, given: Values, dt: Any, _: Any) -> dict[str, Any]:
        sensed = _earth_from_body(given["q_be"], given["delta_v_b"])
        r, v = _mechanized(
            values["r_e"],
            values["v_e"],
            sensed,
            lambda r: local_gravity(r, given),
            given["rotation_rate"],
            dt,
        )
        return {"r_e": r, "v_e": v}

    def closed(values: Values, end: Values, given: Values, dt: Any) -> Any:
        r = ca.SX.sym("r_middle", 3)
        constants = [given[name] for name in names]
        symbols = {name: ca.SX.sym(name) for name in names}
        gradient = ca.Function(
            "gradient",
            [r, *symbols.values()],
            [mirrored(ca.jacobian(local_gravity(r, symbols), r))],
        )
        G = gradient((values["r_e"] + end["r_e"]) / 2, *constants)
        phi = transition_matrix(G, given["rotation_rate"], dt, transition)
        return ca.diagcat(phi, ca.SX.eye(3))

    _check_transition(transition)
    return Process(
        step=step,
        walks={"q_mu": "misalignment_psd"},
        inputs={"delta_v_b": 3, "q_be": 4},
        parameters={**dict.fromkeys(names, 1), "accel_psd": 1},
        transition=None if transition == "derived" else closed,
        spread=_spread,
    )


def _forced_process(forces: Forces, transition: str) -> Process:
    """The same about a pole, with a field of higher degree, Sun, Moon and tide."""
    gravity, constants = central_gravity(forces)

    def turning(given: Values) -> Any:
        if forces.surrounded:
            return given["surroundings.omega_e"]
        pole = given["pole"]
        return given["rotation_rate"] * ca.vertcat(pole[0], -pole[1], 1)

    def published(given: Values) -> dict[str, Any]:
        return {name: given[f"surroundings.{name}"] for name in SIZES}

    def local_gravity(r: Any, given: Values) -> Any:
        omega = turning(given)
        return gravity(r, given) - ca.cross(omega, ca.cross(omega, r))

    def step(values: Values, given: Values, dt: Any, time: Any) -> dict[str, Any]:
        r, v, omega = values["r_e"], values["v_e"], turning(given)

        def fall(r: Any, v: Any) -> Any:
            return local_gravity(r, given) - 2 * ca.cross(omega, v)

        middle = r + dt / 2 * (v + dt / 4 * fall(r, v))
        around = surroundings_at(published(given), time - dt / 2) if forces.surrounded else None
        increment = _earth_from_body(given["q_be"], given["delta_v_b"])
        increment += dt * further_gravity(middle, forces, around or Surroundings(omega, None, None))
        end = rk4(
            lambda _, x: ca.vertcat(x[3:], fall(x[:3], x[3:])),
            ca.vertcat(r, v + increment / 2),
            dt,
        )
        return {"r_e": end[:3], "v_e": end[3:] + increment / 2}

    def closed(values: Values, end: Values, given: Values, dt: Any) -> Any:
        r = ca.SX.sym("r_middle", 3)
        G = mirrored(ca.jacobian(local_gravity(r, given), r))
        G = ca.substitute(G, r, (values["r_e"] + end["r_e"]) / 2)
        return ca.diagcat(transition_matrix(G, turning(given)[2], dt, transition), ca.SX.eye(3))

    _check_transition(transition)
    turned = {} if forces.surrounded else {"rotation_rate": 1, "pole": 2}
    around = {f"surroundings.{name}": n for name, n in SIZES.items()} if forces.surrounded else {}
    return Process(
        step=step,
        walks={"q_mu": "misalignment_psd"},
        inputs={"delta_v_b": 3, "q_be": 4, **around},
        parameters={**dict.fromkeys(constants, 1), **turned, "accel_psd": 1},
        transition=None if transition == "derived" else closed,
        spread=_spread,
    )


def _check_transition(transition: str) -> None:
    if transition not in (*TRANSITIONS, "derived"):
        raise ValueError(f"transition must be one of {TRANSITIONS}, got '{transition}'")


def _spread(_: Values, __: Values, given: Values, dt: Any) -> Any:
    """A white acceleration, of constant axes over a step."""
    density, eye = given["accel_psd"], ca.SX.eye(3)
    cross = density * dt * dt / 2 * eye
    Q = ca.blockcat([[density * dt**3 / 3 * eye, cross], [cross, density * dt * eye]])
    return ca.diagcat(Q, ca.SX(3, 3))


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
        `terrafix.models.filters.measurement.REASONS`. Residual and sigma are zero and one for
        absent elements and without a fix; the
        normalized innovation squared is that of the covariance without underweighting.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    if jacobian not in JACOBIANS:
        raise ValueError(f"jacobian must be one of {JACOBIANS}, got '{jacobian}'")
    return correct_model(
        f"mekf_correct_{update}_{in_track}" + ("" if jacobian == "exact" else "_wrong"),
        STATE,
        sar_observation(in_track),
        update,
        recentered=update != "ekf",
        altered=None if jacobian == "exact" else _wrong_sign,
    )


def _wrong_sign(measurement: Measurement) -> Measurement:
    place = STATE.places["q_mu"].start

    def wrong(error: Any) -> Any:
        H = measurement.jacobian(error)
        return ca.horzcat(H[:, :place], -H[:, place:])

    return replace(measurement, jacobian=wrong)


def sar_observation(in_track: str = "speed") -> Observation:
    """The fix of a SAR image: two tangents, range and velocity to a pixel of uncertain position.

    Parameters
    ----------
    in_track : {"speed", "effective"}
        What the fourth element is.
    """

    def predict(values: Values, given: Values) -> Any:
        return predicted_measurement(
            values["r_e"],
            values["v_e"],
            values["q_mu"],
            ca.SX.zeros(3),
            given["q_be"],
            nominal_antenna(given["look"], given["squint"]),
            given["r_f_e"],
            in_track,
        )

    return Observation(
        predict,
        {"tan_azimuth": "1", "tan_elevation": "1", "slant_range": "m", "in_track_velocity": "m/s"},
        fields=[vector("r_f_e", unit="m", frame="e")],
        mapped={"r_f_e": "D"},
        inputs={"q_be": 4},
        parameters={"look": 1, "squint": 1},
    )
