r"""Maneuvers of a satellite: velocity increments along radial, transverse and normal axes.

A maneuver has constant acceleration in those axes. Over a step from :math:`t_0` to :math:`t_1` it
gives the share of its increment that falls into it, as if at the middle of the step, and the
displacement until then of what was given earlier or later: nothing of it depends on how the steps
lie to the maneuver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

SHORTEST = 1e-3
"""What an impulse takes [s]: so short that it moves nothing, so long that clocks can tell it."""


@dataclass(frozen=True)
class Maneuver:
    """One maneuver.

    Parameters
    ----------
    start : float
        [s]
    duration : float
        [s]; zero for an impulse.
    delta_v : tuple of float
        Radial, transverse (along the track), normal to the orbit [m/s].

    Raises
    ------
    ValueError
        If it starts before zero, or lasts less than nothing.
    """

    start: float
    duration: float
    delta_v: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not self.start >= 0:
            raise ValueError(f"starts at {self.start:g} s, before the run")
        if not self.duration >= 0:
            raise ValueError(f"lasts {self.duration:g} s; a duration is not negative")

    @property
    def impulsive(self) -> bool:
        """Whether it is an impulse."""
        return self.duration == 0

    @property
    def length(self) -> float:
        """How long it takes as flown [s]."""
        return max(self.duration, SHORTEST)

    @property
    def end(self) -> float:
        """When it ends [s]."""
        return self.start + self.length


def radial_axes(r: Any, v: Any) -> Any:
    """Transformation (3, 3) from radial, transverse and normal axes to those of r and v.

    Parameters
    ----------
    r, v : SX, shape (3,)
        Position and inertial velocity, in the same axes.
    """
    radial = r / ca.sqrt(ca.dot(r, r))
    normal = ca.cross(r, v)
    normal = normal / ca.sqrt(ca.dot(normal, normal))
    return ca.horzcat(radial, ca.cross(normal, radial), normal)


def burned(maneuvers: Sequence[Maneuver], start: Any, end: Any) -> tuple[Any, Any]:
    """Velocity increment [m/s] and displacement [m] of a step, in radial axes, (3,) each.

    Parameters
    ----------
    maneuvers : sequence of Maneuver
    start, end : SX
        Of the step [s].

    Returns
    -------
    tuple of SX
        What is to be added to velocity and to position in the middle of the step.
    """
    increment, displacement = ca.SX.zeros(3), ca.SX.zeros(3)
    middle = (start + end) / 2
    for each in maneuvers:
        first = ca.fmin(ca.fmax(start, each.start), each.end)
        last = ca.fmin(ca.fmax(end, each.start), each.end)
        given = (last - first) / each.length * ca.DM(np.asarray(each.delta_v))
        increment += given
        displacement += given * (middle - (first + last) / 2)
    return increment, displacement


def thrust(maneuvers: Sequence[Maneuver], time: Any) -> Any:
    """Acceleration of maneuvers at a time [s], in radial axes, (3,) [m/s^2]."""
    total = ca.SX.zeros(3)
    for each in maneuvers:
        on = ca.logic_and(time >= each.start, time < each.end)
        total += ca.if_else(on, 1.0, 0.0) / each.length * ca.DM(np.asarray(each.delta_v))
    return total
