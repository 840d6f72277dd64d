r"""Quaternions, in one convention: Shuster's product, passive, scalar last.

A quaternion :math:`q = [q_v^T\; q_s]^T` of unit length stands for the transformation matrix

.. math::
    T(q) = (q_s^2 - q_v^T q_v) I + 2 q_v q_v^T - 2 q_s [q_v \times],

which takes the components of a vector from one frame to another (passive), and the product

.. math::
    p \otimes q = \begin{bmatrix} p_s q_v + q_s p_v - p_v \times q_v \\
                                  p_s q_s - p_v \cdot q_v \end{bmatrix}
    \qquad\text{obeys}\qquad T(p \otimes q) = T(p)\,T(q).

``q_be`` takes Earth-fixed components to body components, :math:`r_b = T(q_{be}) r_e`, and
neighboring letters cancel: ``q_se = product(q_sb, q_be)``. The quaternion of a rotation vector
:math:`\theta` is :math:`[\sin(\theta/2)\,\hat\theta^T\; \cos(\theta/2)]^T`, so that
:math:`T = \exp(-[\theta \times]) \approx I - [\theta \times]`: the new frame is turned by
:math:`+\theta` relative to the old one. Hamilton's product (`scipy.spatial.transform`) has the
factors in the opposite order and the transposed matrix.

Functions take and return CasADi columns; those named ``*_array`` take NumPy arrays with leading
member axes.

References
----------
.. [1] B. S. Pogorelsky, R. Zanetti, J. Chen, S. Jenkins, "Synthetic Aperture Radar Based
       Spacecraft Terrain Relative Navigation", eqs. (4)-(7), (29), (41). Eq. (6) prints the
       scalar part in bold; it is the scalar.
.. [2] M. D. Shuster, "A survey of attitude representations", J. Astronaut. Sci. 41(4), 1993.
"""

from __future__ import annotations

from math import nan
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members

IDENTITY = (0.0, 0.0, 0.0, 1.0)
"""The quaternion of no rotation."""

_SMALL = 1e-4
"""Squared angle [rad^2] below which series replace quotients; their error is below 1e-17."""

_LEAST_COSINE = (4 * 1e-6) ** 2
"""Squared, of half the turn between quaternions, times four: below, rounding decides."""


def product(p: Any, q: Any) -> Any:
    """Shuster's product, (4,): ``T(product(p, q)) = T(p) T(q)``, eq. (5) of [1]_."""
    p_v, p_s, q_v, q_s = p[:3], p[3], q[:3], q[3]
    vector = p_s * q_v + q_s * p_v - ca.cross(p_v, q_v)
    return ca.vertcat(vector, p_s * q_s - ca.dot(p_v, q_v))


def inverse(q: Any) -> Any:
    """Conjugate, (4,): the inverse of a unit quaternion."""
    return ca.vertcat(-q[:3], q[3])


def rotation_matrix(q: Any) -> Any:
    """Build the transformation matrix T(q), (3, 3), eq. (6) of [1]_."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, xz, yz = x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return ca.vertcat(
        ca.horzcat(ww + xx - yy - zz, 2 * (xy + wz), 2 * (xz - wy)),
        ca.horzcat(2 * (xy - wz), ww - xx + yy - zz, 2 * (yz + wx)),
        ca.horzcat(2 * (xz + wy), 2 * (yz - wx), ww - xx - yy + zz),
    )


def normalized(q: Any) -> Any:
    """Scale to unit length, (4,)."""
    return q / ca.sqrt(ca.dot(q, q))


def from_rotation_vector(theta: Any) -> Any:
    """Quaternion of a rotation vector (3,) [rad], eq. (41) of [1]_; smooth at zero."""
    squared = ca.dot(theta, theta)
    small = squared < _SMALL
    angle = ca.sqrt(ca.if_else(small, 1.0, squared))
    half_sinc = ca.if_else(small, 0.5 - squared / 48 + squared**2 / 3840, ca.sin(angle / 2) / angle)
    cosine = ca.if_else(
        small, 1 - squared / 8 + squared**2 / 384 - squared**3 / 46080, ca.cos(angle / 2)
    )
    return ca.vertcat(half_sinc * theta, cosine)


def from_small_rotation_vector(theta: Any) -> Any:
    """Quaternion of a small rotation vector (3,) [rad] without trigonometry, unit length.

    The angle is short by a twelfth of its cube: 1e-13 rad at 20 arc seconds.
    """
    return normalized(ca.vertcat(theta / 2, 1.0))


def rotation_vector(q: Any) -> Any:
    """Shortest rotation vector (3,) [rad] of a unit quaternion; smooth at zero."""
    sign = ca.if_else(q[3] < 0, -1.0, 1.0)
    vector, scalar = sign * q[:3], sign * q[3]
    squared = ca.dot(vector, vector)
    small = squared < _SMALL
    length = ca.sqrt(ca.if_else(small, 1.0, squared))
    series = 2 + squared / 3 + 3 * squared**2 / 20 + 5 * squared**3 / 56 + 35 * squared**4 / 576
    factor = ca.if_else(small, series, 2 * ca.atan2(length, scalar) / length)
    return factor * vector


def angle_between(p: Any, q: Any) -> Any:
    """Angle [rad], in [0, pi], of the rotation from `q` to `p`; no derivative at zero angle."""
    difference = product(p, inverse(q))
    vector = difference[:3]
    return 2 * ca.atan2(ca.sqrt(ca.dot(vector, vector)), ca.fabs(difference[3]))


def outer_of_matrix(matrix: Any) -> Any:
    r"""Four times :math:`q q^T`, (4, 4), of a transformation matrix (3, 3); linear in it.

    Every nonzero column, and any combination of them, is the quaternion up to scale and sign.
    """
    m = matrix
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    xx, yy, zz = (1 + 2 * m[i, i] - trace for i in range(3))
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    wx, wy, wz = m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]
    return ca.vertcat(
        ca.horzcat(xx, xy, xz, wx),
        ca.horzcat(xy, yy, yz, wy),
        ca.horzcat(xz, yz, zz, wz),
        ca.horzcat(wx, wy, wz, 1 + trace),
    )


def from_matrix(matrix: Any) -> Any:
    """Quaternion (4,) of a transformation matrix (3, 3), scalar not negative.

    Taken from the column of the largest component, hence accurate at every angle.
    """
    outer = outer_of_matrix(matrix)
    best, column = outer[0, 0], outer[:, 0]
    for i in range(1, 4):
        better = outer[i, i] > best
        best = ca.if_else(better, outer[i, i], best)
        column = ca.if_else(better, outer[:, i], column)
    q = normalized(column)
    return ca.if_else(q[3] < 0, -1.0, 1.0) * q


def from_matrix_near(matrix: Any, reference: Any) -> Any:
    r"""Quaternion (4,) of a transformation matrix with the sign nearer a reference (4,).

    Since :math:`4 q q^T q_{ref} = 4 q (q \cdot q_{ref})`, one product gives value and sign. Half a
    turn away from the reference, to some microradians, it is not defined, and not a number.
    """
    near = ca.mtimes(outer_of_matrix(matrix), reference)
    return normalized(near) * ca.if_else(ca.dot(near, near) > _LEAST_COSINE, 1.0, nan)


product_array = over_members(product, (4,), (4,))
inverse_array = over_members(inverse, (4,))
rotation_matrix_array = over_members(rotation_matrix, (4,))
from_rotation_vector_array = over_members(from_rotation_vector, (3,))
rotation_vector_array = over_members(rotation_vector, (4,))
angle_between_array = over_members(angle_between, (4,), (4,))
from_matrix_array = over_members(from_matrix, (3, 3))


def from_scalar_first(q: ArrayLike) -> FloatArray:
    """Reorder ``[w, x, y, z]`` to ``[x, y, z, w]``, shape (..., 4); no other change."""
    return np.roll(np.asarray(q, dtype=np.float64), -1, axis=-1)


def to_scalar_first(q: ArrayLike) -> FloatArray:
    """Reorder ``[x, y, z, w]`` to ``[w, x, y, z]``, shape (..., 4); no other change."""
    return np.roll(np.asarray(q, dtype=np.float64), 1, axis=-1)
