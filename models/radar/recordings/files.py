"""One recording of a file of any format that is read."""

from __future__ import annotations

from pathlib import Path

from terrafix.models.radar.recordings.arrays import read_npz
from terrafix.models.radar.recordings.recording import Recording


def read_recording(path: Path) -> Recording:
    """Read recorded echo.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or of another kind, more than `lines.MOST_LOST` of its lines are missing,
        lines have slipped, or it holds what is no echo; the message names the file.
    """
    return read_npz(path)
