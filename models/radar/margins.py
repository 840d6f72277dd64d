r"""What an echo has to spare for an image, and what an estimate that is off takes of it.

A target is seen by the processed Doppler band :math:`B` for

.. math:: T = \frac{B \lambda R}{2 V^2},

and only lines about whose zero Doppler all of that was received are focused [1]_. The range to it
grows by :math:`R\,(1 / D - 1)` until the band's edge, :math:`D` the cosine of the angle off
broadside there.

References
----------
.. [1] I. G. Cumming, F. H. Wong, "Digital Processing of Synthetic Aperture Radar Data", 2005,
       sections 4.6 and 6.3.
"""

from __future__ import annotations

from collections.abc import Callable
from math import hypot

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.focusing import migration_factor

PEAK_OF_IMAGING = 4.0
"""Memory at most that forming images takes besides the echo, in echoes of complex64."""


def aperture_lines(radar: Radar, slant_range: float, velocity: float) -> float:
    """Lines for which a target is in the processed band, seen with an effective velocity [m/s]."""
    return radar.prf * radar.doppler_bandwidth * radar.wavelength * slant_range / (2 * velocity**2)


def focused_size(
    radar: Radar, n_lines: int, n_cells: int, slant_range: float, velocity: float
) -> tuple[float, float]:
    """Lines and cells of an echo that are focused, seen about zero Doppler from a slant range [m].

    That is the range of its middle; the farthest cell takes the longest aperture. Of an echo
    shorter than an aperture those lines are focused that all of it sees, with a coarser resolution.
    Less than zero where it is too short for any.
    """
    columns = _focused_cells(radar, n_cells, slant_range, velocity)
    half = max(columns, 0.0) / 2 * radar.range_spacing
    duration = n_lines - 1
    longer = duration - aperture_lines(radar, slant_range + half, velocity)
    shorter = aperture_lines(radar, slant_range - half, velocity) - duration
    return max(longer, shorter), columns


def lines_needed(
    radar: Radar, n_focused: int, n_cells: int, slant_range: float, velocity: float
) -> float:
    """Lines that an echo must have so that some of them are focused with the whole aperture."""
    half = max(_focused_cells(radar, n_cells, slant_range, velocity), 0.0) / 2
    far = slant_range + half * radar.range_spacing
    return n_focused + 1 + aperture_lines(radar, far, velocity)


def _focused_cells(radar: Radar, n_cells: int, slant_range: float, velocity: float) -> float:
    edge = np.array(radar.doppler_bandwidth / 2)
    lag = slant_range * (1 - float(migration_factor(edge, velocity, radar.wavelength)))
    return n_cells - radar.n_pulse + 1 - lag / radar.range_spacing


def sigma_of(
    function: Callable[[FloatArray, FloatArray], float],
    r: FloatArray,
    v: FloatArray,
    r_sigma: FloatArray,
    v_sigma: FloatArray,
) -> float:
    """Standard deviation of a function of position and velocity, by differences of one sigma.

    Parameters
    ----------
    function : callable
        ``function(r, v)``.
    r, v, r_sigma, v_sigma : ndarray, shape (3,)
        Position [m], velocity [m/s], and their standard deviations.
    """
    changes = [
        (function(r + dr, v + dv) - function(r - dr, v - dv)) / 2
        for dr, dv in [
            *((row, np.zeros(3)) for row in np.diag(r_sigma)),
            *((np.zeros(3), row) for row in np.diag(v_sigma)),
        ]
    ]
    return hypot(*changes)
