r"""Celestial and terrestrial frames, by the full chain of the IAU and the IERS.

From the celestial frame GCRF to the terrestrial ITRF, with the pole of date,

.. math::
    r_e = W(x_p, y_p, s')\, R_3(\mathrm{ERA})\, Q(X + dX, Y + dY, s)\, r_g,

precession and nutation of IAU 2006/2000A about the celestial intermediate origin. With the
rotation vector :math:`\omega` of the terrestrial axes, of the whole chain, velocities obey

.. math:: v_e = C_{eg} v_g - \omega \times r_e .

The other frames do not turn, or so slowly that it is left out of velocities, which are inertial
ones in their axes (the equinox moves by 8e-12 rad/s, 0.05 mm/s in a low orbit):

- ``j2000``: mean equator and equinox of J2000.0 (EME2000), a constant 23 mas from GCRF;
- ``tod``: true equator and equinox of date, :math:`r_e = W R_3(\mathrm{GST}) r`;
- ``teme``: true equator, mean equinox, in which SGP4 computes,
  :math:`r_e = W R_3(\mathrm{GMST}_{82}) r` as in [3]_;
- ``uniform``: axes which coincide with the Earth-fixed ones at an angle, and from which the Earth
  turns uniformly about its z axis, as `terrafix.models.geometry.frames` has it.

References
----------
.. [1] G. Petit, B. Luzum (eds.), "IERS Conventions (2010)", IERS Technical Note 36, ch. 5.
.. [2] IAU SOFA Board, "SOFA Tools for Earth Attitude", 2021.
.. [3] D. A. Vallado, P. Crawford, R. Hujsak, T. S. Kelso, "Revisiting Spacetrack Report #3",
       AIAA 2006-6753, appendix C.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.extras import optional
from terrafix.models.core.timescales import DAY, Instant
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import (
    earth_fixed_from_inertial_array,
    inertial_from_earth_fixed_array,
)
from terrafix.models.geometry.orientation import EarthOrientation, earth_orientation
from terrafix.models.geometry.quaternion import (
    from_rotation_vector_array,
    rotation_matrix_array,
)

FRAMES = ("gcrf", "j2000", "teme", "tod", "itrf", "uniform")
"""Names of frames that a state may be given in."""

DATED = ("gcrf", "j2000", "teme", "tod")
"""Those that want an epoch."""

ERA_RATE = 2 * np.pi * 1.00273781191135448 / DAY
"""Rate of the Earth rotation angle by UT1 [rad/s], eq. (5.15) of [1]_ (its printed digits)."""

_MJD = 2400000.5
_HALF = 60.0  # [s] of the differences that give the rate of precession and nutation


def terrestrial_rotation(
    instant: Instant, orientation: EarthOrientation | None = None
) -> FloatArray:
    """Matrix from GCRF to ITRF axes, shape (..., 3, 3).

    Parameters
    ----------
    instant : Instant
    orientation : EarthOrientation, optional
        By the tables of the IERS if absent.

    Raises
    ------
    ValueError
        If an instant lies outside the tables.
    ImportError
        If the packages of the extra ``truth`` are not installed.
    """
    known = earth_orientation(instant) if orientation is None else orientation
    return _polar(instant, known) @ _spin(_era(instant, known)) @ _pole(instant, known)


def rotation_vector_of_earth(
    instant: Instant, orientation: EarthOrientation | None = None
) -> FloatArray:
    """Rotation [rad/s] of the ITRF axes relative to GCRF, in ITRF axes, shape (..., 3).

    Of the whole chain: rotation at the rate of UT1, precession and nutation, and the motion of the
    pole. Parameters and errors as of `terrestrial_rotation`.
    """
    known = earth_orientation(instant) if orientation is None else orientation
    W, R = _polar(instant, known), _spin(_era(instant, known))
    # the pole of date turns by 1e-11 rad/s
    early, late = (_pole(instant, known, t) for t in (-_HALF, _HALF))
    moving = _small_turn(late @ _transposed(early)) / (2 * _HALF)
    rate = ERA_RATE * (1 + np.asarray(known.ut1_rate))
    spin = np.stack(np.broadcast_arrays(0.0, 0.0, rate), axis=-1)
    # W = R1(-yp) R2(-xp) R3(s'), to first order of the pole
    pole = np.stack(
        np.broadcast_arrays(-np.asarray(known.yp_rate), -np.asarray(known.xp_rate), 0.0), axis=-1
    )
    return np.asarray(_times(W, spin + _times(R, moving)) + pole)


def earth_fixed_from_frame(
    frame: str,
    instant: Instant | None,
    r: ArrayLike,
    v: ArrayLike,
    *,
    angle: ArrayLike = 0.0,
    orientation: EarthOrientation | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Position [m] and velocity relative to the Earth [m/s] in ITRF axes, two (..., 3).

    Parameters
    ----------
    frame : str
        One of `FRAMES`, that the state is given in.
    instant : Instant
        Shape () or (...); None will do for "itrf" and "uniform".
    r, v : array_like, shape (..., 3)
        Position [m] and velocity [m/s]: relative to the Earth in "itrf", else inertial.
    angle : array_like, shape (...)
        From the x axis of "uniform" to that of the Earth-fixed frame [rad].
    orientation : EarthOrientation, optional
        By the tables of the IERS if absent.

    Raises
    ------
    ValueError
        If the frame is unknown, or an instant is missing or outside the tables.
    ImportError
        If the packages of the extra ``truth`` are needed and not installed.
    """
    r, v = np.asarray(r, np.float64), np.asarray(v, np.float64)
    if _check(frame, instant):
        assert instant is not None
        C, omega = _link(frame, instant, orientation)
        r_e = _times(C, r)
        return r_e, _times(C, v) - np.cross(omega, r_e)
    if frame == "itrf":
        return r, v
    r_e, v_e = earth_fixed_from_inertial_array(r, v, angle, EARTH.rotation_rate)
    return r_e, v_e


def frame_from_earth_fixed(
    frame: str,
    instant: Instant | None,
    r_e: ArrayLike,
    v_e: ArrayLike,
    *,
    angle: ArrayLike = 0.0,
    orientation: EarthOrientation | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Position [m] and velocity [m/s] in a frame, two (..., 3), from Earth-fixed ones.

    The inverse of `earth_fixed_from_frame`, with the same parameters and errors.
    """
    r_e, v_e = np.asarray(r_e, np.float64), np.asarray(v_e, np.float64)
    if _check(frame, instant):
        assert instant is not None
        C, omega = _link(frame, instant, orientation)
        back = _transposed(C)
        return _times(back, r_e), _times(back, v_e + np.cross(omega, r_e))
    if frame == "itrf":
        return r_e, v_e
    r, v = inertial_from_earth_fixed_array(r_e, v_e, angle, EARTH.rotation_rate)
    return r, v


def _check(frame: str, instant: Instant | None) -> bool:
    """Whether a frame is one of date, or of the sky."""
    if frame not in FRAMES:
        raise ValueError(f"'{frame}' is no frame; there are {', '.join(FRAMES)}")
    if frame in DATED and instant is None:
        raise ValueError(f"a state in the frame '{frame}' needs an epoch: the Earth turns")
    return frame in DATED


def _link(
    frame: str, instant: Instant, orientation: EarthOrientation | None
) -> tuple[FloatArray, FloatArray]:
    """Matrix from a frame's axes to ITRF axes, and the rotation vector of the latter."""
    known = earth_orientation(instant) if orientation is None else orientation
    omega = rotation_vector_of_earth(instant, known)
    if frame == "teme":
        return _polar(instant, known) @ _spin(_gmst82(instant, known)), omega
    if frame == "tod":
        return _polar(instant, known) @ _spin(_gst(instant, known)), omega
    C = terrestrial_rotation(instant, known)
    if frame == "j2000":
        bias = _erfa().bp06(*_julian(instant.to("TT")))[0]
        C = C @ _transposed(bias)
    return C, omega


def _pole(instant: Instant, known: EarthOrientation, t: float = 0.0) -> FloatArray:
    """Q, `t` seconds later: from GCRF to axes of the celestial intermediate pole and origin."""
    x, y, s = _erfa().xys06a(*_julian(instant.plus(t).to("TT")))
    x, y = x + known.dx + t * known.dx_rate, y + known.dy + t * known.dy_rate
    return np.asarray(_erfa().c2ixys(x, y, s))


def _gst(instant: Instant, known: EarthOrientation) -> Any:
    """Apparent sidereal time [rad], the offsets of the celestial pole in its equinox too."""
    erfa, tt = _erfa(), _julian(instant.to("TT"))
    origins = erfa.eors(erfa.pnm06a(*tt), erfa.xys06a(*tt)[2])
    return _era(instant, known) - origins + known.dx / np.tan(erfa.obl06(*tt))


def _polar(instant: Instant, known: EarthOrientation) -> FloatArray:
    """W: from the terrestrial intermediate frame to ITRF."""
    erfa = _erfa()
    return np.asarray(erfa.pom00(known.xp, known.yp, erfa.sp00(*_julian(instant.to("TT")))))


def _era(instant: Instant, known: EarthOrientation) -> Any:
    return _erfa().era00(*_ut1(instant, known))


def _gmst82(instant: Instant, known: EarthOrientation) -> Any:
    return _erfa().gmst82(*_ut1(instant, known))


def _ut1(instant: Instant, known: EarthOrientation) -> tuple[Any, Any]:
    return _MJD + np.asarray(instant.day, np.float64), (instant.seconds + known.ut1_tai) / DAY


def _julian(of_day: tuple[Any, Any]) -> tuple[Any, Any]:
    """Julian date in two parts from a modified Julian day and its seconds."""
    return _MJD + np.asarray(of_day[0], np.float64), np.asarray(of_day[1]) / DAY


def _spin(angle: Any) -> FloatArray:
    """R_3 of an angle [rad], shape (..., 3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = [[c, s, zero], [-s, c, zero], [zero, zero, one]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _small_turn(C: FloatArray) -> FloatArray:
    """Rotation vector (..., 3) of a matrix exp(-[theta x]) of a small angle."""
    pairs = [C[..., 1, 2] - C[..., 2, 1], C[..., 2, 0] - C[..., 0, 2], C[..., 0, 1] - C[..., 1, 0]]
    return np.stack(pairs, axis=-1) / 2


def _times(C: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("...ij,...j->...i", C, x))


def _transposed(C: FloatArray) -> FloatArray:
    return np.swapaxes(C, -1, -2)


def _erfa() -> Any:
    return optional("erfa", "a frame of the sky")


class Turning:
    """How the Earth-fixed axes turn in a run, from instants that come one after the other.

    The whole chain is evaluated every ten seconds, and turned about its rotation vector in between:
    7e-14 rad off.

    Parameters
    ----------
    start : Instant
        Of t = 0.
    """

    def __init__(self, start: Instant) -> None:
        self._start, self._number = start, -1

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Matrix from GCRF to ITRF (3, 3), and the rotation vector (3,) [rad/s], at a time [s]."""
        number = int(t // _SPAN)
        if number != self._number:
            instant = self._start.plus(number * _SPAN)
            self._C = terrestrial_rotation(instant)
            self._omega = rotation_vector_of_earth(instant)
            self._number = number
        turn = from_rotation_vector_array(self._omega * (t - number * _SPAN))
        return np.asarray(rotation_matrix_array(turn) @ self._C), self._omega


_SPAN = 10.0
"""[s] within which the axes are turned about one vector."""
