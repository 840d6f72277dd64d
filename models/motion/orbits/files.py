"""One ephemeris of a file of any format that is read, by what the file begins with."""

from __future__ import annotations

from pathlib import Path

from terrafix.models.core.formats import CEOS_LEADER, HDF5, kind_of
from terrafix.models.motion.ephemeris import Ephemeris, read_eof
from terrafix.models.motion.orbits.hdf5 import read_hdf5
from terrafix.models.motion.orbits.leader import read_leader
from terrafix.models.motion.orbits.oem import read_oem
from terrafix.models.motion.orbits.sp3 import read_sp3
from terrafix.models.motion.orbits.table import read_table

FORMATS = "OEM, SP3-c, SP3-d, EOF, a table (.csv), a NISAR product (HDF5), or a leader of CEOS"
OF_MANY = ("oem", "sp3")
"""Formats that may hold several satellites."""


def format_of(path: Path) -> str:
    """What format a file is in: "oem", "sp3", "eof", "hdf5", "leader" or "table".

    Raises
    ------
    ValueError
        If it is none that is read.
    OSError
        If it cannot be read.
    """
    if path.suffix.lower() == ".eof":
        return "eof"
    with path.open("rb") as file:
        head = file.read(4096).lstrip(b"\xef\xbb\xbf \r\n\t")
    if head.startswith(b"CCSDS_OEM_VERS") or (head[:1] == b"<" and b"<oem" in head):
        return "oem"
    if head[:2] in (b"#c", b"#d", b"#a", b"#b") and head[2:3] in (b"P", b"V"):
        return "sp3"
    if b"<Earth_Explorer_File" in head:
        return "eof"
    if path.suffix.lower() == ".csv":
        return "table"
    found, _ = kind_of(path)
    if found == HDF5:
        return "hdf5"
    if found == CEOS_LEADER:
        return "leader"
    raise ValueError(f"it is {found or 'of a kind that is not known'}; read are {FORMATS}")


def read_orbit(path: str | Path, satellite: str = "") -> Ephemeris:
    """Read an orbit file: OEM, SP3, EOF, a table (.csv), NISAR's HDF5, or a leader of CEOS.

    Parameters
    ----------
    path : str or Path
    satellite : str
        Which satellite, where a file holds several.

    Raises
    ------
    ValueError
        If the file is of another kind, truncated or damaged, its epochs do not increase or are of
        several time scales, its frame is not read, or its states cannot be a satellite's; the
        message names the file.
    ImportError
        If leap seconds or frames are needed, and the extra ``truth`` is not installed.
    OSError
        If it cannot be read.
    """
    path = Path(path)
    try:
        kind = format_of(path)
        if satellite and kind not in OF_MANY:
            raise ValueError(f"it holds one satellite: '{satellite}' need not be named")
        if kind == "eof":
            return read_eof(path)
        if kind == "hdf5":
            return read_hdf5(path)
        if kind == "leader":
            return read_leader(path)
        if kind == "oem":
            return read_oem(path, satellite).ephemeris()
        return (read_sp3(path, satellite) if kind == "sp3" else read_table(path)).ephemeris()
    except ImportError as error:
        raise ImportError(f"{path}: {error}") from error
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: {error}") from error
