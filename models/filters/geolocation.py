r"""The filter of a satellite that tracks a target in its images: what it estimates, and measures.

As printed, ten states: position, velocity, pitch and roll, and where the target lies in the frame,
a random walk of a density that stands for what it is in truth, a function of the others. It starts
with the covariance that it has by them,

.. math::
    P_{tx} = G P_{xx}, \qquad P_{tt} = G P_{xx} G^T, \qquad G = \partial t / \partial x.

Here besides, the target is that function at every step: the noise of the others moves it, and its
covariance with them is kept. An image that is matched to the first one tells how far the target
has moved in the frame, so that what is measured lacks where it was at first,

.. math::
    y = t + A\, b + e + n,

:math:`b` a constant in pixels of the first frame: minus the target's place in it, which is known
no better than the target is, and covaried with it; or, where that frame was georeferenced, the
error of that. :math:`A` takes pixels of the first frame to those of this one. The error :math:`e`
of the match is a Gauss-Markov process: it is the same as long as the image has not moved by a part
of a pixel. White noise :math:`n` comes with the fix.

References
----------
.. [1] "Satellite-Based Fusion of Image/Inertial Sensors for Precise Geolocation", AFIT thesis,
       eqs. (3.1) to (3.47). We differ in the printed filter, too: process noise is a density, not
       its square; P is corrected by (I - K H); what an image measures is the whole offset, not
       (3.13), which takes the attitude off an offset that has it in already.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process
from terrafix.models.geometry.quaternion import rotation_vector
from terrafix.models.sensors.staring import (
    GEOMETRIES,
    GRAVITY,
    NORTH_EAST,
    coasted,
    gravity,
    look_parameters,
    target_offset,
)

PRINTED = ErrorState(
    vector("r", unit="m", frame="i"),
    vector("v", unit="m/s", frame="i"),
    vector("pitch", 1, unit="rad"),
    vector("roll", 1, unit="rad"),
    vector("target", 2, unit="px", labels=NORTH_EAST),
)
"""Ten states: position and velocity, inertial; pitch and roll; the target in the frame."""

_BLOCKS = {block.name: block for block in PRINTED}

EVALUATED = ErrorState(*(_BLOCKS[name] for name in ("r", "v", "target")))
"""What a covariance can tell jointly: with pitch and roll besides, the target is known by them."""

TRACKING = ErrorState(
    *EVALUATED,
    *(_BLOCKS[name] for name in ("pitch", "roll")),
    vector("bias", 2, unit="px", labels=NORTH_EAST),
    vector("mismatch", 2, unit="px", labels=NORTH_EAST),
)
"""The ten, with what the first frame does not tell, and the error of matches that lasts."""

_MOVING = ("r", "v", "pitch", "roll")
"""Blocks that the target is a function of."""


def printed_process() -> Process:
    """Gravity and white acceleration; pitch and roll Gauss-Markov; the target a random walk."""
    return Process(
        rates=lambda x, given, noise, _: {
            "r": x["v"],
            "v": gravity(x["r"], given) + noise["push"],
        },
        noise={"push": ("accel_psd", 3)},
        decays=dict.fromkeys(("pitch", "roll"), ("attitude_time", "attitude_sigma")),
        walks={"target": "target_psd"},
        parameters=GRAVITY,
    )


ATTITUDES = ("wander", "gyro")
"""What pitch and roll follow: a Gauss-Markov process, or the increments of a gyro."""


def tracking_process(geometry: str, attitude: str = "wander") -> Process:
    """The same, but that the target is where the others put it, and a lasting error of matches.

    Parameters
    ----------
    geometry : str
        Of `terrafix.models.sensors.staring.GEOMETRIES`.
    attitude : str
        Of `ATTITUDES`. With a gyro pitch and roll follow its ``delta_theta_b``, with its angle
        random walk for noise; its bias is not estimated, which wants a star tracker beside it.
    """
    gyro = attitude == "gyro"
    wander = ("angle_random_walk",) if gyro else ("attitude_time", "attitude_sigma")

    def step(x: Mapping[str, Any], given: Mapping[str, Any], dt: Any, _: Any) -> dict[str, Any]:
        r, v = coasted(x["r"], x["v"], given, dt)
        if gyro:
            turned = [x[n] + given["delta_theta_b"][k] for k, n in enumerate(("pitch", "roll"))]
        else:
            kept = ca.exp(-dt / given["attitude_time"])
            turned = [kept * x[name] for name in ("pitch", "roll")]
        end = {"r": r, "v": v, "pitch": turned[0], "roll": turned[1]}
        return {**end, "target": target_offset(end, given, geometry)}

    def spread(_: Any, end: Mapping[str, Any], given: Mapping[str, Any], dt: Any) -> Any:
        eye = given["accel_psd"] * ca.SX.eye(3)
        push = ca.blockcat([[dt**3 / 3 * eye, dt**2 / 2 * eye], [dt**2 / 2 * eye, dt * eye]])
        if gyro:
            turn = given["angle_random_walk"] ** 2 * dt
        else:
            turn = given["attitude_sigma"] ** 2 * (1 - ca.exp(-2 * dt / given["attitude_time"]))
        Q = ca.diagcat(push, turn, turn)
        onto = _onto(TRACKING, target_slope(end, given, geometry))
        return ca.mtimes(onto, ca.mtimes(Q, onto.T))

    return Process(
        step=step,
        spread=spread,
        decays={"mismatch": ("mismatch_time", "mismatch_sigma")},
        inputs={"aim": 3, "r_nominal": 3, **({"delta_theta_b": 3} if gyro else {})},
        parameters={
            **GRAVITY,
            **look_parameters(geometry),
            **dict.fromkeys(("accel_psd", *wander), 1),
        },
    )


def _onto(state: ErrorState, slope: Any, bias: Any | None = None) -> Any:
    """Derivative (n, 8) of an error state by position, velocity, pitch and roll.

    Of the target it is `slope` (2, 8), of the bias what is given, of all else zero.
    """
    eye, at = ca.SX.eye(8), {"r": (0, 3), "v": (3, 6), "pitch": (6, 7), "roll": (7, 8)}
    rows = {name: eye[begin:end, :] for name, (begin, end) in at.items()} | {"target": slope}
    if bias is not None:
        rows["bias"] = bias
    return ca.vertcat(*(rows.get(b.name, ca.SX.zeros(b.size, 8)) for b in state))


def target_slope(values: Mapping[str, Any], given: Mapping[str, Any], geometry: str) -> Any:
    """Derivative (2, 8) of the target in the frame by position, velocity, pitch and roll."""
    sizes = {block.name: block.size for block in PRINTED if block.name in _MOVING}
    x = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    symbols = ca.vertcat(*x.values())
    slope = ca.jacobian(target_offset(x, given, geometry), symbols)
    return ca.substitute(slope, symbols, ca.vertcat(*(values[name] for name in x)))


_FIELDS = [vector("from_first", 4)]
"""Pixels of this frame by pixels of the first one, row after row."""

OFFSET = Observation(lambda x, _: x["target"], dict.fromkeys(NORTH_EAST, "px"), fields=_FIELDS)
"""The target's place in the frame, as if the fix had no error but white noise."""

MISPRINTED = Observation(
    lambda x, given: (
        x["target"]
        - ca.norm_2(x["r"] - given["aim"]) * ca.vertcat(x["pitch"], x["roll"]) / given["pixel"]
    ),
    dict.fromkeys(NORTH_EAST, "px"),
    fields=_FIELDS,
    inputs={"aim": 3},
    parameters={"pixel": 1},
)
"""What equation (3.13) says that is measured: less the attitude's part, which is in it already."""

MATCHED = Observation(
    lambda x, given: (
        x["target"] + ca.mtimes(_square(given["from_first"]), x["bias"]) + x["mismatch"]
    ),
    dict.fromkeys(NORTH_EAST, "px"),
    fields=_FIELDS,
)
"""The target's place in the frame, less that in the first one or with the error of that."""

LOCATED = Observation(
    lambda x, _: x["target"] + x["mismatch"], dict.fromkeys(NORTH_EAST, "px"), fields=_FIELDS
)
"""The target's place in the frame, of an image that was matched to the map itself."""


POINTING = Observation(
    lambda x, _: ca.vertcat(x["pitch"], x["roll"]), dict.fromkeys(("pitch", "roll"), "rad")
)
"""Pitch and roll, as a star tracker tells them."""


def pointing_fix_model() -> Model:
    """A fix of pitch and roll from a measured turn off the commanded attitude.

    Returns
    -------
    Model
        Input ``q_be`` (4,), small turns of pitch and roll and about the line of sight; parameter
        ``noise_sigma`` [rad]. Outputs the fields of the message ``fix``.
    """
    q, sigma = ca.SX.sym("q_be", 4), ca.SX.sym("noise_sigma")
    return Model(
        "pointing_fix",
        inputs={"q_be": q},
        parameters={"noise_sigma": sigma},
        outputs={
            "fix.y": rotation_vector(q)[:2],
            "fix.R": sigma**2 * ca.SX.eye(2),
            "fix.present": ca.SX.ones(2),
        },
    )


def _square(flat: Any) -> Any:
    """Matrix (2, 2) of its rows, one after the other."""
    return ca.blockcat([[flat[0], flat[1]], [flat[2], flat[3]]])


FIRST_FRAME = ("unknown", "georeferenced")
"""What is known of where the target lies in the first frame."""


def known_pointing_model(state: ErrorState, geometry: str, first_frame: str = "unknown") -> Model:
    """What is known at t = 0: the nominal orbit, no pitch and roll, the target in the middle.

    Parameters
    ----------
    state : ErrorState
        `PRINTED` or `TRACKING`.
    geometry : str
        Of `terrafix.models.sensors.staring.GEOMETRIES`.
    first_frame : str
        Of `FIRST_FRAME`; of `TRACKING` alone.

    Returns
    -------
    Model
        Inputs ``r_nominal``, ``v_nominal``, ``aim``, (3,) each; parameters ``position_sigma`` [m],
        ``velocity_sigma`` [m/s], (3,) each, ``attitude_sigma`` [rad], those of the geometry; of
        `TRACKING` ``mismatch_sigma`` [px], zero where frames are matched to the first one, which
        matches itself without an error; and ``georeference_sigma`` [px] where that is
        georeferenced. Outputs ``start.*`` of all blocks, and ``start.P`` of rank 8, or more with
        these two.

    Raises
    ------
    ValueError
        If a name is none of those listed.
    """
    if geometry not in GEOMETRIES:
        raise ValueError(f"geometry must be one of {GEOMETRIES}, got '{geometry}'")
    if first_frame not in FIRST_FRAME:
        raise ValueError(f"first_frame must be one of {FIRST_FRAME}, got '{first_frame}'")
    inputs = {name: ca.SX.sym(name, 3) for name in ("r_nominal", "v_nominal", "aim")}
    p = {name: ca.SX.sym(name, 3) for name in ("position_sigma", "velocity_sigma")}
    p |= {name: ca.SX.sym(name) for name in ("attitude_sigma", *look_parameters(geometry))}
    values: dict[str, Any] = {
        "r": inputs["r_nominal"],
        "v": inputs["v_nominal"],
        "pitch": ca.SX(0),
        "roll": ca.SX(0),
    }
    given = {**p, **inputs}
    slope = target_slope(values, given, geometry)
    values["target"] = target_offset(values, given, geometry)
    sigma = ca.vertcat(
        p["position_sigma"], p["velocity_sigma"], p["attitude_sigma"], p["attitude_sigma"]
    )
    bias, own = -slope, ca.SX.zeros(state.size)
    if "bias" in state.places:
        values |= {"bias": -values["target"], "mismatch": ca.SX.zeros(2)}
        p["mismatch_sigma"] = ca.SX.sym("mismatch_sigma")
        place = state.places["mismatch"]
        own[place.start : place.stop] = p["mismatch_sigma"] ** 2
    if first_frame == "georeferenced":
        place = state.places["bias"]
        p["georeference_sigma"] = ca.SX.sym("georeference_sigma")
        values["bias"], bias = ca.SX.zeros(2), None
        own[place.start : place.stop] = p["georeference_sigma"] ** 2
    onto = _onto(state, slope, bias if "bias" in state.places else None)
    P = ca.mtimes(onto, ca.mtimes(ca.diag(sigma * sigma), onto.T)) + ca.diag(own)
    outputs = {f"start.{block.name}": values[block.name] for block in state}
    return Model("known_pointing", inputs=inputs, parameters=p, outputs={**outputs, "start.P": P})
