r"""A GNSS receiver: position and velocity with correlated errors, outages, and a spoofer.

In level axes (north, east, down) the errors are

.. math::
    \delta r = b + \sigma_r n_r, \qquad \delta v = \sigma_v n_v, \qquad
    b^+ = \varphi\, b + \sigma_b \sqrt{1 - \varphi^2}\, n_b, \qquad \varphi = e^{-\Delta t / \tau},

of which :math:`b` are orbits, clocks and the air. The covariance told is that of both together,
which does not say that the error of the next fix is nearly the same; or that of the white noise,
for a filter that estimates the bias.

A spoofer leads the receiver away from a time :math:`t_s` on: position is off by
:math:`u\,(t - t_s)` and velocity by :math:`u`, so that both agree, and the covariance stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.motion.strapdown import level_axes
from terrafix.models.sensors.altimeter import wandering

TOLD = ("all", "white")
"""What the covariance of a fix holds."""

_SAME = 1e-9
"""Of two times [s]: far above their rounding, far below a step."""


def gnss_model(
    earth: str = "wgs84",
    outages: Sequence[tuple[float, float]] = (),
    spoofed: bool = False,
    told: str = "all",
) -> Model:
    """Position and velocity, where there is a signal.

    Parameters
    ----------
    earth : {"wgs84", "flat"}
    outages : sequence of (float, float)
        From when to when nothing is received [s]; the end is received again.
    spoofed : bool
        Whether there is a spoofer.
    told : {"all", "white"}
        Whether the covariance is of all errors, or of the white noise alone.

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``v_e`` [m/s]. Parameters, (3,) north, east, down, ``position_sigma``,
        ``bias_sigma`` [m], ``velocity_sigma`` [m/s], and ``bias_time`` [s]; of a spoofer
        ``spoof_from`` [s] and ``spoof_velocity_n`` [m/s]. Outputs ``fix.y``: position and velocity
        (6,) [m, m/s], their covariance ``fix.R``, ``fix.present``, ``fix.valid``, the true
        ``bias`` [m], Earth-fixed, and ``offset``, what a spoofer adds in level axes [m].

    Raises
    ------
    ValueError
        If the Earth or what is told is not known, or an outage ends before it begins.
    """
    if told not in TOLD:
        raise ValueError(f"told must be one of {TOLD}, got '{told}'")
    for k, (start, stop) in enumerate(outages):
        if not stop > start:
            raise ValueError(f"outage {k + 1} is from {start:g} s to {stop:g} s")
    r_e, v_e = ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3)
    dt, time = ca.SX.sym("dt"), ca.SX.sym("time")
    p = {n: ca.SX.sym(n, 3) for n in ("position_sigma", "bias_sigma", "velocity_sigma")}
    p["bias_time"] = ca.SX.sym("bias_time")
    bias, drive = ca.SX.sym("bias", 3), ca.SX.sym("bias_noise", 3)
    n_r, n_v = ca.SX.sym("position_noise", 3), ca.SX.sym("velocity_noise", 3)
    led, leading = ca.SX.zeros(3), ca.SX.zeros(3)
    if spoofed:
        p |= {"spoof_from": ca.SX.sym("spoof_from"), "spoof_velocity_n": ca.SX.sym("spoof", 3)}
        since = ca.fmax(time - p["spoof_from"], 0)
        led = since * p["spoof_velocity_n"]
        leading = ca.if_else(since > 0, p["spoof_velocity_n"], ca.SX.zeros(3))
    C_en = level_axes(r_e, earth).T
    lost = ca.SX(0)
    for start, stop in outages:
        lost = ca.logic_or(lost, ca.logic_and(time >= start - _SAME, time < stop - _SAME))
    position = r_e + ca.mtimes(C_en, bias + p["position_sigma"] * n_r + led)
    velocity = v_e + ca.mtimes(C_en, p["velocity_sigma"] * n_v + leading)
    C = ca.diagcat(C_en, C_en)
    lasting = p["bias_sigma"] ** 2 if told == "all" else 0
    variances = (p["position_sigma"] ** 2 + lasting, p["velocity_sigma"] ** 2)
    return Model(
        f"gnss_{earth}",
        inputs={"r_e": r_e, "v_e": v_e},
        states={"bias": bias},
        parameters=p,
        noise={"position_noise": n_r, "velocity_noise": n_v, "bias_noise": drive},
        initial={"bias": p["bias_sigma"] * drive},
        next={"bias": wandering(bias, p["bias_sigma"], p["bias_time"], drive, dt)},
        outputs={
            "fix.y": ca.vertcat(position, velocity),
            "fix.R": ca.mtimes(C, ca.mtimes(ca.diag(ca.vertcat(*variances)), C.T)),
            "fix.present": ca.SX.ones(6),
            "fix.valid": ca.logic_not(lost),
            "bias": ca.mtimes(C_en, bias),
            "offset": led,
        },
        step=dt,
        time=time,
    )
