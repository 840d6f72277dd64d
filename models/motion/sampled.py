"""A track through sampled positions: what an arc of an orbit is to a satellite, to an aircraft."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray

_DEGREE = 5


class Arc(Protocol):
    """Position of a radar over a span of time, and its derivatives: an orbit's or a track's."""

    start: float
    stop: float

    def derivative(self, t: ArrayLike, order: int) -> FloatArray:
        """Derivative of position of some order at times `t` [s], shape (..., 3) [m/s^order]."""

    def position(self, t: ArrayLike) -> FloatArray:
        """Position (..., 3) [m] at times `t` [s]."""

    def velocity(self, t: ArrayLike) -> FloatArray:
        """Velocity (..., 3) [m/s] at times `t` [s]."""


class SampledArc:
    """Quintic spline through positions: smooth to the fourth derivative.

    At 100 Hz it errs by less than a micrometer for motion up to 5 Hz and a meter.

    Parameters
    ----------
    t : array_like, shape (n,)
        Times [s], increasing; six at least.
    r : array_like, shape (n, 3)
        Positions [m], in any frame in which the ground rests.

    Raises
    ------
    ValueError
        If there are too few samples, times do not increase, or something is not finite.
    """

    def __init__(self, t: ArrayLike, r: ArrayLike) -> None:
        from scipy.interpolate import make_interp_spline

        t, r = np.asarray(t, np.float64), np.asarray(r, np.float64)
        if t.ndim != 1 or r.shape != (len(t), 3) or len(t) <= _DEGREE:
            raise ValueError(
                f"a track is {_DEGREE + 1} times at least and as many positions (n, 3), got "
                f"{t.shape} and {r.shape}"
            )
        if not (np.isfinite(t).all() and np.isfinite(r).all()):
            raise ValueError("a time or a position of a track is not finite")
        if not (np.diff(t) > 0).all():
            k = int(np.argmin(np.diff(t) > 0))
            raise ValueError(
                f"times of a track run backward: {t[k + 1]:.6f} s comes after {t[k]:.6f} s"
            )
        self.start, self.stop = float(t[0]), float(t[-1])
        # near the middle: far from the origin of the frame derivatives would be rounded
        self._middle = r[len(r) // 2]
        self._spline = make_interp_spline(t, r - self._middle, _DEGREE)

    def derivative(self, t: ArrayLike, order: int) -> FloatArray:
        """Derivative of position of some order at times `t` [s], shape (..., 3) [m/s^order].

        Raises
        ------
        ValueError
            If a time is outside the track.
        """
        t = np.asarray(t, np.float64)
        if t.size and not (t.min() >= self.start - 1e-9 and t.max() <= self.stop + 1e-9):
            raise ValueError(
                f"the track covers {self.start:.3f} to {self.stop:.3f} s, asked for "
                f"{t.min():.3f} to {t.max():.3f} s"
            )
        found = np.asarray(self._spline(t, order))
        return found if order else found + self._middle

    def position(self, t: ArrayLike) -> FloatArray:
        """Position (..., 3) [m] at times `t` [s]."""
        return self.derivative(t, 0)

    def velocity(self, t: ArrayLike) -> FloatArray:
        """Velocity (..., 3) [m/s] at times `t` [s]."""
        return self.derivative(t, 1)
