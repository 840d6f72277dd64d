r"""Doppler centroid of an echo: its fraction of the repetition frequency, and the whole number.

Samples at the repetition frequency :math:`F_a` show the centroid modulo :math:`F_a`,

.. math:: f = f' + M F_a, \qquad -F_a/2 \le f' < F_a/2,

and :math:`f'` is the phase by which the echo advances, on average, from line to line. Where
attitude is known to better than half a repetition frequency, the geometry tells the whole number
:math:`M`.

A Doppler frequency is positive when the range is closing.

References
----------
.. [1] S. N. Madsen, "Estimating the Doppler Centroid of SAR Data", IEEE Trans. Aerospace and
       Electronic Systems 25(2), 1989: the average phase increment.
.. [2] I. Cumming, F. Wong, "Digital Processing of Synthetic Aperture Radar Data", Artech House,
       2005, ch. 12.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import ComplexArray, FloatArray


def fractional_centroid(echo: ComplexArray, prf: float) -> tuple[float, float]:
    """Centroid modulo the repetition frequency, and how coherent successive lines are.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_lines, n_cells)
        Raw or range-compressed echo.
    prf : float
        Pulse repetition frequency [Hz].

    Returns
    -------
    centroid : float
        In [-prf/2, prf/2] [Hz].
    coherence : float
        Magnitude of the correlation of neighboring lines, 0 (noise) to 1.

    Raises
    ------
    ValueError
        If there are fewer than two lines, or the echo is empty of signal or not finite.
    """
    if len(echo) < 2:
        raise ValueError(f"the centroid wants two lines at least, got {len(echo)}")
    increment = np.vdot(echo[:-1], echo[1:])
    power = np.sqrt(np.vdot(echo[:-1], echo[:-1]).real * np.vdot(echo[1:], echo[1:]).real)
    if not (np.isfinite(power) and power > 0):
        raise ValueError("the echo is zero or not finite: it has no Doppler centroid")
    return float(prf * np.angle(increment) / (2 * np.pi)), float(abs(increment) / power)


def geometric_centroid(r: ArrayLike, v: ArrayLike, p: ArrayLike, wavelength: float) -> FloatArray:
    r"""Doppler [Hz] of ground points: :math:`2 v^T (p - r) / (\lambda \lVert p - r \rVert)`.

    Parameters
    ----------
    r, v, p : array_like, shape (..., 3)
        Radar position [m] and velocity [m/s] and ground point [m], all Earth-fixed.
    wavelength : float
        [m]
    """
    r, v, p = (np.asarray(a, dtype=np.float64) for a in (r, v, p))
    line = p - r
    closing = (v * line).sum(axis=-1) / np.linalg.norm(line, axis=-1)
    return np.asarray(2 * closing / wavelength)


def unwrapped_centroid(fraction: float, prf: float, expected: float) -> float:
    """Frequency [Hz] congruent to `fraction` modulo `prf` that is nearest to `expected` [Hz]."""
    return fraction + prf * float(np.rint((expected - fraction) / prf))


def centroid_candidates(
    fraction: float, prf: float, expected: float, sigma: float, n_sigma: float = 3.5
) -> list[float]:
    """Frequencies [Hz] congruent to `fraction` modulo `prf` that an expectation allows.

    Parameters
    ----------
    fraction : float
        Centroid modulo the repetition frequency [Hz].
    prf : float
        Pulse repetition frequency [Hz].
    expected, sigma : float
        Centroid from geometry and its standard deviation [Hz].
    n_sigma : float
        How far from it the centroid may be, in standard deviations.

    Returns
    -------
    list of float
        The nearest first; never empty.
    """
    nearest = unwrapped_centroid(fraction, prf, expected)
    reach = int(n_sigma * sigma / prf + 1)
    found = [nearest + k * prf for k in range(-reach, reach + 1)]
    found = [f for f in found if f == nearest or abs(f - expected) <= n_sigma * sigma]
    return sorted(found, key=lambda f: abs(f - expected))
