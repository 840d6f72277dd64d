"""Imported FMUs: ports, members, state, other people's exporters, and foreign code that fails."""

from __future__ import annotations

import textwrap
import zipfile

import fmu_parts
import numpy as np
import pytest
from fmu_helpers import OPEN_LOOP, broken

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import (
    ConfigurationError,
    StepError,
    SystemCheckError,
    WiringError,
)
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run import fleet
from terrafix.cosim.exchange.fmi.run.binding import MODEL_EXCHANGE
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.loop import FmuLoop
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.files.writing import write_system
from terrafix.cosim.records.checkpoint import read_checkpoint, write_checkpoint
from terrafix.cosim.system.check import check
from terrafix.cosim.system.system import System


def alone(fmu, name="part"):
    system = System("alone")
    system.add(fmu, name)
    return system


def outputs(system, t, path, members=1):
    simulation = Simulation(system, members=members)
    simulation.run_until(t)
    found = simulation.master.wiring.slots[path].data.copy()
    simulation.master.terminate()
    return found


@pytest.fixture(scope="module")
def ramp(tmp_path_factory):
    """An FMU of another exporter, with Python inside."""
    pythonfmu = pytest.importorskip("pythonfmu.builder")
    folder = tmp_path_factory.mktemp("ramp")
    (folder / "ramp.py").write_text(
        textwrap.dedent(
            """
            from pythonfmu import (
                Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real, String)

            class Ramp(Fmi2Slave):
                def __init__(self, **kwargs):
                    super().__init__(**kwargs)
                    self.u, self.y, self.k, self.n = 2.0, 1.0, 0.5, 0
                    self.register_variable(Real("u", causality=Fmi2Causality.input))
                    self.register_variable(Real("y", causality=Fmi2Causality.output))
                    self.register_variable(Integer("n", causality=Fmi2Causality.output))
                    self.word = "hello"
                    self.register_variable(String("word", causality=Fmi2Causality.output))
                    self.register_variable(Real("k", causality=Fmi2Causality.parameter,
                                                variability=Fmi2Variability.tunable))
                def do_step(self, t, h):
                    self.y += h * self.k * self.u
                    self.n += 1
                    return True
            """
        )
    )
    return pythonfmu.FmuBuilder.build_FMU(folder / "ramp.py", dest=folder)


# ------------------------------------------------------------------ what the description says


@pytest.mark.parametrize("fmi", [2, 3])
def test_ports_units_and_start_values(spring, fmi):
    fmu = alone(Fmu(file=spring(fmi), rate=Rate("0.01"))).nodes["part"]
    ports = {n: (p.is_input, p.single.shape, p.single.unit, p.at) for n, p in fmu.ports.items()}
    assert ports == {
        "force": (True, (), "N", "end"),
        "x": (False, (), "m", "end"),
        "acceleration": (False, (), "m/s^2", "end"),
    }
    assert float(fmu.ports["force"].default) == 0.25


@pytest.mark.parametrize("fmi", [2, 3])
def test_messages_frames_and_bundles_come_back(exported, fmi):
    fmu = alone(Fmu(file=exported("correct", fmi))).nodes["part"]
    native = read_system(OPEN_LOOP).nodes["correct"]
    for name, port in native.ports.items():
        other = fmu.ports[name]
        assert (port.kind, port.is_input, port.at) == (other.kind, other.is_input, other.at)
        for key, field in port.fields.items():
            found = other.fields[key]
            assert (field.shape, field.frame, field.unit) == (found.shape, found.frame, found.unit)


def test_parameters_and_start_values_are_set_with_units(spring):
    start = {"mass": "3000 g", "x0": "12 cm", "force": "0.5 N"}
    native = fmu_parts.Spring(mass=3.0, x0=0.12)
    with System("native") as system:
        part = system.add(native, "spring")
    part.ports["force"].default = 0.5
    try:
        expected = outputs(system, "0.2", "spring.x")
    finally:
        part.ports["force"].default = 0.25
    found = outputs(alone(Fmu(file=spring(3), rate=Rate("0.01"), start=start)), "0.2", "part.x")
    assert np.array_equal(found, expected)


def test_a_foreign_fmu_reads_at_the_start_and_its_period_is_found(ramp):
    fmu = Fmu(file=ramp, rate=Rate("0.1"), start={"k": 2.0, "u": 3.0})
    system = alone(fmu)
    assert fmu.ports["u"].at == "start"
    assert check(system).notes == [
        "'part': its state cannot be saved: no checkpoints",
        "'part': word cannot be connected: no numbers",
    ]
    assert fmu.ports["n"].single.dtype == np.int64
    assert outputs(system, "1", "part.y") == pytest.approx(1 + 10 * 0.1 * 2 * 3)


def test_driver_and_ctypes_give_the_same(spring, monkeypatch):
    driven = outputs(alone(Fmu(file=spring(3), rate=Rate("0.01"))), "1", "part.x", members=3)
    monkeypatch.setattr(fleet, "_driver", lambda: None)
    for fmi in (2, 3):
        plain = outputs(alone(Fmu(file=spring(fmi), rate=Rate("0.01"))), "1", "part.x", members=3)
        assert np.array_equal(driven, plain)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(("solver", "error"), [("cvode", 1e-7), ("dop853", 1e-9)])
def test_model_exchange_against_the_closed_form(spring, fmi, solver, error):
    fmu = Fmu(file=spring(fmi), kind=MODEL_EXCHANGE, solver=solver, rate=Rate("0.1"))
    x = outputs(alone(fmu), "3", "part.x")
    w, rest = np.sqrt(4.0 / 1.5), 0.25 / 4.0
    assert x == pytest.approx(rest + (0.3 - rest) * np.cos(3 * w), abs=error)


def test_a_solver_that_fails_says_what_may_help(spring):
    """Five digits more than a double has."""
    fmu = Fmu(file=spring(2), kind=MODEL_EXCHANGE, tolerance=1e-20, rate=Rate("0.1"))
    message = r"the solver failed \(CVode, .*\); another solver, tolerance or step may do"
    with pytest.raises(StepError, match=message) as error:
        outputs(alone(fmu), "1", "part.x")
    assert "/home" not in str(error.value)


@pytest.mark.parametrize("fmi", [2, 3])
def test_model_exchange_of_an_input_that_moves(tmp_path, fmi):
    """x' = u, x(0) = 1, u held over steps of 0.1 s: x(5) = 1 + 0.1 (u_0 + ... + u_49).

    A solver of many steps has looked ahead with the input that was.
    """
    file = tmp_path / "own.fmu"
    export_fmu(fmu_parts.Own(), file, fmi=fmi)
    with System("moving") as system:
        source = system.add(fmu_parts.Turning(), "source")
        for solver in ("cvode", "dop853"):
            part = system.add(
                Fmu(file=file, kind=MODEL_EXCHANGE, solver=solver, rate=Rate("0.1")), solver
            )
            system.connect(source["x"], part["u"])
        system.record("all", ["source.x", "cvode.x", "dop853.x"])
    found = simulate(system, duration="5").dataset
    expected = 1.0 + 0.1 * found["source.x"].values[:-1].sum()
    for solver in ("cvode", "dop853"):
        assert found[f"{solver}.x"].values[-1, 0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_time_in_a_derivative_is_the_same_here_and_in_either_kind(tmp_path, fmi):
    """x' = cos t to t = 10 s at 10 Hz: Simpson's rule here and in co-simulation, sin 10 in all.

    Simpson's error is at most (10 / 180) 0.05^4 = 3.5e-7; with time held at the end of a step it
    is 0.1.
    """
    export_fmu(fmu_parts.Turning(), tmp_path / "turning.fmu", fmi=fmi)
    native = outputs(alone(fmu_parts.Turning()), "10", "part.x")
    stepped = outputs(alone(Fmu(file=tmp_path / "turning.fmu", rate=Rate("0.1"))), "10", "part.x")
    exchange = Fmu(
        file=tmp_path / "turning.fmu", kind=MODEL_EXCHANGE, solver="dop853", rate=Rate("0.1")
    )
    assert native == pytest.approx(np.sin(10), abs=3.5e-7)
    assert np.array_equal(stepped, native)
    assert outputs(alone(exchange), "10", "part.x") == pytest.approx(np.sin(10), abs=1e-9)


def test_a_ring_of_integrators(tmp_path):
    """y = 1.01^100 where initial outputs reach the inputs, 1.01^99 where start values are held."""
    export_fmu(fmu_parts.EulerIntegrator(), tmp_path / "integrator.fmu", fmi=2)
    for held, power in ((False, 100), (True, 99)):
        with System("ring") as ring:
            for name in "abc":
                file = tmp_path / "integrator.fmu"
                ring.add(Fmu(file=file, rate=Rate("0.01"), hold_start_values=held), name)
            for source, target in ("ab", "bc", "ca"):
                ring.connect(f"{source}.y", f"{target}.u")
        assert outputs(ring, "1", "a.y") == pytest.approx(1.01**power, rel=1e-12)


def test_a_ring_iterated_to_convergence(tmp_path):
    """Inputs of a step are the outputs at its end: the implicit Euler method, 1 / 0.99^100."""
    export_fmu(fmu_parts.EulerIntegrator(), tmp_path / "integrator.fmu", fmi=3)
    files = dict.fromkeys("abc", tmp_path / "integrator.fmu")
    loop = FmuLoop(files=files, connect="a.y -> b.u, b.y -> c.u, c.y -> a.u", rate=Rate("0.01"))
    (y,) = outputs(alone(loop), "1", "part.a_y")
    assert y == pytest.approx(0.99**-100, rel=1e-10)


@pytest.mark.parametrize(
    ("connect", "message"),
    [
        ("a.y > b.u", "is no connection: write a.y -> b.u"),
        ("a.y -> d.u", r"has no FMU 'd'"),
        ("a.z -> b.u", r"FMU 'a' has no port 'z'"),
        ("a.u -> b.u", r"a.u is an input; a connection goes from an output"),
    ],
)
def test_loops_that_cannot_be_made(tmp_path, connect, message):
    export_fmu(fmu_parts.EulerIntegrator(), tmp_path / "i.fmu", fmi=2)
    files = dict.fromkeys("ab", tmp_path / "i.fmu")
    with pytest.raises(WiringError, match=message):
        alone(FmuLoop(files=files, connect=connect, rate=Rate("0.01")))


def test_a_loop_that_does_not_settle_excludes_its_members(tmp_path):
    export_fmu(fmu_parts.EulerIntegrator(), tmp_path / "i.fmu", fmi=2)
    loop = FmuLoop(
        files={"a": tmp_path / "i.fmu"}, connect="a.y -> a.u", rate=Rate("0.01"), most_iterations=2
    )
    with pytest.raises(StepError, match="signals did not settle in 2 repetitions of a step"):
        simulate(alone(loop), duration="0.1")


# ------------------------------------------------------------------ ensembles and state


@pytest.mark.parametrize("isolate", [False, True])
def test_a_run_with_fmus_resumes_to_the_same_bytes(exported, tmp_path, isolate):
    def system():
        made = read_system(OPEN_LOOP)
        for name in ("orbit", "imu", "predict", "correct"):
            fmu = Fmu(file=exported(name, 3), rate=made.nodes[name].rate, isolate=isolate)
            made.replace(name, fmu)
        return made

    first = Simulation(system(), members=2)
    first.run_until("8.2")
    write_checkpoint(tmp_path / "run.ckpt", first.get_state())
    second = Simulation(system(), members=2)
    second.set_state(read_checkpoint(tmp_path / "run.ckpt"))
    for simulation in (first, second):
        simulation.run_until("16.4")
    for path in ("orbit.r_e", "imu.delta_v_b", "predict.prior", "correct.estimate"):
        a, b = (s.master.wiring.slots[path].data for s in (first, second))
        assert np.array_equal(a, b), path
    for simulation in (first, second):
        simulation.master.terminate()


@pytest.mark.parametrize("isolate", [False, True])
def test_a_member_alone_is_that_of_any_ensemble(exported, isolate):
    """Noise of its own from the run's seed and the member's number."""

    def drawn(members):
        system = read_system(OPEN_LOOP)
        for name in ("imu", "antenna"):
            fmu = Fmu(file=exported(name, 3), rate=system.nodes[name].rate, isolate=isolate)
            system.replace(name, fmu)
        simulation = Simulation(system, members=members, seed=77)
        simulation.run_until("0.2")
        slots = simulation.master.wiring.slots
        found = np.hstack([slots[p].data for p in ("imu.delta_v_b", "antenna.q_mu")])
        simulation.master.terminate()
        return found

    whole = drawn(7)
    assert len({row.tobytes() for row in whole}) == 7
    assert np.array_equal(drawn([5]), whole[5:6])
    assert np.array_equal(drawn(7), whole)


def test_system_files_with_fmus_that_cannot_be_used(spring, tmp_path):
    text = (
        'schema = "terrafix-system/1"\nname = "s"\n[component.a]\ntype = "fmu"\n{}\n'
        '[record.r]\nports = ["a.x"]\n'
    )
    (tmp_path / "spring.fmu").write_bytes(spring(2).read_bytes())
    for lines, message in (
        ('file = "none.fmu"', "cannot read '.*none.fmu'"),
        ('file = "s.toml"', "is no FMU: file is not a zip file"),
        ('file = "spring.fmu"\nstart = { mass = "1 m" }', "'a.start.mass' is given in m"),
        ('file = "spring.fmu"\nstart = 3', "it takes a table: write { name ="),
        ('file = "spring.fmu"\nrate = "70 Hz"', "its FMU takes multiples of 0.01 s"),
    ):
        (tmp_path / "s.toml").write_text(text.format(lines))
        with pytest.raises(SystemCheckError, match=message) as raised:
            read_system(tmp_path / "s.toml")
        assert len(raised.value.problems) == 1
    (tmp_path / "s.toml").write_text(text.format('file = "spring.fmu"\nstart = { mass = "1 kg" }'))
    write_system(read_system(tmp_path / "s.toml"), tmp_path / "again.toml")
    assert read_system(tmp_path / "again.toml").nodes["a"].setting("mass") == 1.0


def test_an_fmu_without_state_says_so(ramp, tmp_path):
    with pytest.raises(Exception, match=r"'part' \(Fmu\) cannot save its state"):
        simulate(alone(Fmu(file=ramp, rate=Rate("0.1"))), duration="1", checkpoint_every="0.5",
                 out=tmp_path / "x.nc")  # fmt: skip


def test_isolated_gives_the_same_bytes(exported):
    found = []
    for isolate in (False, True):
        system = read_system(OPEN_LOOP)
        for name in ("orbit", "sar"):
            fmu = Fmu(file=exported(name, 2), rate=system.nodes[name].rate, isolate=isolate)
            system.replace(name, fmu)
        found.append(simulate(system, members=2, duration="16.4").dataset["correct.estimate.r_e"])
    assert np.array_equal(*found)


# ------------------------------------------------------------------ foreign code that fails

_AT_ONE = ("core.c", "    return step_to(i, now->tick + (int64_t)count);")


def failing(spring, tmp_path, statement, fmi=3):
    """The spring with something done when a step from t = 0.05 s is asked for."""
    file, line = _AT_ONE
    body = f"    if (t > 0.045) {{ {statement} }}\n{line}"
    return broken(spring(fmi), tmp_path / "failing.fmu", patches=[(file, line, body)])


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_that_returns_an_error(spring, tmp_path, fmi):
    file = failing(spring, tmp_path, 'return fail(i, "the spring broke");', fmi)
    system = alone(Fmu(file=file, rate=Rate("0.01")))
    system.record("history", ["part.x"])
    with pytest.raises(RunError, match="DoStep did not succeed: the spring broke") as raised:
        simulate(system, duration="0.1")
    assert "t = 0.06 s" in str(raised.value)
    assert raised.value.result.dataset["part.x"].size >= 5  # records are kept


def test_one_member_that_fails_is_excluded(spring, tmp_path):
    line = _AT_ONE[1]
    body = f"    if (strchr(i->name, '1') && t > 0.045) return fail(i, \"no\");\n{line}"
    file = broken(spring(2), tmp_path / "one.fmu", patches=[("core.c", line, body)])
    result = simulate(alone(Fmu(file=file, rate=Rate("0.01"))), members=3, duration="0.1")
    assert [(e["member"], e["t_s"]) for e in result.excluded] == [(1, 0.06)]


def test_an_fmu_that_diverges_to_nan(spring, tmp_path):
    line = "    return step_to(i, now->tick + (int64_t)count);"
    body = "    enum status s = step_to(i, now->tick + (int64_t)count);\n" \
           "    if (t > 0.045) now->real[3] = 0.0 / 0.0;\n    return s;"  # fmt: skip
    file = broken(spring(3), tmp_path / "nan.fmu", patches=[("core.c", line, body)])
    with pytest.raises(RunError, match=r"failed in 'part': an output is not finite"):
        simulate(alone(Fmu(file=file, rate=Rate("0.01"))), duration="0.1")


def test_an_fmu_that_crashes_ends_its_component_and_not_the_run(spring, tmp_path):
    file = failing(spring, tmp_path, "*(volatile int *)0 = 1;")
    system = alone(Fmu(file=file, rate=Rate("0.01"), isolate=True))
    system.record("history", ["part.x"])
    with pytest.raises(RunError, match=r"crashed its process \(signal 11\)") as raised:
        simulate(system, duration="0.1")
    assert raised.value.result.dataset["part.x"].size >= 5


def test_an_fmu_that_hangs(spring, tmp_path):
    file = failing(spring, tmp_path, "for (volatile int k = 0;; k++) ;")
    system = alone(Fmu(file=file, rate=Rate("0.01"), isolate=True, time_limit=1.0))
    with pytest.raises(StepError, match=r"did not answer within 1 s"):
        simulate(system, duration="0.1")


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": {"mas": "1 kg"}}, r"has no parameter or input 'mas'\n  did you mean 'mass'\?"),
        ({"start": {"mass": "1 m"}}, r"'part.start.mass' is given in m; it takes number \[kg\]"),
        ({"start": {"mass": [1.0, 2.0]}}, r"'part.start.mass' has shape \(2,\)"),
        ({"units": {"y": "m"}}, r"'part.units' names 'y', which is no port"),
        ({"units": {"x": "km"}}, r"says km for 'x', the FMU says m"),
        ({"frames": {"z": "e"}}, r"'part.frames' names 'z', which is no port"),
        ({"kind": "model exchange", "solver": "euler"}, r"it takes \"cvode\" or \"dop853\""),
    ],
)
def test_settings_that_do_not_fit(spring, options, message):
    with pytest.raises(ConfigurationError, match=message):
        alone(Fmu(file=spring(2), rate=Rate("0.01"), **options))


def test_a_rate_that_does_not_fit(spring):
    with pytest.raises(SystemCheckError, match=r"its FMU takes multiples of 0.01 s"):
        Simulation(alone(Fmu(file=spring(3), rate=Rate("0.015"))))


def test_units_and_shapes_at_a_connection(spring, exported):
    with System("wrong") as system:
        system.add(Fmu(file=spring(2), rate=Rate("0.01")), "spring")
        system.add(Fmu(file=exported("orbit", 2), rate=Rate("0.01")), "orbit")
    with pytest.raises(WiringError, match=r"the units differ: m is not N"):
        system.connect("spring.x", "spring.force")
    with pytest.raises(WiringError, match=r"the shapes differ: \(3,\) is not \(\)"):
        system.connect("orbit.r_e", "spring.force")
    with pytest.raises(WiringError, match=r"has no port 'velocity'"):
        system.connect("orbit.velocity", "spring.force")


def test_co_simulation_that_is_not_offered(exported, tmp_path):
    with pytest.raises(ConfigurationError, match=r"offers co-simulation, not model exchange"):
        alone(Fmu(file=exported("imu", 3), kind=MODEL_EXCHANGE))


def test_a_binary_of_another_platform(spring, tmp_path):
    target = tmp_path / "foreign.fmu"
    with zipfile.ZipFile(spring(2)) as archive, zipfile.ZipFile(target, "w") as out:
        for name in archive.namelist():
            data = archive.read(name)
            out.writestr(name.replace("linux64", "win64").replace(".so", ".dll"), data)
    with pytest.raises(
        ConfigurationError, match=r"no binary for this machine, linux64; it has win64"
    ):
        alone(Fmu(file=target))


def test_a_binary_without_the_functions(spring, tmp_path):
    target = tmp_path / "empty.fmu"
    with zipfile.ZipFile(spring(2)) as archive, zipfile.ZipFile(target, "w") as out:
        for name in archive.namelist():
            out.writestr(name, b"no library" if name.endswith(".so") else archive.read(name))
    with pytest.raises((RunError, ConfigurationError, StepError), match="cannot be loaded"):
        simulate(alone(Fmu(file=target, rate=Rate("0.01"))), duration="0.1")
