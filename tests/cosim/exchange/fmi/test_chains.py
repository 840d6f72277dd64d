"""FMUs stepped without Python between them: the bits, failures and messages of single steps."""

from __future__ import annotations

import logging
import math

import eventful
import numpy as np
import pytest
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import StepError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run import fleet
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System

WHOLE = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
TYPES = ("Float64", "Float32", *WHOLE, "Boolean")
N = len(TYPES)
WAYS = ("chain", "single", "ctypes")
RATE = Rate("0.1")


@pytest.fixture(scope="module")
def worn(tmp_path_factory):
    """All types in and out; it says so at `said`, is not finite at `odd`, and fails at `worn`.

    Whole numbers run through their whole range: y = 3 y + u + 1, as its type has it.
    """
    variables = [Variable(f"u_{t}", t, "input", "false" if t == "Boolean" else 0) for t in TYPES]
    variables += [Variable(f"y_{t}", t) for t in TYPES]
    for name, start in (("said", "1e9"), ("odd", "1e9"), ("worn", "1e9"), ("k", "0.5")):
        variables.append(Variable(name, "Float64", "parameter", start))
    said, odd, late, k = range(2 * N, 2 * N + 4)
    step = f"""
        double end = t + h - 1e-9;
        for (int i = 2; i < {N - 1}; i++)
            m->n[{N} + i] = (int64_t)(3 * (uint64_t)m->n[{N} + i] + (uint64_t)m->n[i] + 1);
        m->n[{N} + {TYPES.index("UInt64")}] &= INT64_MAX;
        m->n[{2 * N - 1}] = !m->n[{N - 1}];
        m->r[{N}] = m->r[{k}] * m->r[{N}] + m->r[0] + t;
        m->r[{N + 1}] = 0.3 * m->r[{N + 1}] + m->r[1] + 0.1;
        if (end > m->r[{odd}]) m->r[{N}] = NAN;
        if (end > m->r[{said}] && end < m->r[{said}] + 0.2) say(m, 1, "warm");
        if (end > m->r[{late}]) {{ say(m, 3, "worn out"); return 3; }}
    """
    return small_fmu(tmp_path_factory.mktemp("worn") / "worn.fmu", 3, variables, step=step)


@pytest.fixture(scope="module")
def ends(tmp_path_factory):
    return eventful.ending(tmp_path_factory.mktemp("ends") / "ending.fmu", fmi=2)


@pytest.fixture
def fly_as(monkeypatch):
    """Fly as chains, by single steps, or without compiled code."""

    def choose(way):
        monkeypatch.undo()
        if way == "single":
            monkeypatch.setattr(Fmu, "compiled_step", lambda _: None)
        if way == "ctypes":
            monkeypatch.setattr(fleet, "_driver", lambda: None)

    return choose


def ring(worn, ends):
    """e -> a -> b -> c -> a, units converted on the way; members end, fail and say something."""
    system = System("ring")
    system.add(Fmu(file=ends, rate=RATE), "e")
    units = {"a": {"y_Float64": "m"}, "b": {"u_Float64": "km", "y_Float64": "km"}, "c": {}}
    units["c"]["u_Float64"] = "m"
    for name in "abc":
        system.add(Fmu(file=worn, rate=RATE, units=units[name]), name)
    for source, target in ("ab", "bc", "ca"):
        for kind in TYPES:
            if (source, kind) != ("c", "Float64"):
                system.connect(f"{source}.y_{kind}", f"{target}.u_{kind}")
    system.connect("e.y", "a.u_Float64")
    for to, values in {
        "e.stop": [9.0, 0.35, 9.0, 9.0, 9.0],
        "a.said": [9.0, 9.0, 0.25, 0.55, 9.0],
        "b.worn": [9.0, 9.0, 9.0, 0.45, 9.0],
        "c.odd": [9.0, 9.0, 9.0, 9.0, 0.65],
        "c.k": [0.1, 0.2, 0.3, 0.4, 0.5],
    }.items():
        system.disperse(Dispersion(to.replace(".", "_"), (to,), values, kind="list"))
    return system


def left_by(system, until, members, caplog, *, recorded=False):
    """All that a run leaves: bits of what was published, and what was said."""
    caplog.clear()
    simulation = Simulation(system, members=members)
    master, seen = simulation.master, []
    slots = master.wiring.slots
    if recorded:
        master.observe(RATE, lambda t: seen.append((t, [s.data.tobytes() for s in slots.values()])))
    with caplog.at_level(logging.INFO):
        simulation.initialize()
        try:
            for end in until:
                simulation.run_until(end)
        except StepError as error:
            seen.append(str(error))
    found = {
        "published": {path: slot.data.tobytes() for path, slot in slots.items()},
        "seen": seen,
        "active": master.active.tolist(),
        "excluded": master.excluded,
        "ended": master.ended,
        "steps": master.component_steps,
        "tick": master.tick,
        "each": {p: (c.step_index, getattr(c, "_t", 0)) for p, c in system.nodes.items()},
        "said": [r.getMessage() for r in caplog.records],
    }
    master.terminate()
    return found


@pytest.mark.parametrize("until", [("1.5",), ("0.3", "0.35", "0.7", "1.5")])
@pytest.mark.parametrize("recorded", [False, True])
def test_a_chain_leaves_what_single_steps_leave(worn, ends, fly_as, caplog, recorded, until):
    found = {}
    for way in WAYS:
        fly_as(way)
        found[way] = left_by(ring(worn, ends), until, 5, caplog, recorded=recorded)
    chain = found["chain"]
    assert chain["active"] == [True, False, True, False, False]
    assert [(e["member"], e["t_s"], e["component"]) for e in chain["excluded"]] == [
        (3, 0.5, "b"),
        (4, 0.7, "c"),
    ]
    assert chain["excluded"][0]["reason"] == "fmi3DoStep did not succeed: worn out"
    assert [(e["member"], e["t_s"]) for e in chain["ended"]] == [(1, 0.4)]
    assert len([s for s in chain["said"] if "member 2" in s]) == 2
    assert chain["steps"] == 4 * 15
    assert chain["each"]["c"] == (15, 1.5)
    for way in WAYS[1:]:
        if way == "ctypes":  # which names the function of each type
            found[way]["excluded"][0]["reason"] = chain["excluded"][0]["reason"]
        assert found[way] == chain, way


@pytest.mark.parametrize("recorded", [False, True])
def test_a_run_that_nobody_survives(worn, fly_as, caplog, recorded):
    """The last member fails in b at t = 0.5; a has stepped then, c has not."""
    found = {}
    for way in ("chain", "single"):
        fly_as(way)
        system = System("s")
        for name in "abc":
            start = {"worn": 0.45} if name == "b" else {}
            system.add(Fmu(file=worn, rate=RATE, start=start), name)
        for source, target in ("ca", "bc"):
            system.connect(f"{source}.y_Int64", f"{target}.u_Int64")
        found[way] = left_by(system, ("1.5",), 2, caplog, recorded=recorded)
    assert found["chain"] == found["single"]
    assert "no member is left at t = 0.5 s (tick 5)" in found["chain"]["seen"][-1]


class Doubled(Component):
    """A component in Python between FMUs."""

    x = Input((), unit="1")
    y = Output((), unit="1")

    def _initialize_impl(self) -> None:
        self.y = 2 * self.x

    def _step_impl(self, t: float, dt: float) -> None:
        self.y = 2 * self.x


def test_chains_around_a_component_in_python_and_at_two_rates(worn, fly_as, caplog):
    found = {}
    for way in ("chain", "single"):
        fly_as(way)
        system = System("s")
        for name, step in {"a": "0.1", "b": "0.1", "c": "0.1", "slow": "0.3"}.items():
            system.add(Fmu(file=worn, rate=Rate(step), inputs_read="end"), name)
        system.add(Doubled(rate=RATE), "twice")
        links = (
            "a.y_Float64 b.u_Float64 b.y_Float64 twice.x twice.y c.u_Float64 c.y_Int8 slow.u_Int8"
        )
        for source, target in zip(links.split()[::2], links.split()[1::2], strict=True):
            system.connect(source, target)
        found[way] = left_by(system, ("1", "2.05", "3"), 2, caplog)
    assert found["chain"] == found["single"]
    assert found["chain"]["each"]["slow"] == (10, 3.0)


@pytest.fixture(scope="module")
def adder(tmp_path_factory):
    """y += u for a double and a whole number; counts from u = 1."""
    folder = tmp_path_factory.mktemp("adders")
    variables = [Variable("u", "Real", "input", "1.0"), Variable("y", start="0.0")]
    variables += [Variable("i", "Int64", "input", 1), Variable("j", "Int64", start=0)]
    step = "m->r[1] += m->r[0]; m->n[3] += m->n[2];"
    return small_fmu(folder / "adder.fmu", 3, variables, step=step)


def counted(monkeypatch):
    """How often Python steps a fleet."""
    calls = []
    step = fleet.Fleet.step
    monkeypatch.setattr(fleet.Fleet, "step", lambda *given: calls.append(1) or step(*given))
    return calls


def test_a_chain_of_sums_is_pascals_triangle(adder, monkeypatch):
    """FMU j counts C(k, j + 1) after k steps, and no step is made in Python."""
    calls = counted(monkeypatch)
    system = System("s")
    for j in range(6):
        system.add(Fmu(file=adder, rate=RATE), f"f{j}")
        if j:
            system.connect(f"f{j - 1}.y", f"f{j}.u")
            system.connect(f"f{j - 1}.j", f"f{j}.i")
    simulation = Simulation(system, members=2)
    simulation.run_until("100")
    slots = simulation.master.wiring.slots
    for name in "yj":
        found = [slots[f"f{j}.{name}"].data[1, 0] for j in range(6)]
        assert found == [math.comb(1000, j + 1) for j in range(6)]
    simulation.master.terminate()
    assert not calls


def test_a_run_goes_on_from_a_saved_state(spring):
    """Saved after a chain, put back behind it: the same bits."""

    def springs():
        system = System("springs")
        for name in "ab":
            system.add(Fmu(file=spring(3), rate=Rate("0.01")), name)
        simulation = Simulation(system)
        simulation.run_until("0.5")
        return simulation, simulation.master.wiring.slots

    first, slots = springs()
    saved = first.get_state()
    first.run_until("1")
    end = {path: slot.data.copy() for path, slot in slots.items()}
    first.run_until("1.3")
    first.set_state(saved)
    first.run_until("1")
    assert all(np.array_equal(slots[p].data, end[p]) for p in end)
    first.master.terminate()


def test_ports_of_mixed_types_are_recorded_as_the_standard_has_them(worn, fly_as):
    """One step from 0: y = 1 of every whole number, True, t = 0 and 0.1 as a single."""
    fly_as("chain")
    system = System("s")
    system.add(Fmu(file=worn, rate=RATE), "a")
    system.record("r", [f"a.y_{t}" for t in TYPES])
    found = simulate(system, duration="0.1").dataset
    assert [found[f"a.y_{t}"].values[-1, 0].item() for t in (*WHOLE, "Boolean")] == [1] * 8 + [1]
    assert found["a.y_Float32"].values[-1, 0] == float(np.float32(0.1))
