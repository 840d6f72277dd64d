r"""Motion compensation: echo of a track that turns and shakes, as if it had been straight.

The line is the straight one through the navigator's own track, flown at constant speed. A pulse
was sent from :math:`r(t) = r_c + l\,x(t) + d(t)`, with :math:`d` across the line. Echo of range
:math:`R` is moved and turned by what it is farther than from the line,

.. math:: \Delta R(t, R) = \lVert p(R) - r(t) \rVert - \lVert p(R) - r_c - l\,x(t) \rVert,

with :math:`p(R)` at the beam's center: moved as at the middle of the swath, turned cell by cell.
Then lines are interpolated to equal steps of :math:`x`.

What is seen off the beam's center is compensated as its center is: for 0.5 m across and 3.5 deg off
that leaves 0.4 rad. Errors of the navigator's *acceleration* stay in the echo, and map drift finds
them (`terrafix.models.radar.map_drift`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from terrafix.models.core.arrays import ComplexArray, FloatArray
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, Radar, unit_phasor

_TAPS = 12
_STILL = 1e-3
"""Lines by which the track may be off the line's steps without being interpolated."""


@dataclass(frozen=True)
class StraightLine:
    """A straight line, flown at constant speed.

    Parameters
    ----------
    t : float
        Time in the middle [s].
    r : ndarray, shape (3,)
        Place then [m].
    v : ndarray, shape (3,)
        Velocity [m/s].
    """

    t: float
    r: FloatArray
    v: FloatArray

    @property
    def speed(self) -> float:
        """Of the line [m/s]."""
        return float(np.linalg.norm(self.v))

    @property
    def along(self) -> FloatArray:
        """Unit vector along the line."""
        return np.asarray(self.v / self.speed)


def straight_line(t: FloatArray, r: FloatArray) -> StraightLine:
    """Straight line through places (n, 3) [m] of times (n,) [s], by least squares."""
    middle = float(t.mean())
    s = t - middle
    return StraightLine(middle, r.mean(axis=0), (s @ r) / (s @ s))


def compensated(
    echo: ComplexArray,
    radar: Radar,
    t: FloatArray,
    r: FloatArray,
    line: StraightLine,
    beam: FloatArray,
    centroid: float,
) -> ComplexArray:
    """Echo as if it had been received from a straight line, at its equal steps.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_pulses, n_cells)
        Compressed in range.
    radar : Radar
    t : ndarray, shape (n_pulses,)
        Times [s].
    r : ndarray, shape (n_pulses, 3)
        Places of the antenna, as the navigator knows them [m].
    line : StraightLine
    beam : ndarray, shape (n_cells, 3)
        Places at the beam's center, at the range of every cell [m], seen from the middle.
    centroid : float
        Absolute Doppler centroid [Hz].

    Raises
    ------
    ValueError
        If shapes do not fit, or the track stands still or turns back.
    """
    n_pulses, n_cells = echo.shape
    if r.shape != (n_pulses, 3) or t.shape != (n_pulses,) or beam.shape != (n_cells, 3):
        raise ValueError(
            f"an echo of {n_pulses} pulses of {n_cells} cells was received at times {t.shape}, "
            f"from places {r.shape}, of places {beam.shape}"
        )
    x = (r - line.r) @ line.along
    foot = line.r + x[:, None] * line.along
    # the beam's center goes along
    reach = beam - line.r
    away = r - foot
    farther = np.linalg.norm(reach[None] - away[:, None], axis=-1) - np.linalg.norm(reach, axis=-1)
    middle = farther[:, n_cells // 2]
    f_r = fft.fftfreq(n_cells, 1 / radar.sample_rate)
    spectrum = fft.fft(echo, axis=1, workers=-1)
    spectrum *= unit_phasor(np.outer(middle, 2 * (radar.carrier + f_r) / SPEED_OF_LIGHT))
    moved = fft.ifft(spectrum, axis=1, overwrite_x=True, workers=-1)
    moved *= unit_phasor(2 / radar.wavelength * (farther - middle[:, None]))
    return _at_equal_steps(moved, x, line.speed * (t - line.t), centroid / line.speed)


def _at_equal_steps(
    echo: ComplexArray, x: FloatArray, wanted: FloatArray, cycles_per_meter: float
) -> ComplexArray:
    """Lines at wanted places from lines at others, about a spatial frequency."""
    step = wanted[1] - wanted[0]
    if np.abs(x - wanted).max() < _STILL * step:
        return echo
    if not (np.diff(x) > 0).all():
        raise ValueError("the track stands still or turns back within an aperture")
    place = np.interp(wanted, x, np.arange(len(x), dtype=np.float64))
    nearest = np.floor(place).astype(np.intp)
    echo = echo * unit_phasor(-cycles_per_meter * x)[:, None]
    padded = np.pad(echo, ((_TAPS, _TAPS), (0, 0)))
    out = np.zeros_like(echo)
    for tap in range(1 - _TAPS // 2, _TAPS // 2 + 1):
        away = nearest + tap - place
        window = np.i0(2.5 * np.sqrt(np.maximum(0, 1 - (2 * away / _TAPS) ** 2))) / np.i0(2.5)
        weight = (np.sinc(away) * window).astype(np.float32)
        out += weight[:, None] * padded[nearest + tap + _TAPS]
    out *= unit_phasor(cycles_per_meter * wanted)[:, None]
    return np.asarray(out)
