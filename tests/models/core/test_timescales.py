"""Time scales: leap seconds, GPS, TT and UT1, and what is refused."""

import sys

import erfa
import numpy as np
import pytest

from terrafix.models.core import timescales
from terrafix.models.core.iers import date_of, leap_seconds
from terrafix.models.core.timescales import (
    SCALES,
    Instant,
    parse_epoch,
    tai_from,
    ut1_minus_tai,
)

NEW_YEAR = 57754  # 2017-01-01


def test_leap_seconds_are_those_of_erfa():
    """TAI - UTC of every half-year since 1972 (ERFA 2.0.1: 10 s to 37 s)."""
    table = leap_seconds()
    days = np.arange(41317, 61000)
    dates = [date_of(day).split("-") for day in days[::181]]
    year, month, day = np.array(dates, dtype=np.int64).T
    np.testing.assert_array_equal(table.at(days[::181]), erfa.dat(year, month, day, 0.0))
    assert len(table.day) == 28


def test_the_leap_second_of_2016_is_a_second_of_its_own():
    before, within, after = (
        parse_epoch(f"{text} UTC")
        for text in ("2016-12-31T23:59:59.5", "2016-12-31T23:59:60.5", "2017-01-01T00:00:00.5")
    )
    assert within.minus(before) == after.minus(within) == 1.0
    assert within == Instant(NEW_YEAR, 36.5)  # TAI - UTC was 36 s
    assert within.to("UTC") == (NEW_YEAR - 1, 86400.5)
    assert within.text(digits=1) == "2016-12-31T23:59:60.5 UTC"


def test_a_run_across_a_leap_second_counts_it():
    start = parse_epoch("2016-12-31T23:59:58 UTC")
    written = [start.plus(t).text(digits=0) for t in range(5)]
    days = ["2016-12-31"] * 3 + ["2017-01-01"] * 2
    clock = ["23:59:58", "23:59:59", "23:59:60", "00:00:00", "00:00:01"]
    assert written == [f"{d}T{c} UTC" for d, c in zip(days, clock, strict=True)]
    many = start.plus(np.arange(5.0))
    np.testing.assert_array_equal(many.to("UTC")[1], [86398, 86399, 86400, 0, 1])
    np.testing.assert_array_equal(many.minus(start), np.arange(5.0))


@pytest.mark.parametrize(
    ("text", "scale", "other"),
    [
        # IERS Conventions: TT = TAI + 32.184 s; GPS time began as UTC on 6 January 1980
        ("1980-01-06T00:00:00 UTC", "GPS", "1980-01-06T00:00:00.000000 GPS"),
        ("2022-09-18T07:49:21.5 UTC", "GPS", "2022-09-18T07:49:39.500000 GPS"),
        ("2022-09-18T07:49:21.5Z", "TT", "2022-09-18T07:50:30.684000 TT"),
        ("2016-12-31T23:59:60 UTC", "GPS", "2017-01-01T00:00:17.000000 GPS"),
        ("2022-09-18 07:50:30.684 TT", "UTC", "2022-09-18T07:49:21.500000 UTC"),
        ("1999-12-31T23:59:59.9999999 TAI", "TAI", "2000-01-01T00:00:00.000000 TAI"),
    ],
)
def test_one_scale_in_another(text, scale, other):
    assert parse_epoch(text).text(scale) == other


def test_ut1_is_the_table_at_midnight_and_continuous_across_a_leap_second():
    """IERS Bulletin B of January 2017: UT1 - UTC on 31 December and on 1 January."""
    for day, ut1_utc, offset in ((NEW_YEAR - 1, -0.40776, 36), (NEW_YEAR, 0.5912975, 37)):
        midnight = tai_from("UTC", day, 0.0)
        assert ut1_minus_tai(midnight)[0] == pytest.approx(ut1_utc - offset, abs=1e-12)
    t = np.array([0.0, 43200.0, 86400.5, 86401.0])
    difference, rate = ut1_minus_tai(tai_from("UTC", NEW_YEAR - 1, t))
    # the day was 0.9425 ms longer than 86400 s of UT1, and had 86401 s
    np.testing.assert_allclose(rate[:3], -0.0009425 / 86401, rtol=1e-9)
    np.testing.assert_allclose(difference, -36.40776 - 0.0009425 / 86401 * t, atol=1e-12)


def test_every_scale_there_and_back():
    instants = parse_epoch("2016-12-30T00:00:00 UTC").plus(np.linspace(0, 3 * 86400, 997))
    for scale in SCALES:
        back = tai_from(scale, *instants.to(scale))
        np.testing.assert_allclose(back.minus(instants), 0.0, atol=3e-11, err_msg=scale)


def test_a_time_of_day_keeps_its_picoseconds():
    """Spacing of floats at 86400 s: 1.5e-11 s."""
    a = parse_epoch("2022-09-18T23:59:00.123456789 UTC")
    assert a.plus(1e-10).minus(a) == pytest.approx(1e-10, abs=1.5e-11)
    late = Instant(1, 0.0).plus(-1e-12)  # 86400 s less that is 86400 s
    assert (late.day, late.seconds) == (1, 0.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("2015-12-31T23:59:60 UTC", "nearest one was 2015-06-30T23:59:60 UTC"),
        ("2016-12-31T22:59:60 UTC", "nearest one was 2016-12-31T23:59:60 UTC"),
        ("2016-12-31T23:59:60 GPS", "which GPS never has"),
        ("2016-12-31T23:59:61 UTC", "no such time of day"),
        ("2022-09-18T07:49:21.5", "has no time scale: UTC and GPS differ by 18 s"),
        ("2022-09-18T07:49:21.5 GMT", "'GMT' is no time scale; there are TAI, UTC, GPS"),
        ("2022-02-30T00:00:00 UTC", "the epoch '2022-02-30T00:00:00 UTC'"),
        ("18 September 2022", "write date, time and time scale"),
        ("1971-12-31T00:00:00 UTC", "leap seconds begin on 1972-01-01"),
        ("2099-01-01T00:00:00 UTC", "leap seconds are announced until 20"),
        ("2099-01-01T00:00:00 UT1", "reaches from 1973-01-02 to the start of 20"),
        ("1973-01-01T00:00:00 UT1", "reaches from 1973-01-02 to the start of 20"),
    ],
)
def test_what_is_refused(text, said):
    with pytest.raises(ValueError, match=said):
        parse_epoch(text)


def test_an_unknown_scale_is_refused():
    with pytest.raises(ValueError, match="'tai' is no time scale"):
        tai_from("tai", 60000, 0.0)


def test_without_the_extra_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy_iers_data", None)
    monkeypatch.setattr(timescales, "leap_seconds", leap_seconds.__wrapped__)  # not from the cache
    with pytest.raises(ImportError, match=r"pip install 'terrafix\[truth\]'"):
        parse_epoch("2022-09-18T07:49:21.5 UTC")
    assert parse_epoch("2022-09-18T07:49:21.5 TAI").seconds == 28161.5  # needs no table
