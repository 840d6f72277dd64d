"""Numbers of FMUs and their types: whole numbers to the last digit, and none outside its type."""

from __future__ import annotations

import numpy as np
import pytest
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.whole import limits
from terrafix.cosim.system.system import System

ODD = 2**53 + 1
"""The first whole number that no double holds."""
WHOLE = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64")


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """An FMU of y = u + k of one type: ``copy("Int8", 3)``; a boolean and a double beside them."""
    folder = tmp_path_factory.mktemp("copies")
    made: dict = {}

    def get(kind, fmi=3):
        if (kind, fmi) not in made:
            variables = [
                Variable("u", kind, "input", 1),
                Variable("y", kind),
                Variable("k", kind, "parameter", 0),
                Variable("x", "Real", start="0.5"),
                Variable("v", "Real", "input", start="0.0"),
            ]
            step = "m->n[1] = m->n[0] + m->n[2]; m->r[3] = m->r[4];"
            made[kind, fmi] = small_fmu(folder / f"{kind}{fmi}.fmu", fmi, variables, step=step)
        return made[kind, fmi]

    return get


def chain(first, second, **options):
    system = System("chain")
    system.add(Fmu(file=first, rate=Rate("0.1"), **options), "a")
    system.add(Fmu(file=second, rate=Rate("0.1")), "b")
    system.connect("a.y", "b.u")
    system.record("r", ["a.y", "b.y", "b.x"])
    return system


@pytest.mark.parametrize(
    ("kind", "value"),
    [("Int8", 300), ("UInt8", -1), ("UInt32", -1), ("Int16", 2**15), ("Int32", -(2**31) - 1)],
)
def test_a_connected_number_outside_its_type_is_no_other_number(copy, kind, value):
    """300 into Int8 gave 44, -1 into UInt8 255."""
    system = chain(copy("Int64"), copy(kind), start={"u": value})
    low, high = limits(kind, 3)
    with pytest.raises((StepError, RunError)) as raised:
        simulate(system, duration="0.5")
    text = f"'u' ({kind}) is set to {value}; it takes whole numbers from {low} to {high}"
    assert text in str(raised.value)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        *(("Int8", 300), ("UInt8", -1), ("Int64", 2.7), ("Int64", 2**63), ("Int32", "2.7")),
        *(("Int16", True), ("Int16", "many")),
    ],
)
def test_a_start_value_outside_its_type_is_refused(copy, kind, value):
    low, high = limits(kind, 3)
    for name in ("k", "u"):
        with pytest.raises(ConfigurationError) as raised:
            System("s").add(Fmu(file=copy(kind), start={name: value}), "part")
        assert f"'part.start.{name}' is " in str(raised.value)
        assert f"type {kind} and takes whole numbers from {low} to {high}" in str(raised.value)


@pytest.mark.parametrize("isolate", [False, True])
def test_the_last_digit_stays(copy, isolate):
    """2^53 + 1, set as input, added to 2 and handed on: 2^53 + 3, and as unsigned too."""
    system = chain(copy("Int64"), copy("UInt64"), start={"u": ODD, "k": "2"}, isolate=isolate)
    found = simulate(system, duration="0.3").dataset
    assert found["a.y"].dtype == np.int64
    assert int(found["a.y"].values.ravel()[-1]) == ODD + 2
    assert int(found["b.y"].values.ravel()[-1]) == ODD + 2


@pytest.mark.parametrize("kind", WHOLE)
def test_limits_of_every_type_pass(copy, kind):
    low, high = limits(kind, 3)
    assert {"Int8": (-128, 127), "UInt16": (0, 65535)}.get(kind, (low, high)) == (low, high)
    for value in (low, high):
        system = chain(copy("Int64"), copy(kind), start={"u": value})
        found = simulate(system, duration="0.3").dataset["b.y"].values
        assert int(found.ravel()[-1]) == value


def test_negative_numbers_are_not_taken_for_nan(copy):
    """The bits of -1 are those of a double that is no number."""
    found = simulate(chain(copy("Int64"), copy("Int64"), start={"u": -1}), duration="0.3").dataset
    assert found["b.y"].values.ravel().tolist()[-1] == -1


@pytest.mark.parametrize(("value", "fits"), [(2**31 - 1, True), (2**31, False)])
def test_integers_of_fmi_2_have_32_bits(copy, value, fits):
    fmu = Fmu(file=copy("Integer", 2), rate=Rate("0.1"), start={"u": value} if fits else {})
    system = System("s")
    system.add(fmu, "part")
    if fits:
        simulation = Simulation(system)
        simulation.run_until("0.1")
        assert int(simulation.master.wiring.slots["part.y"].data.ravel()[0]) == value
        simulation.master.terminate()
        return
    with pytest.raises(ConfigurationError, match=r"is 2147483648; it is of type Integer and"):
        System("s").add(Fmu(file=copy("Integer", 2), start={"u": value}), "part")


def test_an_unsigned_number_that_no_port_holds(tmp_path):
    variables = [Variable("y", "UInt64", start=1)]
    file = small_fmu(tmp_path / "big.fmu", 3, variables, step="m->n[0] = -1;")
    system = System("s")
    system.add(Fmu(file=file, rate=Rate("0.1")), "part")
    with pytest.raises((StepError, RunError), match=r"\(UInt64\) is 18446744073709551615"):
        simulate(system, duration="0.3")


def test_a_double_that_no_single_holds(tmp_path):
    variables = [Variable("y", start="1e300"), Variable("u", "Float32", "input", "0.0")]
    file = small_fmu(tmp_path / "single.fmu", 3, variables)
    system = System("s")
    for name in "ab":
        system.add(Fmu(file=file, rate=Rate("0.1")), name)
    system.connect("a.y", "b.u")
    with pytest.raises((StepError, RunError), match=r"'u' \(Float32\) is set to 1e\+300; it takes"):
        simulate(system, duration="0.3")


def test_truth_values_are_true_or_false(tmp_path):
    variables = [Variable("k", "Boolean", "parameter", "false"), Variable("y", start="0.0")]
    file = small_fmu(tmp_path / "b.fmu", 3, variables, step="m->r[1] = m->n[0];")
    for given in (True, "true", 1):
        system = System("s")
        system.add(Fmu(file=file, rate=Rate("0.1"), start={"k": given}), "part")
        simulation = Simulation(system)
        simulation.run_until("0.1")
        assert float(simulation.master.wiring.slots["part.y"].data.ravel()[0]) == 1.0
        simulation.master.terminate()
    with pytest.raises(ConfigurationError, match="is 2; it is of type Boolean and takes true or f"):
        System("s").add(Fmu(file=file, start={"k": 2}), "part")
