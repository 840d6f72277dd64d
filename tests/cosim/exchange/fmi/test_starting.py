"""Initialization mode: what connected inputs are while FMUs find their start."""

from __future__ import annotations

import numpy as np
import pytest
from plain_fmus import V, plain_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.loop import FmuLoop
from terrafix.cosim.system.check import check
from terrafix.cosim.system.system import System

RATE = Rate("0.1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """p: x = 1 + t. q: its state starts from u, and follows it; y is the state."""
    folder = tmp_path_factory.mktemp("plain")
    plain_fmu(folder / "p.fmu", [V("x", "output", 1.0, depends="")], step="x = 1.0 + t + h;")
    plain_fmu(
        folder / "q.fmu",
        [V("u", "input", 0.0), V("y", "output", depends="u"), V("s", "local")],
        begin="s = u;",
        outputs="y = s;",
        step="s += h * u;",
    )
    return folder


def chain(folder, **settings):
    system = System("chain")
    system.add(Fmu(file=folder / "q.fmu", rate=RATE, **settings), "a_q")
    system.add(Fmu(file=folder / "p.fmu", rate=RATE), "p")
    system.connect("p.x", "a_q.u")
    return system


def at(system, times, *paths, members=1):
    simulation = Simulation(system, members=members)
    found = []
    for t in times:
        simulation.run_until(t)
        found.append([simulation.master.wiring.slots[p].data[:, 0].tolist() for p in paths])
    simulation.master.terminate()
    return np.array(found)


def test_a_state_starts_from_the_source_s_initial_output(folder):
    """y(0) = x(0) = 1; then y(0.1) = 1 + 0.1 x(0), y(0.2) = 1.1 + 0.1 x(0.1)."""
    found = at(chain(folder), ["0", "0.1", "0.2"], "a_q.y", members=2)
    assert found[:, 0, 0] == pytest.approx([1.0, 1.1, 1.21], abs=1e-15)
    assert np.array_equal(found[:, 0, 0], found[:, 0, 1])


def test_it_is_what_fmpy_has(folder):
    from fmpy import simulate_fmu

    u = np.array([(0.0, 1.0), (10.0, 1.0)], dtype=[("time", float), ("u", float)])
    rows = simulate_fmu(str(folder / "q.fmu"), stop_time=0.1, output_interval=0.1, input=u)
    found = at(chain(folder), ["0", "0.1"], "a_q.y")
    assert found[:, 0, 0].tolist() == rows["y"].tolist() == [1.0, 1.1]


def test_dependencies_that_are_declared(tmp_path):
    """By InitialUnknowns, by Outputs without these, on all inputs where neither says anything."""
    variables = [
        V("u", "input", 0.0),
        V("v", "input", 0.0),
        V("one", "output", depends="v"),
        V("none", "output", depends=""),
        V("all", "output"),
        V("held", "output", 1.0, initial="exact"),
    ]
    expected = {"one": {"v"}, "none": set(), "all": {"u", "v"}, "held": set()}
    for structure in (True, False):
        file = plain_fmu(tmp_path / "d.fmu", variables, structure=structure)
        fmu = Fmu(file=file, rate=RATE)
        System("alone").add(fmu, "a")
        assert {name: fmu.needed_by(name) for name in expected} == expected


def test_isolated_and_in_a_loop_component_too(folder):
    found = at(chain(folder, isolate=True), ["0", "0.1"], "a_q.y")
    assert found[:, 0, 0] == pytest.approx([1.0, 1.1], abs=1e-15)


def test_start_values_are_held_where_that_is_asked_for(folder):
    """As FMPy's `simulate_ssp`, which feeds the start value 0 through the first step."""
    found = at(chain(folder, hold_start_values=True), ["0", "0.1", "0.2"], "a_q.y")
    assert found[:, 0, 0] == pytest.approx([0.0, 0.0, 0.11], abs=1e-15)


# ------------------------------------------------------------------ several that wait for each other


def pair(file, *links, delay=0):
    system = System("pair")
    for name in "ab":
        system.add(Fmu(file=file, rate=RATE), name)
    for source, target in links:
        system.connect(source, target, delay=delay)
    return system


@pytest.mark.parametrize("declared", [True, False])
def test_outputs_reach_inputs_in_the_order_of_what_they_depend_on(tmp_path, declared):
    """a.y = 2, b.z = 3 b.u = 6, a starts from a.u = 6: also where nothing is declared."""
    depends = {"y": "", "z": "u"} if declared else {"y": None, "z": None}
    file = plain_fmu(
        tmp_path / "r.fmu",
        [
            V("u", "input", -1.0),
            V("y", "output", 2.0, depends=depends["y"]),
            V("z", "output", depends=depends["z"]),
            V("s", "output"),
            V("seen", "local"),
        ],
        begin="s = u;",
        outputs="y = 2.0; z = 3.0 * u;",
    )
    system = pair(file, ("a.y", "b.u"), ("b.z", "a.u"))
    found = at(system, ["0"], "b.s", "a.s", "b.z", "a.z")
    assert found[0, :, 0].tolist() == [2.0, 6.0, 6.0, 18.0]
    noted = [n for n in check(system).notes if "depend on each other" in n]
    assert len(noted) == (0 if declared else 1)


@pytest.fixture(scope="module")
def affine(tmp_path_factory):
    """y = gain u + 1, at once."""
    return {
        gain: plain_fmu(
            tmp_path_factory.mktemp("affine") / "affine.fmu",
            [V("u", "input", 0.0), V("y", "output", depends="u"), V("s", "output", depends="u")],
            begin="s = u;",
            outputs=f"y = {gain} * u + 1.0;",
        )
        for gain in (0.5, 2.0)
    }


def test_a_loop_is_repeated_until_it_stands_still(affine):
    """y = 0.5 y + 1 has the solution 2."""
    system = pair(affine[0.5], ("a.y", "b.u"), ("b.y", "a.u"))
    found = at(system, ["0"], "a.y", "b.s")
    assert found[0, :, 0] == pytest.approx([2.0, 2.0], abs=1e-11)
    assert (
        "at t = 0, 'a.y -> b.u', 'b.y -> a.u' depend on each other: they are repeated from start "
        "values until they stand still" in check(system).notes
    )


def test_a_loop_settles_with_a_process_for_each_member(tmp_path, caplog):
    """y = 0.5 y + 1 has the solution 2, and each member's log comes with its name."""
    say = 'm->callbacks->logger(m->callbacks->componentEnvironment, "plain", fmi2Warning, "log",'
    file = plain_fmu(
        tmp_path / "affine.fmu",
        [V("u", "input", 0.0), V("y", "output", depends="u"), V("s", "output", depends="u")],
        begin=f's = u; {say} "starts from %.9g", u);',
        outputs="y = 0.5 * u + 1.0;",
        interface=' canBeInstantiatedOnlyOncePerProcess="true"',
    )
    system = pair(file, ("a.y", "b.u"), ("b.y", "a.u"))
    simulation = Simulation(system, members=2)
    simulation.run_until("0.1")
    slots = simulation.master.wiring.slots
    found = np.concatenate([slots[p].data[:, 0] for p in ("a.y", "b.s")])
    simulation.master.terminate()
    assert found == pytest.approx([2.0] * 4, abs=1e-11)
    said = [r.getMessage() for r in caplog.records if "starts from" in r.getMessage()]
    assert sorted(said) == [
        f"'{name}', member {k}, t = 0 s: Warning: starts from 2" for name in "ab" for k in (0, 1)
    ]


def test_a_loop_that_does_not_settle_is_named(affine):
    system = pair(affine[2.0], ("a.y", "b.u"), ("b.y", "a.u"))
    with pytest.raises(StepError, match=r"'a.y -> b.u', 'b.y -> a.u' did not settle in 1000"):
        at(system, ["0"], "a.y")


def test_a_delay_opens_it(affine):
    """With nothing arrived, u is its start value 0, and y = 1."""
    system = pair(affine[2.0], ("a.y", "b.u"), ("b.y", "a.u"), delay="0.1")
    assert at(system, ["0"], "a.y", "a.s")[0, :, 0].tolist() == [1.0, 0.0]


class Gain(Component):
    """y = 3 x, read at the end of a step."""

    default_rate = RATE
    x = Input((), doc="in")
    y = Output((), doc="out")

    def _initialize_impl(self):
        self.y[...] = 3 * self.x

    def _step_impl(self, t, dt):
        self._initialize_impl()


def closed_by_a_native(file):
    system = System("closed")
    system.add(Fmu(file=file, rate=RATE), "a")
    system.add(Gain(), "gain")
    system.connect("a.y", "gain.x")
    system.connect("gain.y", "a.u")
    return system


def test_a_loop_through_a_native_component(affine, tmp_path):
    """It cannot be repeated: a.u keeps its start value 0, and that is said."""
    system = closed_by_a_native(affine[0.5])
    assert at(system, ["0"], "a.y", "gain.y", "a.s")[0, :, 0].tolist() == [1.0, 3.0, 0.0]
    assert any(n.startswith("at t = 0, 'gain.y -> a.u' would close") for n in check(system).notes)
    file = plain_fmu(
        tmp_path / "plant.fmu",
        [V("u", "input", 0.0), V("y", "output", depends=""), V("s", "output", depends="u")],
        begin="s = u;",
        outputs="y = 2.0;",
    )  # whose y is known without u: then u is 6
    system = closed_by_a_native(file)
    assert at(system, ["0"], "a.y", "gain.y", "a.s")[0, :, 0].tolist() == [2.0, 6.0, 6.0]


def test_a_loop_component_hands_on_within_before_the_start(folder):
    """q starts from p.x = 1."""
    files = {n: folder / f"{n}.fmu" for n in "pq"}
    system = System("loop")
    system.add(FmuLoop(files=files, connect="p.x -> q.u", rate=RATE), "both")
    assert at(system, ["0"], "both.p_x", "both.q_y")[0, :, 0].tolist() == [1.0, 1.0]


# ------------------------------------------------------------------ whole numbers


def whole(tmp_path):
    kinds = {"Integer": "i", "Boolean": "b", "Enumeration": "e"}
    source = plain_fmu(
        tmp_path / "source.fmu",
        [V(f"{n}_out", "output", kind=k, depends="") for k, n in kinds.items()],
        outputs="i_out = 7; b_out = 1; e_out = 3;",
    )
    sink = plain_fmu(
        tmp_path / "sink.fmu",
        [
            *(V(n, "input", s, k) for (k, n), s in zip(kinds.items(), (5, True, 2), strict=True)),
            *(V(f"{n}_first", "output", kind=k) for k, n in kinds.items()),
        ],
        begin="i_first = i; b_first = b; e_first = e;",
        check='if (e < 1 || e > 3) REFUSE("0 is not a legal value");',
    )
    return source, sink


@pytest.mark.parametrize(
    ("delay", "isolate", "expected"),
    [("0", False, [7, 1, 3]), ("0", True, [7, 1, 3]), ("0.2", False, [5, 1, 2])],
)
def test_whole_numbers_start_from_their_source_or_their_start_value(
    tmp_path, delay, isolate, expected
):
    """Never from 0, which an enumeration need not have; nothing delayed has arrived at t = 0."""
    source, sink = whole(tmp_path)
    system = System("whole")
    system.add(Fmu(file=sink, rate=RATE, isolate=isolate), "a_sink")
    system.add(Fmu(file=source, rate=RATE), "source")
    for name in "ibe":
        system.connect(f"source.{name}_out", f"a_sink.{name}", delay=delay)
    found = at(system, ["0", "0.3"], *(f"a_sink.{n}_first" for n in "ibe"))
    assert found[0, :, 0].tolist() == expected


# ------------------------------------------------------------------ text, and another start time


@pytest.mark.parametrize("isolate", [False, True])
def test_text_and_exact_outputs_are_set_before_the_start(tmp_path, isolate):
    """The FMU counts the letters of its word; its clock stands at 5 s at t = 0."""
    file = plain_fmu(
        tmp_path / "letters.fmu",
        [
            V("word", "parameter", "no", "String"),
            V("level", "output", 4.0, initial="exact"),
            V("letters", "output", kind="Integer"),
            V("time", "output"),
        ],
        begin="time = t; letters = (int)strlen(word);",
        step="time = t + h;",
    )
    system = System("text")
    start = {"word": "hello", "level": 8.0}
    system.add(Fmu(file=file, rate=RATE, start=start, start_time=5.0, isolate=isolate), "a")
    found = at(system, ["0", "0.1"], "a.letters", "a.level", "a.time")
    assert found[:, :, 0] == pytest.approx(np.array([[5, 8, 5.0], [5, 8, 5.1]]))


def test_text_that_is_no_text(tmp_path):
    file = plain_fmu(tmp_path / "t.fmu", [V("word", "parameter", "no", "String")])
    system = System("text")
    with pytest.raises(ConfigurationError, match=r"'a.start.word' is text, not 3"):
        system.add(Fmu(file=file, rate=RATE, start={"word": 3}), "a")
