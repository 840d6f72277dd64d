"""Exported FMUs: valid, exact, and the same numbers as the native components."""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import casadi as ca
import fmpy
import fmu_parts
import numpy as np
import pytest
from fmpy.model_description import read_build_description
from fmu_helpers import OPEN_LOOP, without_evaluation

import terrafix as tf
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError, SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.check.checks import Subject
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import (
    CO_SIMULATION,
    MODEL_EXCHANGE,
    FmuError,
    Instance,
    load_library,
    references,
)
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.kernels.toolchain import working_compiler
from terrafix.cosim.system.system import System

COMPONENTS = (
    *("orbit", "attitude", "antenna", "ads", "imu"),
    *("sar", "last_known", "predict", "correct"),
)
VERSIONS = (2, 3)


def replaced(names, exported, fmi):
    """The open loop with components replaced by their FMUs."""
    system = read_system(OPEN_LOOP)
    for name in names:
        system.replace(name, Fmu(file=exported(name, fmi), rate=system.nodes[name].rate))
    return system


@pytest.fixture(scope="module")
def native():
    return simulate(read_system(OPEN_LOOP), members=2, duration="32.8").dataset


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", COMPONENTS)
def test_each_component_as_an_fmu_gives_the_same_bytes(exported, native, name, fmi):
    """Co-simulation by the same compiler and flags: noise, messages, members and all."""
    flown = simulate(replaced([name], exported, fmi), members=2, duration="32.8").dataset
    compared = [v for v in native.data_vars if v in flown and native[v].dtype.kind == "f"]
    assert len(compared) > 20
    for variable in compared:
        assert np.array_equal(native[variable], flown[variable], equal_nan=True), variable


def test_the_filter_over_72_updates_is_the_native_one(exported):
    """All parts but the evaluation, over the whole ten minutes."""
    expected = simulate(read_system(OPEN_LOOP), members=1).dataset
    system = replaced(COMPONENTS, exported, 2)
    flown = simulate(system, members=1).dataset
    assert int(flown["correct.innovation.accepted"].sum()) == 72
    for variable in ("correct.estimate.r_e", "correct.estimate.v_e", "correct.estimate.P"):
        assert np.array_equal(expected[variable], flown[variable])


TWO_BODY = (("orbit.gravity", "two-body"),)
DRAG = (
    ("orbit.drag", "true"),
    ("orbit.density", "1e-11 kg/m^3"),
    ("orbit.ballistic_coefficient", "0.01 m^2/kg"),
)


@pytest.mark.parametrize(
    ("fmi", "settings"),
    [
        pytest.param(3, (), id="3-j2"),
        pytest.param(2, DRAG, id="2-drag"),
        pytest.param(2, (), id="2-j2", marks=pytest.mark.campaign),
        pytest.param(3, DRAG, id="3-drag", marks=pytest.mark.campaign),
        pytest.param(2, TWO_BODY, id="2-two-body", marks=pytest.mark.campaign),
        pytest.param(3, TWO_BODY, id="3-two-body", marks=pytest.mark.campaign),
    ],
)
def test_the_orbit_over_6000_s(exported, fmi, settings):
    """Co-simulation: the same bits. Model exchange by CVode: within 0.02 m."""
    settings = (*settings, ("orbit.rate", "10 Hz"))
    file = exported("orbit", fmi, settings)

    def fly(component):
        with System("alone") as system:
            system.add(component, "orbit")
        simulation = Simulation(system)
        simulation.run_until("6000")
        slots = simulation.master.wiring.slots
        found = {p: slots[f"orbit.{p}"].data[0].copy() for p in component.outputs()}
        simulation.master.terminate()
        return found

    source = read_system(OPEN_LOOP, settings)
    orbit = source.nodes["orbit"]
    source.remove("orbit")
    expected = fly(orbit)
    stepped = fly(Fmu(file=file, rate=Rate(hz=10)))
    for port, value in expected.items():
        assert np.array_equal(stepped[port], value), port
    integrated = fly(Fmu(file=file, kind=MODEL_EXCHANGE, rate=Rate(hz=10), tolerance=1e-13))
    for port in ("r_i", "r_e"):
        assert np.linalg.norm(integrated[port] - expected[port]) < 0.02
    assert integrated["delta_v_e"] == pytest.approx(expected["delta_v_e"], abs=1e-9)


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.campaign)])
def test_a_whole_system_as_one_fmu(tmp_path, fmi):
    """Schedule, order, messages and start-reads inside; exposed ports outside."""
    file = without_evaluation(tmp_path / "system.toml")
    export_fmu(read_system(file), tmp_path / "whole.fmu", fmi=fmi)
    inside = Simulation(read_system(file), members=2)
    with System("outer", seed=2008) as outer:
        outer.add(Fmu(file=tmp_path / "whole.fmu", rate=Rate("0.01")), "whole")
    outside = Simulation(outer, members=2)
    ports = {"r_e": "orbit.r_e", "estimate": "correct.estimate", "prior": "predict.prior"}
    for t in ("0.01", "8.2", "8.21", "16.41"):
        inside.run_until(t)
        outside.run_until(t)
        for shown, path in ports.items():
            a, b = inside.master.wiring.slots[path], outside.master.wiring.slots[f"whole.{shown}"]
            assert np.array_equal(a.data, b.data), (t, path)
    a = inside.master.wiring.slots["correct.innovation"]
    b = outside.master.wiring.slots["whole.innovation"]
    assert np.array_equal(a.data, b.data)
    assert np.array_equal(a.sequence, b.sequence)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_what_is_read_at_the_start_is_that_of_then(tmp_path, fmi):
    """A ramp 1 + t at 100 Hz, read at the start of steps of h = 0.05 s and summed up.

    After k steps that is 1 + h (1 + 0) + ... + h (1 + (k - 1) h) = 1 + k h + h^2 k (k - 1) / 2.
    """
    with System("ramp") as system:
        ramp = system.add(fmu_parts.EulerIntegrator(drive=1.0), "a")
        slow = system.add(fmu_parts.EulerIntegrator(rate=Rate("0.05")), "b")
        system.connect(ramp["y"], slow["u"])
        system.expose("sum", slow["y"])
    export_fmu(system, tmp_path / "ramp.fmu", fmi=fmi)
    with System("outer", duration="0.5") as outer:
        outer.add(Fmu(file=tmp_path / "ramp.fmu", rate=Rate("0.01")), "whole")
        outer.record("sum", ["whole.sum"], period="0.05")
    k, h = np.arange(11), 0.05
    right = 1 + k * h + h**2 * k * (k - 1) / 2
    np.testing.assert_allclose(simulate(outer).dataset["whole.sum"].values[:, 0], right, rtol=1e-13)


def test_exposed_inputs_of_a_system_stay_outside(tmp_path):
    with System("pair") as system:
        first = system.add(fmu_parts.Spring(), "first")
        second = system.add(fmu_parts.EulerIntegrator(), "second")
        system.expose("push", first["force"])
        system.expose("y", second["y"])
    made = export_fmu(system, tmp_path / "pair.fmu")
    assert (made.inputs, made.outputs) == (1, 1)


# ------------------------------------------------------------------ time and inputs


def sampled(fmi, spring, *, ahead):
    """Step the spring under a ramp of force: set for the step's end (ahead), or its start."""
    h, outputs = 0.01, []
    library = load_library(open_archive(spring(fmi)), CO_SIMULATION)
    subject = Subject(open_archive(spring(fmi)), CO_SIMULATION)
    force, acceleration = subject.by_name["force"], subject.by_name["acceleration"]
    instance = Instance(library, "ramp")
    instance.begin(0.0)
    subject.set(instance, force, np.zeros(1))
    instance.finish()
    for k in range(50):
        subject.set(instance, force, np.array([(k + ahead) * h]))
        instance.step(k * h, h)
        outputs.append(float(subject.get(instance, [acceleration])[0]))
    instance.free()
    return np.array(outputs)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_the_two_meanings_of_an_input_read_at_the_end(spring, fmi):
    """Set for the end of a step: the native results. Set for its start: one step late."""
    model, h = fmu_parts.Spring().model, 0.01
    state, expected = {"x": 0.3, "v": 0.0}, []
    for k in range(50):
        force = (k + 1) * h
        outputs, state = model.advance(
            **state, force=force, stiffness=4.0, mass=1.5, x0=0.3, step=h
        )
        expected.append(float(outputs["acceleration"][0]))
    assert sampled(fmi, spring, ahead=1) == pytest.approx(np.array(expected), rel=1e-13, abs=1e-14)
    late = sampled(fmi, spring, ahead=0)
    assert np.abs(late - np.array(expected)).max() == pytest.approx(h / 1.5, rel=0.05)


def dependencies(unknowns):
    return {u.variable.name: [v.name for v in u.dependencies] for u in unknowns}


@pytest.mark.parametrize("fmi", VERSIONS)
def test_a_start_follows_from_an_input_read_at_the_start(tmp_path, fmi):
    """u = (5, 1) is set in initialization mode: y is 3 u, then 3 u + 0.1 u. With its start value
    2 it is 6, as natively."""
    file = tmp_path / "follower.fmu"
    export_fmu(fmu_parts.Follower(), file, fmi=fmi)
    start = {"u": "5 1"} if fmi == 3 else {"u[1]": 5.0, "u[2]": 1.0}
    for values, expected in (
        ({}, [[6.0, 6.0], [6.2, 6.2]]),
        (start, [[15.0, 3.0], [15.5, 3.1]]),
    ):
        rows = fmpy.simulate_fmu(str(file), stop_time=0.1, output_interval=0.1, start_values=values)
        found = rows["y"] if fmi == 3 else np.stack([rows["y[1]"], rows["y[2]"]], axis=1)
        assert found == pytest.approx(np.array(expected), abs=1e-15)
    found = dependencies(fmpy.read_model_description(str(file)).initialUnknowns)
    assert found == ({"y": ["u"]} if fmi == 3 else {"y[1]": ["u[1]"], "y[2]": ["u[2]"]})


@pytest.mark.parametrize("fmi", VERSIONS)
def test_model_exchange_takes_an_input_read_at_the_start(tmp_path, fmi):
    """x = 3 u + u t with u = 5, and der(x) = 5 in any mode; derivatives by u are 1."""
    file = tmp_path / "pushed.fmu"
    export_fmu(fmu_parts.Pushed(), file, fmi=fmi)
    t = np.array([0.0, 0.1, 0.2])
    for kind in ("CoSimulation", "ModelExchange"):
        rows = fmpy.simulate_fmu(str(file), stop_time=0.2, output_interval=0.1, fmi_type=kind,
                                 solver="CVode", start_values={"u": 5.0})  # fmt: skip
        assert rows["x"] == pytest.approx(15 + 5 * t, rel=1e-12)
        assert rows["sum"] == pytest.approx(20 + 5 * t, rel=1e-12)
    description = fmpy.read_model_description(str(file))
    assert dependencies(description.derivatives) == {"der(x)": ["u"]}
    if fmi == 2:  # derivatives against differences among them
        assert not tf.check_fmu(file).findings


def test_within_a_system_nothing_is_held_at_the_start(tmp_path):
    """A start that follows from another's output through such a link: refused, as natively."""
    with System("pair", duration="0.1") as system:
        source = system.add(fmu_parts.Turning(), "a")
        follower = system.add(fmu_parts.Pushed(), "b")
        system.connect(source["x"], follower["u"])
        system.expose("sum", follower["sum"])
    with pytest.raises(StepError, match=r"'b': .*nothing was published at t = 0 for u"):
        simulate(system)
    message = r"'pair' does not start: 'b' finds its start from 'a.x -> b.u', which is read at the"
    with pytest.raises(ConfigurationError, match=message):
        export_fmu(system, tmp_path / "pair.fmu")
    assert not list(tmp_path.iterdir())


def test_an_output_held_for_its_own_input_is_for_co_simulation(tmp_path):
    """x' = u from 1 on, u the x of the last step: 1.1 times as much after each 0.1 s."""
    with System("own") as system:
        body = system.add(fmu_parts.Own(), "body")
        system.connect(body["x"], body["u"])
        system.expose("x", body["x"])
    made = export_fmu(system, tmp_path / "own.fmu")
    assert made.kinds == ("co-simulation",)
    rows = fmpy.simulate_fmu(str(tmp_path / "own.fmu"), stop_time=0.3, output_interval=0.1)
    assert rows["x"] == pytest.approx(1.1 ** np.arange(4), rel=1e-14)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_any_multiple_of_the_tick_is_a_step(spring, fmi):
    archive = open_archive(spring(fmi))
    subject = Subject(archive, CO_SIMULATION)
    fine, coarse = subject.started(), subject.started()
    for k in range(30):
        fine.step(k * 0.01, 0.01)
    coarse.step(0.0, 0.07)
    coarse.step(0.07, 0.0)
    coarse.step(0.07, 0.23)
    assert np.array_equal(
        subject.get(fine, subject.outputs()), subject.get(coarse, subject.outputs())
    )
    for wrong in (0.015, 0.004):
        with pytest.raises(FmuError, match=r"must be a multiple of 0.01") as raised:
            coarse.step(0.3, wrong)
        assert raised.value.status == 2  # discard: the instance is as it was
    with pytest.raises(FmuError, match=r"stands at 0.3 s"):
        coarse.step(0.1, 0.01)
    fine.free()
    coarse.free()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_bad_values_are_refused_and_logged(spring, fmi):
    archive = open_archive(spring(fmi))
    subject = Subject(archive, CO_SIMULATION)
    mass, force, x = (subject.by_name[n] for n in ("mass", "force", "x"))
    instance = subject.initializing()
    with pytest.raises(FmuError, match=r"'mass' is set to -1; it must be above 0"):
        subject.set(instance, mass, np.array([-1.0]))
    with pytest.raises(FmuError, match=r"'force' is set to -?nan"):
        subject.set(instance, force, np.array([np.nan]))
    with pytest.raises(FmuError, match=r"'x' is an output and cannot be set here"):
        subject.set(instance, x, np.array([1.0]))
    instance.finish()
    with pytest.raises(FmuError, match=r"'mass' is a fixed parameter: set it before"):
        subject.set(instance, mass, np.array([2.0]))
    with pytest.raises(FmuError, match="cannot be called in step mode"):
        instance.finish()
    instance.free()


def test_a_result_that_is_not_finite_is_an_error_with_its_name(exported):
    archive = open_archive(exported("attitude", 3))
    subject = Subject(archive, CO_SIMULATION)
    instance = subject.started()
    subject.set(instance, subject.by_name["r_e"], np.zeros(3))
    with pytest.raises(FmuError, match=r"'attitude': 'q_be\[1\]' is not finite at t = 0.01 s"):
        instance.step(0.0, 0.01)
    instance.free()


# ------------------------------------------------------------------ derivatives and state


def fourth_order(function, x, h):
    """Derivative by five points: error of order h^4."""
    return (8 * (function(x + h) - function(x - h)) - function(x + 2 * h) + function(x - 2 * h)) / (
        12 * h
    )


@pytest.mark.parametrize("fmi", VERSIONS)
def test_derivatives_of_model_exchange(exported, fmi):
    """Of derivatives and outputs, by states: 1e-9 of the largest entry of the column."""
    subject = Subject(open_archive(exported("orbit", fmi)), MODEL_EXCHANGE)
    instance = subject.started()
    n = 6
    x = instance.get_vector("GetContinuousStates", n).copy()
    rates = [subject.by_name[u.variable.name] for u in subject.description.derivatives]
    states = [subject.by_name[u.variable.derivative.name] for u in subject.description.derivatives]
    vr = references([v.reference for v in rates])
    known = [(v.reference, v.size, k) for v in states for k in range(v.size)]
    for column, (reference, size, element) in enumerate(known):
        seed = np.zeros(size)
        seed[element] = 1.0
        stated = instance.directional(vr, references([reference]), seed.tolist(), n)

        def at(value, column=column):
            y = x.copy()
            y[column] = value
            instance.set_states(y)
            return instance.rates(n).copy()

        found = fourth_order(at, x[column], 2e-3 * abs(x[column]))
        instance.set_states(x)
        assert np.abs(found - stated).max() <= 1e-9 * max(np.abs(found).max(), 1e-3)
    instance.free()


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize(
    ("name", "known", "size"),
    [
        ("attitude", "r_e", 1e4),
        ("attitude", "v_e", 10.0),
        ("predict", "delta_v_b", 1e-2),
        ("ads", "q_be_true", 1e-2),
    ],
)
def test_derivatives_of_co_simulation(exported, name, known, size, fmi):
    """Of outputs by inputs at the communication point, against steps with other inputs."""
    subject = Subject(open_archive(exported(name, fmi)), CO_SIMULATION)
    instance = subject.started()
    instance.step(0.0, 0.01)
    before = instance.get_state()
    outputs = subject.outputs()
    scalars = [v for v in subject.reals("input") if re.fullmatch(rf"{known}(\[\d\])?", v.name)]
    for v in scalars:
        now = subject.get(instance, [v])
        for element in range(v.size):
            seed = np.zeros(v.size)
            seed[element] = 1.0
            instance.set_state(before)
            instance.step(0.01, 0.01)
            stated = instance.directional(
                references([o.reference for o in outputs]),
                references([v.reference]),
                seed.tolist(),
                sum(o.size for o in outputs),
            )

            def at(value, v=v, element=element, now=now):
                instance.set_state(before)
                moved = now.copy()
                moved[element] = value
                subject.set(instance, v, moved)
                instance.step(0.01, 0.01)
                return subject.get(instance, outputs)

            found = fourth_order(at, now[element], size)
            rounding = 1e-15 * np.abs(subject.get(instance, outputs)) / size
            error = np.abs(found - stated) - 10 * rounding
            assert error.max() <= 1e-9 * np.abs(stated).max()
    instance.free_state(before)
    instance.free()


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("name", ["orbit", "imu", "predict", "correct"])
def test_a_state_comes_back_to_the_last_bit_in_another_process(exported, tmp_path, name, fmi):
    file = exported(name, fmi)
    subject = Subject(open_archive(file), CO_SIMULATION)
    instance = subject.started()
    subject.run(instance, 7)
    saved = instance.serialize()
    expected = subject.run(instance, 5, 7)
    instance.free()
    (tmp_path / "state").write_bytes(saved)
    code = (
        "import sys; from pathlib import Path\n"
        "from terrafix.cosim.exchange.fmi.run.archive import open_archive\n"
        "from terrafix.cosim.exchange.fmi.check.checks import Subject\n"
        f"s = Subject(open_archive({str(file)!r}), 'co-simulation')\n"
        f"i = s.started(); i.deserialize(Path({str(tmp_path / 'state')!r}).read_bytes())\n"
        "sys.stdout.write(s.run(i, 5, 7).tobytes().hex())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == expected.tobytes().hex()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_a_state_of_another_fmu_is_refused(exported, spring, fmi):
    subject = Subject(open_archive(spring(fmi)), CO_SIMULATION)
    other = Subject(open_archive(exported("orbit", fmi)), CO_SIMULATION)
    a, b = subject.started(), other.started()
    with pytest.raises(FmuError, match="are not a state of this FMU"):
        b.deserialize(a.serialize())
    a.free()
    b.free()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_five_thousand_instances_one_after_another(spring, fmi):
    """No failure, resident memory flat."""
    subject = Subject(open_archive(spring(fmi)), CO_SIMULATION)

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

    for k in range(5000):
        instance = subject.started()
        instance.step(0.0, 0.01)
        instance.free()
        if k == 1000:
            early = resident()
    assert resident() - early < 2 << 20


# ------------------------------------------------------------------ the archive


@pytest.mark.parametrize("fmi", VERSIONS)
def test_what_is_inside(exported, fmi):
    with zipfile.ZipFile(exported("correct", fmi)) as archive:
        names = archive.namelist()
        xml = archive.read("modelDescription.xml").decode()
        page = archive.read("documentation/index.html").decode()
    assert "sources/core.c" in names
    assert "sources/buildDescription.xml" in names
    assert {"model.png", "terminalsAndIcons/icon.png"} & set(names)
    assert "read at the end of a step" in xml
    assert "Kalman" in page  # the equations of the model
    assert "frame e" in xml
    assert "INF" not in xml.replace("INFORMATION", "")
    assert "1.7976931348623157e+308" in xml


def test_start_values_read_back_to_the_last_bit(exported):
    with zipfile.ZipFile(exported("orbit", 2)) as archive:
        xml = archive.read("modelDescription.xml").decode()
    found = re.search(r'name="r0_i\[2\]".*?start="([^"]*)"', xml, flags=re.DOTALL)
    assert float(found[1]) == -6096830.387203118


def test_only_the_functions_of_fmi_are_visible(exported):
    from terrafix.cosim.exchange.fmi.check.binary_checks import exported as shown
    from terrafix.cosim.exchange.fmi.check.binary_checks import parse

    for fmi in VERSIONS:
        archive = open_archive(exported("imu", fmi))
        names = shown(parse(archive.binary("imu")))
        assert names
        assert all(n.startswith(f"fmi{fmi}") for n in names)


def test_the_same_component_gives_the_same_file(tmp_path):
    for name in ("a", "b"):
        export_fmu(fmu_parts.Spring(), tmp_path / f"{name}.fmu", name="spring")
    assert (tmp_path / "a.fmu").read_bytes() == (tmp_path / "b.fmu").read_bytes()


def test_the_noise_key_is_that_of_python(tmp_path):
    """The hash in C, on long names and large seeds, through the noise that comes of it."""
    system = read_system(OPEN_LOOP, [("seed", "9007199254740993")])
    export_fmu(system, tmp_path / "imu.fmu", component="imu")
    with System("native", seed=9007199254740993) as alone:
        alone.add(type(system.nodes["imu"])(velocity_random_walk=5.916079783099616e-6), "imu")
        alone.expose("a", "imu.delta_v_b_true")
    subject = Subject(open_archive(tmp_path / "imu.fmu"), CO_SIMULATION)
    instance = subject.started()
    instance.step(0.0, 0.01)
    from terrafix.cosim.basics.noise import NormalStream

    drawn = NormalStream(9007199254740993, "imu", "accel_white", [0]).draw(1, 3)[0]
    delta_v = subject.get(instance, [subject.by_name["delta_v_b"]])
    assert delta_v == pytest.approx(5.916079783099616e-6 * np.sqrt(0.01) * drawn, rel=1e-12)
    instance.free()


# ------------------------------------------------------------------ for other tools


def unpacked(file, folder):
    """An FMU's folder without its binary, and the path of that."""
    with zipfile.ZipFile(file) as archive:
        archive.extractall(folder)
    (binary,) = (folder / "binaries").glob("*/*")
    binary.unlink()
    return folder, binary


def listed(folder, fmi):
    """The sources that a tool is told to compile: FMI 2 names them for each kind."""
    if fmi == 3:
        (configuration,) = read_build_description(str(folder))
        (sources,) = configuration.sourceFileSets
        return sources.sourceFiles
    root = ElementTree.parse(folder / "modelDescription.xml").getroot()
    kinds = [k for k in root if k.tag in ("CoSimulation", "ModelExchange")]
    (names,) = {tuple(f.get("name") for f in k.iterfind("SourceFiles/File")) for k in kinds}
    return list(names)


@pytest.mark.skipif(sys.platform != "linux", reason="compiles for Linux")
@pytest.mark.parametrize("fmi", VERSIONS)
def test_compiled_from_its_sources(exported, tmp_path, fmi):
    """By a compiler told nothing of visibility; in FMPy, the same bytes as of our binary.

    The C library's `advance` is not called.
    """
    folder, binary = unpacked(exported("orbit", fmi), tmp_path)
    names = listed(folder, fmi)
    assert {"core.c", "model.c", f"fmi{fmi}.c"} <= set(names)
    command = [*working_compiler().command, "-shared", "-fPIC", "-I.", *names]
    subprocess.run([*command, "-o", str(binary), "-lm"], cwd=folder / "sources", check=True)
    options = {"stop_time": 0.1, "output_interval": 0.01, "fmi_type": "CoSimulation"}
    found, expected = (
        fmpy.simulate_fmu(str(file), **options) for file in (folder, exported("orbit", fmi))
    )
    assert len(expected) == 11
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_a_step_past_the_stop_time_is_refused(spring, fmi):
    """As FMI demands; up to it, steps are made, also to a stop time that is no multiple."""
    subject = Subject(open_archive(spring(fmi)), CO_SIMULATION)
    for stop in (0.05, 0.054):
        instance = subject.instantiate()
        none, zero, end = ctypes.c_double(0.0), ctypes.c_double(0.0), ctypes.c_double(stop)
        if fmi == 2:
            instance.call("SetupExperiment", 0, none, zero, 1, end)
            instance.call("EnterInitializationMode")
        else:
            no, yes = ctypes.c_bool(False), ctypes.c_bool(True)
            instance.call("EnterInitializationMode", no, none, zero, yes, end)
        instance.finish()
        for k in range(5):
            instance.step(0.01 * k, 0.01)
        with pytest.raises(
            FmuError, match=r"DoStep returned Error: a step to t = 0.06 s is refused"
        ):
            instance.step(0.05, 0.01)
        instance.free()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_infinity_is_the_largest_number(tmp_path, fmi):
    """FMI Library reads no INF. 1 / infinity is 0, where 1 / 1.8e308 is not."""
    file = tmp_path / "share.fmu"
    export_fmu(fmu_parts.Share(), file, fmi=fmi)
    with zipfile.ZipFile(file) as archive:
        xml = archive.read("modelDescription.xml").decode()
    assert 'start="1.7976931348623157e+308"' in xml
    for whole, share in ((None, 0.0), (sys.float_info.max, 0.0), (np.inf, 0.0), (4.0, 0.25)):
        start = {} if whole is None else {"whole": whole}
        fmu = Fmu(file=file, rate=Rate("0.1"), start=start)
        assert outputs_of(fmu) == [share]
    rows = fmpy.simulate_fmu(str(file), stop_time=0.2, output_interval=0.1, start_values={"u": 1.0})
    assert rows["y"][-1] == 0.0
    subject = Subject(open_archive(file), CO_SIMULATION)
    instance = subject.started()
    (found,) = subject.get(instance, [subject.by_name["whole"]])
    assert found == sys.float_info.max == subject.by_name["whole"].start[0]
    instance.free()


def test_check_fmu_says_nothing_of_infinity(tmp_path, capfd):
    export_fmu(fmu_parts.Share(), tmp_path / "share.fmu", scalars=True)
    report = tf.check_fmu(tmp_path / "share.fmu")
    assert [*report.findings, *report.warnings] == []
    assert capfd.readouterr().err == ""


def outputs_of(fmu):
    """y of a component after a step."""
    with System("s") as system:
        system.add(fmu, "a")
    system.record("r", ["a.y"])
    return simulate(system, duration="0.1").dataset["a.y"].values[-1].tolist()


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"component": "orbitt"}, r"has no component 'orbitt'\n  did you mean 'orbit'\?"),
        (
            {"component": "evaluation"},
            r"'evaluation' is a NavigationEvaluation, which is written in",
        ),
        (
            {},
            r"cannot be exported as one FMU: 'evaluation' \(NavigationEvaluation\) is not symbolic",
        ),
        ({"component": "orbit", "fmi": 1}, r"there is no FMI 1\n  write 2 or 3"),
        ({"component": "orbit", "platforms": "linx"}, r"there is no platform 'linx'"),
    ],
)
def test_what_cannot_be_exported_is_named(tmp_path, arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        export_fmu(read_system(OPEN_LOOP), tmp_path / "x.fmu", **arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("x.zip", r"is no .fmu file\n  name it 'x.fmu'"),
        ("none/x.fmu", "there is no folder"),
    ],
)
def test_targets_that_cannot_be_written(tmp_path, target, message):
    with pytest.raises(ConfigurationError, match=message):
        export_fmu(fmu_parts.Spring(), tmp_path / target)


def test_a_component_alone_needs_start_values_to_start(tmp_path):
    from terrafix.components.truth.attitude import LvlhAttitude

    with pytest.raises(
        ConfigurationError, match=r"not finite at its start .*\(r_e, v_e, delta_v_e\)"
    ):
        export_fmu(LvlhAttitude(), tmp_path / "x.fmu")
    start = {"r_e": [7e6, 0, 0], "v_e": {"": [0, 7.5e3, 0]}}
    made = export_fmu(LvlhAttitude(), tmp_path / "x.fmu", start=start)
    assert made.model == "lvlh_attitude"


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"forces": 1.0}, r"start names 'forces', but 'spring' has no such input\n .*'force'"),
        ({"force": {"x": 1.0}}, r"start of 'spring.force' has no field 'x'\n  it takes {'': ...}"),
        ({"force": [1.0, 2.0]}, r"start of 'spring.force' has shape \(2,\); it takes \(\)"),
    ],
)
def test_start_values_of_nothing_are_refused(tmp_path, start, message):
    with pytest.raises(ConfigurationError, match=message):
        export_fmu(fmu_parts.Spring(), tmp_path / "x.fmu", start=start)


def test_a_whole_system_takes_no_start_values(tmp_path):
    with System("whole") as system:
        system.expose("x", system.add(fmu_parts.Spring(), "spring")["x"])
    with pytest.raises(ConfigurationError, match=r"start does nothing with a whole system"):
        export_fmu(system, tmp_path / "x.fmu", start={"force": 1.0})


def test_a_delay_is_not_exported(tmp_path):
    with System("late") as system:
        integrator = system.add(fmu_parts.EulerIntegrator(), "integrator")
        system.connect(integrator["y"], integrator["u"], delay="0.02")
        system.expose("y", integrator["y"])
    with pytest.raises(ConfigurationError, match="has a delay, which an exported system does not"):
        export_fmu(system, tmp_path / "x.fmu")


def test_problems_of_the_system_come_first(tmp_path):
    with System("open") as system:
        system.add(fmu_parts.Spring(), "spring")
        from terrafix.components.truth.attitude import LvlhAttitude

        system.add(LvlhAttitude(), "attitude")
    with pytest.raises(SystemCheckError, match=r"input 'attitude.r_e' is not connected"):
        export_fmu(system, tmp_path / "x.fmu", component="spring")


def test_an_fmu_loads_without_a_name_clash(exported):
    """Two FMUs of one kind in a process keep apart."""
    a = load_library(open_archive(exported("orbit", 2)), CO_SIMULATION)
    b = load_library(open_archive(exported("imu", 2)), CO_SIMULATION)
    pointers = [ctypes.cast(x["DoStep"], ctypes.c_void_p).value for x in (a, b)]
    assert pointers[0] != pointers[1]


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_component_without_arguments_or_docstring_is_exported(tmp_path, fmi):
    class Counter(tf.SymbolicComponent):
        default_rate = Rate("1")
        y = tf.Output()

        def build_model(self):
            x = ca.SX.sym("x")
            return tf.Model("counter", states={"x": x}, next={"x": x + 1}, outputs={"y": x})

    export_fmu(Counter(), tmp_path / "counter.fmu", fmi=fmi)
    assert not tf.check_fmu(tmp_path / "counter.fmu").findings
