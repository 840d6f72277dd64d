"""FMUs of many variables: twice as many cost twice as much, not four times."""

from __future__ import annotations

import sys

import pytest
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.reading import Quantity, initial_dependencies
from terrafix.cosim.system.system import System

FEW, MANY = 50, 400


def calls(action):
    """How many functions are called, in Python and in C: the same on every machine."""
    n = 0

    def count(frame, event, argument):
        nonlocal n
        n += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        action()
    finally:
        sys.setprofile(None)
    return n


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """n parameters, inputs, outputs and locals; it is described and never stepped."""
    folder = tmp_path_factory.mktemp("wide")

    def made(n):
        variables = [Variable(f"k{i}", causality="parameter", start="0.5") for i in range(n)]
        variables += [Variable(f"u{i}", causality="input", start="0.0") for i in range(n)]
        variables += [Variable(f"y{i}") for i in range(n)]
        variables += [Variable(f"x{i}", causality="local") for i in range(n)]
        return small_fmu(folder / f"{n}.fmu", 2, variables)

    found = {n: made(n) for n in (FEW, MANY)}
    for file in found.values():
        Fmu(file=file).declare_settings()  # unpacked, which happens once
    return found


def one(file, **options):
    system = System("s")
    system.add(Fmu(file=file, rate=Rate("0.1"), **options), "a")
    return system


def pair(file):
    system = one(file)
    system.add(Fmu(file=file, rate=Rate("0.1")), "b")
    return system


def connect(system, n):
    for i in range(n):
        system.connect(f"a.y{i}", f"b.u{i}")


def costs(wide, action):
    return [calls(lambda n=n, file=file: action(n, file)) for n, file in wide.items()]


@pytest.mark.parametrize(
    "action",
    [
        lambda n, file: one(file, start={f"k{i}": 2.0 for i in range(n)}),
        lambda n, file: one(file, observe={f"o{i}": f"x{i}" for i in range(n)}),
        lambda n, file: connect(pair(file), n),
        lambda _, file: one(file).check(),
    ],
    ids=["start", "observe", "connect", "check"],
)
def test_eight_times_as_many_cost_eight_times_as_much(wide, action):
    few, many = costs(wide, action)
    assert many / few < 1.1 * MANY / FEW


def test_parameters_are_listed_once(wide):
    part = one(wide[FEW]).nodes["a"]
    assert part.settings() is part.settings()


def test_outputs_without_declared_dependencies_share_them(wide):
    """Each depends on all inputs: n sets of n names would be 10^12 for a million."""
    found = initial_dependencies(one(wide[FEW]).nodes["a"].interface)
    assert len(found) == FEW
    assert {len(f) for f in found.values()} == {FEW}
    assert len({id(f) for f in found.values()}) == 1


def test_one_of_them_is_found_by_its_name(wide):
    part = one(wide[MANY], observe={"x": f"x{MANY - 1}"}).nodes["a"]
    quantity, _ = part.interface.ports[-1].fields[""]
    assert isinstance(quantity, Quantity)
    assert (quantity.name, quantity.references) == (f"x{MANY - 1}", [4 * MANY - 1])
