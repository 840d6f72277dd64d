r"""Dryden's turbulence: gusts along the flight, across it and vertical, as shaped white noise.

The gusts are frozen and passed with airspeed :math:`V`. With :math:`T = L / V` the filters of unit
white noise are

.. math::
    H_u = \sigma_u \sqrt{2 T_u}\, \frac{1}{1 + T_u s}, \qquad
    H_{v, w} = \sigma \sqrt{T}\, \frac{1 + \sqrt 3\, T s}{(1 + T s)^2},

and the correlation after a time :math:`\tau`

.. math::
    R_u = \sigma_u^2 e^{-\tau / T_u}, \qquad
    R_{v, w} = \sigma^2 e^{-\tau / T} \Bigl( 1 - \frac{\tau}{2 T} \Bigr).

The transverse filter is two lags in a row, each of time :math:`T`: with :math:`x_1` of variance
:math:`\sigma^2` behind the first and :math:`x_2` behind both, the gust is :math:`(\sqrt 3\, x_1 +
(1 - \sqrt 3)\, x_2) / \sqrt 2`. Over a step, :math:`\varphi = e^{-\Delta t / T}`,

.. math::
    x_1^+ = \varphi x_1 + n_1, \qquad
    x_2^+ = \varphi (x_2 + \tfrac{\Delta t}{T} x_1) + n_2, \qquad
    Q = P - \Phi P \Phi^T, \quad
    P = \sigma^2 \begin{bmatrix} 1 & \tfrac12 \\ \tfrac12 & \tfrac12 \end{bmatrix},

exactly, at any step. The start is drawn from :math:`P`.

References
----------
.. [1] MIL-F-8785C, "Flying qualities of piloted airplanes", 1980, section 3.7.
.. [2] MIL-HDBK-1797, 1997, appendix A, writes the transverse filters with 2 L in the place of L;
       give half of its lengths here.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

N_STATES = 5
"""Of the filters: one along, two across, two vertical. As many normal numbers make a step."""

_FOOT = 0.3048
_LOWEST, _LOW, _MEDIUM = 10.0, 1000.0, 2000.0  # [ft]
_MEDIUM_LENGTH = 1750.0  # [ft]


def gusts(x: Any) -> Any:
    """Gusts (3,) [m/s] along, to the right and down, of the filters' states (5,)."""
    across, down = ((3**0.5 * x[k] + (1 - 3**0.5) * x[k + 1]) / 2**0.5 for k in (1, 3))
    return ca.vertcat(x[0], across, down)


def started(sigma: Any, noise: Any) -> Any:
    """States (5,) at the start, as if it had blown for ever.

    Parameters
    ----------
    sigma : SX, shape (3,)
        Of the gusts [m/s].
    noise : SX, shape (5,)
        Standard normal numbers.
    """
    pairs = [
        sigma[i] * ca.vertcat(noise[k], (noise[k] + noise[k + 1]) / 2) for i, k in ((1, 1), (2, 3))
    ]
    return ca.vertcat(sigma[0] * noise[0], *pairs)


def blown(x: Any, sigma: Any, noise: Any, time: Any, dt: Any) -> Any:
    """States (5,) a step later.

    Parameters
    ----------
    x : SX, shape (5,)
    sigma, noise
        As of `started`.
    time : SX, shape (3,)
        Lengths over airspeed [s].
    dt : SX
        Length of the step [s].
    """
    phi = ca.exp(-dt / time[0])
    along = phi * x[0] + ca.sqrt(1 - phi * phi) * sigma[0] * noise[0]
    pairs = [
        _transverse(x[k : k + 2], sigma[i] * noise[k : k + 2], dt / time[i])
        for i, k in ((1, 1), (2, 3))
    ]
    return ca.vertcat(along, *pairs)


def _transverse(x: Any, noise: Any, a: Any) -> Any:
    phi = ca.exp(-a)
    squared = phi * phi
    first = ca.sqrt(1 - squared)
    mixed = (0.5 - squared * (0.5 + a)) / first
    # below steps of 1e-5 of T rounding decides whether there is anything left
    second = ca.sqrt(ca.fmax(0.5 - squared * (0.5 + a + a * a) - mixed * mixed, 0))
    return ca.vertcat(
        phi * x[0] + first * noise[0],
        phi * (x[1] + a * x[0]) + mixed * noise[0] + second * noise[1],
    )


def military_scales(height: Any, wind: Any) -> tuple[Any, Any]:
    """Sigmas (3,) [m/s] and lengths (3,) [m] of MIL-F-8785C at low and medium altitude.

    Below 1000 ft both follow from height and wind; above 2000 ft the lengths are 1750 ft, and the
    gusts are alike, of the vertical sigma at low altitude; in between they are interpolated. Below
    10 ft they are those of 10 ft.

    Parameters
    ----------
    height : SX
        Above ground [m].
    wind : SX
        Mean wind at 20 ft above ground [m/s]: 15 kn light, 30 kn moderate, 45 kn severe.
    """
    feet = height / _FOOT
    low = ca.fmin(ca.fmax(feet, _LOWEST), _LOW)
    flatter = 0.177 + 0.000823 * low
    share = ca.fmin(ca.fmax((feet - _LOW) / (_MEDIUM - _LOW), 0), 1)
    vertical = 0.1 * wind
    horizontal = vertical * (flatter**-0.4 * (1 - share) + share)
    lengths = ca.vertcat(low / flatter**1.2, low / flatter**1.2, low)
    lengths += share * (_MEDIUM_LENGTH - lengths)
    return ca.vertcat(horizontal, horizontal, vertical), _FOOT * lengths
