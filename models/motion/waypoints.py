r"""Waypoints to a plan: legs of constant course, and turns that pass by the corners.

A leg is a rhumb line at its mean height :math:`h`: with the radii of curvature :math:`M, N`,

.. math::
    \tan\chi = \frac{\Delta\lambda}{\int (M + h) / ((N + h) \cos\varphi)\, d\varphi}, \qquad
    s = \frac{\int (M + h)\, d\varphi}{\cos\chi}.

On a flat Earth it is a straight line. A turn begins as long before the corner as it ends after it,
so that the aircraft is on both legs; its corner is taken as flat (half a meter at turns of 2 km).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import atan2, cos, hypot, isfinite, pi, radians, remainder, sin, tan
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.integrate import quad

from terrafix.models.geometry.geodesy import chart_scales
from terrafix.models.motion.flight import BLEND, Segment, Start, blend
from terrafix.models.motion.gravity import STANDARD_GRAVITY
from terrafix.models.motion.strapdown import rotation_rate

_SHARPEST = radians(150.0)
_NEAREST = 1.0
"""Distance [m] below which two waypoints are one."""


@dataclass(frozen=True)
class Waypoint:
    """A corner of the track.

    Parameters
    ----------
    latitude, longitude : float
        [rad]
    height : float
        [m]
    speed : float, optional
        Horizontal, over ground [m/s]; that of the waypoint before if absent.
    bank : float
        With which it turns there [rad].
    """

    latitude: float
    longitude: float
    height: float
    speed: float | None = None
    bank: float = radians(20.0)


class _Corner(NamedTuple):
    """A turn: its change of course, how long its rate lasts, and what it takes of each leg."""

    turn: float
    duration: float
    taken: float


_STRAIGHT = _Corner(0.0, 0.0, 0.0)


def plan_through(waypoints: Sequence[Waypoint], earth: str) -> tuple[Start, list[Segment]]:
    """Start at the first waypoint, and segments along the legs; beyond the last it flies on.

    Parameters
    ----------
    waypoints : sequence of Waypoint
    earth : {"wgs84", "flat"}

    Raises
    ------
    ValueError
        If there are fewer than two, the first has no speed, two are in one place, a corner is
        sharper than 150 degrees, or a leg is too short for the turns at its ends.
    """
    if len(waypoints) < 2:
        raise ValueError(f"a track has two waypoints or more, got {len(waypoints)}")
    if waypoints[0].speed is None:
        raise ValueError("the first waypoint has no speed")
    speeds = [waypoints[0].speed]
    for k, point in enumerate(waypoints):
        numbers = (point.latitude, point.longitude, point.height, point.bank)
        if not all(isfinite(n) for n in numbers) or not 0 < point.bank < pi / 2:
            raise ValueError(f"waypoint {k + 1} has a number that is none, or no bank: {point}")
        if k:
            speeds.append(speeds[-1] if point.speed is None else point.speed)
        if not 0 < speeds[-1] < np.inf:
            raise ValueError(f"waypoint {k + 1} has a speed of {speeds[-1]:g} m/s")
    legs = [_leg(a, b, waypoints[0], earth) for a, b in pairwise(waypoints)]
    for k, (_, length) in enumerate(legs):
        if not length >= _NEAREST:
            raise ValueError(f"waypoints {k + 1} and {k + 2} are in one place ({length:.3g} m)")
    corners = [_STRAIGHT]
    for k in range(1, len(legs)):
        turn = remainder(legs[k][0] - legs[k - 1][0], 2 * pi)
        if abs(turn) > _SHARPEST:
            raise ValueError(
                f"at waypoint {k + 1} the track turns by {np.degrees(abs(turn)):.0f} deg; it turns "
                "by 150 deg at most\n  put a waypoint between"
            )
        corners.append(_corner(turn, waypoints[k].bank, speeds[k]))
    corners.append(_STRAIGHT)
    segments: list[Segment] = []
    for k, (_, length) in enumerate(legs):
        climb = waypoints[k + 1].height - waypoints[k].height
        try:
            segments += _flown(length, corners[k], corners[k + 1], speeds[k : k + 2], climb)
        except ValueError as error:
            raise ValueError(
                f"waypoints {k + 1} and {k + 2} are {length:.0f} m apart; {error}\n"
                "  bank more, fly slower, or move them apart"
            ) from None
        if corners[k + 1].turn:
            segments.append(Segment(corners[k + 1].duration, corners[k + 1].turn))
    first = waypoints[0]
    return Start(first.latitude, first.longitude, first.height, legs[0][0], speeds[0]), segments


def _leg(a: Waypoint, b: Waypoint, origin: Waypoint, earth: str) -> tuple[float, float]:
    """Course [rad] and length [m] from one waypoint to the next."""
    east = remainder(b.longitude - a.longitude, 2 * pi)
    if not rotation_rate(earth):
        meridian, parallel = _scales(origin.latitude)
        north, across = meridian * (b.latitude - a.latitude), parallel * east
        return atan2(across, north), hypot(across, north)
    height = (a.height + b.height) / 2
    north = _integral(lambda p: _scales(p, height)[0], a.latitude, b.latitude)
    stretched = _integral(
        lambda p: _scales(p, height)[0] / _scales(p, height)[1], a.latitude, b.latitude
    )
    course = atan2(east, stretched)
    if abs(cos(course)) > 0.1:
        return course, north / cos(course)
    return course, _scales((a.latitude + b.latitude) / 2, height)[1] * east / sin(course)


def _integral(function: Callable[[float], float], a: float, b: float) -> float:
    return float(quad(function, a, b, epsabs=0, epsrel=1e-13)[0])


def _scales(latitude: float, height: float = 0.0) -> tuple[float, float]:
    """Meters north for a radian of latitude, and east for one of longitude, at a height [m]."""
    meridian, parallel = chart_scales(latitude)
    return float(meridian) + height, float(parallel) + height * cos(latitude)


def _corner(turn: float, bank: float, speed: float) -> _Corner:
    """Build a turn at one speed, rates changing smoothly."""
    if abs(turn) < 1e-9:
        return _STRAIGHT
    rate = STANDARD_GRAVITY * tan(bank) / speed * np.sign(turn)
    duration = float(turn / rate)
    t = np.linspace(-BLEND / 2, duration + BLEND / 2, 4001)
    since = ca.SX.sym("t")
    gone = ca.Function("gone", [since], [blend(since)[2]])
    course = rate * (gone(t[None, :]) - gone(t[None, :] - duration)).full()[0]
    chord = abs(np.trapezoid(np.exp(1j * course), t)) * speed
    return _Corner(turn, duration, float(chord / (2 * cos(turn / 2))))


def _flown(
    length: float, before: _Corner, after: _Corner, speeds: Sequence[float], climb: float
) -> list[Segment]:
    """Segments of a straight leg: speed and height change where no turn is left or begun."""
    holds = [BLEND if corner.turn else BLEND / 2 for corner in (before, after)]
    middle = length - before.taken - after.taken - sum(speeds) * BLEND / 2
    lasting = 2 * middle / sum(speeds)
    if lasting < BLEND:
        needed = length - middle + BLEND * sum(speeds) / 2
        raise ValueError(f"with the turns at its ends a leg needs {needed:.0f} m")
    return [Segment(holds[0]), Segment(lasting, climb=climb, speed=speeds[1]), Segment(holds[1])]
