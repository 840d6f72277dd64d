"""Epochs as files tag them: time scales, the texts of calendars, and atomic time of both.

GPS time is 19 s behind TAI and terrestrial time 32.184 s ahead of it; between UTC and TAI lie the
leap seconds, of the table in pyerfa.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray

SCALES = ("UTC", "GPS", "TAI", "TT")
"""Time scales that are read."""
INSTALL = "pip install terrafix[truth]"

_BEHIND = {"TAI": 0, "GPS": 19_000_000_000, "TT": -32_184_000_000}
"""Of TAI, in nanoseconds."""
_WRITTEN = re.compile(
    r"(\d{4})-(?:(\d\d)-(\d\d)|(\d{3}))[T ](\d\d):(\d\d):(\d\d)(?:\.(\d+))?Z?", re.ASCII
)
_SECOND, _DAY = np.timedelta64(1, "s"), np.timedelta64(1, "D")
_MJD0 = np.datetime64("1858-11-17", "ns")


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


def atomic(
    tags: NDArray[np.datetime64], within: NDArray[np.bool_], scale: str
) -> NDArray[np.datetime64]:
    """TAI of tags (n,) in a time scale.

    Raises
    ------
    ValueError
        If a tag is 23:59:60 where there is no leap second.
    ModuleNotFoundError
        If leap seconds are needed, and pyerfa is not installed.
    """
    if scale != "UTC":
        return np.asarray(tags + np.timedelta64(_BEHIND[scale], "ns"))
    leap = leap_seconds(tags)
    before = leap_seconds(tags - within * _SECOND)
    wrong = within & (leap == before)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(f"there is no leap second before {tags[k].astype('datetime64[D]')}")
    counted = np.where(within, before, leap)
    return np.asarray(tags + counted.astype("timedelta64[s]"))


def leap_seconds(utc: NDArray[np.datetime64]) -> NDArray[np.int64]:
    """Whole seconds that TAI is ahead of UTC, (n,), from 1972 on.

    Raises
    ------
    ValueError
        If an epoch is before 1972.
    ModuleNotFoundError
        If pyerfa is not installed.
    """
    try:
        erfa = import_module("erfa")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"leap seconds between UTC and TAI need pyerfa\n  {INSTALL}"
        ) from error
    table = erfa.leap_seconds.get()
    since = [f"{row['year']:04d}-{row['month']:02d}-01" for row in table]
    starts = np.array(since, "datetime64[ns]")
    k = np.searchsorted(starts, utc, side="right") - 1
    whole = table["tai_utc"]
    first = int(np.argmax(whole == np.round(whole)))
    if np.any(k < first):
        raise ValueError(f"UTC before {since[first]} has no whole leap seconds")
    return np.asarray(whole[k], np.int64)


def seconds_since_first(
    tags: NDArray[np.datetime64], within: NDArray[np.bool_], scale: str
) -> FloatArray:
    """Seconds of tags (n,) since the first; the leap-second table is asked where it may matter."""
    half_years = np.unique(tags.astype("datetime64[M]")).astype("datetime64[M]").astype(int) // 6
    if scale != "UTC" or (len(np.unique(half_years)) == 1 and not within.any()):
        return np.asarray((tags - tags[:1]).astype(np.int64) / 1e9)
    tai = atomic(tags, within, scale)
    return np.asarray((tai - tai[:1]).astype(np.int64) / 1e9)


def instant(text: str) -> tuple[int, float]:
    """TAI of an epoch, "2022-09-18T07:49:21.5 UTC", as modified Julian day and seconds of it.

    Raises
    ------
    ValueError
        If it is no epoch, or has no time scale that is read.
    ModuleNotFoundError
        If it is UTC, and pyerfa is not installed.
    """
    written, _, scale = text.strip().rpartition(" ")
    if not written:
        raise ValueError(f"'{text}' has no time scale; write 2022-09-18T07:49:21.5 UTC")
    scale = scale_named(scale)
    return day_and_seconds(atomic(*read_tags([written], scale), scale)[0])


def day_and_seconds(tai: np.datetime64) -> tuple[int, float]:
    """Modified Julian day, and seconds of it."""
    day, rest = divmod(int((tai - _MJD0).astype(np.int64)), 86_400 * 10**9)
    return day, rest / 1e9
