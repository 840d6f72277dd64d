r"""Images of an aperture, formed with what a navigator knows: its own track and velocity.

The echo is compensated to a straight line through the navigator's track and focused by the
range-Doppler processor of `terrafix.models.radar.focusing`, which knows the right Doppler rate of
every range. What is *measured* of a point is the slant range and the Doppler frequency with which
it was seen from the middle of the aperture,

.. math:: \rho = \lVert p - r_c \rVert, \qquad x = \frac{v^T (p - r_c)}{V}
          = \frac{\lambda \rho f}{2 V},

the second written as a distance ahead. Pixels are at times :math:`\tau` of zero Doppler from the
middle and closest ranges :math:`R_0` for the velocity :math:`V'` of compression. With
:math:`x = V'^2 \tau / V` and :math:`\rho^2 = R_0^2 + V'^2 \tau^2` they are places again, and
those do not move when another :math:`V'` focuses the image. A point is seen at the true velocity,
so that an error :math:`\delta v` (truth less estimate) moves it by
:math:`\delta v^T (p - r_c) / V`, whole: with squint, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.geometry.geolocation import Height
from terrafix.models.geometry.ground import Ground, seen_on_terrain
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.compensation import StraightLine, compensated, straight_line
from terrafix.models.radar.focusing import Image, RangeDoppler, azimuth_compressed, range_doppler
from terrafix.models.radar.multilook import detected

RANGE_OVERSAMPLING = 2
"""Pixels of an amplitude image in a range cell: detection doubles the bandwidth."""
AZIMUTH_LOOKS = 3
"""Lines averaged in a pixel."""
_SPARE = 0.1
"""Time beyond what the beam sees, in the transform over lines [s]."""


@dataclass(frozen=True)
class ApertureEcho:
    """Echo of an aperture, ready to be focused with any velocity.

    Parameters
    ----------
    domain : RangeDoppler
    line : StraightLine
        To which it was compensated.
    ground : Ground
        Frame of the line.
    side : {1, -1}
        To the right of the track, or to the left.
    """

    domain: RangeDoppler
    line: StraightLine
    ground: Ground
    side: int

    @property
    def speed(self) -> float:
        """That the navigator believes [m/s]."""
        return self.line.speed


def aperture_echo(
    echo: ComplexArray,
    radar: Radar,
    near_range: float,
    t: FloatArray,
    r: FloatArray,
    axis: FloatArray,
    ground: Ground,
    height: float,
    *,
    side: int = 1,
    terrain: Height | None = None,
    compensate: bool = True,
) -> ApertureEcho:
    """Compensate an echo to the navigator's own line, and remove range-cell migration.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_pulses, n_cells)
        Compressed in range.
    radar : Radar
        Its `doppler_bandwidth` is processed: what is seen in it by all pulses is focused.
    near_range : float
        Slant range of the first cell [m].
    t : ndarray, shape (n_pulses,)
        Times of the pulses [s].
    r : ndarray, shape (n_pulses, 3)
        Places of the antenna, as the navigator knows them [m].
    axis : ndarray, shape (n_pulses, 3)
        Unit vector along the antenna's long side, as the navigator knows it: gives the centroid.
    ground : Ground
        Frame of `r`.
    height : float
        Of the terrain in the swath [m].
    side : {1, -1}
        To the right of the track, or to the left.
    terrain : callable, optional
        Height [m] at latitudes and longitudes [rad], for each range where the beam's center meets
        it; `height` for all by default. In a turn of 3.7 m/s^2 a place believed 7 m too high is
        compensated as if the velocity were off by 0.2 m/s.
    compensate : bool
        Whether deviations from the line are compensated; they are for all but a control.

    Raises
    ------
    ValueError
        If shapes do not fit, or the swath does not reach the ground.
    """
    line = straight_line(t, r)
    mean_axis = axis.mean(axis=0)
    cells = near_range + radar.range_spacing * np.arange(echo.shape[1])
    sine = _beam_sine(ground, line, mean_axis, float(cells.mean()), height, side)
    centroid = 2 * line.speed * sine / radar.wavelength
    if compensate:
        beam = (
            ground.seen(line.r, line.v, cells, sine, height, side)
            if terrain is None
            else seen_on_terrain(ground, line.r, line.v, cells, sine, terrain, side)
        )
        echo = compensated(echo, radar, t, r, line, beam, centroid)
    rate = 2 * line.speed**2 / (radar.wavelength * near_range)
    wanted = radar.prf * (radar.doppler_bandwidth / rate + _SPARE)
    domain = range_doppler(
        echo,
        radar,
        near_range=near_range,
        centroid=centroid,
        velocity=line.speed,
        first_time=float(t[0]) - line.t,
        n_doppler=int(fft.next_fast_len(max(len(t), int(wanted)))),
        compressed=True,
    )
    return ApertureEcho(domain, line, ground, side)


def _beam_sine(
    ground: Ground, line: StraightLine, axis: FloatArray, distance: float, height: float, side: int
) -> float:
    """Sine ahead of broadside at which the plane across an axis meets the ground."""
    sine = 0.0
    for _ in range(8):
        p = ground.seen(line.r, line.v, distance, sine, height, side)
        sine -= float(axis @ (p - line.r)) / distance
    return sine


@dataclass(frozen=True)
class PixelGrid:
    """Where the pixels of an amplitude image of an aperture lie.

    Parameters
    ----------
    first_time, row_time : float
        Time of zero Doppler of row 0, from the middle of the aperture, and between rows [s].
    near_range, spacing : float
        Closest range of column 0, and between columns [m].
    velocity : float
        Of azimuth compression [m/s].
    line : StraightLine
    ground : Ground
    side : {1, -1}
    """

    first_time: float
    row_time: float
    near_range: float
    spacing: float
    velocity: float
    line: StraightLine
    ground: Ground
    side: int

    def seen(self, row: ArrayLike, column: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Slant range and distance ahead [m] of pixels, fractional, as measured."""
        tau = self.first_time + np.asarray(row) * self.row_time
        closest = self.near_range + np.asarray(column) * self.spacing
        way = self.velocity * tau
        return np.hypot(closest, way), np.asarray(self.velocity * way / self.line.speed)

    def pixel(self, rho: ArrayLike, ahead: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Row and column, fractional: the inverse of `seen`."""
        way = np.asarray(ahead) * self.line.speed / self.velocity
        closest = np.sqrt(np.asarray(rho) ** 2 - way**2)
        row = (way / self.velocity - self.first_time) / self.row_time
        return np.asarray(row), np.asarray((closest - self.near_range) / self.spacing)

    def predicted(self, p: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Slant range and distance ahead [m] at which the estimate expects points (..., 3) [m]."""
        away = np.asarray(p, np.float64) - self.line.r
        return np.linalg.norm(away, axis=-1), away @ self.line.along

    def places(
        self,
        row: ArrayLike,
        column: ArrayLike,
        terrain: Height,
        offset: ArrayLike = (0.0, 0.0, 0.0),
    ) -> FloatArray:
        """Points (..., 3) [m] of a terrain that the estimate puts at pixels.

        Parameters
        ----------
        row, column : array_like, shape (...)
        terrain : callable
            Height [m] at latitudes and longitudes [rad].
        offset : array_like, shape (3,)
            Correction of the line's place [m].
        """
        rho, ahead = self.seen(row, column)
        r = self.line.r + np.asarray(offset, np.float64)
        return seen_on_terrain(self.ground, r, self.line.v, rho, ahead / rho, terrain, self.side)


@dataclass(frozen=True)
class ApertureImage:
    """An image, and where its pixels lie.

    Parameters
    ----------
    image : Image
        Its times count from the middle of the aperture.
    line : StraightLine
    ground : Ground
    side : {1, -1}
    """

    image: Image
    line: StraightLine
    ground: Ground
    side: int

    def amplitude(self) -> Single:
        """Amplitude of the valid part: pixels of `AZIMUTH_LOOKS` lines and half a range cell."""
        valid = self.image.valid
        n = valid.shape[1]
        spectrum = fft.fft(valid, axis=1, workers=-1)
        padded = np.zeros((len(valid), RANGE_OVERSAMPLING * n), np.complex64)
        low = -(-n // 2)
        padded[:, :low] = spectrum[:, :low]
        padded[:, low - n :] = spectrum[:, low:]
        fine = fft.ifft(padded, axis=1, overwrite_x=True, workers=-1)
        return detected(fine * np.float32(RANGE_OVERSAMPLING), (AZIMUTH_LOOKS, 1))

    @property
    def grid(self) -> PixelGrid:
        """Where the pixels of `amplitude` lie."""
        image = self.image
        prf = image.radar.prf
        cells = image.slant_range
        return PixelGrid(
            float(image.t[0]) + (image.rows.start + (AZIMUTH_LOOKS - 1) / 2) / prf,
            AZIMUTH_LOOKS / prf,
            float(cells[image.columns.start]),
            float(cells[1] - cells[0]) / RANGE_OVERSAMPLING,
            image.velocity,
            self.line,
            self.ground,
            self.side,
        )


def aperture_image(echo: ApertureEcho, velocity: float | None = None) -> ApertureImage:
    """Focus an aperture.

    Parameters
    ----------
    echo : ApertureEcho
    velocity : float, optional
        Of azimuth compression [m/s]: what map drift found; the navigator's own by default.
    """
    image = azimuth_compressed(echo.domain, echo.speed if velocity is None else velocity)
    return ApertureImage(image, echo.line, echo.ground, echo.side)
