r"""How the range to places changes while an aperture passes, and the spectrum that it gives.

About the time :math:`t_b` at which the beam's center passes a place, :math:`s` later,

.. math::
    R(s) = R_b + \dot R s + \tfrac{\ddot R}{2} s^2 + \tfrac{R^{(3)}}{6} s^3
        + \tfrac{R^{(4)}}{24} s^4.

By stationary phase its spectrum at wavelength :math:`\lambda` and Doppler frequency :math:`f` has
the phase :math:`\tfrac{2}{\lambda}(g(x) - R_b)` cycles, with :math:`x = \lambda f` and the
Legendre transform

.. math::
    g(x) = -\bigl(R(S) - R_b\bigr) - \tfrac{x S}{2}, \qquad \dot R(S) = -\tfrac{x}{2},

so that the migration is :math:`R(S) - R_b = -g + x g'`.
"""

from __future__ import annotations

from math import factorial

import numpy as np
from numpy.polynomial import Chebyshev, chebyshev

from terrafix.models.core.arrays import FloatArray
from terrafix.models.motion.sampled import Arc
from terrafix.models.radar.chirp import SPEED_OF_LIGHT
from terrafix.models.radar.footprint import Footprint

_DEGREE = 8
"""Of g as a polynomial: its error is below 1e-6 cycles over apertures of seconds."""


class RangeHistories:
    """The functions g of the module's equation, over a footprint's ranges at one height.

    Parameters
    ----------
    footprint : Footprint
        Grid; its middle line gives the time of the derivatives.
    height : float
        Of all places [m].
    illuminated : float
        Doppler bandwidth over which g must hold [Hz].

    Attributes
    ----------
    span : ndarray, shape (2,)
        First and last range of the grid [m].
    middle : Chebyshev
        The function g of the range in the middle [m], of x [m/s].
    """

    def __init__(self, footprint: Footprint, height: float, illuminated: float) -> None:
        radar, arc = footprint.radar, footprint.arc
        t_b, _ = footprint.middle
        far = footprint.near_range + (footprint.n_cells - 1) * radar.range_spacing
        self.span = np.array([footprint.near_range, far])
        self.ranges = np.mean(self.span) + np.ptp(self.span) / 2 * chebyshev.chebpts1(5)
        p = footprint.points(np.full(5, t_b), self.ranges, np.full(5, height))
        rates = range_derivatives(arc, t_b, p)
        edge = np.array([-0.5, 0.5]) * (illuminated * 1.001) + footprint.centroid
        x = np.concatenate(
            [SPEED_OF_LIGHT * edge / (radar.carrier + s * radar.sample_rate / 2) for s in (-1, 1)]
        )
        self.domain = (float(x.min()), float(x.max()))
        x = np.mean(self.domain) + np.ptp(self.domain) / 2 * chebyshev.chebpts1(2 * _DEGREE)
        self.g = [Chebyshev.fit(x, _legendre(x, c), _DEGREE, domain=self.domain) for c in rates]
        inverse = np.linalg.inv(chebyshev.chebvander(chebyshev.chebpts1(5), 4))
        self.coefficients = np.tensordot(inverse, np.stack([g.coef for g in self.g]), 1)
        middle = chebyshev.chebvander(np.zeros(1), 4)[0] @ self.coefficients
        self.middle = Chebyshev(middle, domain=self.domain)

    def clipped(self, x: FloatArray) -> FloatArray:
        """Hold x within where g is known."""
        return np.asarray(np.clip(x, self.domain[0], self.domain[1]), np.float64)

    def at(self, x: FloatArray) -> FloatArray:
        """Coefficients (len(x), 5) of g at x as a polynomial of range."""
        scaled = (x - np.mean(self.domain)) / (np.ptp(self.domain) / 2)
        return np.asarray(chebyshev.chebvander(scaled, _DEGREE) @ self.coefficients.T)


def range_derivatives(arc: Arc, t: float, p: FloatArray) -> FloatArray:
    """First to fourth derivatives (n, 4) of the range to points (n, 3) at a time [m/s^k]."""
    r, v, a, j, s = (arc.derivative(t, k) for k in range(5))
    d = r - p
    R = np.linalg.norm(d, axis=-1)
    # derivatives of R^2 / 2, then of R
    one = d @ v
    two = v @ v + d @ a
    three = 3 * (v @ a) + d @ j
    four = 3 * (a @ a) + 4 * (v @ j) + d @ s
    r1 = one / R
    r2 = (two - r1**2) / R
    r3 = (three - 3 * r1 * r2) / R
    r4 = (four - 3 * r2**2 - 4 * r1 * r3) / R
    return np.stack([r1, r2, r3, r4], axis=-1)


def _legendre(x: FloatArray, rates: FloatArray) -> FloatArray:
    """Evaluate g at x, for a range history with given derivatives."""
    history = np.polynomial.Polynomial([0.0, *(c / factorial(k + 1) for k, c in enumerate(rates))])
    speed, change = history.deriv(1), history.deriv(2)
    s = (-x / 2 - rates[0]) / rates[1]
    for _ in range(20):
        s = s - (speed(s) + x / 2) / change(s)
    return np.asarray(-history(s) - x * s / 2)
