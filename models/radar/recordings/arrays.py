"""Recorded raw echo in a file of NumPy (.npz).

The arrays are ``i`` and ``q`` (n_lines, n_cells) of integers or floats, or ``echo`` of complex
numbers; ``first_rg_line`` and ``first_rg_cell``, the numbers of its first line and cell in the
recording that it is part of, counted from 1; and, where the receiver's gain was switched,
``agc_db`` (n_lines,), its attenuation. Where lines were lost, ``line_number`` (n_lines,) or
``line_time_s`` (n_lines,) says which are there; those between are filled with zeros, as are lines
that the file itself holds as zeros.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, FloatArray, Single, read_arrays
from terrafix.models.radar.chirp import gain_of
from terrafix.models.radar.recordings.lines import (
    on_grid,
    places_by_number,
    places_by_time,
    slips_among,
)
from terrafix.models.radar.recordings.recording import (
    WHAT,
    Recording,
    looked_through,
    lost_lines,
)

PLACE = ("first_rg_line", "first_rg_cell")
_SLIPPED = "give it the number of every line (line_number), or its time (line_time_s)"
_OPTIONAL = ("echo", "i", "q", "agc_db", "line_number", "line_time_s")


class ArrayLines:
    """Lines of arrays, which stay as narrow as they are in the file.

    Parameters
    ----------
    parts : sequence of ndarray, each (n_lines, n_cells)
        In-phase and quadrature, or one of complex numbers.
    gain : ndarray of float32, shape (n_lines,), optional
    """

    def __init__(self, parts: tuple[NDArray[Any], ...], gain: Single | None) -> None:
        self.shape: tuple[int, int] = (parts[0].shape[0], parts[0].shape[1])
        self._parts, self._gain = parts, gain

    def read(self, first: int, last: int) -> ComplexArray:
        """Lines `first` to `last - 1`."""
        parts = [part[first:last] for part in self._parts]
        echo = np.empty(parts[0].shape, np.complex64)
        if len(parts) == 2:
            echo.real, echo.imag = parts
        else:
            echo[...] = parts[0]
        return echo if self._gain is None else echo * self._gain[first:last, None]


def read_npz(path: Path) -> Recording:
    """Read recorded echo (.npz).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged, lacks an array, more than `lines.MOST_LOST` of its lines are missing, or
        it holds what is no echo.
    """
    arrays = read_arrays(path, PLACE, WHAT, optional=_OPTIONAL)
    try:
        parts = _parts(arrays)
        n = len(parts[0])
        gain = gain_of(arrays["agc_db"], n) if "agc_db" in arrays else None
        first = [_number(arrays[k], k) for k in PLACE]
        place, times = _places(arrays, n)
        lines = ArrayLines(parts, gain)
        neighbors = looked_through(lines)
        lost = lost_lines(neighbors, place)
    except ValueError as error:
        raise ValueError(f"'{path}' is not {WHAT}: {error}") from error
    slips = slips_among(neighbors, place)
    return Recording(
        *(path, lines, place, lost, times, first[0], first[1]), slips=slips, cure=_SLIPPED
    )


def _places(arrays: dict[str, NDArray[Any]], n: int) -> tuple[NDArray[np.intp], FloatArray | None]:
    """Where each of n lines belongs, counted from 0, by its number or time; and all times."""
    times = _of_lines(arrays, "line_time_s", n)
    numbers = _of_lines(arrays, "line_number", n)
    if numbers is not None:
        first = _number(arrays[PLACE[0]], PLACE[0])
        if numbers[0] != first:
            raise ValueError(f"'line_number' begins with {numbers[0]:g}, '{PLACE[0]}' is {first}")
        place = places_by_number(numbers, "line_number")
    elif times is not None:
        place = places_by_time(times, "line_time_s")
    else:
        place = np.arange(n)
    if times is None:
        return place, None
    if numbers is not None and not np.array_equal(place, places_by_time(times, "line_time_s")):
        raise ValueError("'line_number' and 'line_time_s' do not agree where lines were lost")
    return place, on_grid(times, place)


def _of_lines(arrays: dict[str, NDArray[Any]], name: str, n: int) -> FloatArray | None:
    if name not in arrays:
        return None
    values = np.asarray(arrays[name], np.float64)
    if values.shape != (n,):
        raise ValueError(f"'{name}' has shape {values.shape}, for {n} lines")
    return values


def _parts(arrays: dict[str, NDArray[Any]]) -> tuple[NDArray[Any], ...]:
    if "echo" in arrays:
        parts: tuple[NDArray[Any], ...] = (arrays["echo"],)
    elif "i" in arrays and "q" in arrays:
        parts = (arrays["i"], arrays["q"])
        if parts[0].shape != parts[1].shape:
            raise ValueError(f"'i' has shape {parts[0].shape}, 'q' has {parts[1].shape}")
    else:
        raise ValueError("it has neither 'echo' nor 'i' and 'q'")
    if parts[0].ndim != 2 or min(parts[0].shape) < 2:
        raise ValueError(f"it has shape {parts[0].shape}, not lines and cells")
    return parts


def _number(value: NDArray[Any], name: str) -> int:
    if value.size != 1 or not np.isfinite(value).all() or value != np.rint(value) or value < 1:
        raise ValueError(f"'{name}' is {value}, not a number counted from 1")
    return int(value)
