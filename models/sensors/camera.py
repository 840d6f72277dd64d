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

What it looks at is given by an attitude law: down to the center of the Earth or along the normal of
its ellipsoid, the flight upward in the frame, or as the body that carries it is turned. On top come
the mounting, by roll, pitch and yaw in body axes (x forward, y right, z down), and a misalignment.

The center of the first pixel is at (0, 0). A frame of width W that sees an angle :math:`\varphi`
across has :math:`f = W / (2 \tan(\varphi / 2))`.

References
----------
.. [1] D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971.
.. [2] System C's paper prints :math:`f = W / \tan(\varphi/2)`, which is a camera of half the angle,
       and a matrix from body to camera axes whose determinant is -1, a mirror image.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import tan
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.frames import rotate_about_pole
from terrafix.models.geometry.geodesy import geodetic_from_ecef
from terrafix.models.geometry.quaternion import rotation_matrix

BROWN = ("k1", "k2", "k3", "p1", "p2")
"""Coefficients of Brown's distortion, in this order."""


def focal_length(width: float, angle: float) -> float:
    """Focal length [px] of a frame `width` [px] across that sees an angle [rad]."""
    return width / (2 * tan(angle / 2))


def nadir_axes(r: Any, v: Any, down: Any | None = None) -> Any:
    """Camera axes (3, 3) that look to the center of the Earth, the flight upward in the frame.

    Rows are the camera's axes in those of `r` (3,) and `v` (3,): to the right of the track, back
    along it, down (3,), of length one, where it is given. A rotation: the determinant is one.
    """
    down = -r / ca.norm_2(r) if down is None else down
    across = ca.cross(down, v)
    right = across / ca.norm_2(across)
    return ca.horzcat(right, ca.cross(down, right), down).T


def vertical(r: Any) -> Any:
    """Downward normal (3,) of the ellipsoid below a position (3,), inertial or Earth-fixed.

    From the center of the Earth it differs by 0.19 deg at 45 deg: 1.8 km on the ground at 550 km.
    """
    latitude, longitude, _ = geodetic_from_ecef(r)
    out = ca.cos(latitude)
    return -ca.vertcat(out * ca.cos(longitude), out * ca.sin(longitude), ca.sin(latitude))


BODY = ca.DM([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""Body axes (forward, right, down) to those of a camera that looks down (right, back, down)."""


def mounted(angles: Any) -> Any:
    """Turn (3, 3) of a camera's axes by its mounting: roll, pitch, yaw (3,) [rad].

    Yaw first, then pitch, then roll, each about the body axis as turned before. A positive roll
    looks to the left, a positive pitch ahead.
    """
    (s1, s2, s3), (c1, c2, c3) = ([f(angles[k]) for k in range(3)] for f in (ca.sin, ca.cos))
    roll = ca.blockcat([[1, 0, 0], [0, c1, s1], [0, -s1, c1]])
    pitch = ca.blockcat([[c2, 0, -s2], [0, 1, 0], [s2, 0, c2]])
    yaw = ca.blockcat([[c3, s3, 0], [-s3, c3, 0], [0, 0, 1]])
    return ca.mtimes([BODY, roll, pitch, yaw, BODY.T])


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


def lens_grows(lens: FloatArray, reach: float) -> bool:
    """Whether a lens shows what is farther off the axis farther out, up to a tangent of `reach`.

    Beyond the turning point of its polynomial it would fold the scene back into the frame.

    Parameters
    ----------
    lens : ndarray, shape (5,)
        `BROWN`'s coefficients.
    reach : float
        Tangent of the angle off the axis.
    """
    squared = np.linspace(0.0, reach, 257) ** 2
    k1, k2, k3 = lens[:3]
    return bool((1 + squared * (3 * k1 + squared * (5 * k2 + squared * 7 * k3)) > 0).all())


CAMERA = {"focal": 1, "principal": 2, "lens": 5, "mounting": 3} | dict.fromkeys(
    ("earth_angle0", "rotation_rate"), 1
)
"""Parameters of what a camera sees of the ground; `lens` and `mounting` are zero where absent."""

POINTINGS = ("geocentric", "geodetic", "given")
"""Laws of attitude: down to the center of the Earth, down to the ellipsoid, or as the body is."""

POINTING = {"pointing": 1, "q_be": 4}
"""Which law holds, an index into `POINTINGS`, the first where absent; attitude of the body."""

STATE_SIZES = {"r": 3, "v": 3, "attitude": 3, "scale": 1}
"""What a look depends on: position, velocity, misalignment, scale of outlines."""

_SIZES = {**STATE_SIZES, **CAMERA, **POINTING, "t": 1}


def _view(law: str) -> Any:
    """Rotation C (3, 3) from Earth-fixed to camera axes and offset o (3,); their derivatives."""

    def view(r: Any, v: Any, attitude: Any, earth_angle: Any, mounting: Any, q_be: Any) -> Any:
        poles = [rotate_about_pole(-earth_angle, ca.SX.eye(3)[:, k]) for k in range(3)]
        C_ie = ca.horzcat(*poles)
        if law == "given":
            level = ca.mtimes([BODY, rotation_matrix(q_be), C_ie.T])
        else:
            level = nadir_axes(r, v, vertical(r) if law == "geodetic" else None)
        axes = turned(ca.mtimes(mounted(mounting), level), attitude)
        C, offset = ca.mtimes(axes, C_ie), ca.mtimes(axes, r)
        x = ca.vertcat(r, v, attitude)
        return C, offset, ca.jacobian(ca.vec(C.T), x), ca.jacobian(offset, x)

    return view


def _pixel(d: Any, focal: Any, principal: Any, lens: Any | None = None) -> Any:
    found = pixel(d, focal, principal, lens)
    return found, ca.jacobian(found, d)


_VIEWS = [over_members(_view(law), (3,), (3,), (3,), (), (3,), (4,)) for law in POINTINGS]
_PIXEL = over_members(_pixel, (3,), (), (2,))
_BENT_PIXEL = over_members(_pixel, (3,), (), (2,), (5,))


def ground_in_view(
    values: Mapping[str, FloatArray], given: Mapping[str, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Where k cameras have the ground: a point q, Earth-fixed, is at C q - o in camera axes.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (k, size)
        ``r``, ``v``; ``attitude``, zero where absent.
    given : mapping of str to ndarray, shape (k, size)
        `CAMERA`, `POINTING`, and the time ``t`` [s].

    Returns
    -------
    C : ndarray, shape (k, 3, 3)
        Earth-fixed to camera axes.
    o : ndarray, shape (k, 3)
        The camera's own place, in its axes [m].
    dC, do : ndarray, shape (k, 9, 9) and (k, 3, 9)
        Their derivatives by r, v, attitude; of C row by row.
    """
    k = len(values["r"])
    r, v, attitude = (_rows(values, name, k) for name in ("r", "v", "attitude"))
    angle0, rate, t = (_rows(given, name, k) for name in ("earth_angle0", "rotation_rate", "t"))
    mounting, law, q_be = (_rows(given, name, k) for name in ("mounting", "pointing", "q_be"))
    view = _VIEWS[int(law[0, 0]) if k else 0]  # one law for all
    found: tuple[FloatArray, FloatArray, FloatArray, FloatArray] = view(
        r, v, attitude, (angle0 + rate * t)[:, 0], mounting, q_be
    )
    return found


def _rows(told: Mapping[str, FloatArray], name: str, k: int) -> FloatArray:
    """What is told of k estimates (k, size), zero where it is absent."""
    shape = k, _SIZES[name]
    return np.reshape(told.get(name, np.zeros(shape)), shape)


class Seen:
    """An outline as k estimates see it.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (k, size)
        ``r``, ``v``; ``attitude`` and ``scale``, zero where absent.
    given : mapping of str to ndarray, shape (k, size)
        `CAMERA`, `POINTING`, and the time ``t`` [s].
    points : ndarray, shape (K, 3) or (k, K, 3)
        Earth-fixed vertices [m].
    middle : ndarray, shape (3,)
        Earth-fixed point that scale is about [m].

    Attributes
    ----------
    depth : ndarray, shape (k, K)
        Along the optical axis [m]; what is behind the camera has a negative one.
    pixels : ndarray, shape (k, K, 2)
    """

    def __init__(
        self,
        values: Mapping[str, FloatArray],
        given: Mapping[str, FloatArray],
        points: FloatArray,
        middle: FloatArray,
    ) -> None:
        self._C, offset, self._dC, self._do = ground_in_view(values, given)
        k = len(offset)
        scale = _rows(values, "scale", k)
        focal = _rows(given, "focal", k)
        principal, lens = (_rows(given, name, k)[:, None] for name in ("principal", "lens"))
        self._off_middle = points - middle
        self._q = points + scale[:, :, None] * self._off_middle
        d = self._q @ self._C.transpose(0, 2, 1) - offset[:, None]
        self.depth = d[..., 2]
        if lens.any():
            self.pixels, self._by_d = _BENT_PIXEL(d, focal, principal, lens)
        else:
            self.pixels, self._by_d = _PIXEL(d, focal, principal)

    def derivative(self, by_pixels: FloatArray) -> FloatArray:
        """Derivative (k, m, 10) by r, v, attitude, scale of what has this one (k, m, K, 2)."""
        k, m, n_vertices, _ = by_pixels.shape
        G = self._by_places(by_pixels).reshape(k, m * 3, n_vertices)
        by_C = (G @ self._q).reshape(k, m, 9)
        found = by_C @ self._dC - G.sum(axis=2).reshape(k, m, 3) @ self._do
        about = (G @ self._off_middle).reshape(k, m, 9) @ self._C.reshape(k, 9, 1)
        return np.concatenate([found, about], axis=2)

    def factor(self, by_pixels: FloatArray) -> FloatArray:
        """Cholesky factor (k, m, m) of what vertices off by 1 m per axis, each by itself, add.

        Of what has the derivative (k, m, K, 2) by pixels.
        """
        k, m, n_vertices, _ = by_pixels.shape
        G = self._by_places(by_pixels).reshape(k, m, 3 * n_vertices)
        P = G @ G.transpose(0, 2, 1)
        P[~np.isfinite(P).all(axis=(1, 2))] = np.eye(m)  # of an estimate that is lost anyway
        P += _DEFINITE * np.eye(m) * P.diagonal(axis1=1, axis2=2)[:, None]
        return np.asarray(np.linalg.cholesky(P))

    def _by_places(self, by_pixels: FloatArray) -> FloatArray:
        """Derivative (k, m, 3, K) by places in camera axes of what has this one (k, m, K, 2)."""
        by_d = np.ascontiguousarray(self._by_d.transpose(0, 2, 3, 1))[:, None]  # (k, 1, 2, 3, K)
        u, v = (np.ascontiguousarray(by_pixels[..., i])[:, :, None] for i in range(2))
        return np.asarray(u * by_d[:, :, 0] + v * by_d[:, :, 1])


_DEFINITE = 1e-12
"""Of its diagonal, what is added to a covariance that few vertices may leave singular."""


def in_view(
    C: FloatArray, o: FloatArray, centers: FloatArray, radii: FloatArray, reach: FloatArray
) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which circles on the ground a camera may see, and how far off its axis.

    Parameters
    ----------
    C, o : ndarray, shape (k, 3, 3) and (k, 3)
        Of `ground_in_view`.
    centers : ndarray, shape (L, 3)
        Earth-fixed [m].
    radii : ndarray, shape (L,)
        [m]
    reach : ndarray, shape (k,)
        Largest tangent of the angle off the axis that the frame shows; infinity: up to the horizon.

    Returns
    -------
    seen : ndarray of bool, shape (k, L)
    across : ndarray, shape (k, L)
        Distance from the axis [m].
    """
    d = centers @ C.transpose(0, 2, 1) - o[:, None]
    depth, across = d[..., 2], np.hypot(d[..., 0], d[..., 1])
    with np.errstate(invalid="ignore"):
        in_frame = np.isinf(reach)[:, None] | (across - radii < reach[:, None] * depth)
    return above_horizon(C, o, centers) & in_frame, across


def above_horizon(C: FloatArray, o: FloatArray, centers: FloatArray) -> NDArray[np.bool_]:
    """Whether a camera is above the horizon of points on the ground (L, 3) [m]: (k, L)."""
    r_e = np.einsum("kji,kj->ki", C, o)
    return np.asarray(np.einsum("ki,li->kl", r_e, centers) > (centers * centers).sum(axis=1))


def nearest_to_axis(
    C: FloatArray, o: FloatArray, centers: FloatArray
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Which point on the ground each camera's axis comes nearest to, and how near.

    Those below the horizon come after all others.

    Parameters
    ----------
    C, o : ndarray, shape (k, 3, 3) and (k, 3)
        Of `ground_in_view`.
    centers : ndarray, shape (L, 3)
        Earth-fixed [m].

    Returns
    -------
    index : ndarray of int, shape (k,)
    angle : ndarray, shape (k,)
        Between the axis and the line to it [rad]; pi where it is below the horizon.
    distance : ndarray, shape (k,)
        Along the ground, from the point below the camera [m].
    """
    d = centers @ C.transpose(0, 2, 1) - o[:, None]
    off = np.arctan2(np.linalg.norm(d[..., :2], axis=2), d[..., 2])
    r_e = np.einsum("kji,kj->ki", C, o)
    radius = np.linalg.norm(centers, axis=1)
    cosine = np.einsum("ki,li->kl", r_e, centers) / radius
    cosine /= np.linalg.norm(r_e, axis=1, keepdims=True)
    along = radius * np.arccos(np.clip(cosine, -1.0, 1.0))
    seen = above_horizon(C, o, centers)
    index = np.where(seen, off, np.pi + along).argmin(axis=1)
    rows = np.arange(len(o))
    return index, np.where(seen, off, np.pi)[rows, index], along[rows, index]
