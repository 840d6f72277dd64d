r"""A star tracker: the attitude of a while ago, better across its boresight than about it.

With the true attitude :math:`q` and its rotation :math:`\theta` in the last step :math:`\Delta t`,
the boresight :math:`b` in body axes and white noise :math:`n`,

.. math::
    \tilde q = q(\delta) \otimes q(-\theta\, L / \Delta t) \otimes q, \qquad
    \delta = a + \sigma_c\, (n - b\, b^T n) + \sigma_r\, b\, b^T n.

:math:`L` is the latency, of at most a step: over it the rate is that of the step. The alignment
:math:`a` is drawn once. Nothing is measured while the body turns faster than a limit, or while the
boresight is nearer to the Sun or the Moon, where the Earth does not hide them, or to the Earth's
limb, than an exclusion angle.

References
----------
.. [1] F. L. Markley, J. L. Crassidis, "Fundamentals of Spacecraft Attitude Determination and
       Control", Springer, 2014, section 4.2.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.geometry.frames import earth_angle
from terrafix.models.geometry.quaternion import (
    from_rotation_vector,
    inverse,
    normalized,
    product,
    rotation_matrix,
    rotation_vector,
)
from terrafix.models.motion.surroundings import (
    orientation_at,
    published_inputs,
    published_symbols,
    surroundings_at,
)
from terrafix.models.sensors.sky import angle_between, hidden, limb_angle, unit

SKIES = ("environment", "none")
"""Whether Sun, Moon and inertial axes are those of the environment, or the axes turn uniformly."""

BLOCKED = ("no", "Sun", "Moon", "Earth", "rate")
"""Why nothing is measured, indexed by ``blocked``."""


def star_tracker_model(sky: str = "environment") -> Model:
    """Attitude relative to inertial axes, where stars are seen.

    Parameters
    ----------
    sky : {"environment", "none"}
        "none": axes that turn uniformly, and neither Sun nor Moon.

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``q_be`` and, of an environment, ``surroundings.*``. Parameters
        ``boresight_b`` (3,), ``cross_sigma``, ``roll_sigma``, ``alignment_sigma`` [rad],
        ``latency`` [s], ``largest_rate`` [rad/s], ``earth_exclusion`` [rad], with an environment
        ``sun_exclusion``, ``moon_exclusion`` [rad], else ``rotation_rate`` [rad/s] and
        ``earth_angle0`` [rad]. Outputs ``fix.q_bi``, ``fix.R`` [rad^2], ``fix.taken`` [s],
        ``fix.valid``, and ``blocked``, an index into `BLOCKED`.

    Raises
    ------
    ValueError
        If the sky is not known.
    """
    if sky not in SKIES:
        raise ValueError(f"sky must be one of {SKIES}, got '{sky}'")
    r_e, q_be = ca.SX.sym("r_e", 3), ca.SX.sym("q_be", 4)
    dt, time = ca.SX.sym("dt"), ca.SX.sym("time")
    p = {n: ca.SX.sym(n) for n in ("cross_sigma", "roll_sigma", "alignment_sigma", "latency")}
    p |= {n: ca.SX.sym(n) for n in ("largest_rate", "earth_exclusion")}
    p["boresight_b"] = ca.SX.sym("boresight_b", 3)
    last, turn, lean = ca.SX.sym("last", 4), ca.SX.sym("turn", 3), ca.SX.sym("alignment", 3)
    white, drawn = ca.SX.sym("white", 3), ca.SX.sym("alignment_noise", 3)

    inputs: dict[str, Any] = {"r_e": r_e, "q_be": q_be}
    b = unit(p["boresight_b"])
    b_e = ca.mtimes(rotation_matrix(q_be).T, b)
    off_earth = angle_between(b_e, -unit(r_e)) - limb_angle(r_e)
    blocked: Any = ca.if_else(off_earth < p["earth_exclusion"], 3, 0)
    if sky == "environment":
        published = published_symbols()
        inputs |= published_inputs(published)
        q_ei, around = orientation_at(published, time), surroundings_at(published, time)
        for code, body, place in ((2, "moon", around.moon_e), (1, "sun", around.sun_e)):
            p[f"{body}_exclusion"] = ca.SX.sym(f"{body}_exclusion")
            there = unit(place - r_e)
            near = angle_between(b_e, there) < p[f"{body}_exclusion"]
            seen = ca.logic_and(near, ca.logic_not(hidden(there, r_e)))
            blocked = ca.if_else(seen, code, blocked)
    else:
        p |= {n: ca.SX.sym(n) for n in ("rotation_rate", "earth_angle0")}
        angle = earth_angle(p["earth_angle0"], p["rotation_rate"], time)
        q_ei = ca.vertcat(0, 0, ca.sin(angle / 2), ca.cos(angle / 2))

    q_bi = product(q_be, q_ei)
    rate = ca.sqrt(ca.dot(turn, turn)) / ca.if_else(dt > 0, dt, 1)
    blocked = ca.if_else(rate > p["largest_rate"], 4, blocked)
    share = p["latency"] / ca.if_else(dt > 0, dt, 1)
    along = b * ca.dot(b, white)
    error = lean + p["cross_sigma"] * (white - along) + p["roll_sigma"] * along
    earlier = product(from_rotation_vector(-share * turn), q_bi)
    across = ca.SX.eye(3) - ca.mtimes(b, b.T)
    R = p["cross_sigma"] ** 2 * across + p["roll_sigma"] ** 2 * ca.mtimes(b, b.T)
    return Model(
        f"star_tracker_{sky}",
        inputs=inputs,
        states={"last": last, "turn": turn, "alignment": lean},
        parameters=p,
        noise={"white": white, "alignment_noise": drawn},
        initial={"last": q_bi, "alignment": p["alignment_sigma"] * drawn},
        next={"last": q_bi, "turn": rotation_vector(product(q_bi, inverse(last)))},
        outputs={
            "fix.q_bi": normalized(product(from_rotation_vector(error), earlier)),
            "fix.R": R + p["alignment_sigma"] ** 2 * ca.SX.eye(3),
            "fix.taken": time - p["latency"],
            "fix.valid": blocked < 0.5,
            "blocked": blocked,
        },
        step=dt,
        time=time,
    )
