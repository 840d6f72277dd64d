"""SSP packages: the same system again, the same numbers in other tools, anybody's packages."""

from __future__ import annotations

import re
import zipfile
from xml.etree import ElementTree

import fmu_parts
import numpy as np
import pytest
from fmu_helpers import ECOS, OPEN_LOOP, in_another_process, without_evaluation

from terrafix.cli import main
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.exchange.ssp.export import export_ssp
from terrafix.cosim.exchange.ssp.names import OMS
from terrafix.cosim.exchange.ssp.reading import import_ssp, read_ssp
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System

SSD = "http://ssp-standard.org/SSP1/SystemStructureDescription"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"
SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"


def ring(shift=1.0, drive=0.0):
    system = System("ring", duration="1")
    for name in "abc":
        system.add(fmu_parts.EulerIntegrator(shift=shift, drive=drive), name)
    for source, target in ("ab", "bc", "ca"):
        system.connect(f"{source}.y", f"{target}.u")
    return system


def final(system, t, paths, members=1):
    simulation = Simulation(system, members=members)
    simulation.run_until(t)
    found = [simulation.master.wiring.slots[p].data.copy() for p in paths]
    simulation.master.terminate()
    return found


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("packages")
    export_ssp(ring(), folder / "ring.ssp")
    export_ssp(ring(shift=0.0, drive=1.0), folder / "driven.ssp")
    return folder


def in_fmpy(file, names, n=100):
    from fmpy.ssp.simulation import simulate_ssp

    rows = simulate_ssp(str(file), stop_time=n * 0.01 - 1e-9, step_size=0.01)
    return [float(rows[-1][name]) for name in names]


LIBCOSIM = """
import json, sys
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimObserver import CosimObserver
execution = CosimExecution.from_ssp_file(sys.argv[1])
observer = CosimObserver.create_last_value()
execution.add_observer(observer)
execution.step(int(sys.argv[2]))
found = []
for name in sys.argv[3:]:
    part, variable = name.split("::")
    index = execution.slave_index_from_instance_name(part)
    known = {v.name.decode(): v.reference for v in execution.slave_variables(index)}
    found += observer.last_real_values(index, [known[variable]])
print("RESULT", json.dumps(found))
"""


# ------------------------------------------------------------------ other tools


def test_a_ring_in_fmpy_holds_zeros_through_the_first_step(packages):
    assert in_fmpy(packages / "ring.ssp", ["a.y"]) == pytest.approx([1.01**99], rel=1e-12)
    held = read_ssp(packages / "ring.ssp")
    for fmu in held.nodes.values():
        fmu.hold_start_values = True
    (y,) = final(held, "1", ["a.y"])
    assert y == pytest.approx(1.01**99, rel=1e-12)


def test_a_ring_in_ecos_and_here_hands_initial_outputs_on(packages):
    (y,) = final(read_ssp(packages / "ring.ssp"), "1", ["a.y"])
    assert y == pytest.approx(1.01**100, rel=1e-12)
    found = in_another_process("ecospy", ECOS, packages / "ring.ssp", 100, "a::y")
    assert found == pytest.approx([1.01**100], rel=1e-12)


def test_the_same_file_gives_the_same_numbers_everywhere(packages, tmp_path):
    """Where connected outputs are zero at the start, all masters agree to the last bit."""
    file = packages / "driven.ssp"
    expected = [float(v[0, 0]) for v in final(read_ssp(file), "1", ["a.y", "b.y", "c.y"])]
    assert expected[0] == pytest.approx(1.01**100 - 1, rel=1e-12)
    assert in_fmpy(file, ["a.y", "b.y", "c.y"]) == expected
    names = ("a::y", "b::y", "c::y")
    assert in_another_process("ecospy", ECOS, file, 100, *names) == expected
    with zipfile.ZipFile(file) as archive:
        archive.extractall(tmp_path)
    assert in_another_process("libcosimpy", LIBCOSIM, tmp_path, 100, *names) == expected


def children(element):
    return {child.tag.rpartition("}")[2] for child in element}


def test_the_package_has_nothing_where_omsimulator_takes_nothing(packages):
    """Its reader in C++ (2940ef11) stops at anything else, "wrong xml schema detected".

    Model.cpp 889-959: of a document it takes these four; ComponentFMUCS.cpp 318-367: of a component
    these three; System.cpp 959: of annotations the first. Its reader in Python (system.py 1001-1008)
    gives components the solver "oms_ma_default", with the step of 1 ms unless that is declared.
    """
    with zipfile.ZipFile(packages / "ring.ssp") as archive:
        root = ElementTree.fromstring(archive.read("SystemStructure.ssd"))
    assert children(root) <= {"System", "Units", "Enumerations", "DefaultExperiment"}
    for component in root.iter(f"{{{SSD}}}Component"):
        assert children(component) <= {"Connectors", "ElementGeometry", "ParameterBindings"}
    system = root.find(f"{{{SSD}}}System")
    assert [child.tag.rpartition("}")[2] for child in system] == [
        "Elements", "Connections", "Annotations"
    ]  # fmt: skip
    first = system.find(f"{{{SSD}}}Annotations")[0]
    assert first.get("type") == "org.openmodelica"
    (information,) = first.iter(f"{{{OMS}}}SimulationInformation")
    assert (information.get("name"), information.get("fixedStepSize")) == ("oms_ma_default", "0.01")
    assert information.find(f"{{{OMS}}}FixedStepMaster").get("stepSize") == "0.01"
    from fmpy.ssp.ssd import read_ssd

    read_ssd(str(packages / "ring.ssp"))  # validates by the schema


def test_rates_where_packages_had_them_before(tmp_path, packages):
    """In an annotation of each component, as packages of terrafix were written at first."""
    with zipfile.ZipFile(packages / "ring.ssp") as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    text = content["SystemStructure.ssd"].decode()
    text = re.sub('<terrafix:Rate component="a"[^>]*>', "", text)
    rate = (
        '<ssd:Annotations><ssc:Annotation type="org.terrafix"><terrafix:Rate period="0.05"/>'
        "</ssc:Annotation></ssd:Annotations></ssd:Component>"
    )
    content["SystemStructure.ssd"] = text.replace("</ssd:Component>", rate, 1).encode()
    with zipfile.ZipFile(tmp_path / "old.ssp", "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    made = read_ssp(tmp_path / "old.ssp")
    assert [float(made.nodes[n].rate.period) for n in "abc"] == [0.05, 0.01, 0.01]


# ------------------------------------------------------------------ the same system again


@pytest.fixture(scope="module")
def navigation(tmp_path_factory):
    """The whole open loop, packaged without its evaluation, which is Python."""
    folder = tmp_path_factory.mktemp("navigation")
    made = export_ssp(read_system(OPEN_LOOP), folder / "navigation.ssp", leave_out=["evaluation"])
    assert "sar.fix -> correct.fix" in made.delayed
    assert made.left_out == ("evaluation",)
    return folder / "navigation.ssp"


def test_a_navigation_system_comes_back_to_the_same_bytes(navigation, tmp_path):
    """Messages, rates, frames, start-reads, seed and members."""
    paths = ["orbit.r_e", "imu.delta_v_b", "predict.prior", "correct.estimate"]
    native = without_evaluation(tmp_path / "native.toml")
    expected = final(read_system(native), "8.21", paths, members=2)
    import_ssp(navigation, tmp_path / "imported.toml")
    for system in (read_ssp(navigation), read_system(tmp_path / "imported.toml")):
        assert (system.seed, system.members) == (2008, 100)
        for a, b in zip(expected, final(system, "8.21", paths, members=2), strict=True):
            assert np.array_equal(a, b)


def test_ecos_flies_it_too(navigation):
    found = in_another_process(
        "ecospy", ECOS, navigation, 100, "orbit::r_e[1]", "predict::prior.r_e[1]"
    )
    native = final(read_system(OPEN_LOOP), "1", ["orbit.r_e"])
    assert found[0] == native[0][0, 0]
    assert np.isfinite(found[1])


def test_the_command_line(packages, tmp_path, capsys):
    def run(*words):
        with pytest.raises(SystemExit) as done:
            main([str(w) for w in words])
        return done.value.code, capsys.readouterr()

    assert run("run", packages / "ring.ssp", "--duration", "0.1", "--quiet")[0] == 0
    code, said = run("ssp", "import", packages / "ring.ssp", "-o", tmp_path / "ring.toml")
    assert code == 0
    assert "ring_package" in said.err
    assert run("run", tmp_path / "ring.toml", "--duration", "0.1", "--quiet")[0] == 0
    code, said = run("ssp", "import", packages / "ring.ssp", "-o", tmp_path / "ring.toml")
    assert code == 2
    assert "is there already" in said.err
    code, said = run("ssp", "export", OPEN_LOOP, "-o", tmp_path / "x.ssp")
    assert code == 2
    assert "'evaluation' is a NavigationEvaluation, written in Python" in said.err
    assert "--leave-out evaluation" in said.err
    assert not (tmp_path / "x.ssp").exists()
    code, said = run("run", packages / "ring.ssp", "--set", "a.shift=2")
    assert code == 2
    assert "terrafix ssp import" in said.err


# ------------------------------------------------------------------ anybody's packages


def package(path, components, connections, files, extra=""):
    text = (
        f'<ssd:SystemStructureDescription xmlns:ssd="{SSD}" xmlns:ssc="{SSC}" xmlns:ssv="{SSV}" '
        f'version="1.0" name="theirs"><ssd:System name="top"><ssd:Elements>{components}'
        f"</ssd:Elements><ssd:Connections>{connections}</ssd:Connections></ssd:System>"
        f'<ssd:DefaultExperiment startTime="0" stopTime="1"/>{extra}</ssd:SystemStructureDescription>'
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("SystemStructure.ssd", text)
        for name, data in files.items():
            archive.writestr(f"resources/{name}", data)
    return path


def component(name, source, bindings=""):
    return f'<ssd:Component name="{name}" source="resources/{source}">{bindings}</ssd:Component>'


@pytest.fixture(scope="module")
def integrator(tmp_path_factory):
    file = tmp_path_factory.mktemp("integrator") / "integrator.fmu"
    export_fmu(fmu_parts.EulerIntegrator(shift=0.0, drive=1.0), file, fmi=2, name="integrator")
    return file.read_bytes()


def test_transformations_and_parameter_sets(tmp_path, integrator):
    values = (
        f'<ssv:ParameterSet xmlns:ssv="{SSV}" version="1.0" name="v"><ssv:Parameters>'
        '<ssv:Parameter name="drive"><ssv:Real value="2.0"/></ssv:Parameter>'
        "</ssv:Parameters></ssv:ParameterSet>"
    )
    bound = '<ssd:ParameterBindings><ssd:ParameterBinding source="resources/v.ssv"/></ssd:ParameterBindings>'  # fmt: skip
    inline = f"<ssd:ParameterBindings><ssd:ParameterBinding><ssd:ParameterValues>{values.replace('2.0', '0.0')}</ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>"  # fmt: skip
    link = (
        '<ssd:Connection startElement="a" startConnector="y" endElement="b" endConnector="u">'
        '<ssc:LinearTransformation factor="3" offset="0.5"/></ssd:Connection>'
    )
    file = package(
        tmp_path / "theirs.ssp",
        component("a", "i.fmu", bound) + component("b", "i.fmu", inline),
        link,
        {"i.fmu": integrator, "v.ssv": values},
    )
    a, b = final(read_ssp(file), "1", ["a.y", "b.y"])
    assert a == pytest.approx(2.0, rel=1e-12)
    # b' = 3 a + 0.5 with a = 2 t held over steps: 3 * 2 * h^2 * sum(0..99) + 0.5
    assert b == pytest.approx(6 * 1e-4 * 4950 + 0.5, rel=1e-12)


def test_systems_within_systems(tmp_path, integrator):
    inner = (
        '<ssd:System name="inner"><ssd:Connectors><ssd:Connector name="out" kind="output">'
        "<ssc:Real/></ssd:Connector></ssd:Connectors><ssd:Elements>"
        f"{component('a', 'i.fmu')}</ssd:Elements><ssd:Connections>"
        '<ssd:Connection startElement="a" startConnector="y" endConnector="out"/>'
        "</ssd:Connections></ssd:System>"
    )
    link = '<ssd:Connection startElement="inner" startConnector="out" endElement="b" endConnector="u"/>'
    file = package(
        tmp_path / "theirs.ssp", inner + component("b", "i.fmu"), link, {"i.fmu": integrator}
    )
    system = read_ssp(file)
    assert [str(c) for c in system.connections] == ["inner_a.y -> b.u"]


def test_single_elements_of_an_array(tmp_path, exported, integrator):
    """An element goes to a scalar: the orbit then shows its scalars. y' = v + 1 over 10 ms."""
    link = '<ssd:Connection startElement="orbit" startConnector="v_i[2]" endElement="b" endConnector="u"/>'
    file = package(
        tmp_path / "theirs.ssp",
        component("orbit", "orbit.fmu") + component("b", "i.fmu"),
        link,
        {"i.fmu": integrator, "orbit.fmu": exported("orbit", 2).read_bytes()},
    )
    made = read_ssp(file)
    assert "'b.u' has no unit: taken as m/s, that of what it reads" in made.notes
    (y,) = final(made, "0.01", ["b.y"])
    (v,) = final(read_system(OPEN_LOOP), "0", ["orbit.v_i"])
    assert y[0, 0] == pytest.approx(0.01 * (v[0, 1] + 1.0), rel=1e-12)


@pytest.mark.parametrize(
    ("components", "connections", "message"),
    [
        (component("a", "none.fmu"), "", r"names 'resources/none.fmu', which is not in it"),
        (component("a", "../../etc/passwd"), "", r"which is not in it"),
        (
            component("a", "i.fmu"),
            '<ssd:Connection startElement="a" startConnector="z" endElement="a" endConnector="u"/>',
            r"connects 'a.z', but the FMU has no such variable",
        ),
        (
            component("a", "i.fmu"),
            '<ssd:Connection startElement="q" startConnector="y" endElement="a" endConnector="u"/>',
            r"but there is no 'q'",
        ),
        (
            '<ssd:Component name="m" source="resources/i.fmu" type="application/x-mine"/>',
            "",
            r"component 'm' is of type application/x-mine; terrafix reads FMUs",
        ),
    ],
)
def test_what_cannot_be_read(tmp_path, integrator, components, connections, message):
    file = package(tmp_path / "x.ssp", components, connections, {"i.fmu": integrator})
    with pytest.raises(ConfigurationError, match=message):
        read_ssp(file)


def test_files_that_are_no_package(tmp_path):
    with pytest.raises(ConfigurationError, match="there is no SSP package"):
        read_ssp(tmp_path / "none.ssp")
    (tmp_path / "x.ssp").write_text("no")
    with pytest.raises(ConfigurationError, match="is no SSP package: file is not a zip file"):
        read_ssp(tmp_path / "x.ssp")


def test_what_a_package_cannot_carry_is_named_at_once(tmp_path):
    system = ring()
    system.connections.clear()
    system.connect("a.y", "b.u", delay="0.02")
    from terrafix.cosim.system.dispersion import Dispersion

    system.disperse(Dispersion("spread", ("a.drive",), 0.1))
    with pytest.raises(ConfigurationError) as raised:
        export_ssp(system, tmp_path / "x.ssp")
    assert "'a.y -> b.u' has a delay" in str(raised.value)
    assert "dispersion 'spread': a package has no ensembles" in str(raised.value)
    assert not (tmp_path / "x.ssp").exists()
