r"""Time scales: TAI inside, UTC, GPS, TT and UT1 at the edges.

.. math::
    \mathrm{TT} = \mathrm{TAI} + 32.184\,\mathrm{s}, \qquad
    \mathrm{GPS} = \mathrm{TAI} - 19\,\mathrm{s}, \qquad
    \mathrm{UTC} = \mathrm{TAI} - \Delta_{AT}, \qquad
    \mathrm{UT1} = \mathrm{UTC} + \mathrm{DUT1},

with the whole seconds :math:`\Delta_{AT}` of the table of leap seconds. An instant is a modified
Julian day and seconds of it, so that a time of day keeps 1.5e-11 s. In UTC the last day before a
leap second has 86 401 s.

UT1 - TAI is continuous and interpolated linearly between the daily values of the IERS, hence right
on the day of a leap second too. Its variation within a day by ocean tides, up to 0.05 ms or 25 mm
on the equator, is left out.

References
----------
.. [1] G. Petit, B. Luzum (eds.), "IERS Conventions (2010)", IERS Technical Note 36, ch. 5 and 10.
.. [2] ITU-R TF.460-6, "Standard-frequency and time-signal emissions", annex 1.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.iers import (
    MJD_ZERO,
    UPDATE,
    IntArray,
    date_of,
    leap_seconds,
    orientation_table,
)

SCALES = ("TAI", "UTC", "GPS", "TT", "UT1")
"""Names of time scales."""

DAY = 86400.0
"""[s]"""

_FROM_TAI = {"TAI": 0.0, "GPS": -19.0, "TT": 32.184}
_WRITTEN = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d):(\d\d):(\d\d(?:\.\d*)?) ?(Z|[A-Za-z]\w*)?", re.ASCII
)
_EXAMPLE = '"2022-09-18T07:49:21.5 UTC"'


@dataclass(frozen=True)
class Instant:
    """A point of time in TAI, or many.

    Parameters
    ----------
    day : int or ndarray of int64, shape (...)
        Modified Julian day.
    seconds : float or ndarray, shape (...)
        Of this day, in [0, 86400) [s].
    """

    day: Any
    seconds: Any

    def plus(self, t: ArrayLike) -> Instant:
        """The instant(s) `t` seconds later, shape (...)."""
        return tai_from("TAI", self.day, np.asarray(self.seconds) + np.asarray(t, np.float64))

    def minus(self, other: Instant) -> Any:
        """Seconds from another instant to this one, leap seconds counted, shape (...)."""
        return (self.day - other.day) * DAY + (self.seconds - other.seconds)

    def to(self, scale: str) -> tuple[Any, Any]:
        """Modified Julian day and seconds of it in a scale of `SCALES`.

        Within a leap second, UTC has seconds from 86400 on.

        Raises
        ------
        ValueError
            If it is not known then: UTC and UT1 outside the tables.
        ImportError
            If the tables are needed and not installed.
        """
        _check_scale(scale)
        day, seconds = _arrays(self.day, self.seconds)
        if scale == "UTC":
            return _plain(*_utc(day, seconds))
        shift = ut1_minus_tai(self)[0] if scale == "UT1" else _FROM_TAI[scale]
        return _plain(*_normal(day, seconds + shift))

    def text(self, scale: str = "UTC", digits: int = 6) -> str:
        """Write one instant as `parse_epoch` reads it, to `digits` decimals of a second."""
        unit = 10**digits
        day, seconds = self.to(scale)
        length = int(DAY) + (int(leap_at_end(np.asarray(day))) if scale == "UTC" else 0)
        whole, part = divmod(round(seconds * unit), unit)
        if whole >= length:
            day, whole = day + 1, 0
        minutes = min(whole // 60, 24 * 60 - 1)  # a leap second belongs to the last minute
        written = f"{minutes // 60:02d}:{minutes % 60:02d}:{whole - 60 * minutes:02d}"
        decimals = f".{part:0{digits}d}" if digits else ""
        return f"{date_of(day)}T{written}{decimals} {scale}"


def parse_epoch(text: str) -> Instant:
    """Read an epoch with its time scale: "2022-09-18T07:49:21.5 UTC" (or Z, GPS, TT, TAI, UT1).

    Raises
    ------
    ValueError
        If it is no such text, names no time scale or an unknown one, has a second 60 where there
        is none, or lies outside the tables of its scale.
    ImportError
        If the tables are needed and not installed.
    """
    found = _WRITTEN.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"'{text}' is no epoch\n  write date, time and time scale: {_EXAMPLE}")
    date, hour, minute, second, scale = found.groups()
    if scale is None:
        raise ValueError(
            f"the epoch '{text}' has no time scale: UTC and GPS differ by 18 s\n"
            f"  write it behind: {_EXAMPLE}; there are {', '.join(SCALES)}"
        )
    scale = "UTC" if scale == "Z" else scale
    try:
        _check_scale(scale)
    except ValueError as error:
        raise ValueError(f"the epoch '{text}': {error}") from None
    try:
        day = int((np.datetime64(date, "D") - MJD_ZERO).astype(int))
    except ValueError:
        raise ValueError(f"the epoch '{text}': there is no {date}") from None
    h, m, s = int(hour), int(minute), float(second)
    if h > 23 or m > 59 or s >= 61:
        raise ValueError(f"the epoch '{text}' has no such time of day")
    if s >= 60:
        if scale != "UTC":
            raise ValueError(f"the epoch '{text}' has a second 60, which {scale} never has")
        if (h, m) != (23, 59) or not leap_at_end(np.asarray(day)):
            listed = leap_seconds().day[1:] - 1
            nearest = date_of(listed[np.argmin(np.abs(listed - day))])
            raise ValueError(
                f"the epoch '{text}' does not exist: there was no leap second\n"
                f"  the nearest one was {nearest}T23:59:60 UTC"
            )
    try:
        return tai_from(scale, day, 3600.0 * h + 60.0 * m + s)
    except ValueError as error:
        raise ValueError(f"the epoch '{text}': {error}") from error


def tai_from(scale: str, day: ArrayLike, seconds: ArrayLike) -> Instant:
    """Instant(s) of modified Julian days and seconds of them in a scale of `SCALES`, shape (...).

    Parameters
    ----------
    scale : str
    day : array_like of int
    seconds : array_like
        Need not lie within the day; UTC within a leap second is from 86400 on.

    Raises
    ------
    ValueError
        If the scale is none of `SCALES`, or UTC or UT1 is not known then.
    ImportError
        If the tables are needed and not installed.
    """
    _check_scale(scale)
    whole, rest = _arrays(day, seconds)
    if scale == "UTC":
        shift: Any = leap_seconds().at(whole)
    elif scale == "UT1":
        # UT1 - TAI changes by 4e-8 of the time between: two rounds are exact
        about = Instant(*_normal(whole, rest))
        for _ in range(2):
            about = Instant(*_normal(whole, rest - ut1_minus_tai(about)[0]))
        return Instant(*_plain(about.day, about.seconds))
    else:
        shift = -_FROM_TAI[scale]
    return Instant(*_plain(*_normal(whole, rest + shift)))


def ut1_minus_tai(instant: Instant) -> tuple[Any, Any]:
    """UT1 - TAI [s] and its rate [s/s], shape (...) each, linear between days of the IERS table.

    Raises
    ------
    ValueError
        If an instant lies outside the table.
    """
    k, part = table_place(instant)
    table = orientation_table()
    first, second = (table.ut1_utc[j] - leap_seconds().at(table.day[j]) for j in (k, k + 1))
    return first + part * (second - first), (second - first) / table_days(k)


def table_place(instant: Instant) -> tuple[IntArray, FloatArray]:
    """Where instants lie in the table of Earth orientation: row before, and part of the day since.

    Raises
    ------
    ValueError
        If an instant lies outside the table; the message says how far it reaches.
    """
    table, nodes = orientation_table(), _midnights()
    day, seconds = _arrays(instant.day, instant.seconds)
    since = (day - table.day[0]) * DAY + seconds
    outside = ~((since >= nodes[0]) & (since < nodes[-1]))
    if outside.any():
        raise ValueError(
            f"the Earth's orientation on {date_of(day[outside].flat[0])} is not known: the table "
            f"of the IERS reaches from {date_of(table.day[0])} to the start of "
            f"{date_of(table.day[-1])}\n"
            f"  {UPDATE}"
        )
    k = np.searchsorted(nodes, since, side="right") - 1
    return k, (since - nodes[k]) / (nodes[k + 1] - nodes[k])


@cache
def _midnights() -> FloatArray:
    """0 h UTC of the days of the table [s], TAI since its first day; a few are 86 401 s apart."""
    table = orientation_table()
    return np.asarray((table.day - table.day[0]) * DAY + leap_seconds().at(table.day))


def table_days(k: IntArray) -> FloatArray:
    """Length of the days of rows of the table of Earth orientation [s], leap seconds included."""
    return DAY + leap_at_end(orientation_table().day[k])


def leap_at_end(day: IntArray) -> FloatArray:
    """Leap seconds at the end of days of UTC [s], by modified Julian day: 0 or 1."""
    table = leap_seconds()
    later = np.minimum(day + 1, table.expires)
    return table.at(later) - table.at(day)


def _utc(day: IntArray, seconds: FloatArray) -> tuple[IntArray, FloatArray]:
    table = leap_seconds()
    today = seconds - table.at(day)
    before = today < 0
    earlier = np.where(before, day - 1, day)
    return earlier, np.where(before, seconds + DAY - table.at(earlier), today)


def _normal(day: IntArray, seconds: FloatArray) -> tuple[IntArray, FloatArray]:
    """Days, and seconds within them."""
    whole = np.floor(seconds / DAY)
    rest = seconds - whole * DAY
    # the rounding of a small negative number
    over = rest >= DAY
    return day + (whole + over).astype(np.int64), np.where(over, 0.0, rest)


def _arrays(day: ArrayLike, seconds: ArrayLike) -> tuple[IntArray, FloatArray]:
    whole, rest = np.broadcast_arrays(np.asarray(day, np.int64), np.asarray(seconds, np.float64))
    return whole, rest


def _plain(day: IntArray, seconds: FloatArray) -> tuple[Any, Any]:
    """Numbers where there is one."""
    return (int(day), float(seconds)) if not np.ndim(seconds) else (day, seconds)


def _check_scale(scale: str) -> None:
    if scale not in SCALES:
        raise ValueError(f"'{scale}' is no time scale; there are {', '.join(SCALES)}")
