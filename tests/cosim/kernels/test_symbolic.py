"""Symbolic components by themselves: their clock, their noise, their start and their messages."""

import casadi as ca
import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.noise import NormalStream
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, MessageInput, MessageOutput, Output
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model

needs_compiler = pytest.mark.skipif(toolchain.find_compiler() is None, reason="no C compiler")
kinds = pytest.mark.parametrize(
    "kind",
    [pytest.param("vector", marks=needs_compiler), pytest.param("c", marks=needs_compiler), "vm"],
)


class Drift(SymbolicComponent):
    """Adds up two noises, and says what time it is."""

    default_rate = Rate("0.5")
    x = Output((2,))
    when = Output(unit="s")
    length = Output(unit="s")

    def build_model(self):
        """Build the model."""
        x, v, w = ca.SX.sym("x", 2), ca.SX.sym("v", 2), ca.SX.sym("w")
        t, dt = ca.SX.sym("t"), ca.SX.sym("dt")
        return Model(
            "drift",
            states={"x": x},
            noise={"v": v, "w": w},
            next={"x": x + v + 10 * w},
            outputs={"x": x, "when": t, "length": dt},
            step=dt,
            time=t,
        )


@kinds
@pytest.mark.parametrize("seed", [3, 3 + 2**32])
def test_noise_is_that_of_seed_path_stream_member_and_step(toys, kind, seed, monkeypatch):
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    drift, members = Drift(), [9, 2, 5]
    toys.fly(toys.wire({"d": drift}, []), 2, members=members, seed=seed)
    v, w = (NormalStream(seed, "d", stream, members) for stream in "vw")
    x = np.zeros((3, 2))
    for step in (1, 2, 3, 4):
        x = x + v.draw(step, 2) + 10 * w.draw(step, 1)
    np.testing.assert_allclose(drift.x, x, rtol=1e-14)
    assert drift.when.tolist() == [2.0] * 3
    assert drift.length.tolist() == [0.5] * 3


@kinds
def test_a_component_flown_again_is_flown_as_it_is_asked_to(toys, kind, monkeypatch):
    """With noise, nominally, and with noise again: the kernel of one is not that of the other."""
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    drift = Drift()
    system = toys.wire({"d": drift}, [])
    found = []
    for quiet in (False, True, False):
        simulation = toys.fly(system, 1, quiet=quiet)
        found.append(drift.x.tolist())
        simulation.master.terminate()
    assert found[1] == [[0, 0]]
    assert found[0] == found[2] != [[0, 0]]


class Elapsed(SymbolicComponent):
    """Adds up the lengths of its steps."""

    x = Output(unit="s")

    def build_model(self):
        """Build the model."""
        x, dt = ca.SX.sym("x"), ca.SX.sym("dt")
        return Model("elapsed", states={"x": x}, next={"x": x + dt}, outputs={"x": x}, step=dt)


@kinds
@pytest.mark.parametrize(
    ("rate", "end", "last"),
    [
        (Rate("0.25", offset="1.5"), "5.1", 5.0),  # 1.5 s, then 14 steps of 0.25 s
        (Rate("0.25", offset="0.125"), 3, 2.875),  # 0.125 s, then 11
        (Rate("0.25"), "2.3", 2.25),
        (Rate(times=["0.5", "0.75", "4"]), 5, 4.0),
    ],
)
def test_steps_add_up_to_the_last_activation(toys, kind, rate, end, last, monkeypatch):
    """All in binary fractions, so that the sum is exact."""
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    elapsed = Elapsed(rate=rate)
    toys.fly(toys.wire({"e": elapsed, "base": toys.Clock(rate=Rate("0.125"))}, []), end)
    assert elapsed.x.tolist() == [last]
    alone = Elapsed(rate=rate)
    toys.fly(toys.wire({"e": alone}, []), end)
    assert alone.x.tolist() == [last]


class Total(SymbolicComponent):
    """Adds up what it reads."""

    default_rate = Rate("0.25")
    u = Input(unit="s")
    x = Output(unit="s")

    def build_model(self):
        """Build the model."""
        x, u = ca.SX.sym("x"), ca.SX.sym("u")
        return Model("total", inputs={"u": u}, states={"x": x}, next={"x": x + u}, outputs={"x": x})


class TotalBefore(Total):
    """Adds up what it read a step before."""

    u = Input(unit="s", at="start")


@kinds
@pytest.mark.parametrize("name", ["a", "z"])  # before and after the source by name
def test_a_slow_source_is_read_at_its_own_tick_or_a_step_later(toys, kind, name, monkeypatch):
    """Four reads a second of 0, 1, 2, 3 s: 4 (0 + 1 + 2 + 3) of t - 1/4, and 4 more with t = 4."""
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    for total, expected in ((Total(), 28.0), (TotalBefore(), 24.0)):
        system = toys.wire({"m": toys.Clock(), name: total}, [f"m.t -> {name}.u"])
        toys.fly(system, 4)
        assert total.x.tolist() == [expected]


class Root(SymbolicComponent):
    """The root of a parameter, beside a number that is always finite."""

    default_rate = Rate("1")
    square = Parameter(4.0)
    y = Output((2,))

    def build_model(self):
        """Build the model."""
        square = ca.SX.sym("square")
        return Model(
            "root", parameters={"square": square}, outputs={"y": ca.vertcat(1, ca.sqrt(square))}
        )


def test_a_member_whose_start_is_not_finite_fails_alone_and_by_its_number(toys):
    """Of members 4, 7, 9 the first has failed before, and the root of -1 is no number."""

    class Early(toys.Clock):
        def _initialize_impl(self):
            super()._initialize_impl()
            self.fail(self.environment.members == 4, "early")

    system = toys.wire({"a": Early(), "z": Root()}, [])
    simulation = Simulation(system, members=[4, 7, 9])
    system.nodes["z"].parameter_values["square"][:] = 1.0, -1.0, 16.0
    simulation.run_until(2)
    failed = [(e["member"], e["component"], e["t_s"]) for e in simulation.master.excluded]
    assert failed == [(4, "a", 0.0), (7, "z", 0.0)]
    assert system.nodes["z"].y[2].tolist() == [1, 4]


def test_a_member_that_fails_later_does_so_once_and_the_next_in_its_turn(toys):
    system = toys.wire({"z": Root()}, [])
    simulation = Simulation(system, members=[4, 7, 9])
    simulation.run_until(1)
    for t, member in ((2, 1), (3, 0)):
        system.nodes["z"].parameter_values["square"][member] = -1.0
        simulation.run_until(t)
    assert [(e["member"], e["t_s"]) for e in simulation.master.excluded] == [(7, 2.0), (4, 3.0)]


@kinds
def test_a_member_that_failed_flies_again_from_an_earlier_state(toys, kind, monkeypatch):
    """Back at t = 1 s, with a square of 9, it has a root again: its failure left no mark."""
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    root = Root()
    simulation = Simulation(toys.wire({"z": root}, []), members=2)
    simulation.run_until(1)
    saved = simulation.get_state()
    root.parameter_values["square"][1] = -1.0
    simulation.run_until(3)
    assert simulation.master.active.tolist() == [True, False]
    simulation.set_state(saved)
    root.parameter_values["square"][1] = 9.0
    simulation.run_until(3)
    assert simulation.master.active.tolist() == [True, True]
    assert root.y.tolist() == [[1, 2], [1, 3]]


class Waiting(SymbolicComponent):
    """Cannot begin without a message."""

    default_rate = Rate("1")
    note = MessageInput((2,), unit="m", needed_at_start=True)
    y = Output()

    def build_model(self):
        """Build the model."""
        note = ca.SX.sym("note", 2)
        return Model("waiting", inputs={"note": note}, outputs={"y": note[1]})


def test_a_member_without_the_message_that_is_needed_at_start_is_excluded(toys):
    """Of members 3 and 8 the message of t = 0 reaches the even one."""
    plan = lambda step, members: members % 2 == 0  # noqa: E731 - reads as data
    parts = {"a": toys.Sender(plan, at_start=True), "w": Waiting()}
    simulation = toys.fly(toys.wire(parts, ["a.note -> w.note"]), 2, members=[3, 8])
    (failure,) = simulation.master.excluded
    assert (failure["member"], failure["t_s"]) == (3, 0.0)
    assert failure["reason"] == "no 'note' was received at t = 0"
    assert parts["w"].y[1] == 8


class Teller(SymbolicComponent):
    """Sends what it reads if that is above 1.5."""

    default_rate = Rate("1")
    u = Input(unit="s")
    note = MessageOutput(unit="s")

    def build_model(self):
        """Build the model."""
        u = ca.SX.sym("u")
        return Model("teller", inputs={"u": u}, outputs={"note.": u, "note.valid": u > 1.5})


class Always(Teller):
    """Sends at each step: it says nothing of whom it reaches."""

    def build_model(self):
        """Build the model."""
        u = ca.SX.sym("u")
        return Model("always", inputs={"u": u}, outputs={"note.": u})


@pytest.mark.parametrize(
    ("kind", "rate", "expected"),
    [
        (Teller, Rate("1"), [2, 3]),
        (Always, Rate("1"), [0, 1, 2, 3]),
        (Always, Rate("1", offset="2"), [2, 3]),  # 0 is no activation
    ],
)
def test_a_message_is_sent_when_the_model_says_so_and_at_zero_if_that_is_a_step(
    toys, kind, rate, expected
):
    class Listener(toys.Reader):
        note = MessageInput(unit="s")

    reader = Listener(rate=Rate("0.5"))
    links = ["c.t -> t.u", "t.note -> r.note"]
    toys.fly(toys.wire({"c": toys.Clock(), "t": kind(rate=rate), "r": reader}, links), 3)
    assert [validity for _, _, validity, _ in reader.found] == expected
    assert [value for *_, value in reader.found] == expected


@pytest.mark.parametrize("declared", [Parameter(0.0, unit="s"), Input(unit="s"), Output(unit="s")])
def test_the_name_of_the_clock_cannot_be_declared(declared):
    """It would be overwritten by the clock without a word; a component of one's own may have it."""
    with pytest.raises(
        TypeError, match=r"reserved names \['time'\]: a kernel .*\n  call it otherwise"
    ):
        type("Late", (Drift,), {"time": declared})
    type("Free", (Component,), {"time": Output(unit="s")})
