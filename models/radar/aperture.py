r"""Echo of a short aperture, pulse by pulse from the true track, compressed in range.

A radar on an aircraft turns and shakes: its echo has no closed spectrum, and is summed over
scatterers for every pulse (`terrafix.models.radar.pulses`). The scatterers are bright points and
clutter, strewn at random over the terrain, several to a resolution cell: with two the echo has a
texture of its own, which looks of it share, and map drift then "works" on a featureless field; with
eight it does not. Clutter is a new draw for each aperture, so that the echo of another
pass, and of the next second, has speckle of its own.

A scatterer of unit reflection peaks at 1 in the compressed echo, and at the number of pulses in a
focused image. Mean clutter has unit power in a resolution cell of

.. math:: \delta_r = \frac{c}{2 B}, \qquad \delta_a = \frac{\lambda R}{2 V T},

at the beam's center, so white noise of variance :math:`n / \mathrm{SNR}` in the compressed echo of
:math:`n` pulses gives an image of that ratio.

Left out: motion during a pulse, echo from beyond the swath (and with it range ambiguities), the
elevation pattern, the pattern's sidelobes, layover's shadow. Ambiguities in azimuth are there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.core.parallel import batches, over
from terrafix.models.geometry.ground import Ground
from terrafix.models.motion.sampled import SampledArc
from terrafix.models.radar.chirp import (
    SPEED_OF_LIGHT,
    Radar,
    chirp_replica,
    compression_filter,
    padded_length,
    unit_phasor,
)
from terrafix.models.radar.pulses import Impulses, Pulses, PulseSums
from terrafix.models.radar.scene import Scene, brightness

_FINER = 4
"""Cells of the impulses in one of the echo: sharing between two then errs by 1 % at the edge of the
band, after the shares' own response is divided out."""
_MARGIN = 12
"""Cells beyond both ends of the swath that are summed, whose sidelobes reach into it."""
_SURFACE = 1.0
"""Spacing of the grid on which the terrain under an aperture is looked up [m]."""
_HALF_POWER = 0.886
"""Width of a uniform aperture's pattern at half power, one way, relative to its first null."""
_CUT = 0.66
"""Part of the first null up to which scatterers are summed: the pattern has fallen by 15 dB."""
_UNIT = 1e-6
"""How far from one the length of a quaternion may be."""
FEWEST = 5.0
"""Scatterers in a resolution cell below which clutter is refused."""


@dataclass(frozen=True)
class Aperture:
    """Where a radar was while it received, and what it received of.

    Parameters
    ----------
    radar : Radar
    t : ndarray, shape (n_pulses,)
        Times of the pulses [s].
    r : ndarray, shape (n_pulses, 3)
        Places of the antenna [m], in the frame of a `Ground`.
    axis : ndarray, shape (n_pulses, 3)
        Unit vector along the antenna's long side: the beam is centered across it.
    beamwidth : float
        At half power, one way, along the track [rad].
    near_range : float
        Slant range of the first cell [m].
    n_cells : int
        Cells of a line.
    side : {1, -1}
        To the right of the track, or to the left.

    Raises
    ------
    ValueError
        If shapes do not fit, times are not those of the repetition frequency, or the beam holds
        Doppler frequencies that it does not sample.
    """

    radar: Radar
    t: FloatArray
    r: FloatArray
    axis: FloatArray
    beamwidth: float
    near_range: float
    n_cells: int
    side: int = 1

    def __post_init__(self) -> None:
        n = len(self.t)
        if n < 2 or self.r.shape != (n, 3) or self.axis.shape != (n, 3):
            raise ValueError(
                f"an aperture is places and axes of {n} pulses, two at least, got shapes "
                f"{self.r.shape} and {self.axis.shape}"
            )
        if self.side not in (1, -1):
            raise ValueError(f"a radar looks to side 1 (right) or -1 (left), not {self.side}")
        if not (self.near_range > 0 and self.n_cells >= 2):
            raise ValueError(
                f"a swath of {self.n_cells} cells from {self.near_range} m holds nothing"
            )
        if np.abs(np.diff(self.t) * self.radar.prf - 1).max() > 1e-6:
            raise ValueError(
                f"pulses of an aperture are 1/{self.radar.prf:g} s apart: its times are not"
            )
        lit = 2 * self.speed * self.beamwidth / self.radar.wavelength
        if lit > self.radar.prf:
            raise ValueError(
                f"a beam of {np.degrees(self.beamwidth):.1f} deg holds {lit:.0f} Hz of Doppler at "
                f"{self.speed:.1f} m/s, and {self.radar.prf:.0f} pulses a second sample less\n"
                "  raise the repetition frequency, or narrow the beam"
            )

    @property
    def middle(self) -> int:
        """Pulse in the middle."""
        return len(self.t) // 2

    @property
    def velocity(self) -> FloatArray:
        """Mean velocity (3,) [m/s]."""
        return np.asarray((self.r[-1] - self.r[0]) / (self.t[-1] - self.t[0]))

    @property
    def speed(self) -> float:
        """Of the mean velocity [m/s]."""
        return float(np.linalg.norm(self.velocity))

    @property
    def null(self) -> float:
        """Sine at which the pattern first vanishes."""
        return self.beamwidth / _HALF_POWER

    @property
    def slant_range(self) -> FloatArray:
        """Of the cells (n_cells,) [m]."""
        return np.asarray(self.near_range + self.radar.range_spacing * np.arange(self.n_cells))

    @property
    def cell_area(self) -> float:
        """Of a resolution cell in the slant plane, in the middle of the swath [m^2]."""
        duration = len(self.t) / self.radar.prf
        distance = float(self.slant_range.mean())
        along = self.radar.wavelength * distance / (2 * self.speed * duration)
        return along * SPEED_OF_LIGHT / (2 * self.radar.bandwidth)


@dataclass(frozen=True)
class Antenna:
    """How an antenna sits on an aircraft, and what it lights.

    Parameters
    ----------
    beamwidth : float
        At half power, one way, along the track [rad].
    side : {1, -1}
        To the right, or to the left.
    squint : float
        Of the beam, forward of the wing [rad].
    depression : float
        Of the beam's center below the wings [rad].
    elevation_beamwidth : float
        From the near to the far edge of what is lit [rad].
    """

    beamwidth: float
    side: int = 1
    squint: float = 0.0
    depression: float = float(np.radians(40.0))
    elevation_beamwidth: float = float(np.radians(30.0))

    @property
    def axis(self) -> FloatArray:
        """Unit vector along its long side, in body axes forward, right, down."""
        return np.array([np.cos(self.squint), -self.side * np.sin(self.squint), 0.0])


def flown_aperture(
    radar: Radar,
    antenna: Antenna,
    t: FloatArray,
    r: FloatArray,
    q: FloatArray,
    *,
    near_range: float,
    n_cells: int,
) -> Aperture:
    """Aperture of all pulses that are sent between the first and the last sample of a motion.

    Parameters
    ----------
    radar : Radar
    antenna : Antenna
    t : ndarray, shape (n,)
        Times of the samples [s].
    r : ndarray, shape (n, 3)
        Places of the antenna [m], in the frame of a `Ground`.
    q : ndarray, shape (n, 4)
        Attitude, that frame to body, scalar last.
    near_range : float
        Slant range of the first cell [m].
    n_cells : int
        Cells of a line.

    Raises
    ------
    ValueError
        If times run backward, an attitude is no rotation, or less than two pulses are sent.
    """
    from scipy.spatial.transform import Rotation, RotationSpline

    arc = SampledArc(t, r)
    length = np.linalg.norm(q, axis=1)
    if not np.all(np.abs(length - 1) < _UNIT):
        k = int(np.argmax(~(np.abs(length - 1) < _UNIT)))
        raise ValueError(f"the attitude at {t[k]:.3f} s is no rotation: its length is {length[k]}")
    n = int(np.floor((t[-1] - t[0]) * radar.prf + _UNIT))
    if n < 2:
        raise ValueError(f"{n} pulses are sent between {t[0]:.3f} and {t[-1]:.3f} s: two at least")
    pulses: FloatArray = (t[0] + t[-1]) / 2 + (np.arange(n) - (n - 1) / 2) / radar.prf
    # a passive rotation to body is an active one from body
    axis = RotationSpline(t, Rotation.from_quat(q))(pulses).apply(antenna.axis)
    return Aperture(
        radar,
        pulses,
        arc.position(pulses),
        axis,
        antenna.beamwidth,
        near_range,
        n_cells,
        antenna.side,
    )


def require_lit(
    antenna: Antenna, aperture: Aperture, ground: Ground, height: float, q: FloatArray
) -> None:
    """Raise ValueError if a bank has lifted the beam off the swath, or dropped it short.

    Parameters
    ----------
    antenna : Antenna
    aperture : Aperture
    ground : Ground
        Frame of the aperture.
    height : float
        Of the terrain in the swath [m].
    q : ndarray, shape (4,)
        Attitude in the middle of the aperture, the ground's frame to body, scalar last.
    """
    from scipy.spatial.transform import Rotation

    r, v = aperture.r[aperture.middle], aperture.velocity
    p = ground.seen(r, v, aperture.slant_range[[0, -1]], 0.0, height, aperture.side)
    sight = (p - r) / np.linalg.norm(p - r, axis=1, keepdims=True)
    below = np.arcsin(Rotation.from_quat(q).inv().apply(sight)[:, 2])
    half = antenna.elevation_beamwidth / 2
    edges = antenna.depression - half, antenna.depression + half
    if below.min() < edges[0] or below.max() > edges[1]:
        near, far = np.degrees(below)
        raise ValueError(
            f"the swath lies {far:.0f} to {near:.0f} deg below the wings, and the beam lights "
            f"{np.degrees(edges[0]):.0f} to {np.degrees(edges[1]):.0f} deg\n"
            "  fly with less bank, or choose another swath or another depression of the antenna"
        )


@dataclass(frozen=True)
class Scatterers:
    """Points that reflect.

    Parameters
    ----------
    origin : ndarray, shape (3,)
        A place among them [m], in the frame of the aperture.
    offset : ndarray of float32, shape (3, n)
        Places relative to it [m]; quickest if they go along the track.
    reflection : ndarray of complex64, shape (n,)
        As seen from the middle of the aperture: with the phase of that range.
    """

    origin: FloatArray
    offset: Single
    reflection: ComplexArray


def scatterers_at(p: ArrayLike, reflection: ArrayLike) -> Scatterers:
    """Scatterers at places (n, 3) [m] with reflections (n,)."""
    p = np.asarray(p, np.float64)
    origin = p[0] if len(p) else np.zeros(3)
    return Scatterers(
        origin,
        np.ascontiguousarray((p - origin).T, np.float32),
        np.asarray(reflection, np.complex64),
    )


def pulse_echo(
    scatterers: Sequence[Scatterers],
    aperture: Aperture,
    sums: PulseSums,
    rng: np.random.Generator,
    *,
    snr_db: float | None = 10.0,
) -> ComplexArray:
    """Echo of scatterers, compressed in range.

    Parameters
    ----------
    scatterers : sequence of Scatterers
        Their echoes add.
    aperture : Aperture
        True places of the antenna.
    sums : PulseSums
        `terrafix.components.sensors.pulses.pulse_sums` gives the compiled ones.
    rng : numpy.random.Generator
        Of noise.
    snr_db : float, optional
        Ratio of mean clutter to thermal noise in a focused image [dB]; no noise without.

    Returns
    -------
    ndarray of complex64, shape (n_pulses, n_cells)
    """
    radar, n_pulses = aperture.radar, len(aperture.t)
    n_fft = padded_length(radar, aperture.n_cells + 2 * _MARGIN)
    fine = np.zeros((n_pulses, _FINER * n_fft), np.complex64)
    for some in scatterers:
        if len(some.reflection):
            sums.add_impulses(fine, *_about_the_middle(some, aperture, fine.shape[1]))
    cycles = fft.fftfreq(n_fft) / _FINER
    shares = np.sinc(cycles) ** 2
    compression = compression_filter(radar, n_fft)
    pulse = fft.fft(chirp_replica(radar), n_fft) * compression
    gain = (pulse / shares).astype(np.complex64)
    low, high = -(-n_fft // 2), n_fft // 2
    sigma = 0.0 if snr_db is None else np.sqrt(n_pulses * 10 ** (-snr_db / 10) / 2)
    noise_gain = np.sqrt(radar.n_pulse) * compression
    out = np.empty((n_pulses, aperture.n_cells), np.complex64)
    rows = batches(n_pulses, 64)

    def compress(part: tuple[slice, np.random.Generator]) -> None:
        own, stream = part
        spectrum = fft.fft(fine[own], axis=1)
        spectrum = np.concatenate([spectrum[:, :low], spectrum[:, -high:]], axis=1) * gain
        if sigma:
            shape = (len(spectrum), 2 * n_fft)
            noise = stream.standard_normal(shape, np.float32).view(np.complex64)
            spectrum += noise * (np.float32(sigma * np.sqrt(n_fft)) * noise_gain)
        line = fft.ifft(spectrum, axis=1, overwrite_x=True)
        out[own] = line[:, _MARGIN : _MARGIN + aperture.n_cells]

    over(zip(rows, rng.spawn(len(rows)), strict=True), compress)
    return out


def _about_the_middle(
    scatterers: Scatterers, aperture: Aperture, n_cells: int
) -> tuple[Impulses, Pulses]:
    radar, center = aperture.radar, aperture.r[aperture.middle]
    mean_axis = aperture.axis.mean(axis=0)
    line = scatterers.offset + (scatterers.origin - center).astype(np.float32)[:, None]
    R = np.sqrt(np.einsum("in,in->n", line, line))
    along = mean_axis.astype(np.float32) @ line
    spacing = radar.range_spacing / _FINER
    first_range = aperture.near_range - _MARGIN * radar.range_spacing
    way = aperture.r - center
    farthest = float(R.max()) + float(np.linalg.norm(way, axis=1).max())
    # a pulse lights what is near the plane across its own axis, and that differs from the mean's
    reach = _CUT * aperture.null + np.linalg.norm(aperture.axis - mean_axis, axis=1)
    own = np.einsum("ij,ij->i", aperture.axis, way)
    before = np.maximum.accumulate(along)
    after = np.minimum.accumulate(along[::-1])[::-1]
    impulses = Impulses(
        line,
        R,
        (R - np.float32(first_range)) / np.float32(spacing),
        scatterers.reflection,
    )
    pulses = Pulses(
        way,
        aperture.axis,
        np.searchsorted(before, own - reach * farthest).astype(np.int64),
        np.searchsorted(after, own + reach * farthest, side="right").astype(np.int64),
        radar.wavelength,
        spacing,
        aperture.null,
        _CUT,
        n_cells,
    )
    return impulses, pulses


class LitGround:
    """The terrain that an aperture lights, and what is strewn on it.

    Parameters
    ----------
    scene : Scene
    ground : Ground
        Frame of the aperture.
    aperture : Aperture

    Raises
    ------
    ValueError
        If the swath does not reach the ground, or the antenna is not above it.
    """

    def __init__(self, scene: Scene, ground: Ground, aperture: Aperture) -> None:
        self.scene, self.ground, self.aperture = scene, ground, aperture
        self.center = aperture.r[aperture.middle]
        latitude, longitude, height = ground.geodetic(self.center)
        below = float(scene.dem.at(latitude, longitude))
        if not height > below:
            raise ValueError(
                f"an antenna {float(height):.0f} m high is not above the ground, {below:.0f} m"
            )
        self.base = ground.point(latitude, longitude, below)
        self.up = -ground.axes(self.center)[2]
        axis = aperture.axis.mean(axis=0)
        level = axis - self.up * (self.up @ axis)
        self.ahead = level / np.linalg.norm(level)
        self.out = aperture.side * np.cross(self.ahead, self.up)
        self._tilt = float(self.up @ axis) / float(np.linalg.norm(level))
        self._extent(float(height) - below)
        self._look_up()

    def _extent(self, above: float) -> None:
        """Rectangle on the level through the base: along the antenna, and out from it [m]."""
        aperture = self.aperture
        near, far = aperture.slant_range[[0, -1]]
        way = (aperture.r - self.center) @ np.stack([self.ahead, self.out], axis=1)
        turn = np.linalg.norm(aperture.axis - aperture.axis.mean(axis=0), axis=1).max()
        reach = (_CUT * aperture.null + turn) * far
        lowest, highest = self._relief(reach + abs(self._tilt) * above + np.abs(way).max(), far)
        margin = _MARGIN * aperture.radar.range_spacing
        inner = (near - margin) ** 2 - (above - lowest) ** 2
        outer = (far + margin) ** 2 - (above - highest) ** 2
        if not outer > 0:
            raise ValueError(
                f"a swath to {far:.0f} m does not reach the ground, {above - highest:.0f} m below"
            )
        tilt = sorted(h * self._tilt for h in (above - lowest, above - highest))
        self.along = (way[:, 0].min() - reach + tilt[0], way[:, 0].max() + reach + tilt[1])
        self.across = (
            np.sqrt(max(inner, 0.0)) + way[:, 1].min(),
            np.sqrt(outer) + way[:, 1].max(),
        )

    def _relief(self, reach: float, far: float) -> tuple[float, float]:
        """Lowest and highest ground within reach, relative to the base [m]."""
        p = self._plane(np.linspace(-reach, reach, 33)[:, None], np.linspace(0, far, 65)[None, :])
        latitude, longitude, _ = self.ground.geodetic(p)
        base = float(self.ground.geodetic(self.base)[2])
        height = self.scene.dem.at(latitude, longitude) - base
        return float(height.min()), float(height.max())

    def _plane(self, along: FloatArray, across: FloatArray) -> FloatArray:
        return np.asarray(self.base + along[..., None] * self.ahead + across[..., None] * self.out)

    def _look_up(self) -> None:
        """Rise above the level [m] and brightness [dB] on a grid of the rectangle."""
        x, y = (
            low + _SURFACE * np.arange(int(np.ceil((high - low) / _SURFACE)) + 2)
            for low, high in (self.along, self.across)
        )
        level = self._plane(x[:, None], y[None, :])
        latitude, longitude, own = self.ground.geodetic(level)
        rise = self.scene.dem.at(latitude, longitude) - own
        slopes = np.gradient(rise, _SURFACE)
        line = self.center - (level + rise[..., None] * self.up)
        line /= np.linalg.norm(line, axis=-1, keepdims=True)
        facing = line @ self.up - slopes[0] * (line @ self.ahead) - slopes[1] * (line @ self.out)
        cosine = facing / np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)
        db = 10 * np.log10(np.maximum(brightness(cosine), 1e-6))
        # a cell of the slant plane holds more of level ground the steeper it is seen
        db += 5 * np.log10(np.maximum(1 - cosine**2, 1e-6))
        i, j = latitude / self.scene.cell, longitude / self.scene.cell
        rows, columns = (
            range(int(np.floor(a.min())) - 1, int(np.ceil(a.max())) + 2) for a in (i, j)
        )
        texture = self.scene.texture(rows, columns)
        x32, y32 = ((a - s.start).astype(np.float32) for a, s in ((j, columns), (i, rows)))
        db += cv2.remap(texture, x32, y32, cv2.INTER_LINEAR)
        self.cells = rows, columns
        self._surface = rise.astype(np.float32), db.astype(np.float32)

    def clutter(self, rng: np.random.Generator, per_cell: float = 8.0) -> Scatterers:
        """Scatterers strewn at random, of equal strength where the ground is equally bright.

        Their phases are random. Strengths that differ (complex normal ones, say) would give the
        echo twice the texture of its own.

        Parameters
        ----------
        rng : numpy.random.Generator
        per_cell : float
            Scatterers in a resolution cell of level ground in the middle of the swath.

        Raises
        ------
        ValueError
            If they are so few that the echo would have a texture of its own.
        """
        if not per_cell >= FEWEST:
            raise ValueError(
                f"{per_cell:g} scatterers in a resolution cell give the echo a texture of its own, "
                f"which a radar does not see: {FEWEST:g} at least, 8 are usual"
            )
        return self._strewn(rng, per_cell)

    def _strewn(self, rng: np.random.Generator, per_cell: float) -> Scatterers:
        distance = float(self.aperture.slant_range.mean())
        above = float((self.center - self.base) @ self.up)
        cell = self.aperture.cell_area / np.sqrt(1 - min(above / distance, 1.0) ** 2)
        (x0, x1), (y0, y1) = self.along, self.across
        n = int(per_cell * (x1 - x0) * (y1 - y0) / cell)
        # in order along the track, and as even across it as chance is
        x = (np.arange(n, dtype=np.float32) + rng.random(n, np.float32)) * np.float32((x1 - x0) / n)
        y = rng.random(n, np.float32) * np.float32(y1 - y0)
        rise, db = (_at(a, x / _SURFACE, y / _SURFACE) for a in self._surface)
        db -= np.float32(10 * np.log10(per_cell * self.aperture.cell_area / cell))
        x, y = x + np.float32(x0), y + np.float32(y0)
        offset = np.empty((3, n), np.float32)
        for k in range(3):
            np.multiply(x, np.float32(self.ahead[k]), out=offset[k])
            offset[k] += y * np.float32(self.out[k])
            offset[k] += rise * np.float32(self.up[k])
        near, far = self._window
        line = offset + (self.base - self.center).astype(np.float32)[:, None]
        square = np.einsum("in,in->n", line, line)
        heard = (square > near * near) & (square < far * far)
        offset, db = offset[:, heard], db[heard]
        reflection = unit_phasor(rng.random(len(db), np.float32))
        reflection *= np.exp(db * np.float32(np.log(10) / 20))
        return Scatterers(self.base, offset, reflection)

    @property
    def _window(self) -> tuple[float, float]:
        """Ranges that are summed [m]; the track moves by less than the sidelobes reach."""
        aperture = self.aperture
        margin = _MARGIN * aperture.radar.range_spacing
        way = aperture.r - self.center
        drift = float(np.abs(way @ self.up).max() + np.abs(way @ self.out).max())
        near, far = aperture.slant_range[[0, -1]]
        return max(near - margin - drift, 0.0), far + margin + drift

    def points(self) -> Scatterers:
        """Bright points of the scene."""
        latitude, longitude, amplitude, phase = self.scene.points(*self.cells)
        height = self.scene.dem.at(latitude, longitude)
        p = self.ground.point(latitude, longitude, height)
        return scatterers_at(p, amplitude * np.exp(2j * np.pi * phase))


def _at(values: Single, i: Single, j: Single) -> Single:
    """Linear interpolation at fractional rows and columns, (n,)."""
    width = 4096
    padded = -(-len(i) // width) * width
    x, y = (
        np.pad(a.astype(np.float32, copy=False), (0, padded - len(a))).reshape(-1, width)
        for a in (j, i)
    )
    found = cv2.remap(values, x, y, cv2.INTER_LINEAR).ravel()[: len(i)]
    return np.asarray(found, np.float32)
