r"""Three ways to weigh a measurement against a prior, behind one signature.

Common to all: the innovation :math:`\nu = y - \hat y` with covariance
:math:`S = P_{yy} + R`, in which :math:`R` holds the instrument's noise and the error of the
pixel's position; and underweighting by a factor :math:`\beta`, Lear's device,

.. math::
    S_u = (1 + \beta) P_{yy} + R, \qquad K = P_{xy} S_u^{-1},

which enlarges the gain's covariance and the posterior's, not the one by which the innovation is
judged.

Elements of the error that are only considered (a Schmidt filter's) have a gain of zero; the
covariances below hold for any gain.

A measurement says which of its elements are angles: a bearing of 3.1 rad that was predicted as
-3.1 rad is off by 0.08 rad, not by 6.2.

References
----------
.. [1] B. S. Pogorelsky, R. Zanetti, J. Chen, S. Jenkins, "Synthetic Aperture Radar Based
       Spacecraft Terrain Relative Navigation", eqs. (35)-(43). The factor of eq. (43) is that of
       eq. (35), zero where underweighting is not active.
.. [2] B. M. Bell, F. W. Cathey, "The iterated Kalman filter update as a Gauss-Newton method",
       IEEE Trans. Automatic Control 38(2), 1993.
.. [3] I. Arasaratnam, S. Haykin, "Cubature Kalman filters", IEEE Trans. Automatic Control 54(6),
       2009.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any

import casadi as ca

from terrafix.models.core.symmetric import ldl, ldl_solve, mirrored, semidefinite_root

UPDATES = ("ekf", "iterated", "unscented")
"""Names of the updates."""

FLOOR = 1e-12
"""Smallest relative pivot of an innovation covariance: correlations within 1e-12 of one fail."""

_ITERATIONS = 5
"""Gauss-Newton steps. From 1 km and 0.1 deg the second moves the estimate by up to 0.3 sigma, the
third by 5e-6, the fourth by 1e-8, the fifth by 2e-10."""


@dataclass(frozen=True)
class Measurement:
    """A measurement as a function of the error of the prior; absent elements neutralized.

    Parameters
    ----------
    y : SX, shape (m, 1)
        Measured values.
    predict : callable
        Prediction (m, 1) at an error (n, 1), truth minus prior.
    jacobian : callable
        Derivative (m, n) of `predict` by the error, at an error.
    noise : callable
        Covariance (m, m) of the noise at an error.
    present : SX, shape (m, 1)
        1 where an element was measured, else 0.
    angles : tuple of int
        Elements that are angles [rad]: their differences are taken within half a turn.
    held : callable
        What a rule goes on with of an error that it found: the same; a symbol for it where
        predictions are questions, so that one that follows does not repeat how it was found.
    """

    y: Any
    predict: Callable[[Any], Any]
    jacobian: Callable[[Any], Any]
    noise: Callable[[Any], Any]
    present: Any
    angles: tuple[int, ...] = ()
    held: Callable[[Any], Any] = lambda error: error

    def residual(self, error: Any) -> Any:
        """Measured minus predicted, (m, 1); zero where absent."""
        return self.masked(self.wrapped(self.y - self.predict(error)))

    def wrapped(self, difference: Any) -> Any:
        """Difference of two measurements (m, 1), its angles within half a turn."""
        out = ca.SX(difference)
        for k in self.angles:
            out[k] -= 2 * pi * ca.floor((out[k] + pi) / (2 * pi))
        return out

    def continued(self, values: Any, center: Any) -> Any:
        """A measurement (m, 1), its angles within half a turn of those of another."""
        out = ca.SX(values)
        for k in self.angles:
            out[k] = center[k] + self.wrapped(values - center)[k]
        return out

    def sensitivity(self, error: Any) -> Any:
        """Jacobian (m, n) with rows of zeros where absent."""
        return self.masked(self.jacobian(error))

    def covariance(self, error: Any) -> Any:
        """Covariance (m, m) of the noise: rows and columns of the identity where absent."""
        masked = self.masked(self.masked(self.noise(error)).T)
        return mirrored(masked + ca.diag(ca.if_else(self.present > 0.5, 0.0, 1.0)))

    def masked(self, rows: Any) -> Any:
        """Zero the rows of absent elements, whatever they hold."""
        present = ca.repmat(self.present, 1, rows.shape[1])
        return ca.if_else(present > 0.5, rows, 0.0)


@dataclass(frozen=True)
class Update:
    """Outcome of an update.

    Parameters
    ----------
    correction : SX, shape (n, 1)
        What to add to the prior.
    P : SX, shape (n, n)
        Covariance after it.
    residual : SX, shape (m, 1)
        Innovation at the prior.
    S : SX, shape (m, m)
        Its covariance, not inflated.
    nis : SX
        Its normalized square.
    positive : SX
        1 where every innovation covariance was positive definite, else 0.
    """

    correction: Any
    P: Any
    residual: Any
    S: Any
    nis: Any
    positive: Any


def nth(table: Any, n: Any) -> Any:
    """Entry of a column for the number n = 1, 2, ..., in symbols; 0 for any other."""
    return sum(ca.if_else(n == k + 1, table[k], 0.0) for k in range(ca.SX(table).shape[0]))


def _judged(residual: Any, S: Any) -> tuple[Any, Any]:
    """Return the normalized innovation squared, and whether S is positive definite."""
    L, d, positive = ldl(S, FLOOR)
    return ca.dot(residual, ldl_solve(L, d, residual)), positive


def _gain(P_xy: Any, S: Any, considered: Sequence[int]) -> tuple[Any, Any]:
    L, d, positive = ldl(S, FLOOR)
    K = ldl_solve(L, d, P_xy.T).T
    for k in considered:
        K[k, :] = 0
    return K, positive


def _joseph(P: Any, H: Any, K: Any, R: Any) -> Any:
    """Covariance after a gain K, eq. (42) of [1]_: symmetric and definite for any gain."""
    kept = P - ca.mtimes(K, ca.mtimes(H, P))
    kept = kept - ca.mtimes(ca.mtimes(kept, H.T), K.T)
    return mirrored(kept + ca.mtimes(K, ca.mtimes(R, K.T)))


def ekf_update(
    P: Any, measurement: Measurement, beta: Any, considered: Sequence[int] = ()
) -> Update:
    """Linearize once, at the prior: eqs. (35)-(43) of [1]_.

    Parameters
    ----------
    P : SX, shape (n, n)
        Covariance of the prior.
    measurement : Measurement
        The measurement about the prior.
    beta : SX
        Factor of underweighting.
    considered : sequence of int
        Elements of the error that are not corrected.
    """
    zero = ca.SX.zeros(P.shape[0])
    residual, R = measurement.residual(zero), measurement.covariance(zero)
    H = measurement.sensitivity(zero)
    P_xy = ca.mtimes(P, H.T)
    P_yy = mirrored(ca.mtimes(H, P_xy))
    S = P_yy + R
    nis, positive = _judged(residual, S)
    K, solvable = _gain(P_xy, S + beta * P_yy, considered)
    return Update(
        correction=ca.mtimes(K, residual),
        P=_joseph(P, H, K, beta * P_yy + R),
        residual=residual,
        S=S,
        nis=nis,
        positive=ca.logic_and(positive, solvable),
    )


def iterated_update(
    P: Any, measurement: Measurement, beta: Any, considered: Sequence[int] = ()
) -> Update:
    """Linearize again about each iterate: Gauss-Newton for the most probable state, [2]_.

    A fixed number of iterations; the innovation is judged as in `ekf_update`, at the prior.
    Parameters as there.
    """
    first = ekf_update(P, measurement, beta, considered)
    error, positive = measurement.held(first.correction), first.positive
    for _ in range(_ITERATIONS - 1):
        H, K, solvable, R = _linearized(P, measurement, beta, error, considered)
        innovation = measurement.residual(error) + ca.mtimes(H, error)
        error = measurement.held(ca.mtimes(K, innovation))
        positive = ca.logic_and(positive, solvable)
    H, K, solvable, R = _linearized(P, measurement, beta, error, considered)
    return Update(
        correction=error,
        P=_joseph(P, H, K, R),
        residual=first.residual,
        S=first.S,
        nis=first.nis,
        positive=ca.logic_and(positive, solvable),
    )


def _linearized(
    P: Any, measurement: Measurement, beta: Any, error: Any, considered: Sequence[int]
) -> tuple[Any, ...]:
    """Jacobian, gain, whether it exists, and the noise of the Joseph form, at an error."""
    H, R = measurement.sensitivity(error), measurement.covariance(error)
    P_xy = ca.mtimes(P, H.T)
    P_yy = mirrored(ca.mtimes(H, P_xy))
    R = beta * P_yy + R
    K, solvable = _gain(P_xy, P_yy + R, considered)
    return H, K, solvable, R


def unscented_update(
    P: Any, measurement: Measurement, beta: Any, considered: Sequence[int] = ()
) -> Update:
    r"""Propagate sigma points of the error through the measurement.

    The 2 n equally weighted points of [3]_ (no weight is negative). With :math:`P = L L^T` and
    points :math:`\pm\sqrt{n}\, L_j`, half differences :math:`\sqrt{n} M_j` and half sums
    :math:`s_j` of the predictions,

    .. math::
        P_{xy} = L M^T, \qquad P_{yy} = M M^T + N, \qquad
        N = \tfrac{1}{n} \sum_j (s_j - \hat y)(s_j - \hat y)^T,

    and the posterior :math:`(L - K M)(L - K M)^T + K R' K^T` with
    :math:`R' = N + \beta P_{yy} + R` is definite by its form. The noise of the pixel's position is
    mapped by the derivative at the prior. Parameters as in `ekf_update`.
    """
    n = P.shape[0]
    root = semidefinite_root(P)
    points = [ca.sqrt(n) * root[:, j] for j in range(n)]
    zero = ca.SX.zeros(n)
    center = measurement.predict(zero)

    def predicted_at(error: Any) -> Any:
        return measurement.masked(measurement.continued(measurement.predict(error), center))

    ahead = [predicted_at(p) for p in points]
    behind = [predicted_at(-p) for p in points]
    sums = ca.horzcat(*((a + b) / 2 for a, b in zip(ahead, behind, strict=True)))
    M = ca.horzcat(*((a - b) / 2 for a, b in zip(ahead, behind, strict=True))) / ca.sqrt(n)
    predicted = ca.sum2(sums) / n
    spread = (sums - ca.repmat(predicted, 1, n)) / ca.sqrt(n)
    second = mirrored(ca.mtimes(spread, spread.T))
    P_yy = mirrored(ca.mtimes(M, M.T)) + second
    residual = measurement.masked(measurement.wrapped(measurement.y - predicted))
    R = measurement.covariance(zero)
    S = P_yy + R
    nis, positive = _judged(residual, S)
    K, solvable = _gain(ca.mtimes(root, M.T), S + beta * P_yy, considered)
    kept = root - ca.mtimes(K, M)
    noise = second + beta * P_yy + R
    return Update(
        correction=ca.mtimes(K, residual),
        P=mirrored(ca.mtimes(kept, kept.T) + ca.mtimes(K, ca.mtimes(noise, K.T))),
        residual=residual,
        S=S,
        nis=nis,
        positive=ca.logic_and(positive, solvable),
    )


def update_rule(name: str) -> Callable[..., Update]:
    """Choose an update by name.

    Raises
    ------
    ValueError
        If `name` is none of `UPDATES`.
    """
    rules = {"ekf": ekf_update, "iterated": iterated_update, "unscented": unscented_update}
    if name not in rules:
        raise ValueError(f"update must be one of {UPDATES}, got '{name}'")
    return rules[name]
