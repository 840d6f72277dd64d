"""Where an antenna on a body looks.

Antenna axes: z along the boresight, x along the track, y across it.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.quaternion import product, rotation_matrix


def nominal_antenna(look: Any, squint: Any) -> Any:
    r"""Quaternion ``q_sb`` (4,), body to antenna, of a side-looking antenna.

    The boresight in body axes (x forward, y right, z nadir) is
    :math:`(\sin\psi, \sin\lambda \cos\psi, \cos\lambda \cos\psi)`; the antenna's x axis is the
    forward direction orthogonal to it, its y axis completes the triad.

    Parameters
    ----------
    look : SX or float
        Angle :math:`\lambda` from nadir to the boresight, positive to the right, negative to
        the left [rad].
    squint : SX or float
        Angle :math:`\psi` of the boresight ahead of the plane across the track [rad].
    """
    about_x = ca.vertcat(-ca.sin(look / 2), 0, 0, ca.cos(look / 2))
    about_y = ca.vertcat(0, ca.sin(squint / 2), 0, ca.cos(squint / 2))
    return product(about_y, about_x)


def steered(q_be: Any, look: Any, squint: Any) -> Any:
    """Attitude (4,), Earth-fixed to axes whose z is a commanded boresight and x along the track.

    To what carries these axes the antenna is mounted with a look and a squint of zero: a steered
    antenna is one that is fixed to a body that turns.

    Parameters
    ----------
    q_be : SX, shape (4,)
        Attitude of the body, Earth-fixed to body.
    look, squint : SX or float
        As of `nominal_antenna` [rad].
    """
    return product(nominal_antenna(look, squint), q_be)


def boresight_direction(q_be: Any, q_sb: Any, q_mu: Any) -> Any:
    """Earth-fixed direction (3,) of the antenna's z axis."""
    return rotation_matrix(product(q_mu, product(q_sb, q_be)))[2, :].T


nominal_antenna_array = over_members(nominal_antenna, (), ())
steered_array = over_members(steered, (4,), (), ())

boresight_direction_array = over_members(boresight_direction, (4,), (4,), (4,))
