"""Stretches of ticks in one call leave what a call per tick would have left."""

import casadi as ca
import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import StepError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, MessageInput, MessageOutput, Output
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.kernels.stretch import Stretch
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.system.system import System
from terrafix.models.core.model import Model

pytestmark = pytest.mark.skipif(toolchain.find_compiler() is None, reason="no C compiler")


class Source(SymbolicComponent):
    """Walks; a member fails when it reaches its wall."""

    default_rate = Rate(hz=100)
    wall = Parameter(1e9)
    y = Output((2,))
    sensed = Output(doc="depends on the time")

    def build_model(self):
        """Build the model."""
        x, w, wall = ca.SX.sym("x", 2), ca.SX.sym("w", 2), ca.SX.sym("wall")
        dt, t = ca.SX.sym("dt"), ca.SX.sym("t")
        following = x + dt + 0.001 * w
        return Model(
            "source",
            states={"x": x},
            parameters={"wall": wall},
            noise={"w": w},
            next={"x": following},
            outputs={"y": x, "sensed": ca.sqrt(wall - x[0]) + t},
            step=dt,
            time=t,
        )


class Sum(SymbolicComponent):
    """Adds what it reads; starts anew from a message."""

    default_rate = Rate(hz=100)
    u = Input((2,))
    reset = MessageInput(at="start", optional=True)
    total = Output()

    def build_model(self):
        """Build the model."""
        s, u = ca.SX.sym("s"), ca.SX.sym("u", 2)
        reset, fresh = ca.SX.sym("reset"), ca.SX.sym("fresh")
        following = ca.if_else(fresh > 0.5, reset, s) + u[0] * u[1]
        return Model(
            "sum",
            inputs={"u": u, "reset.": reset, "reset.fresh": fresh},
            states={"s": s},
            next={"s": following},
            outputs={"total": s},
        )


class Resetter(Component):
    """Sends every other member a number, now and then."""

    default_rate = Rate("0.35", offset="0.35")
    total = Input()
    reset = MessageOutput()

    def _step_impl(self, t, dt):
        self.reset.publish(t, 0.5 * self.total, valid=self.environment.members % 2 == 0)


def built(walls=False):
    system = System("chain", duration=3)
    source, total = system.add(Source(), "source"), system.add(Sum(), "sum")
    resetter = system.add(Resetter(), "resetter")
    system.connect(source["y"], total["u"])
    system.connect(total["total"], resetter["total"])
    system.connect(resetter["reset"], total["reset"])
    system.record("slow", ["source.y", "source.sensed", "sum.total"], rate=Rate("0.25"))
    return system


def fly(kind, monkeypatch, members=21, walls=None, stop=None):
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    simulation = Simulation(built(), members=members)
    if walls is not None:
        wall = simulation.plan.flat.components["source"].parameter_values["wall"]
        wall[:] = walls[simulation.members]
    simulation.initialize()
    if stop is not None:
        simulation.run_until(stop)
        saved = simulation.get_state()
        simulation.master.terminate()
        simulation = Simulation(built(), members=members)
        if walls is not None:
            simulation.plan.flat.components["source"].parameter_values["wall"][:] = walls
        simulation.set_state(saved)
    simulation.run_until(3)
    _, recorded = simulation.recorders[0].history()
    slots = {k: s.data.tobytes() for k, s in simulation.master.wiring.slots.items()}
    steps = {p: c.step_index for p, c in simulation.plan.flat.components.items()}
    found = (
        {k: v.tobytes() for k, v in recorded.items()},
        slots,
        steps,
        simulation.master.excluded,
        simulation.master.component_steps,
        simulation.master.active.tobytes(),
    )
    simulation.master.terminate()
    return found


def walls_of(n):
    walls = np.full(n, 1e9)
    walls[[3, 4, 11, 17]] = 0.777, 1.5, 1.5003, 2.99
    return walls


def test_stretches_are_flown(monkeypatch):
    flown = []
    real = Stretch.fly
    monkeypatch.setattr(
        Stretch, "fly", lambda self, *a, **k: flown.append(k["n_ticks"]) or real(self, *a, **k)
    )
    fly("vector", monkeypatch)
    assert sum(flown) > 250  # of 300 ticks


class Stairs(Component):
    """Publishes the time of its step."""

    default_rate = Rate("0.1")
    t = Output((2,))

    def _initialize_impl(self):
        self.t = 0.0

    def _step_impl(self, t, dt):
        self.t = [t, 1.0]


@pytest.mark.parametrize("name", ["a", "z"])
def test_a_stretch_ends_before_somebody_else_is_due(name):
    """At tick k of 10 ms, 0.1 floor(k / 10) is read: in 1 s that adds up to 0.1 (10 * 45 + 10)."""
    system = System("stairs", duration=1)
    stairs, total = system.add(Stairs(), name), system.add(Sum(), "sum")
    system.connect(stairs["t"], total["u"])
    simulation = Simulation(system)
    simulation.run_until(1)
    assert simulation.master.wiring.slots["sum.total"].data[0, 0] == pytest.approx(46.0)
    simulation.master.terminate()


@pytest.mark.parametrize("members", [1, 8, 21])
def test_bytes_are_those_of_a_call_per_tick(members, monkeypatch):
    assert fly("vector", monkeypatch, members) == fly("c", monkeypatch, members)


def test_members_that_fail_on_the_way_are_excluded_alike(monkeypatch):
    """Same time, component and reason; outputs nobody reads hold the value before."""
    walls = walls_of(21)
    ours, theirs = (fly(kind, monkeypatch, walls=walls) for kind in ("vector", "c"))
    assert sorted(e["member"] for e in ours[3]) == [3, 4, 11, 17]
    assert ours == theirs


def test_threads_change_nothing(monkeypatch):
    walls = np.full(130, 1e9)
    walls[[5, 70, 129]] = 0.5, 1.25, 2.5
    whole = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("TERRAFIX_THREADS", threads)
        whole.append(fly("vector", monkeypatch, members=130, walls=walls))
    assert whole[0] == whole[1] == whole[2]


def test_a_checkpoint_in_the_middle_changes_nothing(monkeypatch):
    walls = walls_of(21)
    whole = fly("vector", monkeypatch, walls=walls)
    parts = fly("vector", monkeypatch, walls=walls, stop="1.23")
    assert whole[1:4] == parts[1:4]


@pytest.mark.parametrize("kind", ["vector", "c"])
def test_a_run_ends_where_the_last_member_fails(kind, monkeypatch):
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    simulation = Simulation(built(), members=3)
    simulation.plan.flat.components["source"].parameter_values["wall"][:] = 0.5, 0.75, 1.0
    simulation.initialize()
    with pytest.raises(StepError, match=r"no member is left at t = 1\.02 s .*\n.*member 2"):
        simulation.run_until(3)
    assert [e["member"] for e in simulation.master.excluded] == [0, 1, 2]
    times, _ = simulation.recorders[0].history()
    assert times.tolist() == [0, 0.25, 0.5, 0.75, 1]
    simulation.master.terminate()
