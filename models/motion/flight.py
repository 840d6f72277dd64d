r"""An aircraft that flies a plan: courses, speeds and climbs over the ground, wind and gusts.

A plan is a sequence of segments over each of which course, speed and height change at one rate.
Rates change smoothly: about the instant :math:`t_k` between two segments, over `BLEND`, along

.. math::
    S(x) = x^3 (10 - 15 x + 6 x^2), \qquad x = \tfrac12 + (t - t_k) / T_b \in [0, 1],

so that course, speed and height in the end have changed by what the segments say. Speed is
horizontal and over ground; after the last segment it flies straight and level.

The aircraft turns coordinated and without sideslip: the body's x axis is along the velocity through
the air of the plan, and the specific force of the plan has no part along the y axis, so that a
turn banks it by :math:`\tan\phi = V \dot\chi / g` and wind turns its nose.

Gusts act as follows. Along the course, to its right and down, the aircraft is off its planned
velocity by :math:`\delta v` and off its planned place by :math:`\delta p`. It follows the air with
time constant :math:`\tau` while its pilot flies against the displacement; its nose turns into the
air that streams by, and it rolls away from a gust from the side, by an angle of gain :math:`k`,

.. math::
    \dot{\delta p} = \delta v, \qquad
    \tau\, \dot{\delta v} = g - \delta p / T_h - \delta v, \qquad
    \tau\, \dot{\delta\alpha} = \tfrac{k}{V} (s_y, s_z, -s_y) - \delta\alpha,

roll, pitch and yaw, with :math:`s = g - \delta v`. It is a caricature with the right magnitudes and
a place in the air, without the stability derivatives of any aircraft.

What is flown is not the plan but its mechanization (`terrafix.models.motion.strapdown`): at each
step the increments that lead to the planned velocity and attitude are found, held, and mechanized.
So the truth is a trajectory of Newton's equations, its increments are the integrals that an ideal
IMU tells, to rounding, and the flight differs from the plan by the trapezoidal rule's error, some
:math:`\Delta t^2 / 12` times the change of acceleration (1e-5 m at 100 Hz).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import isfinite, radians, tan
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from terrafix.models.core.model import Model
from terrafix.models.geometry.quaternion import (
    from_matrix,
    from_matrix_near,
    from_small_rotation_vector,
    product,
)
from terrafix.models.motion.dryden import N_STATES, blown, gusts, military_scales, started
from terrafix.models.motion.gravity import STANDARD_GRAVITY
from terrafix.models.motion.strapdown import (
    Motion,
    at_end,
    from_level,
    increments_between,
    level_axes,
    mechanized,
)

BLEND = 4.0
"""Time [s] in which rates change from one segment to the next."""

TURBULENCE = ("none", "dryden", "mil-f-8785c")
"""Names of the air: still, Dryden's of given scales, and of those of the specification."""

_G = ca.DM([0, 0, STANDARD_GRAVITY])
_STEEPEST = radians(75.0)


@dataclass(frozen=True)
class Segment:
    """A part of a plan.

    Parameters
    ----------
    duration : float, optional
        [s]; of a turn with a bank it follows.
    turn : float
        Change of course [rad], to the right.
    bank : float, optional
        Of a turn [rad]: its rate follows from the speed at the start of the segment.
    climb : float
        Change of height [m].
    speed : float, optional
        At the end [m/s], horizontal over ground; that of the start if absent.

    Raises
    ------
    ValueError
        If it does not say how long it lasts, says it twice, or a number is none.
    """

    duration: float | None = None
    turn: float = 0.0
    bank: float | None = None
    climb: float = 0.0
    speed: float | None = None

    def __post_init__(self) -> None:
        for name in ("duration", "turn", "bank", "climb", "speed"):
            value = getattr(self, name)
            if value is not None and not isfinite(value):
                raise ValueError(f"its {name} is {value}")
        if (self.duration is None) == (self.bank is None):
            raise ValueError("it has a duration, or a turn with a bank: one of them")
        if self.duration is not None and self.duration <= 0:
            raise ValueError(f"its duration is {self.duration:g} s; it must be positive")
        if self.bank is not None and not (0 < self.bank <= _STEEPEST and self.turn):
            raise ValueError(
                f"a bank of {np.degrees(self.bank):g} deg with a turn of "
                f"{np.degrees(self.turn):g} deg; a bank is above 0 and at most 75 deg, of a turn"
            )
        if self.speed is not None and self.speed <= 0:
            raise ValueError(f"its speed is {self.speed:g} m/s; it must be positive")


class Rates(NamedTuple):
    """Of one segment, and when it ends: numbers, or symbols where the speed is one."""

    end: Any
    turn: Any
    climb: Any
    acceleration: Any


_LEVEL = Rates(0.0, 0.0, 0.0, 0.0)


class Planned(NamedTuple):
    """What a plan says of an instant: symbols.

    Attributes
    ----------
    course : SX
        [rad]
    v_n, a_n : SX, shape (3,)
        Velocity over ground [m/s] and its rate [m/s^2], north, east, down.
    """

    course: Any
    v_n: Any
    a_n: Any


def blend(since: Any) -> tuple[Any, Any, Any]:
    """S' [1/s], S, and its integral [s], at a time since the middle of a change [s]: symbols."""
    x = ca.fmin(ca.fmax(0.5 + since / BLEND, 0), 1)
    gone = BLEND * x**4 * (2.5 - x * (3 - x)) + ca.fmax(since - BLEND / 2, 0)
    return 30 * x**2 * (1 - x) ** 2 / BLEND, x**3 * (10 - x * (15 - 6 * x)), gone


def rates_of(segments: Sequence[Segment], speed: Any) -> list[Rates]:
    """Rates of segments flown one after the other from a speed [m/s]."""
    found: list[Rates] = []
    now: Any = 0.0
    for segment in segments:
        duration: Any = segment.duration
        if segment.bank is not None:
            duration = speed * abs(segment.turn) / (STANDARD_GRAVITY * tan(segment.bank))
        if not found and isinstance(duration, float) and duration < BLEND / 2:
            raise ValueError(
                f"segment 1 lasts {duration:.3g} s; the first lasts {BLEND / 2:g} s or more"
            )
        end = speed if segment.speed is None else segment.speed
        now = now + duration
        changes = (segment.turn, segment.climb, end - speed)
        found.append(Rates(now, *(change / duration for change in changes)))
        speed = end
    return found


def planned(rates: Sequence[Rates], course: Any, speed: Any, t: Any) -> Planned:
    """Build course, velocity and acceleration at a time.

    Parameters
    ----------
    rates : sequence of Rates
    course, speed : SX or float
        At t = 0 [rad], [m/s].
    t : SX
        [s], not negative.
    """
    first = rates[0] if rates else _LEVEL
    turn, climb, acceleration = (ca.SX(r) for r in first[1:])
    rising: Any = ca.SX(0)
    course, speed = course + turn * t, speed + acceleration * t
    for now, following in pairwise([*rates, _LEVEL]):
        change = [b - a for a, b in zip(now[1:], following[1:], strict=True)]
        growing, share, gone = blend(t - now.end)
        course += change[0] * gone
        turn += change[0] * share
        climb += change[1] * share
        rising += change[1] * growing
        speed += change[2] * gone
        acceleration += change[2] * share
    c, s = ca.cos(course), ca.sin(course)
    v_n = ca.vertcat(speed * c, speed * s, -climb)
    sideways = speed * turn
    a_n = ca.vertcat(acceleration * c - sideways * s, acceleration * s + sideways * c, -rising)
    return Planned(course, v_n, a_n)


def coordinated_axes(air: Any, force: Any) -> Any:
    """Transformation (3, 3), to body axes, of a coordinated flight without sideslip.

    Parameters
    ----------
    air, force : SX, shape (3,)
        Velocity through the air [m/s] and specific force [m/s^2], in any axes.
    """
    x = air / ca.norm_2(air)
    z = ca.dot(force, x) * x - force
    z = z / ca.norm_2(z)
    return ca.horzcat(x, ca.cross(z, x), z).T


class Start(NamedTuple):
    """Where and how a plan begins: numbers, or symbols."""

    latitude: Any
    longitude: Any
    height: Any
    course: Any
    speed: Any


@dataclass(frozen=True)
class _Air:
    """What the air does to the aircraft: expressions of the end of a step; nothing where still."""

    off_v: Any = field(default_factory=lambda: ca.SX.zeros(3))
    off_angles: Any = field(default_factory=lambda: ca.SX.zeros(3))
    gust: Any = field(default_factory=lambda: ca.SX.zeros(3))
    states: dict[str, Any] = field(default_factory=dict)
    next: dict[str, Any] = field(default_factory=dict)
    initial: dict[str, Any] = field(default_factory=dict)
    noise: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)


def _dryden(turbulence: str, height: Any, speed: Any, dt: Any) -> _Air:
    """Dryden's gusts, and how the aircraft follows them: held over a step at their mean."""
    air, noise = ca.SX.sym("air", N_STATES), ca.SX.sym("air_noise", N_STATES)
    off = {name: ca.SX.sym(name, 3) for name in ("off_p", "off_v", "off_angles")}
    if turbulence == "dryden":
        scales = {name: ca.SX.sym(name, 3) for name in ("gust_sigma", "gust_length")}
        sigma, length = scales.values()
    else:
        scales = {name: ca.SX.sym(name) for name in ("wind_20ft", "ground")}
        sigma, length = military_scales(height - scales["ground"], scales["wind_20ft"])
    scalars = {n: ca.SX.sym(n) for n in ("response_time", "hold_time", "attitude_response")}
    tau, hold, gain = scalars.values()
    after = blown(air, sigma, noise, length / speed, dt)
    left = ca.exp(-dt / tau)
    wanted = (gusts(air) + gusts(after)) / 2 - off["off_p"] / hold
    lag = off["off_v"] - wanted
    off_v = wanted + left * lag
    stream = gusts(after) - off_v
    leaning = gain / speed * ca.vertcat(stream[1], stream[2], -stream[1])
    following = {
        "off_p": off["off_p"] + dt * wanted + tau * (1 - left) * lag,
        "off_v": off_v,
        "off_angles": leaning + left * (off["off_angles"] - leaning),
    }
    return _Air(
        off_v,
        following["off_angles"],
        gusts(air),
        states={"air": air} | off,
        next={"air": after} | following,
        initial={"air": started(sigma, noise)},
        noise={"air_noise": noise},
        parameters=scales | scalars,
    )


START = ("latitude", "longitude", "height", "course", "speed")
"""Parameters that are a start."""


def flight_model(
    segments: Sequence[Segment],
    earth: str = "wgs84",
    turbulence: str = "none",
    start: Start | None = None,
) -> Model:
    """Aircraft that flies a plan, and what an ideal inertial sensor makes of it.

    Parameters
    ----------
    segments : sequence of Segment
        None: straight and level.
    earth : {"wgs84", "flat"}
    turbulence : {"none", "dryden", "mil-f-8785c"}
        Scales of gusts, airspeed and height are those of the start.
    start : Start, optional
        Parameters ``latitude``, ``longitude`` [rad], ``height`` [m], ``course`` [rad] and ``speed``
        [m/s] in its absence.

    Returns
    -------
    Model
        Parameter ``wind_n`` (3,) [m/s]; of Dryden's air ``gust_sigma`` (3,) [m/s], ``gust_length``
        (3,) [m], or ``wind_20ft`` [m/s] and ``ground`` [m]; and ``response_time`` [s],
        ``hold_time`` [s], ``attitude_response``. Outputs ``r_e`` [m], ``v_e`` [m/s], ``q_be``;
        ``delta_v_b`` [m/s] and ``delta_theta_b`` [rad], the integrals of specific force and
        inertial rate in the turning body axes; ``delta_v_end_b`` [m/s], the change of velocity by
        specific force in the body axes of the end; ``gust`` (3,) [m/s] along, right, down. The
        noise of a step draws the air's start, too.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    if turbulence not in TURBULENCE:
        raise ValueError(f"turbulence must be one of {TURBULENCE}, got '{turbulence}'")
    parameters: dict[str, Any] = {}
    begin = start
    if begin is None:
        parameters = {name: ca.SX.sym(name) for name in START}
        begin = Start(**parameters)
    wind = parameters["wind_n"] = ca.SX.sym("wind_n", 3)
    t, dt = ca.SX.sym("t"), ca.SX.sym("dt")
    motion = Motion(ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3), ca.SX.sym("q_be", 4))
    increments = {n: ca.SX.sym(n, 3) for n in ("delta_v_b", "delta_theta_b")}
    air = _Air()
    if turbulence != "none":
        air = _dryden(turbulence, begin.height, begin.speed, dt)
    parameters |= air.parameters

    rates = rates_of(segments, begin.speed)
    now = planned(rates, begin.course, begin.speed, t)
    axes = level_axes(motion.r_e + dt * motion.v_e, earth)
    c, s = ca.cos(now.course), ca.sin(now.course)
    ahead, right, down = ca.vertsplit(air.off_v)
    off_n = ca.vertcat(c * ahead - s * right, s * ahead + c * right, down)
    v_e = ca.mtimes(axes.T, now.v_n + off_n)
    turn = from_small_rotation_vector(air.off_angles)
    q_be = product(turn, from_matrix_near(_body_axes(now, wind, axes), motion.q_be))
    dv, dtheta = increments_between(motion, v_e, q_be, dt, earth)
    end = mechanized(motion, dv, dtheta, dt, earth)
    return Model(
        f"flight_{earth}_{turbulence}".replace("-", "_"),
        states=motion.named | increments | air.states,
        parameters=parameters,
        noise=air.noise,
        next=end.named | {"delta_v_b": dv, "delta_theta_b": dtheta} | air.next,
        initial=_begun(begin, rates, wind, earth) | air.initial,
        outputs=motion.named
        | increments
        | {"delta_v_end_b": at_end(**increments), "gust": air.gust},
        step=dt,
        time=t,
    )


def _body_axes(plan: Planned, wind: Any, axes: Any) -> Any:
    """Transformation (3, 3), e to body, of who flies a plan in a wind; `axes` are e to level."""
    return ca.mtimes(coordinated_axes(plan.v_n - wind, plan.a_n - _G), axes)


def _begun(begin: Start, rates: Sequence[Rates], wind: Any, earth: str) -> dict[str, Any]:
    """Motion at the start of a plan."""
    first = planned(rates, begin.course, begin.speed, ca.SX(0))
    place = (begin.latitude, begin.longitude)
    upright = from_level(*place, begin.height, first.v_n, ca.SX.zeros(3), earth, place)
    body = _body_axes(first, wind, level_axes(upright.r_e, earth))
    return upright.named | {"q_be": from_matrix(body)}
