"""What a recording of raw echo is, whatever file it is in: echo, times, radar and track.

Echo is read in blocks of lines, and no more of it is in memory. Every line has its place: where
some were lost, those about them stay where they were received, and zeros lie between.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.recordings.lines import (
    MOST_LOST,
    Neighbors,
    too_many_lost,
)

WHAT = "recorded echo"
FORMATS = (
    "recorded echo is a file of NumPy (.npz) with the arrays i and q (or echo), first_rg_line and "
    "first_rg_cell, or NISAR L0B (HDF5)"
)
IMAGE = "an image, formed already: name the raw echo (level 0) that it was formed of"
_MOVED = 0.08
"""Lines that an image is moved by where 3 to 10 lines of its aperture are zeros, rms: measured by
benchmarks/lost_lines.py."""
_BLOCK = 2**22
"""Samples that are in memory at a time: 32 MB."""


class Lines(Protocol):
    """Lines as a file holds them, lost ones left out or not."""

    shape: tuple[int, int]
    """Lines and cells."""

    def read(self, first: int, last: int) -> ComplexArray:
        """Lines `first` to `last - 1` at baseband, gain compensated, those without echo zero."""


@dataclass(frozen=True)
class Sent:
    """What a radar sends and how its echo is sampled, as far as a file of echo says.

    Parameters
    ----------
    carrier, prf, sample_rate, chirp_rate, pulse_length : float
        As those of `terrafix.models.radar.chirp.Radar` [Hz, Hz, Hz, Hz/s, s].
    """

    carrier: float
    prf: float
    sample_rate: float
    chirp_rate: float
    pulse_length: float

    def radar(self, doppler_bandwidth: float) -> Radar:
        """Make the radar of which a Doppler bandwidth [Hz] is processed.

        Raises
        ------
        ValueError
            If it cannot be.
        """
        return Radar(
            *(self.carrier, self.prf, self.sample_rate, self.chirp_rate, self.pulse_length),
            doppler_bandwidth,
        )


@dataclass(frozen=True, eq=False)
class AntennaAttitude:
    """Attitude of an antenna at increasing times.

    Parameters
    ----------
    t : ndarray, shape (n,)
        Seconds since the epoch of the recording.
    q_ae : ndarray, shape (n, 4)
        Quaternions, scalar last, that take Earth-fixed components to those along the antenna's
        axes as the format defines them; z is the boresight.
    """

    t: FloatArray
    q_ae: FloatArray


@dataclass(frozen=True, eq=False)
class Track:
    """Where a radar was, as its file of echo says.

    Parameters
    ----------
    epoch : datetime64[ns]
        UTC from which the recording counts seconds.
    orbit : Ephemeris, optional
    attitude : AntennaAttitude, optional
    """

    epoch: np.datetime64
    orbit: Ephemeris | None
    attitude: AntennaAttitude | None


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded raw echo.

    Parameters
    ----------
    path : Path
    lines : Lines
        As the file holds them.
    place : ndarray of int, shape (n,)
        Line of the recording that each of them is, counted from 0.
    lost : ndarray of int, shape (n_lost,)
        Numbers of the lines that are zero because they were lost, counted from 1.
    line_time : ndarray, shape (n_lines,), optional
        When every line was sent, those lost included [s]; None if the file only numbers lines. It
        counts from the epoch of `track`, if there is one.
    first_line, first_cell : int
        Of what it is part of, counted from 1.
    near_range : float, optional
        Slant range of its first cell [m]: half the delay of its first sample times the speed of
        light.
    sent : Sent, optional
    track : Track, optional
    time_sigma : float
        Standard error that the times of all its lines have in common [s].
    slips : sequence of int
        Lines, counted from 0, before which others are lost without a number or a time that says so:
        from there on lines are too early (`terrafix.models.radar.recordings.slips`).
    cure : str
        What can be done about slips, for messages.
    """

    path: Path
    lines: Lines
    place: NDArray[np.intp]
    lost: NDArray[np.intp]
    line_time: FloatArray | None = None
    first_line: int = 1
    first_cell: int = 1
    near_range: float | None = None
    sent: Sent | None = None
    track: Track | None = None
    time_sigma: float = 0.0
    slips: tuple[int, ...] = ()
    cure: str = ""

    @property
    def n_lines(self) -> int:
        """Lines, those lost included."""
        return int(self.place[-1]) + 1

    @property
    def n_cells(self) -> int:
        """Range cells of a line."""
        return self.lines.shape[1]

    def read(self, first: int = 0, last: int | None = None) -> ComplexArray:
        """Echo of lines `first` to `last - 1`, counted from 0, (n, n_cells); lost ones are zero."""
        last = self.n_lines if last is None else last
        k, m = (int(i) for i in np.searchsorted(self.place, (first, last)))
        echo = np.zeros((last - first, self.n_cells), np.complex64)
        for begin, end in _spans(m - k, self.n_cells):
            own = slice(k + begin, k + end)
            echo[self.place[own] - first] = self.lines.read(own.start, own.stop)
        return echo

    def blocks(self) -> Iterator[tuple[int, ComplexArray]]:
        """Echo block by block: the number of the first line, from 0, and its lines."""
        for first, last in _spans(self.n_lines, self.n_cells):
            yield first, self.read(first, last)

    def states(self) -> tuple[FloatArray, FloatArray]:
        """Earth-fixed position [m] and velocity [m/s] at every line, two (n_lines, 3).

        Raises
        ------
        ValueError
            If the recording has no orbit or no times, or they do not meet.
        """
        orbit, times = self._located()
        return orbit.at(times)

    @property
    def start(self) -> float:
        """When its first line was sent, after the first state of its orbit [s].

        Raises
        ------
        ValueError
            If the recording has no orbit or no times.
        """
        return float(self._located()[1][0])

    def _located(self) -> tuple[Ephemeris, FloatArray]:
        """Orbit, and times of lines after its first state [s]."""
        if self.track is None or self.track.orbit is None or self.line_time is None:
            raise ValueError(f"'{self.path}' has no orbit, or no times of its lines")
        orbit = self.track.orbit
        return orbit, self.line_time + seconds(self.track.epoch - orbit.tags[0])

    def error_of_times(self, prf: float) -> float:
        """Standard error of the times of what an image of it shows [s].

        That of the times themselves, and what lines that are lost move an image by.

        Parameters
        ----------
        prf : float
            Pulse repetition frequency [Hz].
        """
        return float(np.hypot(self.time_sigma, (_MOVED / prf) if len(self.lost) else 0.0))

    def with_lost(self, line: int, n_lost: int) -> Recording:
        """The same with lines that are lost before a line, counted from 0; it and others move on.

        Raises
        ------
        ValueError
            If too many are lost.
        """
        place = np.where(self.place >= line, self.place + n_lost, self.place)
        lost = np.where(self.lost > line, self.lost + n_lost, self.lost)
        lost = np.sort(np.append(lost, line + 1 + np.arange(n_lost)))
        n = int(place[-1]) + 1
        if len(lost) > MOST_LOST * n:
            raise too_many_lost(len(lost), n, int(lost[0]))
        times = self.line_time
        if times is not None:
            step = float(np.median(np.diff(times)))
            gap = times[line - 1] + step * np.arange(1, n_lost + 1)
            times = np.concatenate([times[:line], gap, times[line:] + n_lost * step])
        slips = tuple(k + n_lost if k > line else k for k in self.slips if k != line)
        return replace(self, place=place, lost=lost, line_time=times, slips=slips)

    def slipped(self) -> str:
        """Where lines slipped, and what can be done about it; empty if none did."""
        if not self.slips:
            return ""
        k = self.slips[0]
        return (
            f"lines {k} and {k + 1} are no neighbors, as others are: lines between them are lost"
            f"\n  {self.cure}"
        )

    def told(self) -> str:
        """What was lost, for messages; empty if nothing was."""
        if not len(self.lost):
            return ""
        return (
            f"{len(self.lost)} of its {self.n_lines} lines are lost, the first is line "
            f"{self.lost[0]}: they are taken as zeros"
        )


def seconds(span: np.timedelta64) -> float:
    """Seconds of a span of nanoseconds."""
    return float(span / np.timedelta64(1, "ns")) * 1e-9


def looked_through(lines: Lines) -> Neighbors:
    """Look through lines once: how alike neighbors are, and which are zero.

    Raises
    ------
    ValueError
        If a line is not finite.
    """
    n, n_cells = lines.shape
    neighbors = Neighbors(n_cells)
    for first, last in _spans(n, n_cells):
        block = lines.read(first, last)
        if not np.isfinite(block.sum()):
            line = first + int(np.argmin(np.isfinite(block).all(axis=1)))
            raise ValueError(f"line {line + 1} of its {n} is not finite")
        neighbors.take(block)
    return neighbors


def lost_lines(neighbors: Neighbors, place: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers of the lost ones of lines that were looked through, counted from 1.

    Parameters
    ----------
    neighbors : Neighbors
    place : ndarray of int, shape (n,)
        Line of the recording that each of them is, counted from 0.

    Raises
    ------
    ValueError
        If more than `MOST_LOST` of them are missing.
    """
    there = np.zeros(int(place[-1]) + 1, np.bool_)
    there[place] = neighbors.there
    n_lost = int(np.sum(~there))
    if n_lost > MOST_LOST * len(there):
        raise too_many_lost(n_lost, len(there), int(np.argmin(there)) + 1)
    return np.flatnonzero(~there) + 1


def _spans(n: int, n_cells: int) -> Iterator[tuple[int, int]]:
    step = max(1, _BLOCK // n_cells)
    return ((k, min(k + step, n)) for k in range(0, n, step))
