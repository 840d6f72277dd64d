r"""Raw stripmap echo of a scene, from the exact geometry of an orbit.

A scatterer is placed on a grid of the time :math:`t_b` and the slant range :math:`R_b` at which
the beam's center passes it. About that time its range follows the orbit,

.. math::
    R(s) = R_b - \tfrac{\lambda f_c}{2} s + \tfrac{\ddot R}{2} s^2 + \tfrac{R^{(3)}}{6} s^3
        + \tfrac{R^{(4)}}{24} s^4,

with derivatives of the true orbit against the true place. Its spectrum at range frequency
:math:`f_r` and Doppler frequency :math:`f` has, by stationary phase, the phase (in cycles)

.. math::
    -\frac{2 (f_0 + f_r)}{c} R_b + \frac{2 (f_0 + f_r)}{c}\, g(x), \qquad
    x = \frac{c f}{f_0 + f_r}, \qquad
    g(x) = -\bigl(R(S) - R_b\bigr) - \tfrac{x S}{2}, \quad \dot R(S) = -\tfrac{x}{2},

one smooth function :math:`g` of one variable per range and height. Echo is this spectrum times the
chirp's: exact at the middle range, with the migration at other ranges stretched linearly. Terrain
height changes :math:`\ddot R`; two layers, at the lowest and the highest terrain, are mixed in the
proportion of each scatterer's height.

A line is received where it was sent (stop and go). The beam is that of a uniform aperture of length
:math:`L`, two ways, :math:`\operatorname{sinc}^2(L (f - f_c) / 2 \lVert v \rVert)`, cut at the
illuminated band; ambiguities beyond the repetition frequency are left out.

References
----------
.. [1] I. Cumming, F. Wong, "Digital Processing of Synthetic Aperture Radar Data", Artech House,
       2005, ch. 5: the spectrum. We differ: the range history is the orbit's, not a hyperbola.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy import fft

from terrafix.models.core.arrays import ComplexArray, FloatArray
from terrafix.models.core.parallel import batches, over
from terrafix.models.motion.sampled import Arc
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, Radar, chirp_replica, unit_phasor
from terrafix.models.radar.footprint import Footprint, TerrainGrid
from terrafix.models.radar.history import RangeHistories, range_derivatives
from terrafix.models.radar.scene import Scene
from terrafix.models.radar.speckle import (
    ARRAY_SPECKLE,
    Speckle,
    add_noise,
    scattered,
    scattered_columns,
)
from terrafix.models.radar.spectra import ARRAY_ROWS, Rows

_TAPS, _WINDOW = 20, 5.5
"""Of the interpolation of points and its window: it errs by 0.06 % over 0.4 cycles per pixel."""
_COLUMNS = 64
"""Columns whose scatterers are made, and transformed to Doppler, at a time."""
_ALIKE = 0.05
"""Phase that is left out where one layer stands for all heights [rad]."""
_SENT = 8
"""Degree of the polynomial of range frequency that tells the phase of a line of Doppler."""


@dataclass(frozen=True)
class Acquisition:
    """What a radar receives, when and from where.

    Parameters
    ----------
    radar : Radar
    first_time : float
        Time of the first line [s], on the clock of the orbit.
    n_lines, n_cells : int
        Lines, and cells of each.
    near_range : float
        Slant range of the first cell [m].
    centroid : float
        Doppler frequency of the beam's center [Hz].
    antenna_length : float
        Along the track [m].
    illuminated : float
        Doppler bandwidth that is illuminated [Hz], at most the repetition frequency.
    side : {1, -1}
        To the right of the track, or to the left.

    Raises
    ------
    ValueError
        If there is nothing to receive, or more is illuminated than sampled.
    """

    radar: Radar
    first_time: float
    n_lines: int
    n_cells: int
    near_range: float
    centroid: float = 0.0
    antenna_length: float = 8.9
    illuminated: float = 0.0
    side: int = 1

    def __post_init__(self) -> None:
        if self.n_lines < 2 or self.n_cells < self.radar.n_pulse:
            raise ValueError(
                f"an echo of {self.n_lines} lines and {self.n_cells} cells is smaller than two "
                f"lines of one pulse, {self.radar.n_pulse} cells"
            )
        if self.illuminated == 0.0:
            object.__setattr__(
                self, "illuminated", min(self.radar.prf, 1.15 * self.radar.doppler_bandwidth)
            )
        if not 0 < self.illuminated <= self.radar.prf:
            raise ValueError(
                f"an illuminated band of {self.illuminated:.6g} Hz is not within the repetition "
                f"frequency, {self.radar.prf:.6g} Hz"
            )


def simulated_echo(
    scene: Scene,
    arc: Arc,
    acquisition: Acquisition,
    rng: np.random.Generator,
    *,
    snr_db: float = 10.0,
    operations: Rows = ARRAY_ROWS,
    speckle: Speckle = ARRAY_SPECKLE,
) -> ComplexArray:
    """Raw echo of a scene: speckle, bright points, thermal noise.

    Parameters
    ----------
    scene : Scene
    arc : Arc
        True orbit; it must reach an aperture beyond the acquisition at both ends.
    acquisition : Acquisition
    rng : numpy.random.Generator
        Of speckle and noise.
    snr_db : float
        Ratio of the echo of mean clutter to thermal noise [dB].
    operations : Rows
        Who turns and resamples rows; `terrafix.components.sensors.compiled` has quicker ones.
    speckle : Speckle
        Who makes speckle and noise; likewise.

    Returns
    -------
    ndarray of complex64, shape (n_lines, n_cells)
        A scatterer of unit reflection echoes with unit amplitude; mean clutter is one per pixel.
    """
    radar = acquisition.radar
    footprint, grid_lines = illuminated_footprint(arc, acquisition)
    terrain = TerrainGrid(footprint, scene)
    heights = _layer_heights(terrain)
    n_layers = 1 if _alike(footprint, heights, acquisition) else 2
    points = _bright_points(terrain, scene, heights)
    streams = rng.spawn(-(-footprint.n_cells // _COLUMNS))

    def scatterers(columns: slice) -> list[ComplexArray]:
        stream = streams[columns.start // _COLUMNS]
        layers = scattered_columns(terrain, columns, heights, stream, speckle, n_layers)
        points.add([layers[0], layers[-1]], columns)
        return layers

    own = heights if n_layers == 2 else (sum(heights) / 2,)
    echo = _received(scatterers, own, footprint, acquisition, grid_lines, operations)
    aperture = acquisition.illuminated / _doppler_rate(footprint)
    noise = np.sqrt(0.5 * radar.n_pulse * aperture * radar.prf * 10 ** (-snr_db / 10))
    add_noise(echo, float(noise), rng, speckle)
    return echo


def ideal_image(
    scene: Scene,
    terrain: TerrainGrid,
    rng: np.random.Generator,
    *,
    snr_db: float = 10.0,
    speckle: Speckle = ARRAY_SPECKLE,
) -> ComplexArray:
    """Image of a scene as an ideal processor shows it, on the grid of a footprint.

    Not formed from echo: the scatterers themselves, limited to the bands of the radar.

    Parameters
    ----------
    scene : Scene
    terrain : TerrainGrid
        Footprint and the terrain under it.
    rng : numpy.random.Generator
        Of speckle and noise.
    snr_db : float
        Ratio of mean clutter to thermal noise [dB].
    speckle : Speckle
        Who makes speckle and noise; `terrafix.components.sensors.compiled` has a quicker one.

    Returns
    -------
    ndarray of complex64, shape (n_lines, n_cells)
    """
    footprint, radar = terrain.footprint, terrain.footprint.radar
    heights = _layer_heights(terrain)
    (image,) = scattered(terrain, heights, rng, speckle, n_layers=1)
    _bright_points(terrain, scene, heights).add([image, image], slice(0, footprint.n_cells))
    add_noise(image, float(np.sqrt(0.5 * 10 ** (-snr_db / 10))), rng, speckle)
    spectrum = fft.fft2(image, overwrite_x=True, workers=-1)
    f = fft.fftfreq(footprint.n_lines, 1 / radar.prf)
    f += radar.prf * np.rint((footprint.centroid - f) / radar.prf)
    f_r = fft.fftfreq(footprint.n_cells, 1 / radar.sample_rate)
    spectrum[np.abs(f - footprint.centroid) > radar.doppler_bandwidth / 2] = 0
    spectrum[:, np.abs(f_r) > radar.bandwidth / 2] = 0
    out: ComplexArray = fft.ifft2(spectrum, overwrite_x=True, workers=-1)
    return out


def _layer_heights(terrain: TerrainGrid) -> tuple[float, float]:
    return float(terrain.height.min()) - 1.0, float(terrain.height.max()) + 1.0


def _alike(footprint: Footprint, heights: tuple[float, float], acquisition: Acquisition) -> bool:
    """Whether one layer in the middle does for two: phases differ by less than `_ALIKE` from it."""
    low, high = (RangeHistories(footprint, h, acquisition.illuminated) for h in heights)
    x = np.linspace(*low.domain, 17)
    cycles = (high.at(x) - low.at(x)) @ chebyshev.chebvander(np.linspace(-1, 1, 5), 4).T
    wavelength = footprint.radar.wavelength
    return bool(2 * np.pi * 2 / wavelength * np.abs(cycles).max() / 2 < _ALIKE)


def illuminated_footprint(arc: Arc, acquisition: Acquisition) -> tuple[Footprint, int]:
    """All that an acquisition hears of, and the line of that grid which is its first."""
    radar = acquisition.radar
    at = Footprint(
        arc,
        radar,
        acquisition.first_time,
        acquisition.n_lines,
        acquisition.near_range,
        acquisition.n_cells,
        acquisition.centroid,
        side=acquisition.side,
    )
    aperture = acquisition.illuminated / _doppler_rate(at)
    before = int(np.ceil(aperture / 2 * radar.prf)) + 16
    n_lines = int(fft.next_fast_len(acquisition.n_lines + 2 * before))
    # a squinted beam sees a range grow or shrink all the time
    walk = radar.wavelength * abs(acquisition.centroid) / 2 * aperture / 2
    margin = 16 + int(np.ceil(walk / radar.range_spacing))
    shift = acquisition.near_range - (radar.n_pulse + margin) * radar.range_spacing
    n_cells = int(fft.next_fast_len(acquisition.n_cells + radar.n_pulse + 2 * margin))
    first = acquisition.first_time - before / radar.prf
    centroid, side = acquisition.centroid, acquisition.side
    whole = Footprint(arc, radar, first, n_lines, shift, n_cells, centroid, side=side)
    return whole, before


def _doppler_rate(footprint: Footprint) -> float:
    """Doppler rate [Hz/s] in the middle of a footprint, positive."""
    t, R = footprint.middle
    p = footprint.points(np.array(t), np.array(R), np.array(0.0))
    return float(
        2 / footprint.radar.wavelength * range_derivatives(footprint.arc, t, p[None])[0, 1]
    )


def _bright_points(terrain: TerrainGrid, scene: Scene, heights: tuple[float, float]) -> _Points:
    """The scene's bright points, between the pixels."""
    latitude, longitude, amplitude, phase = scene.points(*terrain.cells)
    height = scene.dem.at(latitude, longitude)
    p = terrain.footprint.ground.point(latitude, longitude, height)
    lit = terrain.visible(p)
    reflection = amplitude * np.exp(2j * np.pi * phase)
    return _Points(terrain.footprint, p[lit], height[lit], reflection[lit], heights)


def add_points(
    layers: list[ComplexArray],
    footprint: Footprint,
    p: FloatArray,
    height: FloatArray,
    reflection: ComplexArray,
    heights: tuple[float, float],
) -> None:
    """Add point scatterers to the grids of the two layers, band-limited between the pixels.

    Parameters
    ----------
    layers : list of ndarray, shape (n_lines, n_cells)
        Scatterers at the lower and at the upper height.
    footprint : Footprint
        Of the grids.
    p : ndarray, shape (n, 3)
        Places [m]; those outside the grids are left out.
    height : ndarray, shape (n,)
        Of the places [m].
    reflection : ndarray of complex, shape (n,)
    heights : tuple of float
        Of the layers [m].
    """
    points = _Points(footprint, p, height, reflection, heights)
    points.add(layers, slice(0, footprint.n_cells))


class _Points:
    """Point scatterers on the grid of a footprint, as of `add_points`."""

    def __init__(
        self,
        footprint: Footprint,
        p: FloatArray,
        height: FloatArray,
        reflection: ComplexArray,
        heights: tuple[float, float],
    ) -> None:
        radar, half = footprint.radar, _TAPS // 2
        line, cell = footprint.place(p)
        i, j = np.floor(line).astype(np.intp), np.floor(cell).astype(np.intp)
        inside = (i >= half - 1) & (i < footprint.n_lines - half)
        inside &= (j >= half - 1) & (j < footprint.n_cells - half)
        self.i, self.j, line, cell = i[inside], j[inside], line[inside], cell[inside]
        self.taps = np.arange(1 - half, half + 1)
        distance = footprint.near_range + cell * radar.range_spacing
        # in lines from the point, about the beam's Doppler frequency; in cells, about baseband
        dy, dx = ((a - b)[:, None] + self.taps for a, b in ((self.i, line), (self.j, cell)))
        along = _interpolator(dy) * unit_phasor(footprint.centroid / radar.prf * dy)
        carrier = unit_phasor(-2 * distance / radar.wavelength)
        self.along = (reflection[inside] * carrier)[:, None] * along
        self.across = _interpolator(dx)
        share = (height[inside] - heights[0]) / (heights[1] - heights[0])
        self.shares = 1 - share, share

    def add(self, layers: list[ComplexArray], columns: slice) -> None:
        """Add them to some columns of the grids of the two layers."""
        near = (self.j + self.taps[-1] >= columns.start) & (self.j + self.taps[0] < columns.stop)
        at = self.i[near, None, None] + self.taps[:, None], self.j[near, None, None] + self.taps
        i, j = np.broadcast_arrays(*at)
        own = (j >= columns.start) & (j < columns.stop)
        patch = (self.along[near, :, None] * self.across[near, None, :])[own]
        for layer, share in zip(layers, self.shares, strict=True):
            weight = np.broadcast_to(share[near, None, None], own.shape)[own]
            np.add.at(layer, (i[own], j[own] - columns.start), (weight * patch).astype(layer.dtype))


def _interpolator(x: FloatArray) -> FloatArray:
    window = np.i0(_WINDOW * np.sqrt(np.maximum(0.0, 1 - (2 * x / _TAPS) ** 2)))
    return np.asarray(np.sinc(x) * window / np.i0(_WINDOW))


def received(
    layers: list[ComplexArray],
    heights: tuple[float, float],
    footprint: Footprint,
    acquisition: Acquisition,
    first_line: int,
    operations: Rows = ARRAY_ROWS,
) -> ComplexArray:
    """Echo of scatterers on the grid of a footprint, as an acquisition receives it.

    Parameters
    ----------
    layers : list of ndarray of complex64, shape (n_lines, n_cells)
        Scatterers at the lower and at the upper height, or one layer half way between.
    heights : tuple of float
        Of the layers [m].
    footprint : Footprint
        Their grid.
    acquisition : Acquisition
    first_line : int
        Line of the grid that is the acquisition's first.
    operations : Rows
        Who turns and resamples rows.
    """
    own = heights if len(layers) == 2 else (sum(heights) / 2,)

    def scatterers(columns: slice) -> list[ComplexArray]:
        return [np.ascontiguousarray(layer[:, columns]) for layer in layers]

    return _received(scatterers, own, footprint, acquisition, first_line, operations)


def _received(
    scatterers: Callable[[slice], list[ComplexArray]],
    heights: tuple[float, ...],
    footprint: Footprint,
    acquisition: Acquisition,
    first_line: int,
    operations: Rows,
) -> ComplexArray:
    """Echo of layers at some heights, which are made for a few columns at a time."""
    radar = acquisition.radar
    n_lines, n_cells = footprint.n_lines, footprint.n_cells
    frequency = fft.fftfreq(n_lines, 1 / radar.prf)
    frequency += radar.prf * np.rint((acquisition.centroid - frequency) / radar.prf)
    lit = np.abs(frequency - acquisition.centroid) <= acquisition.illuminated / 2
    histories = [RangeHistories(footprint, h, acquisition.illuminated) for h in heights]
    middle = histories[0]
    speed = float(np.linalg.norm(footprint.arc.velocity(footprint.middle[0])))
    rate = _doppler_rate(footprint)
    steepness, centroid = acquisition.antenna_length / (2 * speed), acquisition.centroid
    weight = lit * np.float32(radar.prf / np.sqrt(rate))
    cells = np.arange(n_cells)
    ranges = np.asarray(footprint.near_range + cells * radar.range_spacing, np.float64)
    by_range = chebyshev.chebvander(_scaled_to(ranges, middle.span), 4).T
    scale = 2 / radar.wavelength
    x = middle.clipped(radar.wavelength * frequency)
    turns = [scale * history.at(x) for history in histories]
    # rows that are not lit stay zero
    total = np.zeros((n_lines, n_cells), np.complex64)

    def compress_inversely(columns: slice) -> None:
        parts = [fft.fft(part, axis=0, overwrite_x=True) for part in scatterers(columns)]
        for rows in batches(n_lines, 256):
            if not lit[rows].any():
                continue
            low, *others = (part[rows] for part in parts)
            for part, turn in zip((low, *others), turns, strict=True):
                operations.turn_by(part, turn[rows] @ by_range[:, columns])
            for other in others:
                low += other
            np.multiply(low, weight[rows, None], out=total[rows, columns])

    over(batches(n_cells, _COLUMNS), compress_inversely)
    pulse = fft.fft(chirp_replica(radar), n_cells).astype(np.complex64) * unit_phasor(-0.125)
    stretch, origin = _migration(radar.wavelength * frequency, middle, ranges)
    by_cell = chebyshev.chebvander(fft.fftfreq(n_cells, 0.5), _SENT).T
    nodes = radar.sample_rate / 2 * chebyshev.chebpts1(_SENT + 1)
    to_coefficients = np.linalg.inv(chebyshev.chebvander(chebyshev.chebpts1(_SENT + 1), _SENT)).T

    f_r = fft.fftfreq(n_cells, 1 / radar.sample_rate)
    # the Doppler rate is in proportion to the frequency
    pulse *= np.sqrt(radar.carrier / (radar.carrier + f_r)).astype(np.float32)
    # and so is the Doppler frequency at which a direction is seen: to second order
    offset = frequency - centroid
    low, own, high = (np.sinc(steepness * (offset + h)) ** 2 for h in (-1.0, 0.0, 1.0))
    curve = [own, (high - low) / 2 * frequency, (high - 2 * own + low) / 2 * frequency**2]
    beam = np.stack(curve, axis=1).astype(np.float32)
    share = np.power.outer(radar.carrier / (radar.carrier + f_r) - 1, np.arange(3)).T
    share = np.ascontiguousarray(share, np.float32)

    def send(spectrum: ComplexArray, rows: slice) -> None:
        f = np.where(lit[rows], frequency[rows], acquisition.centroid)[:, None]
        carrier = radar.carrier + nodes
        cycles = 2 * carrier / SPEED_OF_LIGHT * middle.middle(SPEED_OF_LIGHT * f / carrier)
        cycles -= scale * middle.middle(radar.wavelength * f)
        operations.turn_by(spectrum, cycles @ to_coefficients @ by_cell)
        spectrum *= pulse
        spectrum *= beam[rows] @ share

    def receive(rows: slice) -> None:
        # ranges other than the middle one move by what their migration differs from its
        part = operations.stretched(total[rows], origin, -stretch[rows])
        part = fft.fft(part, axis=1, overwrite_x=True)
        send(part, rows)
        total[rows] = fft.ifft(part, axis=1, overwrite_x=True)

    over([rows for rows in batches(n_lines) if lit[rows].any()], receive)
    total = fft.ifft(total, axis=0, overwrite_x=True, workers=-1)
    shift = round((acquisition.near_range - footprint.near_range) / radar.range_spacing)
    part = total[first_line : first_line + acquisition.n_lines, shift : shift + acquisition.n_cells]
    return np.ascontiguousarray(part)


def _scaled_to(x: FloatArray, span: FloatArray) -> FloatArray:
    return (x - np.mean(span)) / (np.ptp(span) / 2)


def _migration(
    x: FloatArray, history: RangeHistories, ranges: FloatArray
) -> tuple[FloatArray, float]:
    """How much more than the middle range others migrate, in cells per cell; and that cell."""
    x = history.clipped(x)
    ends = [-g(x) + x * g.deriv()(x) for g in (history.g[0], history.g[-1])]
    stretch = (ends[1] - ends[0]) / (history.ranges[-1] - history.ranges[0])
    origin = float((np.mean(history.span) - ranges[0]) / (ranges[1] - ranges[0]))
    return np.asarray(stretch), origin
