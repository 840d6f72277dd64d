r"""Range-Doppler processor: from raw stripmap echo to a focused complex image.

A point at closest range :math:`R_0`, passed at time :math:`\eta_0`, is seen at

.. math:: R(\eta)^2 = R_0^2 + V^2 (\eta - \eta_0)^2,

with :math:`V` the effective velocity (`terrafix.models.sensors.effective_velocity`). In the two
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
Lines of an image are at times of zero Doppler, columns at closest ranges; lines of one that is
deskewed at times at which the beam's center passes.

References
----------
.. [1] I. Cumming, F. Wong, "Digital Processing of Synthetic Aperture Radar Data", Artech House,
       2005, ch. 6, eqs. (5.24)-(5.27), (6.21). We differ: bulk migration and secondary range
       compression take the root itself in place of its expansion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.signal import get_window

from terrafix.models.core.arrays import ComplexArray, FloatArray
from terrafix.models.core.parallel import batches, over
from terrafix.models.radar.chirp import (
    SPEED_OF_LIGHT,
    Radar,
    Window,
    compression_filter,
    padded_length,
)
from terrafix.models.radar.spectra import ARRAY_ROWS, Columns, Rows

_ROWS = 128
"""Of a batch whose range is compressed: few enough to stay in the cache."""
_SAMPLES = 2**14
"""Of a batch at least: what handing it to a thread costs is little of what it takes."""


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
    velocity_slope : float
        How much the effective velocity grows with range [m/s per m].
    operations : Rows
        Who turns rows of the spectrum.
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
    velocity_slope: float = 0.0
    operations: Rows = ARRAY_ROWS

    @property
    def duration(self) -> float:
        """How long lines were received [s]."""
        return (self.n_lines - 1) / self.radar.prf

    def cropped(self) -> RangeDoppler:
        """Only the columns that are wholly received: less to compress."""
        columns = self.columns
        return replace(
            self,
            spectrum=np.ascontiguousarray(self.spectrum[:, columns]),
            slant_range=self.slant_range[columns],
            columns=slice(0, columns.stop - columns.start),
        )


@dataclass(frozen=True)
class Image:
    """A focused complex image.

    Parameters
    ----------
    data : ndarray of complex64, shape (n_lines, n_cells)
        Amplitudes; the phase of a point is that of its closest range.
    t : ndarray, shape (n_lines,)
        Time of each line [s], on the clock of the echo: when what it shows was seen with the
        Doppler frequency `dated`.
    slant_range : ndarray, shape (n_cells,)
        Closest range of each column [m].
    rows, columns : slice
        What is focused from the whole aperture, or where that is shorter than the beam from all
        lines, and from the whole pulse.
    band : tuple of float
        Lowest and highest Doppler frequency compressed [Hz].
    centroid : float
        Absolute Doppler centroid of the echo [Hz].
    velocity : float
        Effective velocity of compression [m/s], in the middle of the valid columns.
    radar : Radar
    velocity_slope : float
        How much it grows with range [m/s per m].
    dated : float
        Doppler frequency of the times of the lines [Hz]; zero if they are those of closest range.
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
    velocity_slope: float = 0.0
    dated: float = 0.0

    @property
    def doppler(self) -> float:
        """Middle of the compressed band [Hz]."""
        return (self.band[0] + self.band[1]) / 2

    def seen_at(
        self, row: ArrayLike, column: ArrayLike, doppler: float
    ) -> tuple[FloatArray, FloatArray]:
        """When [s] and at what slant range [m] a pixel was seen with a Doppler frequency [Hz].

        In the middle of the compressed band this is free of errors of the velocity.

        Parameters
        ----------
        row, column : array_like, shape (...)
            Pixels of `data`, fractional.
        """
        row, column = (np.asarray(a, dtype=np.float64) for a in (row, column))
        spacing = self.slant_range[1] - self.slant_range[0]
        closest = self.slant_range[0] + spacing * column
        t = self.t[0] + row / self.radar.prf + self._lag(closest, doppler)
        return t, closest / self._cosine(doppler)

    def pixel(
        self, t: ArrayLike, slant_range: ArrayLike, doppler: float
    ) -> tuple[FloatArray, FloatArray]:
        """Row and column of `data`, fractional, of what was seen then: inverse of `seen_at`."""
        t, slant_range = (np.asarray(a, dtype=np.float64) for a in (t, slant_range))
        spacing = self.slant_range[1] - self.slant_range[0]
        closest = slant_range * self._cosine(doppler)
        row = (t - self._lag(closest, doppler) - self.t[0]) * self.radar.prf
        return row, (closest - self.slant_range[0]) / spacing

    def _cosine(self, doppler: float) -> float:
        return float(migration_factor(np.array(doppler), self.velocity, self.radar.wavelength))

    def _lag(self, closest: FloatArray, doppler: float) -> FloatArray:
        """Seconds from when lines are dated to another Doppler frequency."""
        seen, dated = _lag(np.array([doppler, self.dated]), self.velocity, self.radar)
        lag = seen - dated
        center = float(self.slant_range[self.columns].mean())
        return np.asarray(lag * _leverage(closest, center, self.velocity, self.velocity_slope))

    @property
    def valid(self) -> ComplexArray:
        """The part that is fully focused, a view."""
        return self.data[self.rows, self.columns]


def range_doppler(
    echo: ComplexArray,
    radar: Radar,
    *,
    near_range: float,
    centroid: float,
    velocity: float,
    first_time: float = 0.0,
    window: Window = "boxcar",
    exposure: float = 1.0,
    n_doppler: int | None = None,
    velocity_slope: float = 0.0,
    compressed: bool = False,
    operations: Rows = ARRAY_ROWS,
) -> RangeDoppler:
    """Compress in range and remove range-cell migration, once for all azimuth compressions.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_lines, n_cells)
        Raw echo at baseband, or echo that is already compressed in range.
    radar : Radar
    near_range : float
        Slant range of the first cell [m]: half its delay times the speed of light.
    centroid : float
        Absolute Doppler centroid [Hz].
    velocity : float
        Effective velocity, as well as it is known [m/s]. An error of 10 m/s costs 0.04 % of a
        peak without squint.
    first_time : float
        Time of the first line [s].
    window : str or tuple
        Weighting of the pulse against range sidelobes.
    exposure : float
        Share of a pulse that must have been received for a column to count as focused, in (0, 1].
    n_doppler : int, optional
        Length of the azimuth transform, at least `n_lines`; the next fast one by default. What is
        partly illuminated wraps around into what is.
    velocity_slope : float
        How much the effective velocity grows with range [m/s per m]; azimuth compression heeds it.
    compressed : bool
        Whether `echo` is compressed in range: its pulse is then one cell long.
    operations : Rows
        Who turns and resamples rows; `terrafix.components.sensors.compiled` has quicker ones.

    Raises
    ------
    ValueError
        If the echo is not a matrix of finite numbers, is shorter than a pulse, or an argument is
        outside its domain.
    """
    n_pulse = 1 if compressed else radar.n_pulse
    n_lines, n_cells = _checked(echo, n_pulse)
    if not 0 < exposure <= 1:
        raise ValueError(f"exposure must be in (0, 1], got {exposure}")
    n_doppler = int(fft.next_fast_len(n_lines)) if n_doppler is None else n_doppler
    if n_doppler < n_lines:
        raise ValueError(f"a transform of {n_doppler} is shorter than an echo of {n_lines} lines")
    n_fft = int(fft.next_fast_len(n_cells)) if compressed else padded_length(radar, n_cells)
    lines = fft.fft(echo.astype(np.complex64, copy=False), n_doppler, axis=0, workers=-1)

    frequency = fft.fftfreq(n_doppler, 1 / radar.prf)
    frequency += radar.prf * np.rint((centroid - frequency) / radar.prf)
    d = migration_factor(frequency, velocity, radar.wavelength)
    d_center = float(migration_factor(np.array(centroid), velocity, radar.wavelength))
    # the scene lies nearer than its echo by the migration at the centroid, in whole cells
    spacing = radar.range_spacing
    n_shift = round(near_range * (1 - d_center) / spacing)
    slant_range = np.asarray(near_range + spacing * (np.arange(n_cells) - n_shift), np.float64)
    reference = near_range * d_center + spacing * (n_cells - n_pulse) / 2
    f_r = fft.fftfreq(n_fft, 1 / radar.sample_rate)
    transverse = (SPEED_OF_LIGHT * frequency / (2 * velocity)) ** 2
    factor = np.ones(n_fft, np.complex64)
    if not compressed:
        factor = compression_filter(radar, n_fft, window)
    along = Columns(
        factor,
        (radar.carrier + f_r) ** 2,
        f_r * (1 + n_shift * spacing / reference),
        2 * reference / SPEED_OF_LIGHT,
    )
    subtracted, stretch = radar.carrier * d, 1 / d - 1
    origin = (reference - slant_range[0]) / spacing

    def straighten(batch: slice) -> None:
        spectrum = fft.fft(lines[batch], n_fft, axis=1)
        operations.straighten(spectrum, along, transverse[batch], subtracted[batch])
        spectrum = fft.ifft(spectrum, axis=1, overwrite_x=True)
        lines[batch] = operations.stretched(spectrum[:, :n_cells], origin, stretch[batch])

    over(batches(n_doppler, _ROWS), straighten)

    in_band = np.abs(frequency - centroid) <= radar.doppler_bandwidth / 2
    first = near_range * d[in_band].max()
    last_whole = n_cells - 1 - exposure * (n_pulse - 1)
    last = (near_range + spacing * last_whole) * d[in_band].min()
    columns = _inside(
        slant_range, first, last, "the scene is too small: no column is seen by a whole pulse"
    )
    return RangeDoppler(
        lines,
        frequency,
        slant_range,
        first_time,
        n_lines,
        centroid,
        velocity,
        columns,
        radar,
        velocity_slope,
        operations,
    )


def azimuth_compressed(
    domain: RangeDoppler,
    velocity: float,
    *,
    window: Window = "boxcar",
    band: tuple[float, float] | None = None,
    deskewed: bool = False,
) -> Image:
    """Compress in azimuth with a given effective velocity.

    Parameters
    ----------
    domain : RangeDoppler
    velocity : float
        Effective velocity [m/s].
    window : str or tuple
        Weighting of the Doppler band against azimuth sidelobes.
    band : tuple of float, optional
        Lowest and highest absolute Doppler frequency to be used [Hz]: a part of it is an azimuth
        look. The whole processed band by default.
    deskewed : bool
        Whether lines are those of one time at which the beam's center passes, and not of one time
        of zero Doppler: what a squinted beam sees together is then together.

    Raises
    ------
    ValueError
        If no line is illuminated over the whole band, nor any for all of the aperture (both are
        equally long), or the band is empty or outside what the repetition frequency samples.
    """
    half = domain.radar.doppler_bandwidth / 2
    whole = (domain.centroid - half, domain.centroid + half)
    own = whole if band is None else band
    return _compressed(domain, velocity, own, band or whole, window, deskewed=deskewed)


def _compressed(
    domain: RangeDoppler,
    velocity: float,
    band: tuple[float, float],
    frame: tuple[float, float],
    window: Window,
    *,
    deskewed: bool = False,
) -> Image:
    """Compress a band on the grid, and with the valid lines, of the band `frame` that holds it."""
    radar, frequency = domain.radar, domain.frequency
    rows = _in_band(domain, band)
    f = frequency[rows]
    slant_range = domain.slant_range * _range_scale(domain, velocity)
    center = float(slant_range[domain.columns].mean())
    middle = float(np.clip(domain.centroid, *frame))
    leverage = _leverage(slant_range, center, velocity, domain.velocity_slope)
    edges = slant_range[domain.columns][[0, -1]]
    lag = float(_lag(np.array(middle), velocity, radar))
    dated, behind = (middle, lag) if deskewed else (0.0, 0.0)
    lags = np.outer(_lag(np.array(frame), velocity, radar) - behind, edges)
    first, last = _focused_times(domain, lags)
    # rows follow the scene: a point stays at its place in the grid whatever the velocity
    shift = center * (behind - lag)
    # in an aperture shorter than the beam much lies before its first line
    before = domain.first_time + shift - first
    shift -= max(0, int(np.ceil(before * radar.prf))) / radar.prf
    d = migration_factor(f, velocity, radar.wavelength)
    weights = get_window(window, len(rows), fftbins=False).astype(np.float32)
    data = np.zeros_like(domain.spectrum)

    steep, constant = (2 / radar.wavelength) * (d - 1) - f * behind, f * shift

    def compress(batch: slice) -> None:
        part = domain.spectrum[rows[batch]]
        domain.operations.turn(part, steep[batch], leverage, constant[batch], weights[batch])
        data[rows[batch]] = part

    over(batches(len(rows), max(32, _SAMPLES // data.shape[1])), compress)
    data = fft.ifft(data, axis=0, overwrite_x=True, workers=-1)
    t = domain.first_time + shift + np.arange(len(frequency)) / radar.prf
    lines = _inside(
        t,
        first,
        last,
        f"the beam sees a point for as long as lines were received, {domain.duration:.3g} s: none "
        "is focused from all of either; receive for longer or shorter, or process another band",
    )
    return Image(
        data,
        t,
        slant_range,
        lines,
        domain.columns,
        (float(band[0]), float(band[1])),
        domain.centroid,
        velocity,
        radar,
        domain.velocity_slope,
        dated,
    )


def _focused_times(domain: RangeDoppler, lags: FloatArray) -> tuple[float, float]:
    """First and last time [s] of lines that are focused from all that can be had of them.

    That is the whole band where lines are received for longer than the beam passes, and all lines
    where the beam sees for longer than they are received (an aperture shorter than the beam).

    Parameters
    ----------
    domain : RangeDoppler
    lags : ndarray, shape (2, n)
        From when lines are dated to the lower and the upper edge of the band, at some ranges [s].
    """
    start = domain.first_time
    stop = start + domain.duration
    early, late = start - lags.min(axis=0), stop - lags.max(axis=0)
    if early.max() < late.min():
        return float(early.max()), float(late.min())
    return float(late.max()), float(early.min())


def _leverage(
    slant_range: FloatArray, center: float, velocity: float, velocity_slope: float
) -> FloatArray:
    r"""Range that a velocity sees as another does the true one: :math:`R\, V_c^2 / V(R)^2` [m].

    Exact for the quadratic phase of azimuth compression; what follows differs by a ten-thousandth
    of itself.
    """
    own = 1 + velocity_slope * (slant_range - center) / velocity
    return np.asarray(slant_range / own**2)


def _in_band(domain: RangeDoppler, band: tuple[float, float]) -> NDArray[np.intp]:
    """Rows of a band, by increasing frequency; ValueError if it is not inside the sampled one."""
    frequency, (low, high) = domain.frequency, band
    rows = np.flatnonzero((frequency >= low) & (frequency < high))
    if not (len(rows) > 1 and low >= frequency.min() - 1e-9 * domain.radar.prf):
        raise ValueError(
            f"the band {low:.6g} to {high:.6g} Hz is not inside the sampled one, "
            f"{frequency.min():.6g} to {frequency.max():.6g} Hz"
        )
    return rows[np.argsort(frequency[rows])]


def _lag(frequency: FloatArray, velocity: float, radar: Radar) -> FloatArray:
    """Seconds from zero Doppler to when a frequency is seen, per meter of closest range."""
    d = migration_factor(frequency, velocity, radar.wavelength)
    return np.asarray(-radar.wavelength * frequency / (2 * velocity**2 * d))


def azimuth_looks(
    domain: RangeDoppler, velocity: float, n_looks: int, *, window: Window = "boxcar"
) -> list[Image]:
    """Images from disjoint parts of the Doppler band, from its lowest: independent speckle.

    All are on the grid of the whole aperture's image, and valid where that is.

    Parameters
    ----------
    domain : RangeDoppler
    velocity : float
        Effective velocity [m/s].
    n_looks : int
        Number of looks.
    window : str or tuple
        Weighting of each look's band.

    Raises
    ------
    ValueError
        If there is no look, or no line is illuminated over the whole band.
    """
    if n_looks < 1:
        raise ValueError(f"{n_looks} looks: there must be one at least")
    half = domain.radar.doppler_bandwidth / 2
    edges = np.linspace(domain.centroid - half, domain.centroid + half, n_looks + 1)
    whole = (float(edges[0]), float(edges[-1]))
    return [
        _compressed(domain, velocity, (float(low), float(high)), whole, window)
        for low, high in pairwise(edges)
    ]


def time_looks(domain: RangeDoppler, velocity: float, n_looks: int) -> list[Image]:
    """Images from disjoint parts of the time of receiving, from its first: independent speckle.

    Where an aperture is shorter than the beam, halves of its *Doppler band* show different places
    for different times, and their shift is not that of map drift. All images are on the grid of
    the whole aperture's, and valid where that is.

    Parameters
    ----------
    domain : RangeDoppler
    velocity : float
        Effective velocity [m/s].
    n_looks : int
        Number of looks, equally long; the lines left over are used by none.

    Raises
    ------
    ValueError
        If there is no look, fewer lines than looks, or nothing is focused.
    """
    length = domain.n_lines // n_looks if n_looks > 0 else 0
    if length < 1:
        raise ValueError(f"{domain.n_lines} lines cannot be shared by {n_looks} looks")
    lines = fft.ifft(domain.spectrum, axis=0, workers=-1)
    half = domain.radar.doppler_bandwidth / 2
    band = (domain.centroid - half, domain.centroid + half)
    images = []
    for k in range(n_looks):
        own = np.zeros_like(lines)
        own[k * length : (k + 1) * length] = lines[k * length : (k + 1) * length]
        spectrum = fft.fft(own, axis=0, overwrite_x=True, workers=-1)
        part = replace(domain, spectrum=spectrum.astype(np.complex64, copy=False))
        images.append(_compressed(part, velocity, band, band, "boxcar"))
    return images


def _checked(echo: ComplexArray, n_pulse: int) -> tuple[int, int]:
    if echo.ndim != 2:
        raise ValueError(f"an echo has the shape (lines, cells), got {echo.shape}")
    n_lines, n_cells = echo.shape
    if n_cells < n_pulse:
        raise ValueError(f"lines of {n_cells} cells are shorter than a pulse of {n_pulse}")
    if not np.isfinite(echo.sum()):
        bad = int(np.argmin(np.isfinite(echo).all(axis=1)))
        raise ValueError(f"line {bad} of the echo is not finite")
    return n_lines, n_cells


def _range_scale(domain: RangeDoppler, velocity: float) -> float:
    """Closest ranges at a velocity, relative to those at the velocity of migration."""
    f = np.array(domain.centroid)
    wavelength = domain.radar.wavelength
    new, old = (migration_factor(f, v, wavelength) for v in (velocity, domain.velocity))
    return float(new / old)


def _inside(axis: FloatArray, first: float, last: float, otherwise: str) -> slice:
    start, stop = np.searchsorted(axis, first), np.searchsorted(axis, last, side="right")
    if stop <= start:
        raise ValueError(otherwise)
    return slice(int(start), int(stop))
