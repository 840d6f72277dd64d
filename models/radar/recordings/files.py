"""One recording of a file of any format that is read, and what other files are."""

from __future__ import annotations

from pathlib import Path

from terrafix.models.core.formats import ARCHIVE, CEOS_DATA, CEOS_LEADER, CPHD, HDF5, kind_of
from terrafix.models.radar.recordings.arrays import read_npz
from terrafix.models.radar.recordings.ceos import read_ceos
from terrafix.models.radar.recordings.nisar import read_l0b
from terrafix.models.radar.recordings.recording import FORMATS, IMAGE, WHAT, Recording

_PICTURES = ("TIFF", "picture", "JPEG")
_PHASE_HISTORY = (
    "phase history of an aircraft, which is compressed already, is for 'recorded_spotlight' "
    "(examples/aircraft_gotcha.toml)"
)


def read_recording(path: Path, channel: str = "", *, slips: bool = False) -> Recording:
    """Read recorded echo: arrays of NumPy (.npz), NISAR L0B (HDF5), or CEOS of level 1.0.

    Parameters
    ----------
    path : Path
    channel : str
        Which one, ``"A/HH"`` say, where a file has several.
    slips : bool
        Whether lines may have slipped: `Recording.slips` says where, and
        `terrafix.models.radar.recordings.slips.without_slips` puts them right.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or of another kind, more than `lines.MOST_LOST` of its lines are missing,
        lines have slipped and must not, or it holds what is no echo; the message names the file.
    """
    recording = _read(path, channel)
    if recording.slips and not slips:
        raise ValueError(f"'{path}' is not {WHAT}: {recording.slipped()}")
    return recording


def _read(path: Path, channel: str) -> Recording:
    if path.is_dir():
        raise FileNotFoundError(f"'{path}' is a folder\n  name the file in it that holds the echo")
    found, cure = kind_of(path) if path.is_file() else ("", "")
    if found == HDF5:
        return read_l0b(path, channel)
    if channel and path.is_file() and found in ("", ARCHIVE, CEOS_DATA):
        raise ValueError(f"'{path}' has no channels: '{channel}' need not be named")
    if found == CEOS_DATA:
        return read_ceos(path)
    if found and found != ARCHIVE:
        told = "".join(f"\n  {line}" for line in (*_advice(found), FORMATS, cure))
        raise ValueError(f"'{path}' is not {WHAT}: it is {found}{told}")
    return read_npz(path)


def _advice(found: str) -> list[str]:
    """What is known of echo, besides, of a kind of file."""
    if any(word in found for word in _PICTURES):
        return [f"if it is {IMAGE}"]
    if "MATLAB" in found or found == CPHD:
        return [_PHASE_HISTORY]
    if found == CEOS_LEADER:
        return ["its lines are in the file IMG-... beside it"]
    return []
