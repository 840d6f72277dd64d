"""What a parameter accepts at and about its bounds, and how texts become values."""

from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import (
    Count,
    FilePath,
    FileTable,
    Flag,
    OptionalFilePath,
    Parameter,
    Table,
)
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.memory.fields import Field

BOUNDED = Parameter(unit="m", shape=(2,), minimum=1.0, maximum=3.0)


def read(declared, value):
    return declared.read(value, where="'p'")


@pytest.mark.parametrize("value", [[1.0, 3.0], "[100, 300] cm", 1.0, 3.0])
def test_bounds_themselves_are_accepted(value):
    assert set(read(BOUNDED, value).tolist()) <= {1.0, 3.0}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([np.nextafter(1.0, 0.0), 2.0], "must be at least 1 m"),
        ([2.0, np.nextafter(3.0, 4.0)], "must be at most 3 m"),
        ("[2, 301] cm", "must be at least 1 m"),
    ],
)
def test_one_element_beyond_a_bound_is_enough_to_refuse(value, text):
    with pytest.raises(ConfigurationError, match=text):
        read(BOUNDED, value)


def test_positive_is_above_zero_by_any_amount():
    positive = Parameter(positive=True)
    assert read(positive, 5e-324) == 5e-324
    for value in (0.0, -0.0, -5e-324):
        with pytest.raises(ConfigurationError, match="must be positive"):
            read(positive, value)


@pytest.mark.parametrize("sign", [1, -1])
def test_infinity_is_refused_unless_declared(sign):
    with pytest.raises(ConfigurationError, match="must be finite"):
        read(Parameter(), sign * np.inf)
    assert read(Parameter(infinite=True), sign * np.inf) == sign * np.inf


def test_a_count_lies_between_its_bounds_and_includes_them():
    count = Count(minimum=2, maximum=4)
    assert [read(count, n) for n in (2, "3", 4)] == [2, 3, 4]
    for n in (1, 5, "-3"):
        with pytest.raises(ConfigurationError, match="must be at least 2 and at most 4"):
            read(count, n)
    assert read(Count(), 0) == 0


@pytest.mark.parametrize("value", [0, 0.0, [0.0, 0.0]])
def test_zero_needs_no_unit(value):
    """0 m is 0 km: the only number that is the same in every unit."""
    free = Parameter(unit="m", shape=(2,))
    assert free.read(value, where="'p'", bare=False).tolist() == [0, 0]
    with pytest.raises(ConfigurationError, match="has no unit"):
        free.read([0.0, 1.0], where="'p'", bare=False)
    assert Parameter().read(2.0, where="'p'", bare=False) == 2.0


def test_a_value_is_written_with_its_unit():
    assert Parameter(unit="m", shape=(2,)).write(np.array([1.0, 2.5])) == "[1.0, 2.5] m"
    assert Parameter().write(np.array(0.5)) == "0.5"
    assert Parameter(unit=("m", "s"), shape=(2,)).write(np.array([1.0, 2.5])) == [1.0, 2.5]


@pytest.mark.parametrize(
    ("text", "value"), [("true", True), (" FALSE ", False), (True, True), (False, False)]
)
def test_flags_are_read_from_texts(text, value):
    assert read(Flag(), text) is value


def test_a_variable_that_is_set_comes_before_the_fallback(monkeypatch):
    monkeypatch.setenv("TERRAFIX_TEST_DATA", "/there")
    assert read(FilePath(), "${TERRAFIX_TEST_DATA:-/here}/a") == Path("/there/a")
    assert read(FilePath(), "$TERRAFIX_TEST_DATA/a") == Path("/there/a")
    monkeypatch.setenv("TERRAFIX_TEST_DATA", "")
    assert read(FilePath(), "${TERRAFIX_TEST_DATA:-/here}/a") == Path("/here/a")
    assert read(OptionalFilePath(), None) is None
    assert read(OptionalFilePath(), "${TERRAFIX_TEST_DATA:-/here}/a") == Path("/here/a")


def test_files_by_name_begin_beside_the_system_file():
    table = read(FileTable(), {"a": "a.fmu", "b": "/b.fmu"})
    assert FileTable().beside(table, Path("/systems")) == {
        "a": Path("/systems/a.fmu"),
        "b": Path("/b.fmu"),
    }
    assert read(Table(), '{ mass = "12 kg" }') == {"mass": "12 kg"}
    with pytest.raises(ConfigurationError, match="it takes a table"):
        read(Table(), "mass")


@pytest.mark.parametrize("shape", [(0,), (3, 0), 3])
def test_a_shape_is_a_tuple_of_sizes_from_one_on(shape):
    with pytest.raises(ConfigurationError, match="it is a tuple of sizes"):
        Output(shape)
    assert Output((1,)).single.size == 1


def test_a_default_makes_an_input_optional():
    assert Input(default=0.0).optional
    assert Input(optional=True).optional
    assert not Input().optional


def test_sizes_are_products_of_extents():
    assert [Field(shape).size for shape in ((), (3,), (3, 4), (2, 3, 4))] == [1, 3, 12, 24]
