"""Texts of refusals: the nearest name, or all of them, and problems that are counted."""

import pytest

from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError, nearest


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("velocty", "did you mean 'velocity'?"),
        ("VELOCITY", "did you mean 'velocity'?"),
        ("p_Rate", "did you mean 'P_rate'?"),
        ("v", "ports: P_rate, position, velocity"),  # 2 * 1 / (1 + 8) = 0.22 alike: far from it
        ("posse", "ports: P_rate, position, velocity"),  # "pos": 2 * 3 / (5 + 8) = 0.46
    ],
)
def test_the_nearest_name_is_offered_or_all_in_order(name, hint):
    """As difflib measures likeness, twice the letters in common over all letters, from 0.6 on."""
    assert nearest(name, ["velocity", "position", "P_rate", "velocity"], what="ports") == hint


def test_where_there_is_nothing_to_offer_it_is_said():
    assert nearest("a", [], what="ports") == "there are no ports"
    assert nearest("a", []) == "there is nothing to choose from"
    assert nearest("a", ["xyz"]) == "known: xyz"


def test_problems_are_counted_and_the_file_is_named():
    one, two = ConfigurationError("first"), ConfigurationError("second")
    assert str(SystemCheckError("s", [one])) == (
        "system 's' has 1 problem\nConfigurationError: first"
    )
    error = SystemCheckError("s", [one, two], "a.toml")
    assert str(error).splitlines()[0] == "system 's' (a.toml) has 2 problems"
    assert error.problems == (one, two)
