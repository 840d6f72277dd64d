"""What a step of co-simulation is told: when it ends, and how exact it must be."""

from __future__ import annotations

import numpy as np
import pytest
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run import fleet
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.loop import FmuLoop
from terrafix.cosim.system.system import System


def alone(part):
    system = System("alone")
    system.add(part, "part")
    return system


def final(part, path="part.y"):
    simulation = Simulation(alone(part))
    simulation.run_until("0.1")
    found = float(simulation.master.wiring.slots[path].data.ravel()[0])
    simulation.master.terminate()
    return found


@pytest.fixture(scope="module")
def teller(tmp_path_factory):
    """y is the tolerance that the FMU was given, -1 if none: ``teller(2, 'tolerance="1e-4"')``."""
    folder = tmp_path_factory.mktemp("tellers")

    def get(fmi, experiment=""):
        return small_fmu(
            folder / f"{fmi}{len(experiment)}.fmu",
            fmi,
            [Variable("y", start="0.0"), Variable("u", causality="input", start="0.0")],
            step="m->r[0] = m->tolerance;",
            experiment=experiment,
        )

    return get


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_tolerance_of_the_default_experiment_is_handed_on_and_can_be_set(teller, fmi):
    file, silent = teller(fmi, 'tolerance="1e-4"'), teller(fmi)
    rate = Rate("0.1")
    assert final(Fmu(file=file, rate=rate)) == 1e-4
    assert final(Fmu(file=file, rate=rate, tolerance=1e-7)) == 1e-7
    assert final(Fmu(file=silent, rate=rate)) == -1.0
    assert final(Fmu(file=silent, rate=rate, tolerance=1e-7, isolate=True)) == 1e-7
    if fmi == 2:
        fmpy = pytest.importorskip("fmpy")
        found = fmpy.simulate_fmu(str(file), stop_time=0.1, output_interval=0.1, output=["y"])
        assert float(found["y"][-1]) == 1e-4


STATE = {
    "interface": ' canGetAndSetFMUstate="true"',
    "globals_": "".join(
        f"EXPORT int fmi2{n}(void *m, void *s) {{ return 0; }}"
        for n in ("GetFMUstate", "SetFMUstate", "FreeFMUstate")
    ),
}


def test_ports_of_a_loop_that_would_have_one_name_are_refused(tmp_path):
    """Output b_y of FMU a, and y of FMU a_b: one stood for both, without a word."""
    files = {
        "a": small_fmu(tmp_path / "a.fmu", 2, [Variable("b_y", start="1.0")], **STATE),
        "a_b": small_fmu(tmp_path / "ab.fmu", 2, [Variable("y", start="2.0")], **STATE),
    }
    loop = FmuLoop(files=files, connect="", rate=Rate("0.1"))
    with pytest.raises(
        ConfigurationError, match="a port of its FMUs would be called 'a_b_y', as an"
    ):
        final(loop, "part.a_b_y")


def test_a_loop_hands_the_tolerance_on(tmp_path):
    file = small_fmu(
        tmp_path / "t.fmu",
        2,
        [Variable("y", start="0.0"), Variable("u", causality="input", start="0.0")],
        step="m->r[0] = m->tolerance;",
        experiment='tolerance="1e-4"',
        **STATE,
    )
    loop = FmuLoop(files={"a": file}, connect="a.y -> a.u", rate=Rate("0.1"))
    assert final(loop, "part.a_y") == 1e-4


@pytest.mark.parametrize("driven", [True, False])
@pytest.mark.parametrize("step", ["1/100", "1/30", "0.1"])
def test_a_fixed_step_fmu_skips_no_step(tmp_path, monkeypatch, step, driven):
    """It takes a step of its own wherever k h <= t_now + h; after n steps it has taken n.

    With h itself instead of t_next - t_now, t + h lies below k h by a rounding every few steps.
    """
    if not driven:
        monkeypatch.setattr(fleet, "_driver", lambda: None)
    over = {"1/100": 100.0, "1/30": 30.0, "0.1": 10.0}[step]
    file = small_fmu(
        tmp_path / "fixed.fmu",
        2,
        [Variable("y", start="0.0")],
        step=f"while ((m->r[0] + 1) / {over} <= t + h) m->r[0] += 1;",
    )
    system = alone(Fmu(file=file, rate=Rate(step)))
    system.record("r", ["part.y"])
    found = simulate(system, duration="10").dataset["part.y"].values.ravel()
    expected = np.arange(10 * over + 1)
    assert found.tolist() == expected.tolist()
