r"""How many lines a slip has lost, told by what is seen before and after it.

Images are formed of the lines before the slip alone, and of those after it: looks of the same
ground, from the two halves of the aperture. Lines after the slip are too early by as many as were
lost, and so is what they show. A velocity that is a little wrong displaces looks, too; by how much
is measured where nothing was lost, half an aperture away or farther, and taken off.

On RADARSAT-1's chunks lengths are whole numbers to 0.12 lines rms (benchmarks/lost_lines.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import ComplexArray
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.correlation import Shift, contrast, shift_between
from terrafix.models.radar.focusing import azimuth_compressed, range_doppler
from terrafix.models.radar.recordings.recording import Recording
from terrafix.models.radar.spectra import ARRAY_ROWS, Rows

_CELLS = 512
"""Range cells of the looks."""
_ROWS = 0.25
"""Of the strip about a place that is compared, each way, in apertures."""
_LEAST = 0.5
"""Lines that are wanted before and after a place, in apertures."""
_REACH = 60, 12
"""Lines and cells that looks are sought within."""
_QUALITY, _PARTS, _SIGMA = 5.0, 5.0, 0.25
"""What a shift between looks must have to be believed, its sigma in lines."""
_WHOLE = 0.3
"""How far the difference of two shifts may be from a whole number of lines."""


@dataclass(frozen=True)
class Seen:
    """How a recording is imaged.

    Parameters
    ----------
    radar : Radar
    near_range : float
        Slant range of the first cell [m].
    centroid : float
        Absolute Doppler centroid [Hz].
    velocity : float
        Effective velocity, to some meters per second [m/s].
    operations : Rows
        Who turns and resamples rows of spectra.
    """

    radar: Radar
    near_range: float
    centroid: float
    velocity: float
    operations: Rows = ARRAY_ROWS

    def aperture(self, n_cells: int) -> float:
        """Lines for which the beam sees a point in the middle of some cells."""
        middle = self.near_range + n_cells / 2 * self.radar.range_spacing
        rate = 2 * self.velocity**2 / (self.radar.wavelength * middle)
        return self.radar.doppler_bandwidth / rate * self.radar.prf


def without_slips(recording: Recording, seen: Seen) -> Recording:
    """Put lines where they belong after slips, whose lengths are told by the echo.

    Raises
    ------
    ValueError
        If a length is not told: too little is seen on both sides of it, or the same of it.
    """
    while recording.slips:
        slip, *later = recording.slips
        within = 0, later[0] if later else recording.n_lines
        lost = _lost_at(recording.read, slip, within, recording.n_cells, seen)
        recording = recording.with_lost(slip, lost)
    return recording


def _lost_at(
    read: Callable[[int, int], ComplexArray],
    slip: int,
    within: tuple[int, int],
    n_cells: int,
    seen: Seen,
) -> int:
    width = min(n_cells, seen.radar.n_pulse + _CELLS)
    aperture = int(seen.aperture(width))
    least = int(_LEAST * aperture)
    # where nothing was lost: between the slip and the farther end of what has no other
    first, last = within
    if last - slip >= slip - first:
        other, part = slip + min(aperture, (last - slip) // 2), (slip, last)
    else:
        other, part = slip - min(aperture, (slip - first) // 2), (first, slip)
    shifts = []
    for place, (low, high) in ((slip, within), (other, part)):
        low, high = max(low, place - aperture), min(high, place + aperture)
        if min(place - low, high - place) < least:
            raise ValueError(
                f"how many lines are lost before line {slip + 1} is not told: "
                f"{min(place - low, high - place)} lines are seen beside line {place + 1}, and "
                f"{least} are wanted"
            )
        shifts.append(_between_looks(read(low, high)[:, :width], place - low, seen))
    for shift in shifts:
        sigma = np.sqrt(shift.covariance[0, 0])
        good = shift.inside and sigma < _SIGMA
        if not (good and shift.quality > _QUALITY and shift.parts >= _PARTS):
            raise ValueError(
                f"how many lines are lost before line {slip + 1} is not told: what is seen before "
                "and after it is not alike"
            )
    lost = float(shifts[1].pixels[0] - shifts[0].pixels[0])
    if not (round(lost) >= 1 and abs(lost - round(lost)) < _WHOLE):
        raise ValueError(
            f"how many lines are lost before line {slip + 1} is not told: looks before and after "
            f"it are {lost:.2f} lines apart"
        )
    return round(lost)


def _between_looks(echo: ComplexArray, at: int, seen: Seen) -> Shift:
    """Shift of what lines from `at` on show on what those before it show [lines, cells]."""
    images = []
    for part in (slice(0, at), slice(at, None)):
        own = np.zeros_like(echo)
        own[part] = echo[part]
        domain = range_doppler(
            own,
            seen.radar,
            near_range=seen.near_range,
            centroid=seen.centroid,
            velocity=seen.velocity,
            operations=seen.operations,
        )
        images.append(azimuth_compressed(domain.cropped(), seen.velocity))
    before, after = images
    middle = before.slant_range[len(before.slant_range) // 2]
    row, _ = before.pixel(at / seen.radar.prf, middle, seen.centroid)
    half = int(_ROWS * seen.aperture(echo.shape[1]))
    down, right = _REACH
    low, high = round(float(row)) - half, round(float(row)) + half
    low, high = max(low, down), min(high, len(before.t) - down)
    if high - low < 2 * down:
        raise ValueError(f"{high - low} lines are imaged about a slip, too few to compare")
    return shift_between(
        contrast(np.abs(after.data[low:high, right:-right])),
        contrast(np.abs(before.data[low - down : high + down])),
        _REACH,
    )
