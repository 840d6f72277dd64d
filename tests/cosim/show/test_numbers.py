"""Numbers as a person reads them: significant digits, dashes, and angles in degrees."""

import math

import pytest

from terrafix.cosim.show.numbers import number, shown_unit, summaries


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (None, "-"),
        (math.nan, "-"),
        (-math.inf, "-"),
        (2.5, "2.500"),
        (-2.5, "-2.500"),
        (12.3456, "12.35"),
        (123456.7, "123457"),
        (999_999.0, "999999"),
        (1e6, "1.000e+06"),
        (1e-3, "0.001000"),
        (0.000999, "9.990e-04"),
        (-1234567.0, "-1.235e+06"),
    ],
)
def test_numbers_have_four_significant_digits(value, text):
    """Between 0.001 and a million without an exponent; what is no number is a dash."""
    assert number(value) == text


def test_the_number_of_digits_can_be_chosen():
    assert (number(math.pi, 2), number(math.pi * 1e8, 2)) == ("3.1", "3.1e+08")


def test_angles_are_shown_in_degrees_and_their_rates_in_degrees_per_hour():
    """A right angle; and the Earth's rate, one turn in a sidereal day of 86164.0905 s."""
    unit, factor = shown_unit("rad")
    assert (unit, math.pi / 2 * factor) == ("deg", pytest.approx(90.0, rel=1e-15))
    unit, factor = shown_unit("rad/s")
    expected = 360 / (86164.0905 / 3600)
    assert (unit, 2 * math.pi / 86164.0905 * factor) == ("deg/h", pytest.approx(expected))
    assert shown_unit("m") == ("m", 1.0)


QUANTITY = {"unit": "m", "error": [1.0]}
CONSISTENCY = {"mean": 1.0, "interval_95": None, "dof": 3}


@pytest.mark.parametrize("one", [{"place": QUANTITY}, {"nees": CONSISTENCY}, {"n": 3}])
def test_the_only_evaluation_has_no_path_and_several_have_theirs(one):
    assert summaries({}) == {}
    assert summaries(one) == {"": one}
    assert summaries({"nav.a": one, "nav.b": one}) == {"nav.a": one, "nav.b": one}
