"""Events of imported FMUs: discrete inputs, time events, models without states, an early end."""

from __future__ import annotations

import eventful
import numpy as np
import pytest
from click.testing import CliRunner
from fmu_helpers import broken

from terrafix.cli import main
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run import fleet
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.files.writing import write_system
from terrafix.cosim.records.checkpoint import read_checkpoint, write_checkpoint
from terrafix.cosim.system.dispersion import Dispersion
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
@pytest.mark.parametrize(("n_states", "continuous"), [(0, False), (1, False), (1, True)])
def test_inputs_that_jump_time_events_and_zero_nominals(tmp_path, solver, n_states, continuous):
    """The FMU refuses any call in a mode that FMI 2 does not allow it in.

    Its real input is discrete, or a continuous one, of which FMI makes a jump an event.

    At t = 1 s: x = 0.1 (0 + 1 + ... + 9) = 4.5, four events of 0.25 s, and the step began with
    u = 9 and b = 1. The nominal value of x is 0.
    """
    file = eventful.strict(tmp_path / "strict.fmu", n_states=n_states, continuous=continuous)
    y = simulate(driven(file, solver=solver), duration="1").dataset["part.y"].values[:, 0]
    assert y[0].tolist() == [0.0, 0.0, 0.0]
    assert y[-1, 1:].tolist() == [4.0, 19.0]
    assert y[-1, 0] == pytest.approx(4.5 if n_states else 0.0, abs=1e-9)
    assert y[:, 1].tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4]


def test_an_input_that_was_not_set_at_the_start_is_set_in_the_first_step(tmp_path):
    """x' = u, u 5 in the FMU: nothing comes over the delay at the start, and then zeros."""
    with System("unset") as system:
        system.add(Stairs(), "stairs")
        system.add(Fmu(file=eventful.unset(tmp_path / "unset.fmu"), rate=Rate("0.1")), "part")
        system.connect("stairs.u", "part.u", delay="0.2")
        system.record("history", ["part.y"])
    y = simulate(system, duration="0.2").dataset["part.y"].values[:, 0, 0]
    assert y.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("solver", ["cvode", "dop853"])
def test_an_event_of_which_the_derivative_tells_later(tmp_path, solver):
    """x' = 0 until 0.25 s, then t - 0.25 s: x(2 s) = 1.75^2 / 2. x' itself does not jump."""
    with System("late") as system:
        file = eventful.late(tmp_path / "late.fmu")
        system.add(Fmu(file=file, solver=solver, rate=Rate("0.1")), "part")
        system.record("history", ["part.y"])
    y = simulate(system, duration="2").dataset["part.y"].values[-1, 0]
    assert y[0] == pytest.approx(1.75**2 / 2, abs=1e-8)


def test_an_fmu_that_asks_for_an_event_again_and_again(tmp_path):
    file = eventful.strict(tmp_path / "stuck.fmu", n_states=1, stuck=True)
    with pytest.raises(StepError, match=r"event after event at t = 0.25 s: time stands still"):
        simulate(driven(file), duration="1")


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return eventful.ball(tmp_path_factory.mktemp("balls") / "ball.fmu")


def bouncing(file, **options):
    with System("bouncing") as system:
        system.add(Fmu(file=file, rate=Rate("0.1"), **options), "ball")
        names = ("h", "v", "last", "bounces", "ticks", "entered")
        system.record("history", [f"ball.{name}" for name in names])
    return system


@pytest.mark.parametrize(("solver", "error"), [("cvode", 1e-7), ("dop853", 1e-13)])
def test_a_ball_bounces_when_it_should(ball, solver, error):
    """It falls for t1 = sqrt(2 / g); the n-th bounce is 2 t1 (0.7 + ... + 0.7^(n - 1)) later.

    Until 2 s there are four (0.447, 1.073, 1.512, 1.818 s), and eight time events.
    """
    found = simulate(bouncing(ball, solver=solver), duration="2").dataset
    first = np.sqrt(0.2)
    times = first * (1.0 + 2.0 * np.cumsum([0.0, *0.7 ** np.arange(1, 9)]))
    t = np.arange(21) / 10
    n = np.searchsorted(times, t)
    since = t - np.where(n > 0, times[n - 1], 0.0)
    speed = np.where(n > 0, 10.0 * first * 0.7**n, 0.0)
    height = np.where(n > 0, 0.0, 1.0) + speed * since - 5.0 * since**2
    assert found["ball.bounces"].values[:, 0].tolist() == n.tolist()
    assert n[-1] == 4
    last = np.where(n > 0, times[n - 1], 0.0)
    assert found["ball.last"].values[:, 0] == pytest.approx(last, abs=error)
    assert found["ball.h"].values[:, 0] == pytest.approx(height, abs=20 * error)
    assert found["ball.ticks"].values[-1, 0] == 8


@pytest.mark.parametrize("solver", ["cvode", "dop853"])
def test_an_event_indicator_of_time_alone(tmp_path, solver):
    """Without continuous states, it passes 0 at 1/3 s; event mode is entered there, and every 0.25 s."""
    file = eventful.ball(tmp_path / "still.fmu", still=True)
    found = simulate(bouncing(file, solver=solver), duration="0.6").dataset
    assert found["ball.last"].values[-1, 0] == pytest.approx(1 / 3, abs=1e-12)
    assert found["ball.bounces"].values[:, 0].tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert found["ball.entered"].values[-1, 0] == 3


@pytest.mark.parametrize(("solver", "error"), [("cvode", 1e-7), ("dop853", 0.0)])
def test_a_restored_model_goes_on_without_an_event_of_its_own(ball, tmp_path, solver, error):
    """The time of its next event is restored with its state: event mode is entered as often.

    CVode begins anew where it is restored; DOP853 does so in each step.
    """
    whole = Simulation(bouncing(ball, solver=solver))
    whole.run_until("1.1")
    write_checkpoint(tmp_path / "run.ckpt", whole.get_state())
    other = Simulation(bouncing(ball, solver=solver))
    other.set_state(read_checkpoint(tmp_path / "run.ckpt"))
    for simulation in (whole, other):
        simulation.run_until("2")
    found = [s.get_state() for s in (whole, other)]
    outputs = [s["master"]["components"]["ball"]["extra"]["outputs"] for s in found]
    assert outputs[1][0, 3:].tolist() == outputs[0][0, 3:].tolist() == [4, 8, 12]
    assert outputs[1][0] == pytest.approx(outputs[0][0], rel=0.0, abs=error)
    for simulation in (whole, other):
        simulation.master.terminate()


# ------------------------------------------------------------------ co-simulation with FMI 3


@pytest.mark.parametrize("start_time", ["0 s", "5 s"])
def test_event_mode_of_co_simulation(tmp_path, start_time):
    """The FMU refuses discrete inputs outside of event mode, and steps over its own events.

    y = (integral of u, number of time events every 0.25 s, number of its own events at every
    0.15 s, where it returns early): at t = 1 s 4.5, 4 and 6, whatever the FMU's time is at t = 0.
    """
    file = eventful.stepping(tmp_path / "stepping.fmu")
    y = simulate(driven(file, start_time=start_time), duration="1").dataset["part.y"].values[:, 0]
    assert y[-1] == pytest.approx([4.5, 4.0, 6.0], abs=1e-12)
    assert y[:, 1].tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3, 3, 4]
    assert y[:, 2].tolist() == [0, 0, 1, 2, 2, 3, 4, 4, 5, 6, 6]


def test_clocks_that_never_tick_are_told(tmp_path):
    clock = '<Clock name="c" valueReference="9" causality="input" intervalVariability="triggered"/>'
    xml = eventful.STEPPING_XML.replace("</ModelVariables>", f"{clock}</ModelVariables>")
    file = eventful.make_fmu(tmp_path / "clock.fmu", eventful.STEPPING, xml, fmi=3)
    assert (
        driven(file).check().notes[1]
        == "'part': its clocks c never tick: nothing here triggers them"
    )


@pytest.mark.parametrize("kind", ["co-simulation", "model exchange"])
def test_clocks_that_depend_on_time_tick(tmp_path, kind):
    """Those of 0.3 s: at 0.1, 0.4, 0.7, ... 1.9 s; the countdown after the first, third, ... of them.

    So at 0.15, 0.75, 1.35 and 1.95 s. A checkpoint at 0.6 s changes nothing.
    """
    file = eventful.clocked(tmp_path / "clocked.fmu")
    with System("clocked") as system:
        system.add(Fmu(file=file, rate=Rate("0.2"), kind=kind), "part")
        system.record("history", ["part.y"])
    assert (
        "'part': its clocks outside never tick: nothing here triggers them" in system.check().notes
    )
    y = simulate(system, duration="2").dataset["part.y"].values[:, 0]
    assert y[:, 0].tolist() == [0, 1, 2, 2, 3, 4, 4, 5, 6, 6, 7]
    assert y[:, 2].tolist() == [0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4]
    assert y[-1, [1, 3]] == pytest.approx([1.9, 1.95], abs=1e-12)
    first = Simulation(system)
    first.run_until("0.6")
    state = first.get_state()
    first.master.terminate()
    second = Simulation(system)
    second.set_state(state)
    second.run_until("2")
    after = second.get_state()["master"]["components"]["part"]["extra"]["outputs"]
    second.master.terminate()
    assert after[0].tolist() == y[-1].tolist()


def test_inputs_of_clocks_are_told(tmp_path):
    file = eventful.clocked(tmp_path / "clocked.fmu")
    more = '<Float64 name="u" valueReference="9" causality="input" clocks="1" start="0"/>'
    xml = [("</ModelVariables>", f"{more}</ModelVariables>")]
    part = Fmu(file=broken(file, tmp_path / "more.fmu", xml=xml), rate=Rate("0.2"))
    part.prepare()
    assert (
        part.capabilities.notes[-1] == "its inputs u are set when they change, not by their clocks"
    )


def test_a_clock_without_a_sensible_interval_is_refused(tmp_path):
    file = eventful.clocked(tmp_path / "clocked.fmu")
    wrong = broken(file, tmp_path / "wrong.fmu", xml=[('"3" shift', '"0" shift')])
    with pytest.raises(ConfigurationError, match=r"the interval of its clock 'period' is '0 / 10'"):
        Fmu(file=wrong, rate=Rate("0.2")).prepare()


# ------------------------------------------------------------------ an FMU that ends its simulation


def ending(file, stops, **options):
    with System("ending") as system:
        system.add(Fmu(file=file, rate=Rate("0.1"), **options), "part")
        system.disperse(Dispersion("stop", ("part.stop",), stops, kind="list"))
        system.record("history", ["part.y"])
    return system


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("way", ["driver", "ctypes", "isolated"])
def test_a_member_whose_fmu_ends_is_complete_and_the_others_go_on(tmp_path, monkeypatch, fmi, way):
    """Member 0 ends itself at t = 0.3 s, and shows y = 0.3 when it says so, in the next step."""
    if way == "ctypes":
        monkeypatch.setattr(fleet, "_driver", lambda: None)
    file = eventful.ending(tmp_path / "ending.fmu", fmi=fmi)
    result = simulate(
        ending(file, [0.3, 9.0], isolate=way == "isolated"), members=2, duration="0.8"
    )
    assert (result.status, result.excluded) == ("complete", [])
    (note,) = result.notes
    assert note.startswith("'part' ended the run of member 0 at t = 0.4 s: the FMU asks to end")
    y = result.dataset["part.y"].values
    assert y[:, 0] == pytest.approx([0, 0.1, 0.2, 0.3, 0.3] + [np.nan] * 4, nan_ok=True)
    assert y[:, 1] == pytest.approx(np.arange(9) / 10)


def test_a_member_that_ended_in_a_process_of_its_own_is_terminated(tmp_path):
    """Once each: member 0 when it ends, member 1 with the run."""
    log = tmp_path / "terminated"
    ends = '{ FILE *f = fopen(LOG, "a"); fprintf(f, "%g ", of(c)->stop); fclose(f); return 0; }'
    source = eventful.ENDING2.replace(
        "F int fmi2Terminate(void *c) { return 0; }", f"F int fmi2Terminate(void *c) {ends}"
    )
    once = 'modelIdentifier="m" canBeInstantiatedOnlyOncePerProcess="true"'
    xml = eventful.ENDING2_XML.replace('modelIdentifier="m"', once)
    defines = f'#include <stdio.h>\n#define ENDS 1\n#define LOG "{log}"\n'
    file = eventful.make_fmu(tmp_path / "e.fmu", source, xml, fmi=2, defines=defines)
    result = simulate(ending(file, [0.3, 9.0]), members=2, duration="0.8")
    assert (result.status, result.excluded) == ("complete", [])
    assert log.read_text().split() == ["0.3", "9"]


def test_a_run_whose_members_have_all_ended_is_complete(tmp_path):
    """With status 0 and what was recorded until then; so does a campaign."""
    file = eventful.ending(tmp_path / "ending.fmu", fmi=3)
    system = ending(file, [0.3, 0.5])
    result = simulate(system, members=2, duration="0.8")
    assert result.status == "complete"
    assert result.dataset["part.y"].values.shape[0] == 7
    assert [n.split(" at ")[0] for n in result.notes] == [
        "'part' ended the run of member 0",
        "'part' ended the run of member 1",
    ]
    write_system(system, tmp_path / "s.toml")
    done = CliRunner().invoke(main, ["run", str(tmp_path / "s.toml"), "--duration", "0.8 s"])
    assert done.exit_code == 0, done.output
    assert "ended the run of member 0 at t = 0.4 s" in done.output + done.stderr


def test_model_exchange_that_ends_itself(tmp_path):
    """At the second event, t = 0.5 s, whose values are the last."""
    file = eventful.strict(tmp_path / "strict.fmu", n_states=1, ends=True)
    result = simulate(driven(file), duration="1")
    assert result.status == "complete"
    assert result.notes == [
        "'part' ended the run of member 0 at t = 0.5 s: the FMU asks to end the simulation"
    ]
    assert result.dataset["part.y"].values[-1, 0].tolist() == [pytest.approx(1.0), 2.0, 4.0]


def test_a_step_that_is_discarded_for_another_reason_is_a_failure(tmp_path):
    file = eventful.ending(tmp_path / "ending.fmu", fmi=2, ends=False)
    result = simulate(ending(file, [0.3, 9.0]), members=2, duration="0.8")
    assert [(e["member"], e["t_s"], e["reason"]) for e in result.excluded] == [
        (0, 0.4, "fmi2DoStep did not succeed")
    ]


def test_ended_members_stay_ended_over_a_checkpoint(spring, tmp_path):
    """An FMU that can save its state: the spring, ended by another component."""
    with System("kept") as system:
        system.add(Fmu(file=spring(3), rate=Rate("0.1")), "part")
        system.add(Stop(), "stop")
    first = Simulation(system, members=2)
    first.run_until("0.3")
    write_checkpoint(tmp_path / "run.ckpt", first.get_state())
    first.master.terminate()
    second = Simulation(system, members=2)
    second.set_state(read_checkpoint(tmp_path / "run.ckpt"))
    assert [(e["member"], e["t_s"]) for e in second.master.ended] == [(1, 0.2)]
    assert second.master.active.tolist() == [True, False]
    second.master.terminate()


class Stop(Component):
    """Ends the run of the second member at its second step."""

    default_rate = Rate("0.1")

    def _step_impl(self, t, dt):
        if self.step_index == 2:
            self.end_run([False, True], "enough")
