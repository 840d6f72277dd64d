"""Units are converted or refused when connected; parameters are validated when set."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, WiringError
from terrafix.cosim.basics.units import (
    base_offset,
    base_units,
    conversion_factor,
    unit_by_definition,
)
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Count, FilePath, Flag, Parameter, Text
from terrafix.cosim.declare.ports import Input, MessageInput, MessageOutput, Output
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.system.wiring import check_connection, port_factor


@pytest.mark.parametrize(
    ("source", "target", "factor"),
    [
        ("m", "m", 1.0),
        ("1", "", 1.0),
        ("km", "m", 1000.0),
        ("deg", "rad", math.pi / 180),
        ("deg/h", "rad/s", math.pi / 180 / 3600),
        ("px", "pixel", 1.0),
        ("px", "m", None),
        ("m/s", "m/s^2", None),
        ("1", "m", None),
        ("rpm", "rad/s", 2 * math.pi / 60),
        ("Hz", "1/s", 1.0),
        ("deg/sqrt(h)", "rad/s^0.5", math.pi / 180 / 60),
        ("deg/h^0.5", "rad/s^0.5", math.pi / 180 / 60),
        ("rad", "1", 1.0),
        ("N*m/rad", "N*m", 1.0),
        ("m*rad/s", "m/s", 1.0),
        # a rotation is no frequency, and neither degrees nor turns are plain numbers
        ("rpm", "Hz", None),
        ("Hz", "rad/s", None),
        ("rad/s", "1/s", None),
        ("rad^2/s", "1/s", None),
        ("deg", "1", None),
        ("turn", "1", None),
    ],
)
def test_conversion_factors(source, target, factor):
    found = conversion_factor(source, target)
    assert found == factor if factor is None else found == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    ("unit", "factor", "exponents"),
    [
        ("1", 1.0, {}),
        ("m/s^2", 1.0, {"m": 1, "s": -2}),
        ("km^2", 1e6, {"m": 2}),
        ("g", 1e-3, {"kg": 1}),
        ("N", 1.0, {"kg": 1, "m": 1, "s": -2}),
        ("N*m", 1.0, {"kg": 1, "m": 2, "s": -2}),
        ("N/kg", 1.0, {"m": 1, "s": -2}),
        ("kN/g", 1e6, {"m": 1, "s": -2}),
        ("deg", math.pi / 180, {"rad": 1}),
        ("arcsecond", math.pi / 648_000, {"rad": 1}),
        ("rpm", 2 * math.pi / 60, {"rad": 1, "s": -1}),
    ],
)
def test_base_units_are_those_of_the_si(unit, factor, exponents):
    """Definitions of the units by hand; radians are kept, as FMI does."""
    found = base_units(unit)
    assert found == (pytest.approx(factor, rel=1e-14), exponents)


@pytest.mark.parametrize("unit", ["m^0.5", "rad/sqrt(h)", "px"])
def test_what_has_no_whole_exponent_or_no_base_has_no_base_units(unit):
    assert base_units(unit) is None


def test_what_is_no_unit_or_no_pure_factor_is_refused():
    with pytest.raises(ConfigurationError, match="'metre per' is not a unit"):
        conversion_factor("metre per", "m")
    with pytest.raises(ConfigurationError, match="is not a pure factor"):
        conversion_factor("degC", "kelvin")


@pytest.mark.parametrize(
    ("source", "target", "advice"),
    [
        ("rpm", "Hz", r"a turn is 2 pi rad; write both sides as rad/s, or both as Hz"),
        ("deg", "1", "an angle becomes a plain number in radians alone: write it in rad"),
        ("ug", "m/s^2", "g is gram; for standard gravity write ug_0"),
        ("mg/Hz^0.5", "m/s^2/Hz^0.5", r"g is gram; for standard gravity write mg_0/Hz\^0.5"),
        ("m", "s", "the units differ: m is not s$"),
    ],
)
def test_a_common_mistake_is_answered(source, target, advice):
    a, b = Output(unit=source), Input(unit=target)
    with pytest.raises(WiringError, match=advice):
        check_connection("a.y", a, "b.u", b)


def factor(a, b):
    check_connection("a.y", a, "b.u", b)
    return port_factor(a, b)


def test_factors_by_port():
    """Scalar, per element along the last axis, none where nothing changes."""
    assert factor(Output((3,), unit="m"), Input((3,), unit="m")) is None
    assert factor(Output(unit="km"), Input(unit="m")).tolist() == [1000.0]
    per_element = Output((2, 2), unit=("m", "s"))
    assert factor(per_element, Input((2, 2), unit=("km", "s"))).tolist() == [1e-3, 1.0, 1e-3, 1.0]
    assert factor(Output((2,), unit="m"), Input((2,), unit=("m", "km"))).tolist() == [1.0, 1e-3]
    bundle = {"r": Field((2,), "m"), "t": Field((), "s")}
    other = {"t": Field((), "ms"), "r": Field((2,), "m")}
    assert factor(Output(fields=bundle), Input(fields=bundle)) is None
    assert factor(Output(fields=bundle), Input(fields=other)).tolist() == [1.0, 1.0, 1000.0]


@pytest.mark.parametrize(
    ("source", "target", "text"),
    [
        (Output(unit="m/s"), Input(unit="m/s^2"), r"the units differ: m/s is not m/s\^2"),
        (
            Output((2,), unit=("m", "s")),
            Input((2,), unit="m"),
            r"the units differ: \(m, s\) is not m",
        ),
        (Output((3,)), Input((2,)), r"the shapes differ: \(3,\) is not \(2,\)"),
        (Output(frame="e"), Input(frame="i"), "the frames differ: e is not i"),
        (Output(frame="e"), Input(), "the frames differ: e is not none"),
        (Output(dtype=np.int64), Input(), "the types differ: int64 is not float64"),
        (
            Output(unit="m", dtype=np.int64),
            Input(unit="km", dtype=np.int64),
            "only float64 ports are converted",
        ),
        (
            MessageOutput((4,), ragged=True),
            MessageInput((4,)),
            "one side is ragged, the other is not",
        ),
        (Output(), MessageInput(), "a signal cannot feed a message: a message has a time"),
        (Input(), Input(), "a.y'? is an input; a connection goes from an output"),
        (Output(), Output(), "b.u'? is an output; a connection ends at an input"),
        (
            Output(fields={"r": Field(), "v": Field()}),
            Input(fields={"r": Field()}),
            r"the fields differ: \(?r, v\)? is not \(?r",
        ),
        (Output(), Input(fields={"r": Field()}), r"the fields differ: \(?no fields\)? is not \(?r"),
        (
            Output(fields={"r": Field(unit="m")}),
            Input(fields={"r": Field(unit="s")}),
            "field 'r': the units differ: m is not s",
        ),
        (
            Output(fields={"r": Field()}),
            Input(window=True, fields={"r": Field()}),
            "a window collects a plain signal",
        ),
    ],
)
def test_what_does_not_fit_is_refused_showing_both_sides(source, target, text):
    with pytest.raises(WiringError, match=text) as caught:
        check_connection("a.y", source, "b.u", target)
    first, *rest = str(caught.value).splitlines()
    assert first == "cannot connect 'a.y' to 'b.u'"
    assert any(line.startswith("  a.y") for line in rest)
    assert any(line.startswith("  b.u") for line in rest)


def test_the_message_reads_as_the_style_guide_wants():
    with pytest.raises(WiringError) as caught:
        check_connection(
            "orbit.velocity",
            Output((3,), unit="m/s", frame="i"),
            "nav.accel",
            Input((3,), unit="m/s^2", frame="b"),
        )
    words = [line.split() for line in str(caught.value).splitlines()]
    assert words == [
        ["cannot", "connect", "'orbit.velocity'", "to", "'nav.accel'"],
        ["orbit.velocity", "output", "shape", "(3,)", "unit", "m/s", "frame", "i"],
        ["nav.accel", "input", "shape", "(3,)", "unit", "m/s^2", "frame", "b"],
        ["the", "units", "differ:", "m/s", "is", "not", "m/s^2"],
    ]


# ---------------------------------------------------------------------- parameters


class Part(Component):
    default_rate = Rate("1")
    r0 = Parameter([1.0, 2.0, 3.0], shape=(3,), unit="m")
    mass = Parameter(unit="kg", positive=True)
    gate = Parameter(math.inf, minimum=0, infinite=True)
    v0 = Parameter(0.0, shape=(3,), unit="m/s", frame="i")
    mixed = Parameter([0.0, 0.0], shape=(2,), unit=("m", "s"))
    mode = Choice(["two-body", "j2"], "j2")
    n = Count(3, minimum=1, maximum=9)
    on = Flag(False)
    label = Text("")
    data = FilePath("x.bin")

    def _step_impl(self, t, dt):
        pass


@pytest.mark.parametrize(
    ("name", "value", "read"),
    [
        ("r0", "[7000, 0, 1_0] km", [7e6, 0, 1e4]),
        ("r0", "1, 2, 3 m", [1, 2, 3]),
        ("r0", 5, [5, 5, 5]),
        ("v0", "[0, 7.5, 0] km/s", [0, 7500, 0]),
        ("v0", 0, [0, 0, 0]),
        ("r0", {"value": [1, 2, 3], "unit": "km"}, [1e3, 2e3, 3e3]),
        ("mass", "500 g", 0.5),
        ("gate", "inf", math.inf),
        ("mixed", [1, 2], [1, 2]),
    ],
)
def test_numbers_are_read_with_their_units(name, value, read):
    part = Part(**{name: value})
    np.testing.assert_allclose(part.setting(name), read, rtol=1e-15)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        (
            "r0",
            "[1, 2] m",
            r"has shape \(2,\); it takes array \(3,\) \[m\]: write \"\[1\.0, 1\.0, 1\.0\] m\"",
        ),
        ("r0", "1 s", r"given in s; it takes .*\n  the units differ: s is not m"),
        (
            "v0",
            "7.5 km/s",
            r"is one number; it takes .*\n  one for each axis of frame 'i'",
        ),
        ("v0", 1, r'is one number; it takes .* write "\[1\.0, 1\.0, 1\.0\] m/s"'),
        ("r0", "far away", "is 'far away', which is not a number"),
        ("r0", [1, 2, math.nan], "must be finite"),
        ("r0", [1, 2, math.inf], "must be finite"),
        ("r0", {"value": 1, "untit": "m"}, "write { value = ..., unit = ... }"),
        ("mass", 0, r"is 0\.0 kg; it must be positive"),
        ("mass", True, "it takes number"),
        ("gate", -1, "must be at least 0"),
        ("gate", math.nan, "must be finite"),
        ("mixed", "[1, 2] m", r"elements of different units \(m, s\)"),
        ("mode", "J2", r'is \'J2\'; it takes "two-body" or "j2"'),
        ("n", 0, "must be at least 1 and at most 9"),
        ("n", 2.5, "takes a whole number"),
        ("n", True, "takes a whole number"),
        ("on", "yes", "takes true or false"),
        ("label", 3, "takes text"),
        ("data", "", "takes the path of a file"),
        ("data", "${TERRAFIX_NO_SUCH_THING}/a", "TERRAFIX_NO_SUCH_THING is not set"),
    ],
)
def test_what_cannot_be_used_is_refused_when_set(name, value, text):
    with pytest.raises(ConfigurationError, match=text):
        Part(**{name: value})


def test_a_bare_number_is_refused_where_units_are_required():
    with pytest.raises(ConfigurationError, match=r'has no unit\n  it takes .*: write "1\.0 kg"'):
        Part.mass.read(3.0, where="'p.mass'", bare=False)


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3))
def test_written_values_read_back_to_the_same_bits(numbers):
    value = np.array(numbers)
    assert Part.r0.read(Part.r0.write(value), where="r0").tobytes() == value.tobytes()


def test_unknown_parameters_are_named_with_the_nearest():
    with pytest.raises(
        ConfigurationError, match=r"Part has no parameter 'masss'\n  did you mean 'mass'"
    ):
        Part(masss=1)


def test_paths_take_variables_of_the_environment(monkeypatch):
    monkeypatch.setenv("TERRAFIX_TEST_DATA", "/there")
    assert str(Part(data="${TERRAFIX_TEST_DATA}/a").data) == "/there/a"
    assert str(Part(data="${TERRAFIX_NO_SUCH_THING:-/here}/a").data) == "/here/a"


def test_parameters_have_a_value_per_member_while_a_simulation_runs(toys):
    part = Part(mass=2)
    simulation = toys.fly(toys.wire({"p": part}, []), 1, members=4)
    assert part.r0.shape == (4, 3)
    assert part.mass.tolist() == [2, 2, 2, 2]
    assert part.mode == "j2"
    with pytest.raises(
        ConfigurationError, match=r"'p\.mass' cannot be set while a simulation runs"
    ):
        part.mass = 3
    simulation.master.terminate()
    part.mass = 3
    assert float(part.mass) == 3


def test_degrees_celsius_by_base_units():
    """K = 1 degC + 273.15: the factor is of differences."""
    assert base_units("degC") == (1.0, {"K": 1})
    assert (base_offset("degC"), base_offset("m/s")) == (273.15, 0.0)
    assert unit_by_definition("degC", 1.0, {"K": 1}, 273.15) == "degC"


def test_a_defined_unit_carries_its_definition():
    kmph = unit_by_definition("kmph", 0.27778, {"m": 1, "s": -1})
    assert kmph == "kmph = 0.27778 m/s"
    assert conversion_factor(kmph, "m/s") == 0.27778
    assert base_units(kmph) == (0.27778, {"m": 1, "s": -1})
    assert conversion_factor(kmph, "kg") is None
