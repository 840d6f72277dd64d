r"""A pinhole camera: points to pixels, with lens distortion, in axes that an attitude law gives.

Camera axes: x to the right of the frame, y down it, z along the optical axis. A point at
:math:`d = (d_x, d_y, d_z)` from the camera, in its axes, has the pixel

.. math::
    u = c_u + f\, x_d, \qquad v = c_v + f\, y_d, \qquad (x, y) = (d_x, d_y) / d_z,

where :math:`(x_d, y_d)` is :math:`(x, y)`, or distorted after Brown [1]_, with
:math:`\rho^2 = x^2 + y^2`,

.. math::
    x_d = x (1 + k_1 \rho^2 + k_2 \rho^4 + k_3 \rho^6) + 2 p_1 x y + p_2 (\rho^2 + 2 x^2), \\
    y_d = y (1 + k_1 \rho^2 + k_2 \rho^4 + k_3 \rho^6) + p_1 (\rho^2 + 2 y^2) + 2 p_2 x y.

The center of the first pixel is at (0, 0). A frame of width W that sees an angle :math:`\varphi`
across has :math:`f = W / (2 \tan(\varphi / 2))`.

References
----------
.. [1] D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971.
.. [2] System C's paper prints :math:`f = W / \tan(\varphi/2)`, which is a camera of half the angle,
       and a matrix from body to camera axes whose determinant is -1, a mirror image.
"""

from __future__ import annotations

from math import tan
from typing import Any

import casadi as ca

DISTORTIONS = ("none", "brown")
"""Names of lenses."""

BROWN = ("k1", "k2", "k3", "p1", "p2")
"""Coefficients of Brown's distortion, in this order."""


def focal_length(width: float, angle: float) -> float:
    """Focal length [px] of a frame `width` [px] across that sees an angle [rad]."""
    return width / (2 * tan(angle / 2))


def nadir_axes(r: Any, v: Any) -> Any:
    """Camera axes (3, 3) that look to the center of the Earth, the flight upward in the frame.

    Rows are the camera's axes in those of `r` (3,) and `v` (3,): to the right of the track, back
    along it, down. A rotation: the determinant is one.
    """
    down = -r / ca.norm_2(r)
    across = ca.cross(down, v)
    right = across / ca.norm_2(across)
    return ca.horzcat(right, ca.cross(down, right), down).T


def turned(axes: Any, theta: Any) -> Any:
    """Axes (3, 3) that are off by small angles (3,) [rad] about themselves, to first order.

    Of a misalignment of a mrad the second order is 0.5e-6, a thousandth of a pixel.
    """
    x, y, z = theta[0], theta[1], theta[2]
    off = ca.blockcat([[1, z, -y], [-z, 1, x], [y, -x, 1]])
    return ca.mtimes(off, axes)


def pixel(d: Any, focal: Any, center: Any, lens: Any | None = None) -> Any:
    """Pixel (2,) of a point in camera axes.

    Parameters
    ----------
    d : SX, shape (3,)
        From the camera to the point, in camera axes [m].
    focal : SX
        [px]
    center : SX, shape (2,)
        Principal point [px].
    lens : SX, shape (5,), optional
        `BROWN`'s coefficients; no distortion without them.
    """
    x, y = d[0] / d[2], d[1] / d[2]
    if lens is not None:
        squared = x * x + y * y
        radial = 1 + squared * (lens[0] + squared * (lens[1] + squared * lens[2]))
        bent = ca.vertcat(
            x * radial + 2 * lens[3] * x * y + lens[4] * (squared + 2 * x * x),
            y * radial + lens[3] * (squared + 2 * y * y) + 2 * lens[4] * x * y,
        )
        x, y = bent[0], bent[1]
    return center + focal * ca.vertcat(x, y)
