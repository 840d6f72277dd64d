r"""Gravity in spherical harmonics, as symbolic expressions that hold at the poles too.

With :math:`(\xi, \eta, \zeta) = a\, r / \lVert r \rVert^2` and :math:`q = a / \lVert r \rVert`, a
field of radius :math:`a` is

.. math::
    U = \frac{\mu}{a}\, q\, \Phi, \qquad
    \Phi = \sum_{n, m} B_{nm}(\zeta, q^2)
        \left( \bar C_{nm} R_m + \bar S_{nm} I_m \right), \qquad
    R_m + i I_m = (\xi + i \eta)^m,

where :math:`\Phi` is a polynomial, and therefore without any singularity. Its columns
follow from the recursion of Cunningham [1]_ on fully normalized functions [2]_, upward in degree
at fixed order, which is stable,

.. math::
    B_{nm} = \alpha_{nm}\, \zeta\, B_{n-1,m} - \beta_{nm}\, q^2 B_{n-2,m}, \qquad
    \alpha_{nm}^2 = \frac{(2n-1)(2n+1)}{(n-m)(n+m)}, \quad
    \beta_{nm}^2 = \frac{(2n+1)(n+m-1)(n-m-1)}{(n-m)(n+m)(2n-3)},

and the derivative by :math:`\zeta` is one of the next column,
:math:`\partial B_{nm} / \partial \zeta |_{q^2} \propto B_{n,m+1}`. With derivatives at constant
:math:`q^2`, as Pines has them,

.. math::
    g = \frac{\mu}{a^2}\, q \left[ q^2 \frac{\partial \Phi}{\partial s}
        - s \left( \sum_{n, m} (n + m + 1)\, \Phi_{nm}
        + \zeta \frac{\partial \Phi}{\partial \zeta} \right) \right],
    \qquad s = (\xi, \eta, \zeta).

Coefficients are numbers in the expressions, not symbols. The columns are scaled so that the
recursion has no factor at :math:`\zeta`.

References
----------
.. [1] L. E. Cunningham, "On the computation of the spherical harmonic terms needed during the
       numerical integration of the orbital motion of an artificial satellite", Celestial
       Mechanics 2, 1970.
.. [2] S. A. Holmes and W. E. Featherstone, "A unified approach to the Clenshaw summation and the
       recursive computation of very high degree and order normalised associated Legendre
       functions", Journal of Geodesy 76, 2002, eqs. (11)-(13).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.motion.gravity_field import GravityField


def harmonic_acceleration(r: Any, field: GravityField) -> Any:
    """Gravity of all coefficients of a field, (3,) [m/s^2], Earth-fixed.

    Parameters
    ----------
    r : SX, shape (3,)
        Position [m], Earth-fixed.
    field : GravityField
    """
    return harmonic_sum(r, field.mu, field.radius, field.C, field.S)


def harmonics_beyond_j2(r: Any, field: GravityField) -> Any:
    """Gravity of a field without its central and second zonal term, (3,) [m/s^2], Earth-fixed.

    Parameters
    ----------
    r : SX, shape (3,)
        Position [m], Earth-fixed.
    field : GravityField
    """
    C = field.C.copy()
    C[0, 0] = C[2, 0] = 0.0
    return harmonic_sum(r, field.mu, field.radius, C, field.S)


def harmonic_sum(r: Any, mu: Any, radius: Any, C: Any, S: Any) -> Any:
    """Acceleration of a field of given coefficients, (3,) [m/s^2].

    Parameters
    ----------
    r : SX, shape (3,)
        Position [m], in the axes of the coefficients.
    mu, radius : SX or float
        [m^3/s^2], [m]
    C, S : ndarray or SX, shape (n_max + 1, n_max + 1)
        Fully normalized coefficients; what is zero costs nothing.
    """
    degree = C.shape[0] - 1
    inverse = 1 / ca.dot(r, r)
    s = radius * inverse * r
    xi, eta, zeta = s[0], s[1], s[2]
    squared = radius * radius * inverse
    scale, ratio = _scales(degree)
    column = _column(0, degree, zeta, squared, ratio)
    # real and imaginary part of (xi + i eta)^m, and of the power below it
    power, below = (ca.SX(1), ca.SX(0)), (ca.SX(0), ca.SX(0))
    by_xi = by_eta = by_zeta = weighted = ca.SX(0)
    for m in range(degree + 1):
        following = _column(m + 1, degree, zeta, squared, ratio)
        plain, rising, radial = ([ca.SX(0), ca.SX(0)] for _ in range(3))
        for n in range(m, degree + 1):
            for part, table in enumerate((C, S)):
                c = table[n, m]
                if (m == 0 and part == 1) or _is_zero(c):
                    continue
                value = c * scale[n, m]
                plain[part] += value * column[n]
                radial[part] += value * (n + m + 1) * column[n]
                if n > m:
                    slope = _slope(n, m) * scale[n, m + 1]
                    rising[part] += c * slope * following[n]
        by_zeta += power[0] * rising[0] + power[1] * rising[1]
        weighted += power[0] * radial[0] + power[1] * radial[1]
        if m:
            by_xi += m * (plain[0] * below[0] + plain[1] * below[1])
            by_eta += m * (plain[1] * below[0] - plain[0] * below[1])
        below = power
        power = (xi * power[0] - eta * power[1], xi * power[1] + eta * power[0])
        column = following
    q = ca.sqrt(squared)
    lateral = squared * ca.vertcat(by_xi, by_eta, by_zeta)
    along = weighted + zeta * by_zeta
    return mu / (radius * radius) * q * (lateral - along * s)


def _is_zero(c: Any) -> bool:
    return bool(c.is_zero()) if isinstance(c, ca.SX) else c == 0.0


def _alpha(n: int, m: int) -> float:
    return float(np.sqrt((2 * n - 1) * (2 * n + 1) / ((n - m) * (n + m))))


def _beta(n: int, m: int) -> float:
    numerator = (2 * n + 1) * (n + m - 1) * (n - m - 1)
    return float(np.sqrt(numerator / ((n - m) * (n + m) * (2 * n - 3))))


def _slope(n: int, m: int) -> float:
    """Of the normalized function of order m + 1, in the derivative of that of order m."""
    return float(np.sqrt((n - m) * (n + m + 1) / (2.0 if m == 0 else 1.0)))


def _scales(degree: int) -> tuple[FloatArray, FloatArray]:
    """Normalized functions by those of the columns; factors at q^2 in the recursion of these."""
    scale, ratio = np.zeros((2, degree + 2, degree + 2))
    sectoral = 1.0
    for m in range(degree + 2):
        if m:
            sectoral *= float(np.sqrt((2 * m + 1) / (2 * m) * (2 if m == 1 else 1)))
        scale[m, m] = sectoral
        for n in range(m + 1, degree + 2):
            scale[n, m] = scale[n - 1, m] * _alpha(n, m)
            if n > m + 1:
                ratio[n, m] = _beta(n, m) / (_alpha(n, m) * _alpha(n - 1, m))
    return scale, ratio


def _column(m: int, degree: int, zeta: Any, squared: Any, ratio: FloatArray) -> dict[int, Any]:
    """Functions of one order by degree, scaled so that the recursion has no factor at zeta."""
    column: dict[int, Any] = {}
    for n in range(m, degree + 1):
        if n == m:
            column[n] = ca.SX(1)
        elif n == m + 1:
            column[n] = zeta
        else:
            column[n] = zeta * column[n - 1] - ratio[n, m] * (squared * column[n - 2])
    return column


def solid_harmonics(r: Any, radius: Any, degree: int) -> tuple[dict[Any, Any], dict[Any, Any]]:
    r"""Fully normalized functions of a place, by degree and order.

    .. math::
        \left( \frac{a}{r} \right)^{n+1} \bar P_{nm}(\sin \varphi) \cos m \lambda, \qquad
        \left( \frac{a}{r} \right)^{n+1} \bar P_{nm}(\sin \varphi) \sin m \lambda.

    Parameters
    ----------
    r : SX, shape (3,)
        Position [m].
    radius : SX or float
        [m]
    degree : int
        The largest.
    """
    inverse = 1 / ca.dot(r, r)
    s = radius * inverse * r
    squared = radius * radius * inverse
    q = ca.sqrt(squared)
    scale, ratio = _scales(degree)
    power = (ca.SX(1), ca.SX(0))
    cosines, sines = {}, {}
    for m in range(degree + 1):
        for n, value in _column(m, degree, s[2], squared, ratio).items():
            cosines[n, m] = q * scale[n, m] * value * power[0]
            sines[n, m] = q * scale[n, m] * value * power[1]
        power = (s[0] * power[0] - s[1] * power[1], s[0] * power[1] + s[1] * power[0])
    return cosines, sines
