"""FMI 3 without arrays, for tools that read none: scalars named as in FMI 2."""

from __future__ import annotations

import re
import zipfile

import casadi as ca
import fmpy
import numpy as np
import pytest
from click.testing import CliRunner
from fmpy.validation import validate_fmu
from fmu_helpers import OPEN_LOOP, in_another_process

from terrafix.cli import main
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.exchange.fmi.check.check import check_fmu
from terrafix.cosim.exchange.fmi.check.checks import Subject
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System

NAMES = ("orbit", "imu", "sar")
FEW = ("orbit", "imu")


@pytest.fixture(scope="module")
def scalars(exported):
    """Export with scalars: ``scalars("orbit")``."""
    return lambda name: exported(name, 3, scalars=True)


def elements(variable):
    """Names of the numbers of a vector."""
    n = variable.size
    return [variable.name] if n == 1 else [f"{variable.name}[{k + 1}]" for k in range(n)]


@pytest.fixture(scope="module")
def stepped(exported):
    """Scalars after ten steps, as the FMU with arrays has them: the native numbers."""
    found = {}
    for name in FEW:
        subject = Subject(open_archive(exported(name, 3)), CO_SIMULATION)
        instance = subject.started()
        for k in range(10):
            instance.step(k * 0.01, 0.01)
        outputs = subject.outputs()
        values = subject.get(instance, outputs).tolist()
        instance.free()
        names = [n for v in outputs for n in elements(v)]
        found[name] = dict(zip(names, values, strict=True))
    return found


def declared(file):
    """All variables of a description, by name, but for the time."""
    variables = fmpy.read_model_description(str(file)).modelVariables
    return {v.name: v for v in variables if v.causality != "independent"}


def without_axis(text):
    """Each scalar has a unit of its own: nothing is said of those along an axis."""
    return re.sub("; units .* along the last axis", "", text or "")


@pytest.mark.parametrize("name", NAMES)
def test_variables_are_those_of_fmi_2(exported, scalars, name):
    """Names, start values to the last bit, units, types, bounds; and what depends on what."""
    two, three = (declared(file) for file in (exported(name, 2), scalars(name)))
    assert list(two) == list(three)
    assert len(three) == {"orbit": 32, "imu": 50, "sar": 67}[name]
    assert not any(v.dimensions for v in three.values())
    for each in ("causality", "variability", "start", "min", "max"):
        assert [getattr(v, each) for v in two.values()] == [
            getattr(v, each) for v in three.values()
        ]
    said, units = (
        [[read(v) for v in x.values()] for x in (two, three)]
        for read in (
            lambda v: without_axis(v.description),
            lambda v: v.unit or (v.declaredType and v.declaredType.unit),
        )
    )
    assert said[0] == said[1]
    assert units[0] == units[1]
    descriptions = [
        fmpy.read_model_description(str(file)) for file in (exported(name, 2), scalars(name))
    ]
    for each in ("outputs", "derivatives", "initialUnknowns"):
        structure = [
            {
                u.variable.name: sorted(v.name for v in u.dependencies)
                for u in getattr(description, each)
            }
            for description in descriptions
        ]
        assert structure[0] == structure[1]


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_found_wrong(scalars, name):
    assert validate_fmu(str(scalars(name))) == []
    report = check_fmu(scalars(name))
    assert [*report.findings, *report.warnings] == []
    assert {"description", "library", "start", "state", "derivatives"} <= set(report.checks)


def described(field):
    return vars(field) | {"doc": without_axis(field.doc)}


@pytest.mark.parametrize("name", NAMES)
def test_they_are_arrays_again_here(exported, scalars, name):
    """Ports with their shapes, units and frames; messages; parameters."""
    read = []
    for file in (exported(name, 3), scalars(name)):
        with System("alone") as system:
            fmu = system.add(Fmu(file=file), "a")
        ports = {
            n: (type(p), p.is_input, p.at, [described(f) for f in p.fields.values()])
            for n, p in fmu.ports.items()
        }
        settings = {n: (p.kind(), p.unit, p.frame) for n, p in fmu._found_settings.items()}
        read.append((ports, settings))
    assert read[0] == read[1]
    assert any(p[3][0]["shape"] == (3,) for p in read[1][0].values())


def test_in_the_loop_they_give_the_native_bytes(scalars):
    """Over four fixes of the radar, which are messages."""
    flown = []
    for names in ((), NAMES):
        system = read_system(OPEN_LOOP)
        for name in names:
            system.replace(name, Fmu(file=scalars(name), rate=system.nodes[name].rate))
        flown.append(simulate(system, members=1, duration="24.6").dataset)
    compared = [v for v in flown[0].data_vars if v in flown[1] and flown[0][v].dtype.kind == "f"]
    assert len(compared) > 20
    for variable in compared:
        assert np.array_equal(flown[0][variable], flown[1][variable], equal_nan=True), variable


@pytest.mark.parametrize("name", FEW)
def test_fmpy_and_ecos_run_them(scalars, stepped, name):
    """To the bit. ecos reads 0 from arrays."""
    rows = fmpy.simulate_fmu(str(scalars(name)), stop_time=0.1, output_interval=0.01,
                             fmi_type="CoSimulation")  # fmt: skip
    expected = stepped[name]
    assert {n: rows[n][-1] for n in expected} == expected
    code = (
        "import json, sys, ecospy as e\n"
        "with e.EcosSimulationStructure() as structure:\n"
        "    structure.add_model('part', sys.argv[1])\n"
        "    with e.EcosSimulation(step_size=0.01, structure=structure) as simulation:\n"
        "        simulation.init(0.0)\n"
        "        simulation.step(10)\n"
        "        names = ['part::' + n for n in sys.argv[2:]]\n"
        "        print('RESULT', json.dumps([simulation.get_real(n) for n in names]))\n"
    )
    assert in_another_process("ecospy", code, scalars(name), *expected) == list(expected.values())


def test_casadi_reads_the_orbit(scalars, tmp_path):
    """Derivatives and outputs of the native model, to the bit of the same functions in C."""
    with zipfile.ZipFile(scalars("orbit")) as archive:
        archive.extractall(tmp_path)
    builder = ca.DaeBuilder("orbit", str(tmp_path), {})
    assert builder.x() == [f"{n}[{k}]" for n in ("r_i", "v_i") for k in (1, 2, 3)]
    orbit = read_system(OPEN_LOOP).nodes["orbit"]
    x = np.concatenate([orbit.setting("r0_i"), orbit.setting("v0_i")])
    ode, y = (v.full().ravel() for v in builder.create("read", ["x"], ["ode", "y"])(x))
    function = orbit.model.rate_function()
    settings = (orbit.setting(n) for n in orbit.model.parameters)
    values = (v.full().ravel() for v in function(*np.split(x, 2), *settings, 0.0, 0.0))
    native = dict(zip(function.name_out(), values, strict=True))
    assert ode.tolist() == [*native["der_r_i_"], *native["der_v_i_"]]
    outputs = dict(zip(builder.y(), y, strict=True))
    for port in ("r_i", "v_i", "r_e", "v_e"):
        assert [outputs[f"{port}[{k}]"] for k in (1, 2, 3)] == native[f"{port}_"].tolist()


def test_with_fmi_2_it_would_do_nothing(tmp_path):
    file = tmp_path / "x.fmu"
    with pytest.raises(Exception, match=r"scalars do nothing with FMI 2, which has no arrays\n  l"):
        export_fmu(read_system(OPEN_LOOP), file, component="orbit", fmi=2, scalars=True)
    words = ["export-fmu", f"{OPEN_LOOP}:orbit", "-o", str(file), "--fmi", "2", "--scalars"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code != 0
    assert not file.exists()
