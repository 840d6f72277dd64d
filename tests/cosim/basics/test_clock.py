"""Rational time: periods, base steps, activations, and the texts of refusals."""

import math
from decimal import Decimal
from fractions import Fraction
from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafix.cosim.basics.clock import (
    Rate,
    base_step,
    hertz,
    rational_gcd,
    seconds,
    text_seconds,
)
from terrafix.cosim.basics.errors import RateError, SystemCheckError
from terrafix.cosim.system.check import check


def test_base_step_is_the_rational_gcd():
    assert rational_gcd([Fraction("1/30"), Fraction("8.2")]) == Fraction(1, 30)
    assert rational_gcd([Fraction("1/30"), Fraction("8.21")]) == Fraction(1, 300)
    assert base_step([Fraction("0.01"), Fraction("8.2")]) == Fraction(1, 100)
    assert base_step(Rate(hz="1256.98").exact_numbers) == Fraction(50, 62849)
    assert Rate(1, offset="0.3").exact_numbers == (1, Fraction(3, 10))
    assert base_step(Rate(1, offset="0.3").exact_numbers) == Fraction(1, 10)


def test_without_a_period_listed_times_choose_the_base_step_and_without_any_it_is_a_second():
    assert base_step([], [Fraction(1, 2), Fraction(3, 4)]) == Fraction(1, 4)
    assert base_step([Fraction(1)], [Fraction(3, 4)]) == 1
    assert base_step([]) == 1


@given(st.lists(st.fractions(min_value="1/997", max_value=1000, max_denominator=997), min_size=1))
def test_base_step_divides_everything_and_nothing_larger_does(numbers):
    step = rational_gcd(numbers)
    quotients = [n / step for n in numbers]
    assert all(q.denominator == 1 for q in quotients)
    assert rational_gcd(quotients) == 1


@given(st.fractions(max_denominator=2**80))
def test_written_seconds_read_back_exactly(value):
    assert seconds(text_seconds(value)) == value


@pytest.mark.parametrize("value", [Fraction(1, 2**60), Fraction(10**40 + 1), Fraction(-82, 10)])
def test_written_seconds_read_back_exactly_beyond_a_decimals_digits(value):
    assert seconds(text_seconds(value)) == value


@pytest.mark.parametrize(
    ("text", "exact"),
    [
        ("8.2", Fraction(41, 5)),
        ("1/30", Fraction(1, 30)),
        ("10 ms", Fraction(1, 100)),
        ("2 min", Fraction(120)),
        ("1.5 h", Fraction(5400)),
        ("250 us", Fraction(1, 4000)),
        (3, Fraction(3)),
        (Decimal("0.1"), Fraction(1, 10)),
        ("1e-3 s", Fraction(1, 1000)),
        ("2 h", Fraction(7200)),
        ("5 us", Fraction(1, 200_000)),
        ("1 MIN", Fraction(60)),
        ("1e18", Fraction(10**18)),
    ],
)
def test_times_are_read_exactly(text, exact):
    assert seconds(text) == exact


@pytest.mark.parametrize(
    ("text", "exact"),
    [("50", 50), ("8 Hz", 8), ("2 kHz", 2000), ("1.5 MHz", 1_500_000), ("3 mhz", 3_000_000)],
)
def test_rates_are_read_exactly(text, exact):
    assert hertz(text) == exact
    assert Rate(hz=text).period == Fraction(1, exact)


def test_millihertz_are_not_taken_for_megahertz():
    with pytest.raises(RateError, match="rate is '1 mHz', which is not a rate in hertz"):
        hertz("1 mHz")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (8.2, r'period is 8\.2, a binary fraction near 8\.2\n  write "8\.2" \(exact\) or "41/5"'),
        (1 / 30, r'write "0\.0333333333333" \(exact\) or "1/30"'),
        (8.0, 'write 8 or "8"'),
        (float("nan"), "give a finite number"),
        ("8,2", "which is not a time in seconds"),
        ("1/0", "division by zero"),
        (0, "it must be positive"),
        ("-1", "it must be positive"),
        ("1e19", "which no simulation can count"),
        (True, "give a time in seconds"),
        ([1], "give a time in seconds as a string"),
    ],
)
def test_what_is_no_period_is_refused_with_a_hint(value, text):
    with pytest.raises(RateError, match=text):
        Rate(value)


def test_schedules_that_contradict_themselves_are_refused():
    with pytest.raises(RateError, match="exactly one of a period, hz or times"):
        Rate("1", hz=1)
    for listed in (["1", "1"], ["2", "1"], ["0", "3", "2"], ["-1", "1"]):
        with pytest.raises(RateError, match="times must be increasing and not negative"):
            Rate(times=listed)
    with pytest.raises(RateError, match="times is empty"):
        Rate(times=[])
    with pytest.raises(RateError, match="rate is 0; it must be positive"):
        Rate(hz=0)
    with pytest.raises(RateError, match=r"offset is -0\.5 s; it must not be negative"):
        Rate(1, offset="-0.5")
    with pytest.raises(RateError, match="an offset goes with a period"):
        Rate(times=["1"], offset="1")
    with pytest.raises(RateError, match="times is the text"):
        Rate(times="1 2 3")


def test_activations_of_a_period_with_an_offset():
    base = Fraction(1, 10)
    assert list(islice(Rate("0.3").ticks(base), 3)) == [3, 6, 9]
    assert list(islice(Rate("0.3", offset="0.2").ticks(base), 3)) == [2, 5, 8]
    assert list(islice(Rate("0.3", offset="0.2").ticks(base, after=5), 2)) == [8, 11]
    assert [Rate("0.3", offset="0.2").last_tick(base, None, k) for k in (1, 2, 4, 5)] == [
        0,
        2,
        2,
        5,
    ]


@given(
    st.integers(1, 50),
    st.integers(0, 100),
    st.integers(0, 300),
    st.sets(st.integers(0, 200), min_size=1),
)
def test_continuing_from_any_tick_gives_the_rest_of_the_activations(period, offset, after, listed):
    base = Fraction(1, 7)
    for rate in (
        Rate(period * base, offset=offset * base),
        Rate(times=[k * base for k in sorted(listed)]),
    ):
        whole = [t for t in islice(rate.ticks(base), 501) if t <= 500]
        assert [t for t in whole if t > after] == [
            t for t in islice(rate.ticks(base, after=after), 501) if t <= 500
        ]
        assert rate.last_tick(base, None, after) == max((t for t in whole if t <= after), default=0)


def test_listed_times_are_snapped_to_the_next_tick():
    """Lines of a radar at 1256.98 Hz on a base step of 1 ms: never before the data exist."""
    lines = [Fraction(100 * k, 125698) for k in range(1, 40)]
    base = Fraction(1, 1000)
    ticks = list(Rate(times=lines[::2]).ticks(base))
    for tick, line in zip(ticks, lines[::2], strict=True):
        assert 0 <= tick * base - line < base
    assert ticks == sorted(set(ticks))


def test_a_listed_time_goes_to_the_point_after_it_never_to_the_nearest():
    """By hand, on a grid of 0.5 s of five ticks: 0.1 -> 0.5, 0.5 -> 0.5, 1.01 -> 1.5, 2 -> 2."""
    rate = Rate(times=["0.1", "1.01", "2"])
    assert list(rate.ticks(Fraction(1, 10), Fraction(1, 2))) == [5, 15, 20]
    assert list(rate.ticks(Fraction(1, 10), Fraction(1, 2), after=5)) == [15, 20]
    assert [rate.last_tick(Fraction(1, 10), Fraction(1, 2), k) for k in (4, 5, 19)] == [0, 5, 15]
    assert list(Rate(times=["0.5"]).ticks(Fraction(1, 10), Fraction(1, 2))) == [5]


def test_listed_times_closer_than_the_base_step_are_refused(toys):
    crowded = toys.Clock(rate=Rate(times=["0.5", "0.7"]))
    with pytest.raises(SystemCheckError, match=r"'a' has the times 0\.5 s and 0\.7 s, closer than"):
        check(toys.wire({"a": crowded, "b": toys.Clock()}, []))


def test_time_is_one_division_and_never_a_sum(toys):
    """At 30 Hz, tick k is the float nearest k/30, also after many steps."""
    system = toys.wire(
        {"a": toys.Clock(rate=Rate(hz=30)), "b": toys.EndSpy(rate=Rate(hz=30))}, ["a.t -> b.u"]
    )
    toys.fly(system, 40)
    times = [t for t, _, _ in system.nodes["b"].seen]
    assert times == [float(Fraction(k, 30)) for k in range(1, 1201)]
    assert {dt for _, dt, _ in system.nodes["b"].seen} == {1 / 30}


def test_listed_times_travel_as_time_of_validity(toys):
    """What is snapped keeps its own time: asked by the component, and shown by windows."""
    lines = ["0.5003", "1.2"]
    clock = toys.Clock(rate=Rate(times=lines))
    system = toys.wire(
        {"line": clock, "beat": toys.Clock(rate=Rate("0.25")), "w": toys.WindowSpy(rate=Rate("2"))},
        ["line.t -> w.u"],
    )
    simulation = toys.fly(system, 2)
    (samples, times) = system.nodes["w"].seen[0][2]
    assert times.tolist() == [0.5003, 1.2]
    assert samples[0].tolist() == [0.75, 1.25]  # when they were published, after snapping
    assert clock.scheduled(1.25) == 1.2
    simulation.master.terminate()


def test_a_recorder_does_not_move_what_is_snapped(toys):
    """A finer recorder refines the base step; listed times stay where the components put them."""

    def run(*records):
        system = toys.wire(
            {
                "line": toys.Clock(rate=Rate(times=["0.5003", "1.2"])),
                "beat": toys.Clock(rate=Rate("0.5")),
            },
            [],
            ["line.t"],
        )
        for period in records:
            system.record("fine", ["beat.t"], period=period)
        simulation = toys.fly(system, 3)
        return simulation.recorders[0].history()[0].tolist()

    assert run() == run("0.001") == [1.0, 1.5]


@pytest.mark.parametrize(
    ("rate", "text"),
    [
        (Rate("8.2"), 'Rate("8.2 s")'),
        (Rate(hz=3, offset="10 ms"), 'Rate("1/3 s", offset="0.01 s")'),
        (Rate(times=["0", "1/7"]), 'Rate(times=["0 s", "1/7 s"])'),
    ],
)
def test_a_rate_can_be_pasted_back(rate, text):
    assert repr(rate) == text
    assert eval(text) == rate


@pytest.mark.parametrize(
    ("rate", "text", "identity", "at_zero", "last"),
    [
        (Rate("0.5"), "every 0.5 s", "every 0.5 s", True, math.inf),
        (Rate(2, offset="1/3"), "every 2 s from 1/3 s", "every 2 s from 1/3 s", False, math.inf),
        (Rate(times=[0, 1, 2, 3]), "at 0, 1, 2, 3 s", "at 0, 1, 2, 3 s", True, 3.0),
        (
            Rate(times=[1, 2, 3, 4, "4.5"]),
            "at 1, 2, 3, 4, ... s",
            "at 1, 2, 3, 4, 4.5 s",
            False,
            4.5,
        ),
    ],
)
def test_a_rate_says_when_it_begins_and_ends(rate, text, identity, at_zero, last):
    assert (str(rate), rate.identity()) == (text, identity)
    assert (rate.starts_at_zero, rate.last) == (at_zero, last)


def test_a_long_list_of_times_is_cut_and_counted():
    shown = repr(Rate(times=list(range(20))))
    assert shown == 'Rate(times=["0 s", "1 s", "2 s", "3 s", ..., "19 s"])  # 20 times'
    with pytest.raises(RateError):  # pasted back, it is refused rather than something else
        eval(shown)
