r"""A short arc of an orbit as polynomials of time: exact enough for the phase of a radar.

Over the seconds of a synthetic aperture an Earth-fixed orbit is smooth. It is integrated from one
state by an eighth-order method to a relative tolerance of 1e-13 and fitted by Chebyshev
polynomials, whose derivatives then give velocity, acceleration and what follows without noise.
The fit errs by less than a micrometer over half a minute.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.gravity import earth_fixed_acceleration
from terrafix.models.motion.sampled import Arc

_DEGREE = 10
_STEPS = 50


def _on_earth(r: object, v: object) -> object:
    return earth_fixed_acceleration(r, v, EARTH.mu, EARTH.radius, EARTH.j2, EARTH.rotation_rate)


earth_fixed_acceleration_array = over_members(_on_earth, (3,), (3,))
"""Acceleration [m/s^2] of free bodies, shape (..., 3), seen from the rotating Earth."""


class OrbitArc:
    """Earth-fixed position of a free body near an epoch, and its derivatives.

    Parameters
    ----------
    r_e, v_e : array_like, shape (3,)
        Position [m] and velocity [m/s] at `epoch`, Earth-fixed.
    epoch : float
        Time of the state [s].
    before, after : float
        How far the arc reaches [s].

    Raises
    ------
    ValueError
        If the state is not finite, lies inside the Earth, or the arc has no length.
    """

    def __init__(
        self, r_e: ArrayLike, v_e: ArrayLike, epoch: float, before: float, after: float
    ) -> None:
        from scipy.integrate import solve_ivp

        state = np.concatenate([np.asarray(r_e, np.float64), np.asarray(v_e, np.float64)])
        if not (state.shape == (6,) and np.isfinite(state).all()):
            raise ValueError(f"an arc starts from a finite position and velocity, got {state}")
        if np.linalg.norm(state[:3]) < EARTH.polar_radius:
            raise ValueError(f"the position {state[:3]} m lies inside the Earth")
        if not (before >= 0 and after >= 0 and before + after > 0):
            raise ValueError(f"an arc of {before} s before and {after} s after has no length")
        self.epoch, self.start, self.stop = epoch, epoch - before, epoch + after
        nodes = np.polynomial.chebyshev.chebpts1(2 * _DEGREE)
        t = epoch + (after - before) / 2 + (before + after) / 2 * nodes
        position = np.empty((len(t), 3))

        def derivative(_: float, x: FloatArray) -> FloatArray:
            a = earth_fixed_acceleration_array(x[:3], x[3:])
            return np.concatenate([x[3:], np.asarray(a)])

        for side, end in ((t < epoch, self.start), (t >= epoch, self.stop)):
            if side.any():
                path = solve_ivp(
                    derivative,
                    (epoch, end),
                    state,
                    method="DOP853",
                    rtol=1e-13,
                    atol=1e-9,
                    dense_output=True,
                )
                position[side] = path.sol(t[side])[:3].T
        domain = [self.start, self.stop]
        self._axes = [Chebyshev.fit(t, x, _DEGREE, domain=domain) for x in position.T]

    def derivative(self, t: ArrayLike, order: int) -> FloatArray:
        """Derivative of position of some order at times `t` [s], shape (..., 3) [m/s^order].

        Raises
        ------
        ValueError
            If a time is outside the arc.
        """
        t = np.asarray(t, dtype=np.float64)
        if t.size and not (t.min() >= self.start - 1e-9 and t.max() <= self.stop + 1e-9):
            raise ValueError(
                f"the arc covers {self.start:.3f} to {self.stop:.3f} s, asked for "
                f"{t.min():.3f} to {t.max():.3f} s"
            )
        axes = [axis.deriv(order) if order else axis for axis in self._axes]
        return np.stack([axis(t) for axis in axes], axis=-1)

    def position(self, t: ArrayLike) -> FloatArray:
        """Position (..., 3) [m] at times `t` [s]."""
        return self.derivative(t, 0)

    def velocity(self, t: ArrayLike) -> FloatArray:
        """Velocity (..., 3) [m/s] at times `t` [s]."""
        return self.derivative(t, 1)


def seen_at(
    arc: Arc, p: ArrayLike, doppler: float, wavelength: float, start: ArrayLike | None = None
) -> tuple[FloatArray, FloatArray]:
    """Time [s] and slant range [m] at which points are seen with a Doppler frequency.

    Parameters
    ----------
    arc : Arc
        Of the radar, an orbit's or a track's.
    p : array_like, shape (..., 3)
        Points [m], Earth-fixed.
    doppler : float
        Absolute Doppler frequency [Hz].
    wavelength : float
        [m]
    start : array_like, optional
        Times to begin with [s]; the middle of the arc by default.

    Raises
    ------
    ValueError
        If a point is not seen so within the arc.
    """
    p = np.asarray(p, dtype=np.float64)
    middle = (arc.start + arc.stop) / 2
    t = np.broadcast_to(np.asarray(middle if start is None else start, np.float64), p.shape[:-1])
    for _ in range(_STEPS):
        inside = np.clip(t, arc.start, arc.stop)
        r, v, a = (arc.derivative(inside, k) for k in range(3))
        line = p - r
        R = np.linalg.norm(line, axis=-1)
        closing = np.sum(v * line, axis=-1) / R
        # d(closing)/dt = (a . line - v . v + closing^2) / R
        rate = (np.sum(a * line, axis=-1) - np.sum(v * v, axis=-1) + closing**2) / R
        change = (doppler * wavelength / 2 - closing) / rate
        t = inside + change
        if np.abs(change).max(initial=0.0) < 1e-10:
            return np.asarray(t), np.asarray(R)
    raise ValueError(
        f"a point is not seen at a Doppler frequency of {doppler:.6g} Hz between "
        f"{arc.start:.3f} and {arc.stop:.3f} s"
    )
