r"""Range-Doppler processor: from raw stripmap echo to a focused complex image.

A point at closest range :math:`R_0`, passed at time :math:`\eta_0`, is seen at

.. math:: R(\eta)^2 = R_0^2 + V^2 (\eta - \eta_0)^2,

with :math:`V` the effective velocity (`terrafix.models.effective_velocity`). In the two
dimensional frequency domain its phase, in cycles, is

.. math::
    -\frac{2 R_0}{c} \sqrt{(f_0 + f_r)^2 - \left(\frac{c f}{2 V}\right)^2}
    = -\frac{2 R_0}{\lambda} D(f) - \frac{2 R_0}{c\,D(f)} f_r - \dots, \qquad
    D(f) = \sqrt{1 - \left(\frac{\lambda f}{2 V}\right)^2}.

The first term is azimuth compression, the second range-cell migration, the rest secondary range
compression. Migration and what follows it are removed at the reference range exactly, by one
multiplication that includes range compression; what migration differs at other ranges by is
interpolated in the range-Doppler domain. Both change little with :math:`V` and are done once,
with the velocity that the navigator believes; azimuth compression is done for any velocity
afterwards.

Frequencies :math:`f` are absolute, about the Doppler centroid, so that squint is no special case.
Lines of an image are at times of zero Doppler, columns at closest ranges.

References
----------
.. [1] I. Cumming, F. Wong, "Digital Processing of Synthetic Aperture Radar Data", Artech House,
       2005, ch. 6, eqs. (5.24)-(5.27), (6.21). We differ: bulk migration and secondary range
       compression take the root itself in place of its expansion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.signal import get_window

from terrafix.models.chirp import (
    SPEED_OF_LIGHT,
    ComplexArray,
    Radar,
    Window,
    compression_filter,
    padded_length,
    unit_phasor,
)
from terrafix.models.model import FloatArray

_TAPS = 8
_BLOCK_SHIFT = 0.01
"""Largest error of position inside a block of interpolation, in cells."""


def migration_factor(frequency: FloatArray, velocity: float, wavelength: float) -> FloatArray:
    """Cosine D of the angle off broadside at a Doppler frequency [Hz].

    Raises
    ------
    ValueError
        If a frequency cannot occur at this velocity.
    """
    sine = wavelength * np.asarray(frequency, dtype=np.float64) / (2 * velocity)
    if not np.all(np.abs(sine) < 1):
        raise ValueError(
            f"no target has a Doppler frequency of {np.abs(frequency).max():.6g} Hz at "
            f"{velocity:.6g} m/s"
        )
    return np.asarray(np.sqrt(1 - sine * sine))


@dataclass(frozen=True)
class RangeDoppler:
    """Echo in the range-Doppler domain, compressed in range and with its migration removed.

    Parameters
    ----------
    spectrum : ndarray of complex64, shape (n_doppler, n_cells)
        Rows in the order of `frequency`, which is that of an FFT.
    frequency : ndarray, shape (n_doppler,)
        Absolute Doppler frequency [Hz].
    slant_range : ndarray, shape (n_cells,)
        Closest range, were `velocity` right [m].
    first_time : float
        Time of the first line of the echo [s].
    n_lines : int
        Lines of the echo; `n_doppler` may be more.
    centroid : float
        Absolute Doppler centroid [Hz].
    velocity : float
        Effective velocity with which migration was removed [m/s].
    columns : slice
        Cells whose whole pulse was received over the whole band.
    radar : Radar
    """

    spectrum: ComplexArray
    frequency: FloatArray
    slant_range: FloatArray
    first_time: float
    n_lines: int
    centroid: float
    velocity: float
    columns: slice
    radar: Radar


@dataclass(frozen=True)
class Image:
    """A focused complex image.

    Parameters
    ----------
    data : ndarray of complex64, shape (n_lines, n_cells)
        Amplitudes; the phase of a point is that of its closest range.
    t : ndarray, shape (n_lines,)
        Time of zero Doppler of each line [s], on the clock of the echo.
    slant_range : ndarray, shape (n_cells,)
        Closest range of each column [m].
    rows, columns : slice
        What is focused from the whole aperture and the whole pulse.
    band : tuple of float
        Lowest and highest Doppler frequency compressed [Hz].
    centroid : float
        Absolute Doppler centroid of the echo [Hz].
    velocity : float
        Effective velocity of compression [m/s].
    radar : Radar
    """

    data: ComplexArray
    t: FloatArray
    slant_range: FloatArray
    rows: slice
    columns: slice
    band: tuple[float, float]
    centroid: float
    velocity: float
    radar: Radar

    @property
    def valid(self) -> ComplexArray:
        """The part that is fully focused, a view."""
        return self.data[self.rows, self.columns]
