"""Epochs as files tag them: time scales, the texts of calendars, and atomic time of both."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.iers import MJD_ZERO
from terrafix.models.core.timescales import Instant, leap_at_end, tai_from

SCALES = ("UTC", "GPS", "TAI", "TT")
"""Time scales that are read: all but UT1."""

_WRITTEN = re.compile(
    r"(\d{4})-(?:(\d\d)-(\d\d)|(\d{3}))[T ](\d\d):(\d\d):(\d\d)(?:\.(\d+))?Z?", re.ASCII
)
_SECOND, _DAY = np.timedelta64(1, "s"), np.timedelta64(1, "D")


def scale_named(name: str) -> str:
    """A time scale that is read.

    Raises
    ------
    ValueError
        If it is none.
    """
    if name.strip().upper() not in SCALES:
        raise ValueError(f"its time scale is '{name}', read are {', '.join(SCALES)}")
    return name.strip().upper()


def read_tags(texts: Sequence[str], scale: str) -> tuple[NDArray[np.datetime64], NDArray[np.bool_]]:
    """Epochs (n,) written as 2022-09-18T05:31:55.47 or 2022-261T05:31:55.47.

    Returns
    -------
    tags : ndarray of datetime64[ns], shape (n,)
        Within a leap second, the tag of the second after it.
    within : ndarray of bool, shape (n,)
        Which are within a leap second, 23:59:60 of UTC.

    Raises
    ------
    ValueError
        If one is not an epoch, or is 23:59:60 in another scale than UTC.
    """
    tags = np.empty(len(texts), "datetime64[ns]")
    within = np.zeros(len(texts), np.bool_)
    for k, text in enumerate(texts):
        tags[k], within[k] = _read(text, scale)
    return tags, within


def _read(text: str, scale: str) -> tuple[np.datetime64, bool]:
    found = _WRITTEN.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"'{text}' is no epoch; written is 2022-09-18T05:31:55.47")
    year, month, day, of_year, hour, minute, second, fraction = found.groups()
    leap = scale == "UTC" and (hour, minute, second) == ("23", "59", "60")
    try:
        if of_year is None:
            date = np.datetime64(f"{year}-{month}-{day}", "ns")
        else:
            date = np.datetime64(f"{year}-01-01", "ns") + (int(of_year) - 1) * _DAY
            if str(date)[:4] != year:
                raise ValueError(of_year)
        clock = np.datetime64(f"2000-01-01T{hour}:{minute}:{'59' if leap else second}", "ns")
    except ValueError as error:
        raise ValueError(f"'{text}' is no epoch of {scale}") from error
    since = clock - np.datetime64("2000-01-01", "ns") + leap * _SECOND
    nanoseconds = np.timedelta64(int((fraction or "0")[:9].ljust(9, "0")), "ns")
    return date + since + nanoseconds, leap


def atomic(tags: NDArray[np.datetime64], within: NDArray[np.bool_], scale: str) -> Instant:
    """Instants of tags (n,) in a time scale.

    Raises
    ------
    ValueError
        If a tag is 23:59:60 where there is no leap second, or the table does not reach it.
    ImportError
        If leap seconds are needed, and their table is not installed.
    """
    # a leap second belongs to the day before
    days = (tags - within * _SECOND - MJD_ZERO) // _DAY
    seconds = (tags - MJD_ZERO - days * _DAY).astype(np.int64) / 1e9
    day = days.astype(np.int64)
    found = tai_from(scale, day, seconds)
    if within.any():
        wrong = within & (leap_at_end(day) == 0)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(f"there is no leap second before {tags[k].astype('datetime64[D]')}")
    return found


def utc_tag(instant: Instant) -> np.datetime64:
    """Tag of one instant in UTC; within a leap second, that of the second after it.

    Raises
    ------
    ValueError
        If the table of leap seconds does not reach it.
    ImportError
        If that table is not installed.
    """
    day, seconds = instant.to("UTC")
    found: np.datetime64 = MJD_ZERO + day * _DAY + np.timedelta64(round(seconds * 1e9), "ns")
    return found


def seconds_since_first(
    tags: NDArray[np.datetime64], within: NDArray[np.bool_], scale: str
) -> FloatArray:
    """Seconds of tags (n,) since the first; the leap-second table is asked where it may matter."""
    half_years = np.unique(tags.astype("datetime64[M]").astype(int) // 6)
    if scale != "UTC" or (len(half_years) == 1 and not within.any()):
        return np.asarray((tags - tags[:1]).astype(np.int64) / 1e9)
    tai = atomic(tags, within, scale)
    return np.asarray(tai.minus(Instant(tai.day[0], tai.seconds[0])))
