"""From one echo to images, for many who each bring an estimate of their own.

Compression in range, the removal of migration and every image are done once for all who agree on
what they depend on. So that what one gets never depends on who else asks, velocities are rounded
to grids, and nothing is averaged over those who ask.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import ComplexArray
from terrafix.models.radar.autofocus import REASONS as FOCUS_REASONS
from terrafix.models.radar.autofocus import Focus, SharpnessCurve, autofocus
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.doppler import fractional_centroid
from terrafix.models.radar.focusing import Image, RangeDoppler, azimuth_compressed, range_doppler
from terrafix.models.radar.spectra import ARRAY_ROWS, Rows

BLIND = "no image: the estimate sees no ground at the measured range"
OPEN = "no image: the estimate leaves too many Doppler centroids open"
OUTSIDE = "no image: the beam's center lies outside of what is focused"
ZERO = "no image: the echo is zero"
REASONS = (*FOCUS_REASONS, BLIND, OPEN, OUTSIDE, ZERO)
"""What became of autofocus; from the first of those above on, there is no image either."""

FARTHEST = 300.0
"""Farthest from what is believed that a velocity is looked for [m/s]."""
_SLOPE_STEP = 5e-6
"""Grid of the growth of velocity with range [m/s per m]: 0.02 m/s over half a swath."""
_RATE_STEP = 2e-3
"""Grid of the growth of velocity with time [m/s^2]: a millimeter per second over half an image."""


@dataclass(frozen=True)
class Processing:
    """What an echo is compressed in range with.

    Parameters
    ----------
    centroid : float
        Absolute Doppler centroid [Hz].
    velocity : float
        Of the removal of migration [m/s].
    velocity_slope : float
        How much the effective velocity grows with range [m/s per m].
    """

    centroid: float
    velocity: float
    velocity_slope: float


class NoImageError(ValueError):
    """An estimate leads to no image of what is wanted; another estimate may.

    Parameters
    ----------
    reason : str
        One of `REASONS`.
    text : str
        In full.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class Imager:
    """Images of one echo.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_lines, n_cells)
        Raw echo at baseband.
    radar : Radar
    near_range : float
        Slant range of the first cell [m].
    first_time : float
        Time of the first line [s].
    step : float
        Grid of velocities of autofocus [m/s].
    migration_step : float
        Grid of velocities of the removal of migration [m/s].
    band : tuple of float
        Part of the processed Doppler band that images show, from 0 to 1: a look. Autofocus uses
        the whole band.
    exposure : float
        Share of a pulse that must have been received for a column to be used.
    operations : Rows
        Who turns and resamples rows of spectra.

    Raises
    ------
    ValueError
        If the echo is empty of signal or a step or the band is not possible.
    """

    def __init__(
        self,
        echo: ComplexArray,
        radar: Radar,
        near_range: float,
        first_time: float,
        *,
        step: float = 1.0,
        migration_step: float = 50.0,
        band: tuple[float, float] = (0.0, 1.0),
        exposure: float = 1.0,
        operations: Rows = ARRAY_ROWS,
    ) -> None:
        if not (step > 0 and migration_step > 0):
            raise ValueError(f"steps of {step} and {migration_step} m/s must be positive")
        if not 0 <= band[0] < band[1] <= 1:
            raise ValueError(f"a band from {band[0]} to {band[1]} is not a part of the whole")
        self.echo, self.radar = echo, radar
        self.near_range, self.first_time = near_range, first_time
        self.step, self.migration_step, self.band = step, migration_step, band
        self.exposure, self.operations = exposure, operations
        self.fraction, self.coherence = fractional_centroid(echo, radar.prf)
        self._curves: dict[Processing, SharpnessCurve] = {}
        self._focused: dict[tuple[Processing, int, float, float, bool], Focus] = {}
        self._images: dict[tuple[Processing, int], Image] = {}

    def processing(self, centroid: float, velocity: float, velocity_slope: float) -> Processing:
        """Round what an estimate asks for to what is shared."""
        return Processing(
            centroid,
            self.migration_step * round(velocity / self.migration_step),
            _SLOPE_STEP * round(velocity_slope / _SLOPE_STEP),
        )

    def curve(self, processing: Processing) -> SharpnessCurve:
        """Sharpness of the echo as a function of velocity."""
        if processing not in self._curves:
            domain = range_doppler(
                self.echo,
                self.radar,
                near_range=self.near_range,
                centroid=processing.centroid,
                velocity=processing.velocity,
                velocity_slope=processing.velocity_slope,
                first_time=self.first_time,
                exposure=self.exposure,
                operations=self.operations,
            )
            self._curves[processing] = SharpnessCurve(domain.cropped(), self.step)
        return self._curves[processing]

    def focus(
        self,
        candidates: list[Processing],
        velocity: float,
        *,
        reach: float = 150.0,
        velocity_rate: float = 0.0,
    ) -> tuple[Processing, Focus]:
        """Autofocus from a velocity, with each of some candidates, and choose among them.

        A wrong whole number of repetition frequencies in the centroid leaves migration in the
        echo; what is sharpest has none. Where the velocity that is found asks for another removal
        of migration than the one believed, the echo is focused with that: what an image is like
        depends on what is found, not on where one started.

        Parameters
        ----------
        candidates : list of Processing
        velocity : float
            That the navigator believes [m/s].
        reach : float
            Largest change from it [m/s].
        velocity_rate : float
            How much the effective velocity grows from row to row of the scene [m/s^2].
        """
        for thorough in (False, True):
            found = [
                (p, self._focus(p, velocity, reach, velocity_rate, thorough)) for p in candidates
            ]
            processing, focus = max(found, key=lambda pair: (pair[1].accepted, pair[1].sharpness))
            if focus.accepted:
                break
        settled = self.processing(processing.centroid, focus.velocity, processing.velocity_slope)
        if focus.accepted and settled != processing:
            again = self._focus(settled, focus.velocity, reach, velocity_rate, False)
            if again.accepted:
                return settled, again
        return processing, focus

    def _focus(
        self, processing: Processing, velocity: float, reach: float, rate: float, thorough: bool
    ) -> Focus:
        rate = _RATE_STEP * round(rate / _RATE_STEP)
        key = processing, round(velocity / self.step), reach, rate, thorough
        if key not in self._focused:
            self._focused[key] = autofocus(
                self.curve(processing),
                key[1] * self.step,
                max_change=reach,
                velocity_rate=rate,
                thorough=thorough,
            )
        return self._focused[key]

    def image(self, processing: Processing, velocity: float) -> Image:
        """Image compressed with a velocity [m/s], rounded to a tenth of the step."""
        tenth = round(10 * velocity / self.step)
        key = processing, tenth
        if key not in self._images:
            domain = self.curve(processing).domain
            band = self._band(domain)
            self._images[key] = azimuth_compressed(
                domain, tenth * self.step / 10, band=band, deskewed=True
            )
        return self._images[key]

    def velocity_at(
        self,
        processing: Processing,
        velocity: float,
        velocity_rate: float,
        pixel: tuple[float, float],
    ) -> float:
        """Velocity that focuses a pixel, from that which focuses the middle [m/s].

        Parameters
        ----------
        processing : Processing
        velocity : float
            In the middle of the valid columns, and of the valid rows at the velocity with which
            migration is removed.
        velocity_rate : float
            How much the effective velocity grows from row to row of the scene [m/s^2].
        pixel : tuple of float
            Row and column of the image.
        """
        image, (row, column) = self.image(processing, velocity), pixel
        spacing = image.slant_range[1] - image.slant_range[0]
        middle = image.slant_range[image.columns].mean()
        beyond = image.slant_range[0] + spacing * column - middle
        late = float(image.seen_at(row, column, 0.0)[0]) - self.curve(processing).middle
        return float(velocity + processing.velocity_slope * beyond + velocity_rate * late)

    def _band(self, domain: RangeDoppler) -> tuple[float, float]:
        low, high = (
            domain.centroid + (edge - 0.5) * self.radar.doppler_bandwidth for edge in self.band
        )
        return low, high


def chip_slices(
    center: tuple[float, float], size: tuple[int, int], inside: tuple[slice, slice]
) -> tuple[slice, slice]:
    """Rows and columns about a center, moved to lie inside.

    Parameters
    ----------
    center : tuple of float
        Row and column.
    size : tuple of int
        Rows and columns.
    inside : tuple of slice
        Where they may lie.

    Raises
    ------
    NoImageError
        If the center is not inside.
    ValueError
        If what is inside is too small.
    """
    found = []
    for c, n, part, what in zip(center, size, inside, ("row", "column"), strict=True):
        if part.stop - part.start < n:
            raise ValueError(
                f"{part.stop - part.start} {what}s of the image are focused, and {n} are wanted"
            )
        if not part.start <= c <= part.stop - 1:
            raise NoImageError(
                OUTSIDE,
                f"the beam's center is at {what} {c:.0f}, outside what is focused, "
                f"{part.start} to {part.stop - 1}",
            )
        start = int(np.clip(round(c - (n - 1) / 2), part.start, part.stop - n))
        found.append(slice(start, start + n))
    return found[0], found[1]
