r"""A satellite whose camera stares at a place on the ground: where the target lies in the frame.

The satellite flies a nominal orbit, but for errors of its start and white acceleration, and points
its camera as if it flew the nominal one. The target then lies off the middle of the frame by

.. math::
    t = \frac{1}{PX} \left( \Delta + d_o \begin{pmatrix} \phi \\ \theta \end{pmatrix} \right),
    \qquad
    \Delta_n = M (\varphi_{nom} - \varphi), \quad
    \Delta_e = N \cos\varphi_{nom}\, (\lambda_{nom} - \lambda),

to the north and to the east [px]: of a satellite too far north the camera looks too far north, and
the target lies south in its frame. The scene moves the other way. :math:`PX` is the pixel's size on
the ground, :math:`d_o` the distance to the aim point, :math:`\phi, \theta` pitch and roll. On a
sphere latitude is geocentric and both radii are the Earth's; on WGS-84 they are those of the
ellipsoid. Longitudes are inertial: the rotation of the Earth cancels.

That camera is levelled by the local vertical, and the aim point is the nominal nadir, which moves
along with the satellite: in a low orbit a place on the ground is in view for some 80 seconds, not
for 20 minutes. A camera that is pointed by the stars at a place which turns with the Earth sees it
in axes :math:`e_n, e_e, u` of the nominal line of sight, north upward, at

.. math::
    t = \frac{1}{\psi} \left( \frac{(e_n \cdot d,\; e_e \cdot d)}{u \cdot d}
        + (\phi, \theta) \right), \qquad d = r_{target} - r,

with :math:`\psi` the angle of a pixel.

References
----------
.. [1] "Satellite-Based Fusion of Image/Inertial Sensors for Precise Geolocation", AFIT thesis,
       eqs. (3.14) to (3.25). We differ: the offset of attitude is in pixels; pitch and roll are
       driven by noise, and stationary; differences of longitude are within half a turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.model import Model, rk4
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import rotate_about_pole
from terrafix.models.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from terrafix.models.geometry.quaternion import from_small_rotation_vector
from terrafix.models.motion.elements import ELEMENTS, state_of_elements
from terrafix.models.motion.gravity import j2_acceleration
from terrafix.models.motion.kepler import KeplerianElements

GEOMETRIES = ("sphere", "wgs84", "stars")
"""Aimed at the nadir on a sphere, or on the ellipsoid; or at a place, pointed by the stars."""

NADIR = ("sphere", "wgs84")
"""Those whose aim point is the nominal nadir."""

LOOK = {"sphere": ("pixel", "radius"), "wgs84": ("pixel",), "stars": ("pixel_angle",)}
"""Parameters of each geometry: pixel [m], radius of the Earth [m], angle of a pixel [rad]."""

GRAVITY = {"mu": 1, "radius": 1, "j2": 1}
"""Parameters of `gravity`: [m^3/s^2], [m], second zonal coefficient; and their sizes."""

PLACE = ("latitude", "longitude", "earth_angle0", "rotation_rate")
"""Parameters of a place that turns with the Earth [rad], [rad/s]."""

NORTH_EAST = ("north", "east")


def nadir(r: Any, geometry: str, radius: Any = EARTH.radius) -> Any:
    """Point (3,) of the ground under a position (3,) [m]."""
    if geometry == "sphere":
        return radius * r / ca.norm_2(r)
    latitude, longitude, _ = geodetic_from_ecef(r)
    return ecef_from_geodetic(latitude, longitude, 0)


def drift(r: Any, aim: Any, geometry: str, radius: Any = EARTH.radius) -> Any:
    """How far the nominal nadir `aim` (3,) lies north and east of the one under `r`: (2,) [m]."""
    east = ca.atan2(aim[1] * r[0] - aim[0] * r[1], aim[0] * r[0] + aim[1] * r[1])
    if geometry == "sphere":
        nominal, true = (ca.atan2(p[2], ca.norm_2(p[:2])) for p in (aim, r))
        return radius * ca.vertcat(nominal - true, ca.cos(nominal) * east)
    e2 = EARTH.flattening * (2 - EARTH.flattening)
    nominal, true = geodetic_from_ecef(aim)[0], geodetic_from_ecef(r)[0]
    w = 1 - e2 * ca.sin(nominal) ** 2
    normal = EARTH.radius / ca.sqrt(w)
    return ca.vertcat(normal * (1 - e2) / w * (nominal - true), normal * ca.cos(nominal) * east)


def line_of_sight_axes(r: Any, aim: Any) -> Any:
    """Rows north in the frame, east in it, and along the line of sight from `r` to `aim`, (3,)."""
    u = aim - r
    u /= ca.norm_2(u)
    north = ca.vertcat(-u[2] * u[0], -u[2] * u[1], 1 - u[2] * u[2])
    north /= ca.norm_2(north)
    return ca.horzcat(north, ca.cross(u, north), u).T


def target_offset(values: Mapping[str, Any], given: Mapping[str, Any], geometry: str) -> Any:
    """Where the target lies in the frame, north and east of its middle: (2,) [px].

    Parameters
    ----------
    values : mapping of str to SX
        Position ``r`` (3,) [m], inertial; ``pitch`` and ``roll`` [rad].
    given : mapping of str to SX
        ``r_nominal`` and ``aim`` (3,) [m], inertial, and the parameters that `LOOK` names.
    geometry : str
        Of `GEOMETRIES`.
    """
    r, turned = values["r"], ca.vertcat(values["pitch"], values["roll"])
    if geometry == "stars":
        d = ca.mtimes(line_of_sight_axes(given["r_nominal"], given["aim"]), given["aim"] - r)
        return (d[:2] / d[2] + turned) / given["pixel_angle"]
    off = drift(r, given["aim"], geometry, given.get("radius", EARTH.radius))
    return (off + ca.norm_2(r - given["aim"]) * turned) / given["pixel"]


def ground_view(r: Any, given: Mapping[str, Any], geometry: str) -> Any:
    """Pixels north and east in the frame by meters north and east on the ground, (2, 2) [px/m]."""
    if geometry in NADIR:
        return ca.SX.eye(2) / given["pixel"]
    aim, moved = given["aim"], ca.SX.sym("moved", 2)
    up = aim / ca.vertcat(1, 1, (1 - EARTH.flattening) ** 2)
    up /= ca.norm_2(up)
    east = ca.vertcat(-up[1], up[0], 0)
    east /= ca.norm_2(east)
    place = aim + moved[0] * ca.cross(up, east) + moved[1] * east
    d = ca.mtimes(line_of_sight_axes(given["r_nominal"], aim), place - r)
    slope = ca.jacobian(d[:2] / d[2] / given["pixel_angle"], moved)
    return ca.substitute(slope, moved, ca.SX.zeros(2))


def off_nadir(r: Any, aim: Any) -> Any:
    """Angle [rad] of the line of sight from `r` to `aim`, (3,) each, off the center of the Earth.

    Half a turn where the aim point is below the horizon.
    """
    los = aim - r
    angle = ca.atan2(ca.norm_2(ca.cross(r, los)), -ca.dot(r, los))
    up = aim / ca.vertcat(1, 1, (1 - EARTH.flattening) ** 2)
    return ca.if_else(ca.dot(up, los) < 0, angle, pi)


def aim_point(r_nominal: Any, given: Mapping[str, Any], geometry: str, time: Any) -> Any:
    """Point (3,) [m], inertial, that the camera is aimed at: the nominal nadir, or the place."""
    if geometry in NADIR:
        return nadir(r_nominal, geometry, given.get("radius", EARTH.radius))
    place = ecef_from_geodetic(given["latitude"], given["longitude"], 0)
    return rotate_about_pole(-(given["earth_angle0"] + given["rotation_rate"] * time), place)


def look_parameters(geometry: str) -> dict[str, int]:
    """Names of the parameters of `target_offset`, and their sizes."""
    return dict.fromkeys(LOOK[geometry], 1)


def gravity(r: Any, given: Mapping[str, Any]) -> Any:
    """Acceleration (3,) [m/s^2] at a position [m], by the parameters that `GRAVITY` names."""
    return j2_acceleration(r, given["mu"], given["radius"], given["j2"])


def coasted(r: Any, v: Any, given: Mapping[str, Any], dt: Any) -> tuple[Any, Any]:
    """Position [m] and velocity [m/s] of a free body after a step [s], (3,) each.

    By the classical Runge-Kutta method of order four, in the `gravity` of what is given.
    """
    end = rk4(lambda _, x: ca.vertcat(x[3:6], gravity(x[:3], given)), ca.vertcat(r, v), dt)
    return end[:3], end[3:6]


def white_acceleration(psd: Any, dt: Any, first: Any, second: Any) -> tuple[Any, Any]:
    """What white acceleration does to position [m] and velocity [m/s] in a step, (3,) each.

    Exactly, from two standard normals (3,); gravity's gradient moves it by 1e-6 of itself.
    """
    dv = ca.sqrt(psd * dt) * first
    return dt * (dv / 2 + ca.sqrt(psd * dt / 12) * second), dv


def staring_satellite_model(geometry: str) -> Model:
    r"""A satellite near its nominal orbit, and where its target lies in the frame.

    Parameters
    ----------
    geometry : str
        Of `GEOMETRIES`.

    Returns
    -------
    Model
        Parameters: the six of `ELEMENTS`; ``mu`` [m^3/s^2], ``radius`` [m], ``j2``; standard
        deviations at the start, ``position_sigma`` [m], ``velocity_sigma`` [m/s], (3,) each;
        ``accel_psd`` [m^2/s^3]; ``attitude_sigma`` [rad] and ``attitude_time`` [s] of pitch and
        roll, stationary Gauss-Markov processes in exact steps; those of `LOOK`; those of `PLACE`
        where it is aimed at one. Outputs ``r``, ``v``, ``r_nominal``, ``v_nominal``, ``aim``, (3,)
        each; ``pitch``, ``roll``; ``target`` (2,) [px]; ``view`` and ``nominal_view`` (2, 2)
        [px/m]; ``off_nadir`` [rad], of the nominal line of sight. For inertial sensors ``q_be``
        (4,), the turn off the commanded attitude by pitch, roll and nothing, and over the last
        step ``delta_theta_b`` [rad] of it and ``delta_v_b`` [m/s], which is zero, (3,) each.

    Raises
    ------
    ValueError
        If `geometry` is none of `GEOMETRIES`.
    """
    if geometry not in GEOMETRIES:
        raise ValueError(f"geometry must be one of {GEOMETRIES}, got '{geometry}'")
    sizes = dict.fromkeys(("r", "v", "r_nominal", "v_nominal"), 3)
    sizes |= {"pitch": 1, "roll": 1, "delta_theta_b": 3}
    x = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    names = {*ELEMENTS, *GRAVITY, "accel_psd", "attitude_sigma", "attitude_time"}
    names |= {*LOOK[geometry], *(() if geometry in NADIR else PLACE)}
    p = {name: ca.SX.sym(name) for name in sorted(names)}
    p |= {name: ca.SX.sym(name, 3) for name in ("position_sigma", "velocity_sigma")}
    w = {
        name: ca.SX.sym(name, size)
        for name, size in (("start", 6), ("push", 6), ("turn", 2), ("turned", 2))
    }
    dt, time = ca.SX.sym("dt"), ca.SX.sym("time")
    r0, v0 = state_of_elements([p[name] for name in ELEMENTS], p["mu"])
    r, v = coasted(x["r"], x["v"], p, dt)
    dr, dv = white_acceleration(p["accel_psd"], dt, w["push"][:3], w["push"][3:])
    nominal = coasted(x["r_nominal"], x["v_nominal"], p, dt)
    kept = ca.exp(-dt / p["attitude_time"])
    turn = p["attitude_sigma"] * ca.sqrt(1 - kept * kept) * w["turn"]
    off = ca.vertcat(x["pitch"], x["roll"])
    turned = kept * off + turn
    given = {**p, "r_nominal": x["r_nominal"]}
    given["aim"] = aim_point(x["r_nominal"], given, geometry, time)
    return Model(
        "staring_satellite",
        states=x,
        parameters=p,
        noise=w,
        initial={
            "r": r0 + p["position_sigma"] * w["start"][:3],
            "v": v0 + p["velocity_sigma"] * w["start"][3:],
            "r_nominal": r0,
            "v_nominal": v0,
            "pitch": p["attitude_sigma"] * w["turned"][0],
            "roll": p["attitude_sigma"] * w["turned"][1],
        },
        next={
            "r": r + dr,
            "v": v + dv,
            "r_nominal": nominal[0],
            "v_nominal": nominal[1],
            "pitch": turned[0],
            "roll": turned[1],
            "delta_theta_b": ca.vertcat(turned - off, 0),
        },
        outputs={
            **x,
            "aim": given["aim"],
            "target": target_offset(x, given, geometry),
            "view": ground_view(x["r"], given, geometry),
            "nominal_view": ground_view(x["r_nominal"], given, geometry),
            "off_nadir": off_nadir(x["r_nominal"], given["aim"]),
            "q_be": from_small_rotation_vector(ca.vertcat(off, 0)),
            "delta_v_b": ca.SX.zeros(3),
        },
        step=dt,
        time=time if geometry not in NADIR else None,
    )


_STEPS, _LONGEST = 200, 60.0
"""A run is looked through in so many steps, or more, of at most so long [s]."""


def ever_in_view(model: Model, parameters: Mapping[str, ArrayLike], duration: float) -> bool:
    """Whether the place that a nominal orbit is aimed at is above the horizon at any time.

    Parameters
    ----------
    model : Model
        Of `staring_satellite_model`.
    parameters : mapping of str to array_like
        Its parameters.
    duration : float
        Of the run [s].
    """
    n_steps = max(_STEPS, int(np.ceil(duration / _LONGEST)))
    step = duration / n_steps
    elements = [float(np.asarray(parameters[name])) for name in ELEMENTS]
    r, v = KeplerianElements(*elements).state(float(np.asarray(parameters["mu"])))
    states: dict[str, ArrayLike] = {"r": r, "v": v, "r_nominal": r, "v_nominal": v}
    outputs = model(**states, **parameters)
    for k in range(1, n_steps + 1):
        if float(outputs["off_nadir"][0]) < pi / 2:
            return True
        outputs, ends = model.advance(**states, **parameters, step=step, time=k * step)
        states = {name: ends[name] for name in states}
    return bool(float(outputs["off_nadir"][0]) < pi / 2)
