r"""The apertures of an airborne radar, and what its images would measure.

An aperture lasts one interval; the next begins where it ends. `aperture_model` marks its center
and adds up what the IMU measures within it. `synthetic_shift_model` stands in the place of images:
the fix that image formation, correlation and map drift would give, from the true motion, with given
errors. The point is on the ground abeam of where the navigator believes it was at the center, so
that its position is known and the image was formed with the navigator's own speed.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.geometry.quaternion import from_rotation_vector, rotation_matrix
from terrafix.models.motion.strapdown import at_end, height_of, level_axes, rotation_rate
from terrafix.models.sensors.altimeter import wandering

LOOKS = ("right", "left", "in-turn")
"""Names of the sides that apertures look to; in turn: right, left, right, ..."""

ROWS = ("shift", "shift-and-drift")
"""Names of what is measured: range and cross-range, or what map drift reads besides."""


CENTER = "t_center"
"""Field of a fix: the time of its aperture's center [s]."""


def side_of(looks: str, index: int) -> int:
    """Side of an aperture: 1 is right, -1 left."""
    return {"right": 1, "left": -1}.get(looks, 1 - 2 * (index % 2))


def shift_of(d: Any, v: Any, a: Any, speed: Any) -> Any:
    """What an aperture measures about a point, without biases: (3, 1) [m], [m], [m/s].

    Parameters
    ----------
    d : SX, shape (3,)
        From the aperture's center to the point [m].
    v, a : SX, shape (3,)
        Velocity [m/s] and acceleration [m/s^2] relative to the point.
    speed : SX
        By which frequencies are turned into meters [m/s].
    """
    own = ca.norm_2(v)
    return ca.vertcat(ca.norm_2(d), -ca.dot(d, v) / speed, own - ca.dot(d, a) / (2 * own))


def aperture_model() -> Model:
    """When apertures have their centers, and the mean specific force since one began.

    Returns
    -------
    Model
        Inputs ``delta_v_b`` [m/s], ``delta_theta_b`` [rad]: the IMU's increments, (3,). Parameter
        ``length`` [s]. Outputs ``f_b`` (3,) [m/s^2], the mean specific force since the aperture
        began, in body axes of now; ``center.index``, number of the aperture, and ``center.valid``.
    """
    dv, dtheta = ca.SX.sym("delta_v_b", 3), ca.SX.sym("delta_theta_b", 3)
    length, gained = ca.SX.sym("length"), ca.SX.sym("gained", 3)
    dt, time = ca.SX.sym("dt"), ca.SX.sym("time")
    began = (time - dt) / length
    index = ca.floor(began + dt / (4 * length))  # of the aperture that this step is in
    since = time - index * length
    first = since < 1.5 * dt
    turned = ca.mtimes(rotation_matrix(from_rotation_vector(dtheta)), gained)
    following = ca.if_else(first, 0.0, turned) + at_end(dv, dtheta)
    at_center = ca.logic_and(dt > 0, ca.fabs(since - length / 2) < dt / 2)
    return Model(
        "aperture",
        inputs={"delta_v_b": dv, "delta_theta_b": dtheta},
        states={"gained": gained},
        parameters={"length": length},
        next={"gained": following},
        outputs={
            "f_b": gained / ca.fmax(since, dt + 1e-12),
            "center.index": index,
            "center.valid": at_center,
        },
        step=dt,
        time=time,
    )


def synthetic_shift_model(
    earth: str = "wgs84", looks: str = "right", rows: str = "shift", on: bool = True
) -> Model:
    """A fix without an image: what an aperture measures about a known point on the ground.

    Parameters
    ----------
    earth : {"wgs84", "flat"}
    looks : {"right", "left", "in-turn"}
    rows : {"shift", "shift-and-drift"}
    on : bool
        Whether it sends fixes at all.

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``v_e`` [m/s], ``q_be``: the true motion; ``center.fresh``;
        ``prior.r_e_at_aperture`` and ``prior.v_e_at_aperture``, the estimate of the center; with
        drift ``f_b`` [m/s^2], measured. Steps at centers and ends of apertures, and sends a fix at
        an end. Outputs ``fix.*`` as of `terrafix.models.filters.navigator.shift_observation`;
        ``range_bias`` and ``cross_range_bias`` [m].

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    for value, known, what in ((looks, LOOKS, "looks"), (rows, ROWS, "rows")):
        if value not in known:
            raise ValueError(f"{what} must be one of {known}, got '{value}'")
    rotation_rate(earth)
    drift = rows == ROWS[1]
    r, v, q = ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3), ca.SX.sym("q_be", 4)
    r_hat, v_hat = ca.SX.sym("r_hat", 3), ca.SX.sym("v_hat", 3)
    fresh, dt, time = (ca.SX.sym(name) for name in ("fresh", "dt", "time"))
    inputs = {
        "r_e": r,
        "v_e": v,
        "q_be": q,
        "center.fresh": fresh,
        "prior.r_e_at_aperture": r_hat,
        "prior.v_e_at_aperture": v_hat,
    }
    parameters = {name: ca.SX.sym(name) for name in _PARAMETERS}
    own = {name: ca.SX.sym(name, size) for name, size in _STATES.items()}
    noise = {name: ca.SX.sym(name) for name in ("range_noise", "cross_range_noise")}
    drives = {f"{name}_noise": ca.SX.sym(f"{name}_noise") for name in _BIASES}
    at_center = fresh > 0.5
    following = _at_center(own, at_center, r, v, time)
    for name in _BIASES:
        sigma, tau = parameters[f"{name}_sigma"], parameters[f"{name}_time"]
        following[name] = wandering(own[name], sigma, tau, drives[f"{name}_noise"], dt)
    side = {"right": 1, "left": -1}.get(looks, 2 * ca.fmod(own["count"], 2) - 1)
    p_t = _point(r_hat, v_hat, side * parameters["ground_range"], parameters["ground"], earth)
    speed = ca.norm_2(v_hat)
    a = ca.SX.zeros(3)
    if drift:
        inputs["f_b"] = ca.SX.sym("f_b", 3)
        noise["map_drift_noise"] = ca.SX.sym("map_drift_noise")
        for name in ("map_drift_sigma", "force_sigma"):
            parameters[name] = ca.SX.sym(name)
        began = {"v_began": 3, "t_began": 1, "a_mean": 3}
        own |= {name: ca.SX.sym(name, size) for name, size in began.items()}
        following |= _over_aperture(own, at_center, v, time)
        a = own["a_mean"]
    sigmas = ca.vertcat(*(parameters[f"{name.removesuffix('_noise')}_sigma"] for name in noise))
    y = shift_of(p_t - own["r_center"], own["v_center"], a, speed)
    y += ca.vertcat(own["range_bias"], own["cross_range_bias"], 0)
    sent = ca.logic_and(ca.logic_not(at_center), own["count"] > 0.5)
    sent = ca.logic_and(sent, time - own["t_mid"] < 1.5 * dt)  # the step after a center, once
    sent = ca.logic_and(sent, _banked(r, q, earth) <= ca.sin(parameters["largest_bank"]))
    sent = ca.logic_and(sent, on)
    given = _measured(y, sigmas, ca.vertcat(*noise.values())) | {
        "p_t_e": p_t,
        "speed": speed,
        "f_b": inputs.get("f_b", ca.SX.zeros(3)),
        CENTER: own["t_mid"],
        "F": (parameters["force_sigma"] ** 2 if drift else 0) * ca.SX.eye(3),
    }
    return Model(
        f"synthetic_shift_{earth}_{looks}_{rows}{'' if on else '_off'}".replace("-", "_"),
        inputs=inputs,
        states=own,
        parameters=parameters,
        noise={**noise, **drives},
        next=following,
        initial={name: parameters[f"{name}_sigma"] * drives[f"{name}_noise"] for name in _BIASES}
        | ({"v_began": v} if drift else {}),
        outputs={
            **{
                f"fix.{name}": ca.densify(ca.if_else(sent, value, 0.0))
                for name, value in given.items()
            },
            "fix.valid": sent,
            **{name: own[name] for name in _BIASES},
        },
        step=dt,
        time=time,
    )


_BIASES = ("range_bias", "cross_range_bias")
_STATES = {"r_center": 3, "v_center": 3, "t_mid": 1, "count": 1} | dict.fromkeys(_BIASES, 1)
_PARAMETERS = (
    *("ground_range", "ground", "largest_bank", "range_sigma", "cross_range_sigma"),
    *(f"{name}_{what}" for name in _BIASES for what in ("sigma", "time")),
)


def _at_center(own: dict[str, Any], at_center: Any, r: Any, v: Any, time: Any) -> dict[str, Any]:
    """Position, velocity and time at the last center, and how many there were."""
    now = {"r_center": r, "v_center": v, "t_mid": time, "count": own["count"] + 1}
    return {name: ca.if_else(at_center, value, own[name]) for name, value in now.items()}


def _measured(y: Any, sigmas: Any, noise: Any) -> dict[str, Any]:
    """Fields of what was measured: the first elements of y, as many as there is noise."""
    m = noise.numel()
    present = ca.vertcat(ca.SX.ones(m), ca.SX.zeros(3 - m))
    return {
        "y": (y + ca.vertcat(sigmas * noise, ca.SX.zeros(3 - m))) * present,
        "R": ca.diag(ca.vertcat(sigmas**2, ca.SX.ones(3 - m))),
        "present": present,
    }


def _point(r: Any, v: Any, away: Any, ground: Any, earth: str) -> Any:
    """Point (3,) on the ground abeam, so far to the right, of who is at r and flies with v."""
    axes = level_axes(r, earth)
    course = ca.mtimes(axes, v)
    horizontal = ca.sqrt(course[0] ** 2 + course[1] ** 2)
    right = ca.vertcat(-course[1], course[0], 0) / horizontal
    down = ca.vertcat(0, 0, height_of(r, earth) - ground)
    return r + ca.mtimes(axes.T, away * right + down)


def _banked(r: Any, q: Any, earth: str) -> Any:
    """Sine of the bank, without its sign: how far the right wing is from level."""
    return ca.fabs(ca.mtimes(rotation_matrix(q), level_axes(r, earth).T)[1, 2])


def _over_aperture(own: dict[str, Any], at_center: Any, v: Any, time: Any) -> dict[str, Any]:
    """Velocity and time at which the next aperture begins, and the mean acceleration of this."""
    mean = (v - own["v_began"]) / ca.fmax(time - own["t_began"], 1e-9)
    return {
        name: ca.if_else(at_center, own[name], value)
        for name, value in (("v_began", v), ("t_began", time), ("a_mean", mean))
    }
