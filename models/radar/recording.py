"""Recorded raw echo: lines of a radar's receiver in a file of NumPy (.npz).

The arrays are ``i`` and ``q`` (n_lines, n_cells) of integers or floats, or ``echo`` of complex
numbers; ``first_rg_line`` and ``first_rg_cell``, the numbers of its first line and cell in the
recording that it is part of, counted from 1; and, where the receiver's gain was switched,
``agc_db`` (n_lines,), its attenuation.
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


@dataclass(frozen=True, eq=False)
class RecordedLines:
    """Lines of a recording.

    Parameters
    ----------
    echo : ndarray of complex64, shape (n_lines, n_cells)
        At baseband, with its gain compensated.
    first_line, first_cell : int
        Counted from 1.
    """

    echo: ComplexArray
    first_line: int
    first_cell: int


def read_recording(path: Path) -> RecordedLines:
    """Read recorded echo.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged, lacks an array, lines are missing, or it holds what is no echo.
    """
    what = "recorded echo"
    arrays = read_arrays(path, PLACE, what, optional=("echo", "i", "q", "agc_db"))
    try:
        echo = _complex(arrays)
        if not np.isfinite(echo.sum()):
            line = int(np.argmin(np.isfinite(echo).all(axis=1)))
            raise ValueError(f"line {line + 1} of its {len(echo)} is not finite")
        silent = ~np.any(echo, axis=1)
        if silent.any():
            raise ValueError(
                f"{int(silent.sum())} of its {len(echo)} lines are missing (zero), the first is "
                f"line {int(np.argmax(silent)) + 1}"
            )
        if "agc_db" in arrays:
            echo = gain_compensated(echo, arrays["agc_db"])
        first = [_number(arrays[k], k) for k in PLACE]
    except ValueError as error:
        raise ValueError(f"'{path}' is not {what}: {error}") from error
    return RecordedLines(echo, *first)


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
