"""Other people's tools run what terrafix exports, and get the same numbers."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import zipfile

import casadi as ca
import numpy as np
import pytest
from fmu_helpers import OPEN_LOOP, has_zig

from terrafix.cosim.exchange.fmi.check.binary_checks import exported as shown
from terrafix.cosim.exchange.fmi.check.binary_checks import glibc, parse
from terrafix.cosim.exchange.fmi.check.checks import Subject
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system

NAMES = (
    *("orbit", "attitude", "antenna", "ads", "imu"),
    *("sar", "last_known", "predict", "correct"),
)


def library(name):
    """Import a tool in a process of its own first: its library may not load here."""
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed")
    done = subprocess.run([sys.executable, "-c", f"import {name}"], capture_output=True, text=True, check=False)  # fmt: skip
    if done.returncode:
        pytest.skip(f"{name} cannot be loaded: {done.stderr.strip().splitlines()[-1]}")
    return importlib.import_module(name)


def stepped(file, n, step=0.01):
    """Outputs of double precision after n steps, by our own binding."""
    subject = Subject(open_archive(file), CO_SIMULATION)
    instance = subject.started()
    for k in range(n):
        instance.step(k * step, step)
    values = subject.get(instance, subject.outputs())
    names = [v.name for v in subject.outputs() for _ in range(v.size)]
    instance.free()
    return names, values


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_every_fmu_runs_in_fmpy(exported, name, fmi):
    import fmpy

    rows = fmpy.simulate_fmu(
        str(exported(name, fmi)), stop_time=0.1, step_size=0.01, output_interval=0.01,
        fmi_type="CoSimulation",
    )  # fmt: skip
    names, values = stepped(exported(name, fmi), 10)
    last = np.concatenate([np.ravel(rows[n][-1]) for n in dict.fromkeys(names)])
    assert np.array_equal(last, values)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_every_fmu_runs_in_ecos(exported, name, fmi):
    ecos = library("ecospy")
    names, values = stepped(exported(name, fmi), 10)
    with ecos.EcosSimulationStructure() as structure:
        structure.add_model("part", str(exported(name, fmi)))
        with ecos.EcosSimulation(step_size=0.01, structure=structure) as simulation:
            simulation.init(0.0)
            simulation.step(10)
            if fmi == 2:
                found = [simulation.get_real(f"part::{n}") for n in names]
                assert found == values.tolist()


@pytest.mark.parametrize("name", NAMES)
def test_every_fmi_2_runs_in_libcosim(exported, name):
    library("libcosimpy")
    names, values = stepped(exported(name, 2), 10)
    code = (
        "import sys, json\n"
        "from libcosimpy.CosimExecution import CosimExecution\n"
        "from libcosimpy.CosimSlave import CosimLocalSlave\n"
        "from libcosimpy.CosimObserver import CosimObserver\n"
        "execution = CosimExecution.from_step_size(step_size=1e7)\n"
        "index = execution.add_local_slave(CosimLocalSlave(sys.argv[1], 'part'))\n"
        "observer = CosimObserver.create_last_value()\n"
        "execution.add_observer(observer)\n"
        "known = {v.name.decode(): v.reference for v in execution.slave_variables(index)}\n"
        "execution.step(10)\n"
        "references = [known[n] for n in json.loads(sys.argv[2])]\n"
        "print('RESULT', json.dumps(observer.last_real_values(index, references)))\n"
    )
    import json

    done = subprocess.run(
        [sys.executable, "-c", code, str(exported(name, 2)), json.dumps(names)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-500:]
    line = next(x for x in done.stdout.splitlines() if x.startswith("RESULT"))
    assert json.loads(line.removeprefix("RESULT")) == values.tolist()


def test_casadi_reads_our_model_exchange_and_gets_our_jacobian(exported, tmp_path):
    with zipfile.ZipFile(exported("orbit", 2)) as archive:
        archive.extractall(tmp_path)
    read = ca.DaeBuilder("orbit", str(tmp_path), {}).create("read", ["x"], ["ode"])
    orbit = read_system(OPEN_LOOP).nodes["orbit"]
    x = np.concatenate([orbit.setting("r0_i"), orbit.setting("v0_i")])
    found = np.array(read.factory("jacobian", ["x"], ["jac:ode:x"])(x))
    model = orbit.model
    state = ca.vertcat(*(model.states[k] for k in model.derivatives))
    rates = ca.vertcat(*model.derivatives.values())
    own = ca.Function("own", [state, *model.parameters.values()], [ca.jacobian(rates, state)])
    expected = np.array(own(x, *(orbit.setting(k) for k in model.parameters)))
    assert found == pytest.approx(expected, rel=1e-14, abs=1e-20)


def test_casadi_reads_fmi_3_of_scalars(spring, tmp_path):
    """Its importer of FMI 3 takes scalars alone; the spring has no arrays."""
    with zipfile.ZipFile(spring(3)) as archive:
        archive.extractall(tmp_path)
    read = ca.DaeBuilder("spring", str(tmp_path), {}).create("read", ["x", "u"], ["ode", "y"])
    jacobian = read.factory("jacobian", ["x", "u"], ["jac:ode:x", "jac:y:u"])
    a, b = (np.array(m) for m in jacobian([0.3, 0.1], [0.5]))
    assert a == pytest.approx(np.array([[0, 1], [-4 / 1.5, 0]]), rel=1e-14)
    assert b == pytest.approx(np.array([[0], [1 / 1.5]]), rel=1e-14)


PLATFORMS = ("x86_64-linux", "aarch64-linux", "x86_64-windows", "x86_64-darwin", "aarch64-darwin")


@pytest.mark.skipif(not has_zig(), reason="the ziglang wheel is not installed")
@pytest.mark.parametrize(
    "platforms",
    [
        ["x86_64-windows"],
        pytest.param(
            list(PLATFORMS),
            marks=pytest.mark.skipif(
                os.environ.get("TERRAFIX_ZIG_WARM") != "1",
                reason="zig builds its libraries for minutes the first time; TERRAFIX_ZIG_WARM=1",
            ),
        ),
    ],
    ids=["windows", "five"],
)
def test_binaries_for_other_platforms(tmp_path, platforms):
    """Linked, with the functions of FMI and nothing else, for old C libraries."""
    file = tmp_path / "orbit.fmu"
    export_fmu(read_system(OPEN_LOOP), file, component="orbit", platforms=",".join(platforms))
    folder = open_archive(file).folder / "binaries"
    assert sorted(p.name for p in folder.iterdir()) == sorted(platforms)
    for platform in platforms:
        binary = parse(next((folder / platform).iterdir()))
        names = shown(binary)
        assert "fmi3DoStep" in names
        assert len(names) >= 74
        assert all(n.startswith("fmi3") for n in names)
        if platform.endswith("linux"):
            assert glibc(binary) <= (2, 17)
