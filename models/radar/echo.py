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
from terrafix.models.radar.spectra import ARRAY_ROWS, Rows

_TAPS = 12


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

    Returns
    -------
    ndarray of complex64, shape (n_lines, n_cells)
        A scatterer of unit reflection echoes with unit amplitude; mean clutter is one per pixel.
    """
    radar = acquisition.radar
    footprint, grid_lines = illuminated_footprint(arc, acquisition)
    terrain = TerrainGrid(footprint, scene)
    heights = _layer_heights(terrain)
    layers = [np.zeros((footprint.n_lines, footprint.n_cells), np.complex64) for _ in range(2)]
    _speckle(layers, terrain, heights, rng)
    _bright_points(layers, terrain, scene, heights)
    echo = received(layers, heights, footprint, acquisition, grid_lines, operations)
    aperture = acquisition.illuminated / _doppler_rate(footprint)
    noise = np.sqrt(0.5 * radar.n_pulse * aperture * radar.prf * 10 ** (-snr_db / 10))
    _add_noise(echo, noise, rng)
    return echo


def ideal_image(
    scene: Scene, terrain: TerrainGrid, rng: np.random.Generator, *, snr_db: float = 10.0
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

    Returns
    -------
    ndarray of complex64, shape (n_lines, n_cells)
    """
    footprint, radar = terrain.footprint, terrain.footprint.radar
    heights = _layer_heights(terrain)
    layers = [np.zeros((footprint.n_lines, footprint.n_cells), np.complex64) for _ in range(2)]
    _speckle(layers, terrain, heights, rng)
    _bright_points(layers, terrain, scene, heights)
    image = layers[0]
    image += layers[1]
    _add_noise(image, np.sqrt(0.5 * 10 ** (-snr_db / 10)), rng)
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
    shift = acquisition.near_range - (radar.n_pulse + 16) * radar.range_spacing
    n_cells = int(fft.next_fast_len(acquisition.n_cells + radar.n_pulse + 32))
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


def _complex_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> ComplexArray:
    """Complex noise of variance 2."""
    pairs = rng.standard_normal((*shape[:-1], 2 * shape[-1]), np.float32)
    return pairs.view(np.complex64)


def _add_noise(image: ComplexArray, sigma: float, rng: np.random.Generator) -> None:
    """Add noise of a standard deviation in each of both parts, from a stream for each batch."""
    rows = batches(len(image), 256)

    def add(part: tuple[slice, np.random.Generator]) -> None:
        noise = _complex_noise(part[1], image[part[0]].shape)
        noise *= np.float32(sigma)
        image[part[0]] += noise

    over(zip(rows, rng.spawn(len(rows)), strict=True), add)


def _speckle(
    layers: list[ComplexArray],
    terrain: TerrainGrid,
    heights: tuple[float, float],
    rng: np.random.Generator,
) -> None:
    """Add fully developed speckle: a complex normal scatterer on every pixel."""
    rows = batches(len(layers[0]), 256)

    def add(part: tuple[slice, np.random.Generator]) -> None:
        own, stream = part
        amplitude, share = terrain.pixels(own.start, own.stop)
        amplitude *= np.float32(np.sqrt(0.5))
        share -= np.float32(heights[0])
        share /= np.float32(heights[1] - heights[0])
        scatterers = _complex_noise(stream, amplitude.shape)
        scatterers *= amplitude
        layers[1][own] += share * scatterers
        scatterers -= layers[1][own]
        layers[0][own] += scatterers

    over(zip(rows, rng.spawn(len(rows)), strict=True), add)


def _bright_points(
    layers: list[ComplexArray],
    terrain: TerrainGrid,
    scene: Scene,
    heights: tuple[float, float],
) -> None:
    """Add the scene's bright points between the pixels."""
    latitude, longitude, amplitude, phase = scene.points(*terrain.cells)
    height = scene.dem.at(latitude, longitude)
    add_points(
        layers,
        terrain.footprint,
        terrain.footprint.ground.point(latitude, longitude, height),
        height,
        amplitude * np.exp(2j * np.pi * phase),
        heights,
    )


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
    radar = footprint.radar
    line, cell = footprint.place(p)
    shape = layers[0].shape
    half = _TAPS // 2
    i, j = np.floor(line).astype(np.intp), np.floor(cell).astype(np.intp)
    inside = (i >= half - 1) & (i < shape[0] - half) & (j >= half - 1) & (j < shape[1] - half)
    i, j, line, cell = i[inside], j[inside], line[inside], cell[inside]
    taps = np.arange(1 - half, half + 1)
    distance = footprint.near_range + cell * radar.range_spacing
    # in lines from the point, about the beam's Doppler frequency; in cells, about baseband
    dy, dx = (i - line)[:, None] + taps, (j - cell)[:, None] + taps
    along = _interpolator(dy) * unit_phasor(footprint.centroid / radar.prf * dy)
    carrier = unit_phasor(-2 * distance / radar.wavelength)
    patch = (reflection[inside] * carrier)[:, None, None] * along[:, :, None]
    patch = patch * _interpolator(dx)[:, None, :]
    at = (i[:, None, None] + taps[:, None], j[:, None, None] + taps)
    share = ((height[inside] - heights[0]) / (heights[1] - heights[0]))[:, None, None]
    np.add.at(layers[0], at, ((1 - share) * patch).astype(np.complex64))
    np.add.at(layers[1], at, (share * patch).astype(np.complex64))


def _interpolator(x: FloatArray) -> FloatArray:
    window = np.i0(2.5 * np.sqrt(np.maximum(0.0, 1 - (2 * x / _TAPS) ** 2))) / np.i0(2.5)
    return np.asarray(np.sinc(x) * window)


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
        Scatterers at the lower and at the upper height; overwritten.
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
    radar = acquisition.radar
    n_lines, n_cells = layers[0].shape
    frequency = fft.fftfreq(n_lines, 1 / radar.prf)
    frequency += radar.prf * np.rint((acquisition.centroid - frequency) / radar.prf)
    lit = np.abs(frequency - acquisition.centroid) <= acquisition.illuminated / 2
    histories = [RangeHistories(footprint, h, acquisition.illuminated) for h in heights]
    middle = histories[0]
    # rows that are not lit are zero; the sums of the layers go where the first one was
    spectra = [fft.fft(layer, axis=0, overwrite_x=True, workers=-1) for layer in layers]
    total = spectra[0]
    total[~lit] = 0
    speed = float(np.linalg.norm(footprint.arc.velocity(footprint.middle[0])))
    rate = _doppler_rate(footprint)
    beam = np.sinc(acquisition.antenna_length * (frequency - acquisition.centroid) / (2 * speed))
    weight = beam**2 * radar.prf / np.sqrt(rate)
    cells = np.arange(n_cells)
    ranges = np.asarray(footprint.near_range + cells * radar.range_spacing, np.float64)
    by_range = chebyshev.chebvander(_scaled_to(ranges, middle.span), 4).T
    scale = 2 / radar.wavelength

    def compress_inversely(rows: slice) -> None:
        x = middle.clipped(radar.wavelength * frequency[rows])
        low, high = (spectrum[rows] for spectrum in spectra)
        for part, history in ((low, histories[0]), (high, histories[1])):
            operations.turn_by(part, scale * (history.at(x) @ by_range))
        low += high
        low *= (weight[rows] * lit[rows]).astype(np.float32)[:, None]
        total[rows] = low

    over([rows for rows in batches(n_lines) if lit[rows].any()], compress_inversely)
    spectra.clear()
    _migrate(total, radar.wavelength * frequency, lit, middle, ranges, operations)
    total = fft.fft(total, axis=1, overwrite_x=True, workers=-1)
    pulse = fft.fft(chirp_replica(radar), n_cells).astype(np.complex64) * unit_phasor(-0.125)
    f_r = fft.fftfreq(n_cells, 1 / radar.sample_rate)

    def send(rows: slice) -> None:
        f = np.where(lit[rows], frequency[rows], acquisition.centroid)[:, None]
        own = scale * middle.middle(radar.wavelength * f)
        cycles = 2 * (radar.carrier + f_r) / SPEED_OF_LIGHT
        cycles = cycles * middle.middle(SPEED_OF_LIGHT * f / (radar.carrier + f_r)) - own
        operations.turn_by(total[rows], cycles)
        total[rows] *= pulse

    over([rows for rows in batches(n_lines) if lit[rows].any()], send)
    total = fft.ifft(total, axis=1, overwrite_x=True, workers=-1)
    total = fft.ifft(total, axis=0, overwrite_x=True, workers=-1)
    shift = round((acquisition.near_range - footprint.near_range) / radar.range_spacing)
    part = total[first_line : first_line + acquisition.n_lines, shift : shift + acquisition.n_cells]
    return np.ascontiguousarray(part)


def _scaled_to(x: FloatArray, span: FloatArray) -> FloatArray:
    return (x - np.mean(span)) / (np.ptp(span) / 2)


def _migrate(
    spectrum: ComplexArray,
    x: FloatArray,
    lit: FloatArray,
    history: RangeHistories,
    ranges: FloatArray,
    operations: Rows,
) -> None:
    """Move ranges other than the middle one by what their migration differs from its."""
    x = history.clipped(x)
    ends = [-g(x) + x * g.deriv()(x) for g in (history.g[0], history.g[-1])]
    stretch = (ends[1] - ends[0]) / (history.ranges[-1] - history.ranges[0])
    origin = float((np.mean(history.span) - ranges[0]) / (ranges[1] - ranges[0]))

    def move(rows: slice) -> None:
        spectrum[rows] = operations.stretched(spectrum[rows], origin, -stretch[rows])

    over([rows for rows in batches(len(spectrum), 256) if lit[rows].any()], move)
