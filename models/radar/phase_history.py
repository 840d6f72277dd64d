r"""Phase history of a spotlight radar: recorded pulses in the frequency domain, and images of them.

A scatterer at :math:`p` has, at frequency :math:`f` of the pulse sent from :math:`r`, the phase

.. math:: -\frac{4\pi f}{c}\,\bigl(\lVert p - r \rVert - r_0\bigr),

with :math:`r_0` the range to the center of the scene to which the recording was compensated. Pulses
are compressed by a transform over frequency and summed by back projection, which asks nothing of
the track: where it is a poor guess, the image shows places elsewhere and blurred.

What is measured of a place is, as in `terrafix.models.radar.aperture_image`, its range from the
middle of the track and its distance ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import fft
from scipy.signal import get_window

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single
from terrafix.models.core.formats import kind_of
from terrafix.models.radar.chirp import SPEED_OF_LIGHT
from terrafix.models.radar.compensation import straight_line
from terrafix.models.radar.map_drift import Looks, MapDrift, drifted
from terrafix.models.radar.pulses import Profiles, PulseSums

_FINER = 8
"""Cells of a compressed pulse in a resolution cell."""
_FIELDS = ("fp", "freq", "x", "y", "z", "r0")
_EVEN = 1e-3
"""Steps between frequencies may differ by this share of one."""
_LARGEST = 4.0
"""Largest change of velocity that map drift looks for [m/s]."""


@dataclass(frozen=True)
class PhaseHistory:
    """Pulses of a spotlight radar.

    Parameters
    ----------
    phase : ndarray of complex64, shape (n_pulses, n_frequencies)
    frequency : ndarray, shape (n_frequencies,)
        In equal steps [Hz].
    r : ndarray, shape (n_pulses, 3)
        Places of the antenna: east, north, up of the center of the scene, or any frame with the
        ground at z = 0 [m].
    reference : ndarray, shape (n_pulses,)
        Range to which each pulse was compensated [m].
    t : ndarray, shape (n_pulses,), optional
        Times of the pulses [s], where they were recorded.

    Raises
    ------
    ValueError
        If shapes do not fit, something is not finite, frequencies are not in equal steps, or times
        do not increase.
    """

    phase: ComplexArray
    frequency: FloatArray
    r: FloatArray
    reference: FloatArray
    t: FloatArray | None = None

    def __post_init__(self) -> None:
        n, k = self.phase.shape if self.phase.ndim == 2 else (0, 0)
        if n < 2 or k < 2 or self.frequency.shape != (k,) or self.r.shape != (n, 3):
            raise ValueError(
                f"a phase history of shape {self.phase.shape} has {self.frequency.shape} "
                f"frequencies and places {self.r.shape}"
            )
        if self.reference.shape != (n,):
            raise ValueError(f"{n} pulses have reference ranges of shape {self.reference.shape}")
        for name in ("phase", "frequency", "r", "reference"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} of a phase history is not finite")
        steps = np.diff(self.frequency)
        if not (steps.mean() > 0 and np.abs(steps / steps.mean() - 1).max() < _EVEN * k):
            raise ValueError("frequencies of a phase history are not in equal steps upward")
        if self.t is not None and not (self.t.shape == (n,) and (np.diff(self.t) > 0).all()):
            raise ValueError("times of a phase history do not increase from pulse to pulse")

    @property
    def wavelength(self) -> float:
        """At the middle frequency [m]."""
        return SPEED_OF_LIGHT / float(self.frequency[len(self.frequency) // 2])

    def times(self, speed: float) -> FloatArray:
        """Times (n_pulses,) of the pulses from their mean [s].

        Those recorded, or else as flown at a speed [m/s].
        """
        if self.t is not None:
            return np.asarray(self.t - self.t.mean())
        way = np.linalg.norm(np.diff(self.r, axis=0), axis=1)
        t = np.concatenate([[0.0], np.cumsum(way)]) / speed
        return np.asarray(t - t.mean())


def read_gotcha(paths: Sequence[Path]) -> PhaseHistory:
    """Read files of the AFRL "Gotcha" volumetric set (MATLAB 5), one after the other.

    Raises
    ------
    FileNotFoundError
        If one is not there.
    ValueError
        If one is no such file, or frequencies differ between them.
    """
    parts = [_read_gotcha(path) for path in paths]
    first = parts[0]
    for path, part in zip(paths, parts, strict=True):
        if not np.array_equal(part.frequency, first.frequency):
            raise ValueError(f"'{path}' has other frequencies than '{paths[0]}'")
    return PhaseHistory(
        np.concatenate([p.phase for p in parts]),
        first.frequency,
        np.concatenate([p.r for p in parts]),
        np.concatenate([p.reference for p in parts]),
    )


def _read_gotcha(path: Path) -> PhaseHistory:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    try:
        data: Any = loadmat(path, squeeze_me=True, struct_as_record=False)["data"]
        fp, freq, *place, r0 = (np.asarray(getattr(data, name)) for name in _FIELDS)
        return PhaseHistory(
            np.ascontiguousarray(fp.T, np.complex64),
            freq.astype(np.float64),
            np.stack(place, axis=1).astype(np.float64),
            r0.astype(np.float64),
        )
    except (OSError, ValueError, TypeError, KeyError, AttributeError, MatReadError) as error:
        found, cure = kind_of(path)
        raise ValueError(
            f"'{path}' is no phase history of the Gotcha set: {error}\n"
            f"  such a file holds a struct 'data' with {', '.join(_FIELDS)}"
            + (f"\n  it is {found}: {cure}" if found else "")
        ) from error


def compressed_pulses(history: PhaseHistory) -> Profiles:
    """Compress pulses in range, about the middle frequency, their band weighted (Hamming)."""
    n = len(history.frequency)
    n_fft = int(fft.next_fast_len(_FINER * n))
    step = float(np.diff(history.frequency).mean())
    weighted = history.phase * get_window("hamming", n, fftbins=False).astype(np.float32)
    padded = np.zeros((len(history.phase), n_fft), np.complex64)
    half = n // 2
    padded[:, : n - half] = weighted[:, half:]
    padded[:, n_fft - half :] = weighted[:, :half]
    line = fft.fftshift(fft.ifft(padded, axis=1, workers=-1), axes=1) * np.float32(n_fft / n)
    spacing = SPEED_OF_LIGHT / (2 * n_fft * step)
    return Profiles(
        np.ascontiguousarray(line),
        history.r,
        history.reference,
        -(n_fft // 2) * spacing,
        spacing,
        history.wavelength,
    )


@dataclass(frozen=True)
class GroundGrid:
    """Pixels on the level ground: rows along the track, columns away from it.

    Parameters
    ----------
    along, out : ndarray, shape (3,)
        Unit vectors of rows and columns.
    spacing : float
        Between pixels [m].
    n_rows, n_columns : int
    """

    along: FloatArray
    out: FloatArray
    spacing: float
    n_rows: int
    n_columns: int

    def places(self) -> FloatArray:
        """Points (n_rows * n_columns, 3) [m] of all pixels; the middle is the origin."""
        y = self.spacing * (np.arange(self.n_rows) - (self.n_rows - 1) / 2)
        x = self.spacing * (np.arange(self.n_columns) - (self.n_columns - 1) / 2)
        grid = y[:, None, None] * self.along + x[None, :, None] * self.out
        return np.asarray(grid.reshape(-1, 3))

    def grown(self, rows: int, columns: int) -> GroundGrid:
        """The same with more pixels at every side."""
        return replace(self, n_rows=self.n_rows + 2 * rows, n_columns=self.n_columns + 2 * columns)


def ground_grid(r: FloatArray, spacing: float, n_rows: int, n_columns: int) -> GroundGrid:
    """Grid about the origin, along the mean track of places (n, 3) [m]."""
    along = r[-1] - r[0]
    along = np.array([along[0], along[1], 0.0])
    along /= np.linalg.norm(along)
    out = np.cross(along, [0.0, 0.0, 1.0])
    out *= -np.sign(out @ r.mean(axis=0))
    return GroundGrid(along, out, spacing, n_rows, n_columns)


def projected(
    profiles: Profiles, grid: GroundGrid, sums: PulseSums, pulses: slice | None = None
) -> Single:
    """Amplitude (n_rows, n_columns) of an image by back projection, of all pulses or some."""
    if pulses is not None:
        profiles = replace(
            profiles,
            echo=profiles.echo[pulses],
            r=profiles.r[pulses],
            reference=profiles.reference[pulses],
        )
    taper = get_window("hamming", len(profiles.r), fftbins=False).astype(np.float32)
    weighted = replace(profiles, echo=profiles.echo * taper[:, None])
    image = sums.back_projected(weighted, grid.places())
    return np.abs(image).reshape(grid.n_rows, grid.n_columns)


def moved(profiles: Profiles, r: FloatArray) -> Profiles:
    """The same pulses, believed to come from other places (n_pulses, 3) [m]."""
    return replace(profiles, r=r)


def projected_drift(
    profiles: Profiles, t: FloatArray, grid: GroundGrid, sums: PulseSums
) -> tuple[MapDrift, Profiles]:
    """Map drift by back projection: the velocity that focuses pulses, and their places with it.

    Parameters
    ----------
    profiles : Profiles
        With places as the navigator knows them.
    t : ndarray, shape (n_pulses,)
        Times of the pulses [s].
    grid : GroundGrid
    sums : PulseSums

    Raises
    ------
    ValueError
        If there are fewer pulses than looks.
    """
    n = len(t) // 2
    if n < 2:
        raise ValueError(f"{len(t)} pulses cannot be shared by two looks")
    line = straight_line(t, profiles.r)
    halves = slice(0, n), slice(len(t) - n, len(t))
    apart = float(t[halves[1]].mean() - t[halves[0]].mean())

    def flown_at(speed: float) -> Profiles:
        return moved(
            profiles, profiles.r + np.outer((speed - line.speed) * (t - line.t), line.along)
        )

    def looks_at(speed: float) -> Looks:
        first, second = (projected(flown_at(speed), grid, sums, half) for half in halves)
        return Looks(first, second, grid.spacing / speed, apart)

    found = drifted(looks_at, line.speed, _LARGEST)
    return found, flown_at(found.velocity) if found.accepted else profiles
