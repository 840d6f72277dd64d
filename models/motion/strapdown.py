r"""Strapdown mechanization: position, velocity and attitude from the increments of an IMU.

One set of equations, in a frame "e" that is fixed to the Earth,

.. math::
    \dot r = v, \qquad
    \dot v = C_{eb} f_b + \gamma(r) - 2\, \omega \times v, \qquad
    \dot C_{be} = -[(\omega_{ib}^b - C_{be}\, \omega) \times]\, C_{be},

with :math:`v` relative to the Earth, :math:`\gamma` gravity with its centrifugal part. Two Earths:

- "wgs84": e is the Earth-fixed frame of `terrafix.models.motion.orbit`, :math:`\omega` the Earth's
  rotation, :math:`\gamma` normal gravity along the ellipsoid's normal. There is no transport rate,
  and no latitude where it fails.
- "flat": e *is* north, east, down from an origin on the ground, :math:`\omega = 0`, :math:`\gamma`
  standard gravity down: the local level, non-rotating flat Earth of [3]_.

North, east, down (frame "n"), latitude, longitude, height, roll, pitch and heading are views of
that state, `level_view`. The angles are those of pyins: :math:`C_{nb} = R_z(\text{heading})
R_y(\text{pitch}) R_x(\text{roll})`, body axes forward, right, down.

An IMU tells the integrals of rate and specific force over a step in its own turning axes,

.. math::
    \Delta\theta = \int \omega_{ib}^b\, dt, \qquad \Delta v = \int f_b\, dt.

If both are *held* over a step, a step is in closed form: attitude turns by :math:`\Delta\theta`
about a fixed axis, and with :math:`\Theta = [\Delta\theta \times]` velocity and position gain, in
the body axes of the step's start,

.. math::
    \int_0^1 e^{s \Theta} ds\, \Delta v = (I + a_1 \Theta + a_2 \Theta^2)\, \Delta v, \qquad
    \int_0^1 (1 - s)\, e^{s \Theta} ds\, \Delta v\, \Delta t
        = (\tfrac12 I + a_2 \Theta + a_3 \Theta^2)\, \Delta v\, \Delta t.

That is carried in inertial axes which coincide with e at the start of the step, with the
gravitation of its middle, and turned to the e axes of its end. So a trajectory of held rates and
forces is reproduced to rounding, apart from the change of gravitation within a step
(:math:`\dot g\, \Delta t^3 / 12`): 8e-6 m after 600 s with turns at 100 Hz, against 1 kHz.

Where rate and force move within a step, `two_sample` corrects its increments by those of the step
before (coning, sculling), as if both were linear over the two [1]_, [2]_.

References
----------
.. [1] P. G. Savage, "Strapdown Inertial Navigation Integration Algorithm Design Part 1: Attitude
       Algorithms", J. Guidance, Control, and Dynamics 21(1), 1998.
.. [2] P. G. Savage, "... Part 2: Velocity and Position Algorithms", ibid. 21(2), 1998.
.. [3] The aircraft paper (`docs/aircraft.md`), eqs. (21)-(25).
.. [4] P. D. Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems",
       2nd edition, 2013, section 5.3 (ECEF-frame navigation equations).
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import casadi as ca

from terrafix.models.core.batch import over_members
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_rate_cross
from terrafix.models.geometry.geodesy import (
    chart_scales,
    ecef_from_geodetic,
    geodetic_from_ecef,
    north_east_down,
)
from terrafix.models.geometry.quaternion import (
    from_matrix,
    from_rotation_vector,
    inverse,
    normalized,
    product,
    rotation_matrix,
    rotation_vector,
)
from terrafix.models.motion.gravity import STANDARD_GRAVITY, normal_gravity

EARTHS = ("wgs84", "flat")
"""Names of the Earths."""

INCREMENTS = ("held", "two-sample")
"""Names of what is assumed of rate and force within a step."""

_TERMS = 6
"""Of the series in the angle of a step; what is left out is below 1e-11 at one radian."""


class Motion(NamedTuple):
    """Where a body is, how it moves and how it lies: symbols.

    Attributes
    ----------
    r_e : SX, shape (3,)
        Position [m].
    v_e : SX, shape (3,)
        Velocity relative to the Earth [m/s].
    q_be : SX, shape (4,)
        Attitude, e to body.
    """

    r_e: Any
    v_e: Any
    q_be: Any

    @property
    def named(self) -> dict[str, Any]:
        """By the names of its parts."""
        return {"r_e": self.r_e, "v_e": self.v_e, "q_be": self.q_be}


def rotation_rate(earth: str) -> float:
    """Rotation of an Earth about the z axis of e [rad/s].

    Raises
    ------
    ValueError
        If `earth` is none of `EARTHS`.
    """
    if earth not in EARTHS:
        raise ValueError(f"earth must be one of {EARTHS}, got '{earth}'")
    return EARTH.rotation_rate if earth == "wgs84" else 0.0


def level_axes(r_e: Any, earth: str) -> Any:
    """Transformation (3, 3) from e to north, east, down at a position (3,) [m]."""
    if rotation_rate(earth):
        return north_east_down(r_e)[0]
    return ca.SX.eye(3)


def height_of(r_e: Any, earth: str) -> Any:
    """Height [m] above the ellipsoid, or the ground of a flat Earth, of a position (3,) [m]."""
    return geodetic_from_ecef(r_e)[2] if rotation_rate(earth) else -r_e[2]


def gravity(r_e: Any, earth: str) -> Any:
    """Gravity (3,) [m/s^2] in e at a position (3,) [m]: gravitation and centrifugal part."""
    if rotation_rate(earth):
        axes, sin_latitude, height = north_east_down(r_e)
        return normal_gravity(sin_latitude, height) * axes[2, :].T
    return ca.SX([0, 0, STANDARD_GRAVITY])


def mechanized(motion: Motion, delta_v_b: Any, delta_theta_b: Any, dt: Any, earth: str) -> Motion:
    """Advance by the increments of a step over which rate and specific force are held.

    Parameters
    ----------
    motion : Motion
        At the start.
    delta_v_b, delta_theta_b : SX, shape (3,)
        Integrals of specific force [m/s] and of the rate relative to inertial space [rad].
    dt : SX
        Length of the step [s].
    earth : {"wgs84", "flat"}
    """
    rate = rotation_rate(earth)
    C_eb = rotation_matrix(motion.q_be).T
    gained, moved = _turning(delta_theta_b, delta_v_b)
    v_i, g = _inertial(motion, dt, earth)
    r_i = motion.r_e + dt * (v_i + ca.mtimes(C_eb, moved) + dt / 2 * g)
    r_e = _turned_about_pole(rate * dt, r_i)
    v_e = _turned_about_pole(rate * dt, v_i + ca.mtimes(C_eb, gained) + dt * g)
    turn = from_rotation_vector(delta_theta_b)
    q_be = product(product(turn, motion.q_be), inverse(_earth_turn(rate, dt)))
    # rounding that is the same in every step would let the length drift, and the force with it
    return Motion(r_e, v_e - earth_rate_cross(rate, r_e), normalized(q_be))


def increments_between(motion: Motion, v_e: Any, q_be: Any, dt: Any, earth: str) -> Any:
    """Increments that lead to a velocity (3,) and an attitude (4,): `mechanized` turned round.

    Attitude is met to rounding, velocity to the Earth's rotation times half the acceleration over
    the square of a step (2e-8 m/s at 100 Hz and 0.5 g). Where that leads is `mechanized`'s to say.

    Returns
    -------
    delta_v_b, delta_theta_b : SX, shape (3,)
    """
    rate = rotation_rate(earth)
    turn = product(product(q_be, _earth_turn(rate, dt)), inverse(motion.q_be))
    theta = rotation_vector(turn)
    v_i, g = _inertial(motion, dt, earth)
    r_e = _turned_about_pole(rate * dt, motion.r_e + dt * v_i)
    end_i = _turned_about_pole(-rate * dt, v_e + earth_rate_cross(rate, r_e))
    gained = ca.mtimes(rotation_matrix(motion.q_be), end_i - v_i - dt * g)
    return _held_still(theta, gained), theta


def _inertial(motion: Motion, dt: Any, earth: str) -> tuple[Any, Any]:
    """Inertial velocity, and gravitation in the middle of a step, in e axes of its start."""
    rate = rotation_rate(earth)
    v_i = motion.v_e + earth_rate_cross(rate, motion.r_e)
    middle = motion.r_e + dt / 2 * v_i
    outward = earth_rate_cross(rate, earth_rate_cross(rate, middle))
    return v_i, gravity(middle, earth) + outward


def _turned_about_pole(angle: Any, vector: Any) -> Any:
    """Components (3,) in axes turned by a small angle [rad] about the polar axis.

    What the turn changes is added: a cosine near one is rounded alike in every step, which after
    ten minutes at 1 kHz is 0.2 mm of position.
    """
    s, k = ca.sin(angle), 2 * ca.sin(angle / 2) ** 2
    x, y, z = vector[0], vector[1], vector[2]
    return ca.vertcat(x + (s * y - k * x), y - (s * x + k * y), z)


def _earth_turn(rate: float, dt: Any) -> Any:
    half = rate * dt / 2
    return ca.vertcat(0, 0, ca.sin(half), ca.cos(half))


def _alternating(squared: Any, first: int) -> Any:
    """The series of (-x)^k / (2 k + first)! at x = `squared`."""
    total = ca.SX(0)
    for k in reversed(range(_TERMS)):
        total = 1 / factorial(2 * k + first) - squared * total
    return total


def _turning(theta: Any, delta_v: Any) -> tuple[Any, Any]:
    """What velocity, and position over the length of the step, gain by an increment that turns."""
    squared = ca.dot(theta, theta)
    a1, a2, a3 = (_alternating(squared, first) for first in (2, 3, 4))
    once = ca.cross(theta, delta_v)
    twice = ca.cross(theta, once)
    return delta_v + a1 * once + a2 * twice, delta_v / 2 + a2 * once + a3 * twice


def _held_still(theta: Any, gained: Any) -> Any:
    """The increment in turning axes of what velocity gains: the first of `_turning`, inverted."""
    squared = ca.dot(theta, theta)
    # 1/x^2 - cot(x/2) / (2 x), Bernoulli numbers over factorials
    a = 1 / 12 + squared * (
        1 / 720 + squared * (1 / 30240 + squared * (1 / 1209600 + squared * (1 / 47900160)))
    )
    once = ca.cross(theta, gained)
    return gained - once / 2 + a * ca.cross(theta, once)


def at_end(delta_v_b: Any, delta_theta_b: Any) -> Any:
    """Change of velocity by specific force (3,) [m/s], in the body axes of a step's end.

    Of the integrals of specific force and rate in turning axes, both held: what `lvlh_attitude`
    calls its increment. They differ by half of the rotation times the increment.
    """
    return _turning(-delta_theta_b, delta_v_b)[0]


def two_sample(delta_v: Any, delta_theta: Any, earlier_v: Any, earlier_theta: Any) -> Any:
    r"""Increments corrected for coning and sculling by those of the step before.

    .. math::
        \Delta\theta + \tfrac1{12} \Delta\theta_- \times \Delta\theta, \qquad
        \Delta v + \tfrac1{12} (\Delta\theta_- \times \Delta v + \Delta v_- \times \Delta\theta),

    exact to the third order of the step where rate and force are linear over both steps [1]_, [2]_;
    the rotation of the force within the step is left to `mechanized`.

    Parameters
    ----------
    delta_v, delta_theta : SX, shape (3,)
        Of this step.
    earlier_v, earlier_theta : SX, shape (3,)
        Of the step before, of the same length.

    Returns
    -------
    delta_v, delta_theta : SX, shape (3,)
    """
    sculling = ca.cross(earlier_theta, delta_v) + ca.cross(earlier_v, delta_theta)
    return delta_v + sculling / 12, delta_theta + ca.cross(earlier_theta, delta_theta) / 12


def from_level(
    latitude: Any,
    longitude: Any,
    height: Any,
    v_n: Any,
    angles: Any,
    earth: str,
    origin: Any = (0.0, 0.0),
) -> Motion:
    """Motion of a local-level one.

    Parameters
    ----------
    latitude, longitude, height : SX
        [rad], [rad], [m].
    v_n : SX, shape (3,)
        Velocity north, east, down [m/s].
    angles : SX, shape (3,)
        Roll, pitch, heading [rad].
    earth : {"wgs84", "flat"}
    origin : (SX, SX)
        Latitude and longitude of the origin of the flat Earth, as of `level_view`.
    """
    if rotation_rate(earth):
        r_e = ecef_from_geodetic(latitude, longitude, height)
    else:
        north, east = chart_scales(origin[0])
        r_e = ca.vertcat(north * (latitude - origin[0]), east * (longitude - origin[1]), -height)
    axes = level_axes(r_e, earth)
    q_be = product(quaternion_from_angles(angles), from_matrix(axes))
    return Motion(r_e, ca.mtimes(axes.T, v_n), q_be)


def quaternion_from_angles(angles: Any) -> Any:
    """Attitude (4,), north-east-down to body, of roll, pitch and heading (3,) [rad]."""
    half = angles / 2
    roll = ca.vertcat(ca.sin(half[0]), 0, 0, ca.cos(half[0]))
    pitch = ca.vertcat(0, ca.sin(half[1]), 0, ca.cos(half[1]))
    heading = ca.vertcat(0, 0, ca.sin(half[2]), ca.cos(half[2]))
    return product(product(roll, pitch), heading)


def angles_from_matrix(C_bn: Any) -> Any:
    """Roll, pitch and heading (3,) [rad] of a transformation (3, 3), north-east-down to body."""
    level = ca.sqrt(C_bn[1, 2] ** 2 + C_bn[2, 2] ** 2)
    return ca.vertcat(
        ca.atan2(C_bn[1, 2], C_bn[2, 2]),
        ca.atan2(-C_bn[0, 2], level),
        ca.atan2(C_bn[0, 1], C_bn[0, 0]),
    )


def level_view(motion: Motion, earth: str, origin: Any = (0.0, 0.0)) -> dict[str, Any]:
    """What a motion is in local level terms.

    Parameters
    ----------
    motion : Motion
    earth : {"wgs84", "flat"}
    origin : (SX, SX)
        Latitude and longitude of the origin of the flat Earth [rad], whose north and east are
        drawn on the ellipsoid in the scales of that place.

    Returns
    -------
    dict of str to SX
        ``latitude``, ``longitude`` [rad], ``height`` [m], ``v_n`` (3,) north, east, down [m/s],
        ``angles`` (3,): roll, pitch, heading [rad].
    """
    axes = level_axes(motion.r_e, earth)
    if rotation_rate(earth):
        place = geodetic_from_ecef(motion.r_e)
    else:
        north, east = chart_scales(origin[0])
        r_e = motion.r_e
        place = (origin[0] + r_e[0] / north, origin[1] + r_e[1] / east, -r_e[2])
    C_bn = ca.mtimes(rotation_matrix(motion.q_be), axes.T)
    named = dict(zip(("latitude", "longitude", "height"), place, strict=True))
    return named | {"v_n": ca.mtimes(axes, motion.v_e), "angles": angles_from_matrix(C_bn)}


quaternion_from_angles_array = over_members(quaternion_from_angles, (3,))


def strapdown_model(earth: str = "wgs84", increments: str = "held") -> Model:
    """Free inertial navigation: what follows from a start and the increments.

    Parameters
    ----------
    earth : {"wgs84", "flat"}
    increments : {"held", "two-sample"}
        How rate and force move within a step: not at all, or as `two_sample` has it.

    Returns
    -------
    Model
        Inputs ``delta_v_b`` [m/s], ``delta_theta_b`` [rad], (3,) each. Parameters ``r0_e`` [m],
        ``v0_e`` [m/s], ``q0_be``: the start. States and outputs ``r_e``, ``v_e``, ``q_be``.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    if increments not in INCREMENTS:
        raise ValueError(f"increments must be one of {INCREMENTS}, got '{increments}'")
    motion = Motion(ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3), ca.SX.sym("q_be", 4))
    start = Motion(ca.SX.sym("r0_e", 3), ca.SX.sym("v0_e", 3), ca.SX.sym("q0_be", 4))
    inputs = {name: ca.SX.sym(name, 3) for name in ("delta_v_b", "delta_theta_b")}
    kept = {}
    dt = ca.SX.sym("dt")
    delta_v, delta_theta = inputs.values()
    if increments == "two-sample":
        kept = {f"earlier_{name}": ca.SX.sym(f"earlier_{name}", 3) for name in inputs}
        delta_v, delta_theta = two_sample(delta_v, delta_theta, *kept.values())
    end = mechanized(motion, delta_v, delta_theta, dt, earth)
    return Model(
        f"strapdown_{earth}_{increments}".replace("-", "_"),
        inputs=inputs,
        states=motion.named | kept,
        parameters=dict(zip(("r0_e", "v0_e", "q0_be"), start, strict=True)),
        next=end.named | dict(zip(kept, inputs.values(), strict=False)),
        initial=start.named,
        outputs=motion.named,
        step=dt,
    )


def level_view_model(earth: str = "wgs84") -> Model:
    """Latitude, longitude, height, velocity and angles of a motion.

    Parameters
    ----------
    earth : {"wgs84", "flat"}

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``v_e`` [m/s], ``q_be``; of the flat Earth the parameters ``latitude0``
        and ``longitude0`` [rad]. Outputs as of `level_view`, ``roll``, ``pitch`` and ``heading``
        [rad] one by one.
    """
    motion = Motion(ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3), ca.SX.sym("q_be", 4))
    origin = {name: ca.SX.sym(name) for name in ("latitude0", "longitude0")}
    view = level_view(motion, earth, tuple(origin.values()))
    angles = dict(zip(("roll", "pitch", "heading"), ca.vertsplit(view.pop("angles")), strict=True))
    return Model(
        f"level_view_{earth}",
        inputs=motion.named,
        parameters={} if rotation_rate(earth) else origin,
        outputs=view | angles,
    )
