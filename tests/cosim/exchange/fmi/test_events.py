"""Events of imported FMUs: discrete inputs, time events, models without states, an early end."""

from __future__ import annotations

import foreign
import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import StepError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.system.system import System


class Stairs(Component):
    """k at the k-th step, and whether k is odd."""

    default_rate = Rate("0.1")

    u = Output((), unit="1")
    b = Output((), unit="1", dtype=np.bool_)

    def _initialize_impl(self):
        self.port_views["u"][...], self.port_views["b"][...] = 0.0, False

    def _step_impl(self, t, dt):
        self.port_views["u"][...] = self.step_index
        self.port_views["b"][...] = self.step_index % 2 == 1


def driven(file, **options):
    with System("driven") as system:
        system.add(Stairs(), "stairs")
        system.add(Fmu(file=file, rate=Rate("0.1"), **options), "part")
        system.connect("stairs.u", "part.u")
        system.connect("stairs.b", "part.b")
        system.record("history", ["part.y"])
    return system


# ------------------------------------------------------------------ model exchange


@pytest.mark.parametrize("solver", ["cvode", "dop853"])
@pytest.mark.parametrize("n_states", [0, 1])
def test_discrete_inputs_time_events_and_zero_nominals(tmp_path, solver, n_states):
    """The FMU refuses any call in a mode that FMI 2 does not allow it in.

    At t = 1 s: x = 0.1 (0 + 1 + ... + 9) = 4.5, four events of 0.25 s, and the step began with
    u = 9 and b = 1. The nominal value of x is 0.
    """
    file = foreign.strict(tmp_path / "strict.fmu", n_states=n_states)
    y = simulate(driven(file, solver=solver), duration="1").dataset["part.y"].values[:, 0]
    assert y[0].tolist() == [0.0, 0.0, 0.0]
    assert y[-1, 1:].tolist() == [4.0, 19.0]
    assert y[-1, 0] == pytest.approx(4.5 if n_states else 0.0, abs=1e-9)
    assert y[:, 1].tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4]


def test_an_fmu_that_asks_for_an_event_again_and_again(tmp_path):
    file = foreign.strict(tmp_path / "stuck.fmu", n_states=1, stuck=True)
    with pytest.raises(StepError, match=r"event after event at t = 0.25 s: time stands still"):
        simulate(driven(file), duration="1")
