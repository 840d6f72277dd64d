"""Tables of the International Earth Rotation and Reference Systems Service (IERS).

They come with the package astropy-iers-data and are read from its files, offline: leap seconds
(Leap_Second.dat) and daily Earth orientation (finals2000A.all), whose predictions reach a year
ahead of the package's date.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.extras import optional

IntArray = NDArray[np.int64]

UPDATE = "newer tables come with: pip install -U astropy-iers-data"
"""What to do where a table ends too early."""

MJD_ZERO = np.datetime64("1858-11-17", "D")
"""Day 0 of modified Julian days."""

_FIRST_DAY = datetime(1858, 11, 17, tzinfo=UTC)
_ARC_SECOND = np.pi / (180 * 3600)


def date_of(day: int | np.integer[Any]) -> str:
    """Calendar date of a modified Julian day, "2022-09-18"."""
    return str(MJD_ZERO + np.timedelta64(int(day), "D"))


@dataclass(frozen=True)
class LeapSeconds:
    """TAI - UTC, since 1972 a whole number of seconds.

    Attributes
    ----------
    day : ndarray of int64, shape (n,)
        Modified Julian days (UTC) at whose start a difference begins to hold.
    offset : ndarray, shape (n,)
        TAI - UTC from then on [s].
    expires : int
        Modified Julian day up to which none is missing.
    """

    day: IntArray
    offset: FloatArray
    expires: int

    def at(self, day: IntArray) -> FloatArray:
        """TAI - UTC [s] on days (UTC), shape (...).

        Raises
        ------
        ValueError
            If a day lies before 1972 or after the end of the table.
        """
        early, late = day < self.day[0], day > self.expires
        if early.any():
            raise ValueError(
                f"UTC of {date_of(day[early].flat[0])} is not known: leap seconds begin on "
                f"{date_of(self.day[0])}"
            )
        if late.any():
            raise ValueError(
                f"UTC of {date_of(day[late].flat[0])} is not known: leap seconds are announced "
                f"until {date_of(self.expires)}\n  {UPDATE}"
            )
        return self.offset[np.searchsorted(self.day, day, side="right") - 1]


@dataclass(frozen=True)
class Orientation:
    """Earth orientation at 0 h UTC of consecutive days, shape (n,) each.

    Attributes
    ----------
    day : ndarray of int64
        Modified Julian days (UTC).
    ut1_utc : ndarray
        UT1 - UTC [s].
    xp, yp : ndarray
        Coordinates of the pole [rad].
    dx, dy : ndarray
        Offsets of the celestial pole from the model of IAU 2006/2000A [rad]; zero where the table
        does not predict them.
    """

    day: IntArray
    ut1_utc: FloatArray
    xp: FloatArray
    yp: FloatArray
    dx: FloatArray
    dy: FloatArray


@cache
def leap_seconds() -> LeapSeconds:
    """Read the table of leap seconds.

    Raises
    ------
    ImportError
        If astropy-iers-data is not installed.
    ValueError
        If its file cannot be understood.
    """
    path = _file("IERS_LEAP_SECOND_FILE")
    text = path.read_text()
    expires = re.search(r"expires on (\d+ \w+ \d{4})", text)
    if expires is None:
        raise ValueError(f"{path}: does not say when it expires")
    last = datetime.strptime(expires[1], "%d %B %Y").replace(tzinfo=UTC)
    rows = np.loadtxt(text.splitlines(), comments="#", ndmin=2)
    return LeapSeconds(rows[:, 0].astype(np.int64), rows[:, 4], (last - _FIRST_DAY).days)


@cache
def orientation_table() -> Orientation:
    """Read the table of Earth orientation.

    Final values (Bulletin B) are taken where there are any, else those of Bulletin A, predictions
    included.

    Raises
    ------
    ImportError
        If astropy-iers-data is not installed.
    ValueError
        If its file cannot be understood.
    """
    path = _file("IERS_A_FILE")
    content = path.read_bytes()
    width = content.find(b"\n") + 1
    if not width or len(content) % width:
        raise ValueError(f"{path}: its lines are not of one length")
    lines = np.frombuffer(content, "S1").reshape(-1, width)

    def column(first: int, last: int) -> FloatArray:
        """Numbers of bytes first to last, as they are counted in ReadMe.finals2000A."""
        cut = np.ascontiguousarray(lines[:, first - 1 : last])
        text = np.char.strip(cut.view(f"S{last - first + 1}")[:, 0])
        return np.where(text == b"", b"nan", text).astype(np.float64)

    def best(final: tuple[int, int], rapid: tuple[int, int]) -> FloatArray:
        b, a = column(*final), column(*rapid)
        return np.where(np.isnan(b), a, b)

    day = column(8, 15)
    ut1_utc = best((155, 165), (59, 68))
    xp, yp = best((135, 144), (19, 27)), best((145, 154), (38, 46))
    dx, dy = best((166, 175), (98, 106)), best((176, 185), (117, 125))
    known = np.isfinite(ut1_utc) & np.isfinite(xp) & np.isfinite(yp)
    # a prediction beyond the last announced leap second is of no known UTC
    known &= day <= leap_seconds().expires
    n = int(known.sum())
    if not known[:n].all() or n < 2 or np.any(np.diff(day[:n]) != 1):
        raise ValueError(f"{path}: has gaps between its days")
    return Orientation(
        day[:n].astype(np.int64),
        ut1_utc[:n],
        xp[:n] * _ARC_SECOND,
        yp[:n] * _ARC_SECOND,
        np.nan_to_num(dx[:n]) * 1e-3 * _ARC_SECOND,
        np.nan_to_num(dy[:n]) * 1e-3 * _ARC_SECOND,
    )


def _file(name: str) -> Path:
    return Path(getattr(optional("astropy_iers_data", "an epoch"), name))
