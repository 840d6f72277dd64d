"""Recorded raw echo: lines of a radar's receiver in a file of NumPy (.npz).

The arrays are ``i`` and ``q`` (n_lines, n_cells) of integers or floats, or ``echo`` of complex
numbers; ``first_rg_line`` and ``first_rg_cell``, the numbers of its first line and cell in the
recording that it is part of, counted from 1; and, where the receiver's gain was switched,
``agc_db`` (n_lines,), its attenuation. Where lines were lost, ``line_number`` (n_lines,) or
``line_time_s`` (n_lines,) says which are there; those between are filled with zeros, as are lines
that the file itself holds as zeros.

A file that does not say so, though lines between others are lost, has slipped: what comes after is
too early. It shows where neighboring lines, which the antenna's beam makes alike, suddenly are not:
the correlation of their phases falls to nothing between two lines, and is back at the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import ComplexArray, read_arrays
from terrafix.models.radar.chirp import gain_compensated

PLACE = ("first_rg_line", "first_rg_cell")
MOST_LOST = 0.02
"""Share of lines that may be missing: an image of the others has that part of energy astray."""
_FALL = 0.5
"""Correlation of a pair of lines, relative to those about it, at which they are no neighbors: that
of RADARSAT-1's recordings does not fall below 0.6 over land; where ten lines are lost it is below
0.5 at 91 to 100 % of places, most others being water, which hardly correlates at all."""
_CERTAIN = 5.0
"""How far it must fall, in standard errors of a correlation of noise."""
_OFF_GRID = 0.25
"""How far a time may be from the grid of the others, in lines."""
_ABOUT = 65
"""Pairs of lines to compare with."""


@dataclass(frozen=True, eq=False)
class RecordedLines:
    """Lines of a recording.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_lines, n_cells)
        At baseband, with its gain compensated.
    first_line, first_cell : int
        Counted from 1.
    lost : ndarray of int, shape (n,)
        Numbers of the lines that are zero because they were lost, counted from 1 in `echo`.
    """

    echo: ComplexArray
    first_line: int
    first_cell: int
    lost: NDArray[np.intp]

    def told(self) -> str:
        """What was lost, for messages; empty if nothing was."""
        if not len(self.lost):
            return ""
        return (
            f"{len(self.lost)} of its {len(self.echo)} lines are lost, the first is line "
            f"{self.lost[0]}: they are taken as zeros"
        )


def read_recording(path: Path) -> RecordedLines:
    """Read recorded echo.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged, lacks an array, more than `MOST_LOST` of its lines are missing, lines
        have slipped, or it holds what is no echo.
    """
    what = "recorded echo"
    optional = ("echo", "i", "q", "agc_db", "line_number", "line_time_s")
    arrays = read_arrays(path, PLACE, what, optional=optional)
    try:
        echo = _complex(arrays)
        if not np.isfinite(echo.sum()):
            line = int(np.argmin(np.isfinite(echo).all(axis=1)))
            raise ValueError(f"line {line + 1} of its {len(echo)} is not finite")
        if "agc_db" in arrays:
            echo = gain_compensated(echo, arrays["agc_db"])
        first = [_number(arrays[k], k) for k in PLACE]
        place = _places(arrays, len(echo))
        n_lines = int(place[-1]) + 1
        lost = n_lines - int(np.any(echo, axis=1).sum())
        if lost > MOST_LOST * n_lines:
            there = np.zeros(n_lines, np.bool_)
            there[place] = np.any(echo, axis=1)
            raise ValueError(
                f"{lost} of its {n_lines} lines are missing (zero), the first is line "
                f"{int(np.argmin(there)) + 1}; {MOST_LOST:.0%} of them may be"
            )
        if n_lines > len(echo):
            whole = np.zeros((n_lines, echo.shape[1]), np.complex64)
            whole[place] = echo
            echo = whole
        _refuse_slips(echo)
    except ValueError as error:
        raise ValueError(f"'{path}' is not {what}: {error}") from error
    return RecordedLines(echo, first[0], first[1], np.flatnonzero(~np.any(echo, axis=1)) + 1)


def _places(arrays: dict[str, NDArray[Any]], n: int) -> NDArray[np.intp]:
    """Where each of n lines belongs, counted from 0: of its number, or of its time."""
    if "line_number" in arrays:
        name, numbers = "line_number", np.asarray(arrays["line_number"], np.float64)
        first = _number(arrays[PLACE[0]], PLACE[0])
        if numbers.shape == (n,) and numbers[0] != first:
            raise ValueError(f"'{name}' begins with {numbers[0]:g}, '{PLACE[0]}' is {first}")
    elif "line_time_s" in arrays:
        name, numbers = "line_time_s", np.asarray(arrays["line_time_s"], np.float64)
        spacing = np.median(np.diff(numbers)) if numbers.shape == (n,) else 1.0
        if spacing > 0:
            numbers = (numbers - numbers[0]) / spacing
    else:
        return np.arange(n)
    if numbers.shape != (n,):
        raise ValueError(f"'{name}' has shape {numbers.shape}, for {n} lines")
    whole = np.rint(numbers)
    if not ((np.diff(numbers) > 0).all() and np.abs(numbers - whole).max() <= _OFF_GRID):
        k = int(
            np.argmax(np.append(np.diff(numbers) <= 0, True) | (abs(numbers - whole) > _OFF_GRID))
        )
        raise ValueError(f"'{name}' does not count lines one by one: look at its element {k}")
    return np.asarray(whole - whole[0], dtype=np.intp)


def _refuse_slips(echo: ComplexArray) -> None:
    """Raise ValueError where two lines are no neighbors, though those about them are."""
    from scipy.ndimage import median_filter

    size = np.abs(echo)
    there = np.any(size, axis=1)
    phase = np.divide(echo, size, out=np.zeros_like(echo), where=size > 0)
    alike = np.einsum("ij,ij->i", phase[1:], phase[:-1].conj()) / echo.shape[1]
    total = alike.sum()
    alike = (alike * np.conj(total)).real / max(abs(total), 1e-30)
    pairs = np.flatnonzero(there[1:] & there[:-1])
    if len(pairs) < _ABOUT:
        return
    own = alike[pairs]
    usual = median_filter(own, size=_ABOUT, mode="nearest")
    fallen = (own < _FALL * usual) & ((usual - own) * np.sqrt(echo.shape[1]) > _CERTAIN)
    if fallen.any():
        k = int(pairs[np.argmax(fallen)]) + 1
        raise ValueError(
            f"lines {k} and {k + 1} are no neighbors, as others are: lines between them are lost\n"
            "  give it the number of every line (line_number), or its time (line_time_s)"
        )


def _complex(arrays: dict[str, NDArray[Any]]) -> ComplexArray:
    if "echo" in arrays:
        echo = arrays["echo"]
    elif "i" in arrays and "q" in arrays:
        i, q = arrays["i"], arrays["q"]
        if i.shape != q.shape:
            raise ValueError(f"'i' has shape {i.shape}, 'q' has {q.shape}")
        if i.ndim == 2:
            echo = np.empty(i.shape, np.complex64)
            echo.real, echo.imag = i, q
        else:
            echo = i
    else:
        raise ValueError("it has neither 'echo' nor 'i' and 'q'")
    if echo.ndim != 2 or min(echo.shape) < 2:
        raise ValueError(f"it has shape {echo.shape}, not lines and cells")
    return np.ascontiguousarray(echo, np.complex64)


def _number(value: NDArray[Any], name: str) -> int:
    if value.size != 1 or not np.isfinite(value).all() or value != np.rint(value) or value < 1:
        raise ValueError(f"'{name}' is {value}, not a number counted from 1")
    return int(value)
