r"""The orbit of a satellite: its equations of motion, and where to start it.

.. math::
    \dot r_i = v_i, \qquad \dot v_i = g(r_i) + a_i, \qquad \dot s_i = a_i,

with gravity :math:`g` and non-gravitational acceleration :math:`a_i` (drag), whose integral
:math:`s_i` is what an accelerometer triad sums up. Integrated in the inertial frame by the
classical Runge-Kutta method of order four.
"""

from __future__ import annotations

from math import nan
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import (
    earth_angle,
    earth_fixed_from_inertial,
    rotate_about_pole,
)
from terrafix.models.motion.gravity import drag_acceleration, gravity_acceleration


def below_surface(r: Any, radius: Any) -> Any:
    """Whether a position (3,) [m] lies inside an ellipsoid of the Earth's flattening."""
    z = r[2] * (1 / (1 - EARTH.flattening))
    return r[0] * r[0] + r[1] * r[1] + z * z < radius * radius


def orbit_model(gravity: str = "j2", *, drag: bool = False) -> Model:
    """Satellite under gravity and, if wanted, drag of an atmosphere of given density.

    Parameters
    ----------
    gravity : {"j2", "two-body"}
        Gravity field. The parameters are the same for both; two-body leaves ``j2`` unused.
    drag : bool
        Add drag, with the parameters ``density`` [kg/m^3] and ``ballistic_coefficient``, drag
        coefficient times area over mass [m^2/kg].

    Returns
    -------
    Model
        Parameters ``r0_i`` (3,) [m] and ``v0_i`` (3,) [m/s], the start; ``mu`` [m^3/s^2],
        ``radius`` [m], ``j2``, ``rotation_rate`` [rad/s], and ``earth_angle0`` [rad], the angle
        from the inertial to the Earth-fixed x axis at time zero. Outputs ``r_i``, ``v_i``,
        ``r_e``, ``v_e``, (3,) each, and ``delta_v_e`` (3,) [m/s], the non-gravitational velocity
        increment over the last step in the Earth-fixed axes at its end. Below the surface, the
        ellipsoid of ``radius`` and the Earth's flattening, ``r_e`` is not a number.

    Raises
    ------
    ValueError
        If `gravity` is not a known field.
    """
    acceleration = gravity_acceleration(gravity)
    r, v, r0, v0 = (ca.SX.sym(name, 3) for name in ("r_i", "v_i", "r0_i", "v0_i"))
    names = ("mu", "radius", "j2", "rotation_rate", "earth_angle0")
    constants = {name: ca.SX.sym(name) for name in names}
    mu, radius, j2, rate, angle0 = constants.values()
    dt, time = ca.SX.sym("dt"), ca.SX.sym("time")
    states = {"r_i": r, "v_i": v}
    derivatives = {"r_i": v, "v_i": acceleration(r, mu, radius, j2)}
    following: dict[str, Any] = {}
    angle = earth_angle(angle0, rate, time)
    delta_v_e = ca.SX.zeros(3)
    if drag:
        air = ("density", "ballistic_coefficient")
        constants |= {name: ca.SX.sym(name) for name in air}
        sensed, sensed_before = ca.SX.sym("sensed_v_i", 3), ca.SX.sym("sensed_v_before_i", 3)
        felt = drag_acceleration(
            r, v, constants["density"], constants["ballistic_coefficient"], rate
        )
        states |= {"sensed_v_i": sensed, "sensed_v_before_i": sensed_before}
        derivatives = {
            "r_i": v,
            "v_i": derivatives["v_i"] + felt,
            "sensed_v_i": felt,
        }
        following = {"sensed_v_before_i": sensed}
        delta_v_e = rotate_about_pole(angle, sensed - sensed_before)
    r_e, v_e = earth_fixed_from_inertial(r, v, angle, rate)
    r_e *= 1 + ca.if_else(below_surface(r, radius), nan, 0.0)
    return Model(
        "orbit",
        states=states,
        parameters={"r0_i": r0, "v0_i": v0, **constants},
        derivatives=derivatives,
        next=following,
        initial={"r_i": r0, "v_i": v0},
        outputs={"r_i": r, "v_i": v, "r_e": r_e, "v_e": v_e, "delta_v_e": delta_v_e},
        step=dt,
        time=time,
    )
