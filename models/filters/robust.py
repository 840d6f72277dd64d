r"""Robust weights: rules that a measurement far from its prediction does not pull along.

Any rule of `terrafix.models.filters.updates` is given a noise that the innovation :math:`\nu` has
enlarged, with :math:`S = P_{yy} + R` as the rule has it, at the prior and without underweighting.

Weights ``huber`` enlarge each element by Huber's weight [1]_ of its normalized innovation,

.. math::
    w_i = \min\left(1, \frac{k}{|\nu_i| / \sqrt{S_{ii}}}\right), \qquad
    R'_{ij} = \frac{R_{ij}}{\sqrt{w_i w_j}},

which keeps correlations, as the bifactor weights of [2]_ do. One element that is off by
:math:`a = |\nu| / \sqrt{S} > k` has the gain :math:`P_{xy} / (P_{yy} + a R / k)`: its correction is
never larger than :math:`k P_{xy} \sqrt{S} / R`, however large the innovation.

Weights ``nis`` scale all of the noise until the normalized innovation squared is at its threshold
:math:`\gamma`, [3]_,

.. math::
    R' = \lambda R, \qquad \lambda = \min\left\{\lambda \ge 1 :
    \nu^T (P_{yy} + \lambda R)^{-1} \nu \le \gamma\right\}.

For one element :math:`\lambda = (\nu^2 / \gamma - P_{yy}) / R`. For more, one over the left side is
concave in :math:`\lambda`, a harmonic mean of straight lines, so that Newton's method for it rises
to the solution from below.

What is judged and published, residual, covariance and normalized square, is that of the noise as
reported. The covariance of the posterior is that of the enlarged noise: somewhat too large where
nothing is wrong.

References
----------
.. [1] P. J. Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics
       35(1), 1964. k = 1.345 estimates the mean of normal numbers with an efficiency of 0.95.
.. [2] Y. Yang, L. Song, T. Xu, "Robust estimator for correlated observations based on bifactor
       equivalent weights", Journal of Geodesy 76, 2002.
.. [3] G. Chang, "Robust Kalman filtering based on Mahalanobis distance as outlier judging
       criterion", Journal of Geodesy 88, 2014.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca

from terrafix.models.core.symmetric import ldl, ldl_solve
from terrafix.models.filters.updates import FLOOR, Measurement, Update, nth

WEIGHTS = ("none", "huber", "nis")
"""Names of the weights."""

THRESHOLDS = {"huber": "huber_threshold", "nis": "nis_threshold"}
"""The parameter that each of them takes."""

HUBER = 1.345
"""Threshold of Huber's weights, unless said otherwise [sigma]."""

_NEWTON = 8
"""Steps to the scale of R. Where eigenvalues of P_yy and R span six decades each and an element is
off by up to 300 sigma, the NIS is then above its threshold by less than 2e-12 of it; 7: 4e-7."""

_LARGEST = 1e12
"""Largest scale of R: where some of it is zero, none brings the NIS to its threshold."""


def robust_rule(
    rule: Callable[..., Update], weights: str, threshold: Any = None
) -> Callable[..., Update]:
    """Make a rule robust.

    Parameters
    ----------
    rule : callable
        One of `terrafix.models.filters.updates`.
    weights : {"none", "huber", "nis"}
        With none, the rule itself.
    threshold : SX
        Of "huber", k [sigma]; of "nis", (m, 1): the largest with 1 to m elements. Infinity leaves
        the noise as it is.

    Raises
    ------
    ValueError
        If the weights are not known.
    """
    if weights not in WEIGHTS:
        raise ValueError(f"weights must be one of {WEIGHTS}, got '{weights}'")
    if weights == "none":
        return rule

    def robust(P: Any, measurement: Measurement, beta: Any, considered: Sequence[int] = ()) -> Any:
        plain = rule(P, measurement, beta, considered)
        if weights == "huber":
            spread = huber_spread(plain, threshold)
        else:
            R = measurement.covariance(ca.SX.zeros(P.shape[0]))
            n = ca.sum1(measurement.present > 0.5)
            spread = ca.repmat(ca.sqrt(nis_scale(plain, R, nth(threshold, n))), R.shape[0])
        scale = ca.mtimes(spread, spread.T)
        weighed = rule(
            P,
            replace(measurement, noise=lambda error: scale * measurement.noise(error)),
            beta,
            considered,
        )
        _, _, positive = ldl(plain.S, FLOOR)
        return replace(
            weighed,
            residual=plain.residual,
            S=plain.S,
            nis=plain.nis,
            positive=ca.logic_and(positive, weighed.positive),
        )

    return robust


def huber_spread(plain: Update, threshold: Any) -> Any:
    """Factor on the sigma of each element, (m, 1), at least 1: the root of Huber's weight, over."""
    variance = ca.diag(plain.S)
    sigma = ca.sqrt(ca.if_else(variance > 0, variance, 1.0))
    return ca.sqrt(ca.fmax(1.0, ca.fabs(plain.residual) / sigma / threshold))


def nis_scale(plain: Update, R: Any, threshold: Any) -> Any:
    """Factor on R, at least 1, with which the NIS is not above a threshold."""
    scale = ca.SX(1)
    for _ in range(1 if R.shape[0] == 1 else _NEWTON):
        L, d, _ = ldl(plain.S + (scale - 1) * R, FLOOR)
        x = ldl_solve(L, d, plain.residual)
        nis, slope = ca.dot(plain.residual, x), ca.dot(x, ca.mtimes(R, x))
        above = ca.logic_and(nis > threshold, slope > 0)
        by = nis * (nis - threshold) / ca.if_else(above, threshold * slope, 1.0)
        scale = ca.fmin(scale + ca.if_else(above, by, 0.0), _LARGEST)
    return scale
