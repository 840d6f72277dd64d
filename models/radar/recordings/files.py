"""One recording of a file of any format that is read, and what other files are."""

from __future__ import annotations

from pathlib import Path

from terrafix.models.core.formats import ARCHIVE, CEOS_DATA, HDF5, kind_of
from terrafix.models.radar.recordings.arrays import read_npz
from terrafix.models.radar.recordings.nisar import read_l0b
from terrafix.models.radar.recordings.recording import FORMATS, IMAGE, WHAT, Recording

_PICTURES = ("TIFF", "picture", "JPEG")
_MATLAB = (
    "phase history of an aircraft, which is compressed already, is for 'recorded_spotlight' "
    "(examples/aircraft_gotcha.toml)"
)
_CEOS_LEVEL = slice(400, 440)
"""Where the first record of a CEOS file of lines says what its samples are."""


def read_recording(path: Path, channel: str = "") -> Recording:
    """Read recorded echo: arrays of NumPy (.npz), or NISAR L0B (HDF5).

    Parameters
    ----------
    path : Path
    channel : str
        Which one, ``"A/HH"`` say, where a file has several.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or of another kind, more than `lines.MOST_LOST` of its lines are missing,
        lines have slipped, or it holds what is no echo; the message names the file.
    """
    if path.is_dir():
        raise FileNotFoundError(f"'{path}' is a folder\n  name the file in it that holds the echo")
    found, cure = kind_of(path) if path.is_file() else ("", "")
    if found == HDF5:
        return read_l0b(path, channel)
    if found and found != ARCHIVE:
        told = "".join(f"\n  {line}" for line in (*_advice(path, found), FORMATS, cure))
        raise ValueError(f"'{path}' is not {WHAT}: it is {found}{told}")
    if channel:
        raise ValueError(f"'{path}' has no channels: '{channel}' need not be named")
    return read_npz(path)


def _advice(path: Path, found: str) -> list[str]:
    """What is known of echo, besides, of a kind of file."""
    if any(word in found for word in _PICTURES):
        return [f"if it is {IMAGE}"]
    if "MATLAB" in found:
        return [_MATLAB]
    if found == CEOS_DATA:
        with path.open("rb") as file:
            samples = file.read(_CEOS_LEVEL.stop)[_CEOS_LEVEL]
        if b"C*8" in samples or b"COMPLEX*8" in samples:
            return [f"its samples are COMPLEX*8: it is {IMAGE} (level 1.1)"]
    return []
