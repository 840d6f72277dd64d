r"""What is where in the sky of a satellite: directions, angles, and what the Earth hides.

The Earth is a sphere of its equatorial radius where it hides something or is looked at: its limb
lies :math:`\arcsin(R / r)` off its center.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.geometry.earth import EARTH


def unit(vector: Any) -> Any:
    """Direction of a vector (3,)."""
    return vector / ca.sqrt(ca.dot(vector, vector))


def limb_angle(r_e: Any) -> Any:
    """Angle [rad] of the Earth's limb off its center, seen from a position (3,) [m]."""
    return ca.asin(ca.fmin(EARTH.radius / ca.sqrt(ca.dot(r_e, r_e)), 1.0))


def angle_between(a: Any, b: Any) -> Any:
    """Angle [rad] between unit vectors (3,); its derivative exists but at 0 and half a turn."""
    cross = ca.cross(a, b)
    return ca.atan2(ca.sqrt(ca.dot(cross, cross)), ca.dot(a, b))


def hidden(direction: Any, r_e: Any) -> Any:
    """1 where the Earth hides a far point in a direction (3,) from a position (3,), else 0."""
    return angle_between(direction, -unit(r_e)) < limb_angle(r_e)
