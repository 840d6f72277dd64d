r"""The linear chirp that an imaging radar sends, and its compression.

A pulse of length :math:`T` sweeps the band :math:`|K| T` about the carrier :math:`f_0`,

.. math::
    s(t) = e^{j \pi K (t - T/2)^2}, \qquad 0 \le t < T,

and an echo is compressed by correlation with it: a scatterer whose echo *begins* at delay
:math:`\tau` peaks at :math:`\tau`, so that a cell's range is half the delay of its first sample
times the speed of light.

Arrays of echo are complex64 with lines (azimuth) first. Phases are formed in double precision,
in cycles, wrapped, and only then rounded: a slant range is tens of millions of cycles long.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft
from scipy.signal import get_window

from terrafix.models.core.arrays import ComplexArray, Single

SPEED_OF_LIGHT = 299792458.0
_MOST_ATTENUATION = 100.0
"""By which lines of one echo may differ [dB]."""
"""Speed of light in vacuum [m/s]."""

Window = str | tuple[Any, ...]
"""A window as `scipy.signal.get_window` names it: ``"boxcar"``, ``("kaiser", 2.5)``."""


@dataclass(frozen=True)
class Radar:
    """A pulsed radar that looks to the side: what it sends, and how its echo is sampled.

    Parameters
    ----------
    carrier : float
        Carrier frequency [Hz].
    prf : float
        Pulse repetition frequency: lines per second [Hz].
    sample_rate : float
        Complex samples per second along a line [Hz].
    chirp_rate : float
        Sweep of the pulse, negative downward [Hz/s].
    pulse_length : float
        Length of the pulse [s].
    doppler_bandwidth : float
        Doppler bandwidth that is processed, at most `prf` [Hz].

    Raises
    ------
    ValueError
        If a number is not finite or not positive, the chirp rate is zero, the sweep exceeds the
        sample rate, the Doppler bandwidth exceeds the repetition frequency, or a pulse is shorter
        than two samples.
    """

    carrier: float
    prf: float
    sample_rate: float
    chirp_rate: float
    pulse_length: float
    doppler_bandwidth: float

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not np.isfinite(value) or value == 0 or (value < 0 and f.name != "chirp_rate"):
                raise ValueError(f"{f.name} of a radar cannot be {value}")
        if self.bandwidth > self.sample_rate:
            raise ValueError(
                f"a chirp of {self.bandwidth:.6g} Hz cannot be sampled at {self.sample_rate:.6g} Hz"
            )
        if self.doppler_bandwidth > self.prf:
            raise ValueError(
                f"a Doppler bandwidth of {self.doppler_bandwidth:.6g} Hz exceeds the pulse "
                f"repetition frequency, {self.prf:.6g} Hz"
            )
        if self.n_pulse < 2:
            raise ValueError(
                f"a pulse of {self.pulse_length} s is shorter than two samples at "
                f"{self.sample_rate:.6g} Hz"
            )

    @property
    def wavelength(self) -> float:
        """Wavelength of the carrier [m]."""
        return SPEED_OF_LIGHT / self.carrier

    @property
    def bandwidth(self) -> float:
        """Frequencies swept by a pulse [Hz]."""
        return abs(self.chirp_rate) * self.pulse_length

    @property
    def range_spacing(self) -> float:
        """Slant range between cells [m], eq. (2) of the spacecraft paper."""
        return SPEED_OF_LIGHT / (2 * self.sample_rate)

    @property
    def n_pulse(self) -> int:
        """Samples of a pulse."""
        return round(self.pulse_length * self.sample_rate)


def unit_phasor(cycles: ArrayLike) -> ComplexArray:
    r"""Return :math:`e^{j 2 \pi c}` in single precision, of phases in cycles in double precision.

    Wrapping before rounding keeps the error of the phase at 2e-7 rad however many cycles it
    counts; cosine and sine in single precision take a tenth of the time of a complex exponential.
    """
    wrapped = np.array(cycles, dtype=np.float64)
    wrapped -= np.rint(wrapped)
    angle = np.multiply(wrapped, 2 * np.pi, dtype=np.float32, casting="same_kind")
    out = np.empty(angle.shape, np.complex64)
    np.cos(angle, out=out.real)
    np.sin(angle, out=out.imag)
    return out


def chirp_replica(radar: Radar) -> ComplexArray:
    """Samples of the pulse sent, shape (n_pulse,), of unit amplitude."""
    t = np.arange(radar.n_pulse) / radar.sample_rate - radar.pulse_length / 2
    return unit_phasor(0.5 * radar.chirp_rate * t * t)


def compression_filter(radar: Radar, n_fft: int, window: Window = "boxcar") -> ComplexArray:
    """Spectrum of the filter that compresses a pulse, shape (n_fft,), in the order of an FFT.

    Weights in time are weights in frequency for a chirp of large time-bandwidth product.

    Parameters
    ----------
    radar : Radar
    n_fft : int
        Length of the transform, at least that of the pulse.
    window : str or tuple
        Weighting against sidelobes.

    Raises
    ------
    ValueError
        If the transform is shorter than the pulse.
    """
    if n_fft < radar.n_pulse:
        raise ValueError(f"a transform of {n_fft} is shorter than a pulse of {radar.n_pulse}")
    weights = get_window(window, radar.n_pulse, fftbins=False)
    replica = chirp_replica(radar) * (weights / weights.sum())
    spectrum: ComplexArray = np.conj(fft.fft(replica, n_fft)).astype(np.complex64)
    return spectrum


def padded_length(radar: Radar, n_cells: int) -> int:
    """Length of a range transform in which echo does not wrap around."""
    return int(fft.next_fast_len(n_cells + radar.n_pulse - 1))


def range_compressed(echo: ComplexArray, radar: Radar, window: Window = "boxcar") -> ComplexArray:
    """Compress every line of an echo in range.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_lines, n_cells)
        Raw echo at baseband.
    radar : Radar
    window : str or tuple
        Weighting against sidelobes.

    Returns
    -------
    ndarray of complex64, shape (n_lines, n_cells)
        A scatterer of unit amplitude peaks at 1, in the cell where its echo begins. Cells whose
        pulse ends beyond the last one are compressed from what was received of it.
    """
    n_fft = padded_length(radar, echo.shape[1])
    spectrum = fft.fft(echo, n_fft, axis=1, workers=-1)
    spectrum *= compression_filter(radar, n_fft, window)
    compressed: ComplexArray = fft.ifft(spectrum, axis=1, overwrite_x=True, workers=-1)
    return np.ascontiguousarray(compressed[:, : echo.shape[1]])


def gain_of(attenuation_db: ArrayLike, n_lines: int) -> Single:
    """Factors (n_lines,) that undo the automatic gain control of a receiver.

    Parameters
    ----------
    attenuation_db : array_like, shape (n_lines,)
        Attenuation set for each line [dB]; the echo of the least attenuated line stays.
    n_lines : int

    Raises
    ------
    ValueError
        If there is not one finite attenuation per line, or they differ by more than 100 dB.
    """
    db = np.asarray(attenuation_db, dtype=np.float64)
    if db.shape != (n_lines,) or not np.isfinite(db).all():
        raise ValueError(
            f"an echo of {n_lines} lines wants as many finite attenuations, got {db.shape}"
        )
    if np.ptp(db) > _MOST_ATTENUATION:
        raise ValueError(f"its attenuation varies by {np.ptp(db):.6g} dB, which none does")
    return np.asarray(10 ** ((db - db.min()) / 20), np.float32)
