"""Parameters of an FMU are those of its component: set, dispersed, written and reported alike."""

from __future__ import annotations

import eventful
import fmu_parts
import numpy as np
import pytest
from fmu_helpers import OPEN_LOOP

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError, SystemCheckError
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.loop import FmuLoop
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.files.writing import write_system
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    """A real with bounds and a unit, an integer, an enumeration, a boolean and a text."""
    file = tmp_path_factory.mktemp("settings") / "settings.fmu"
    return eventful.make_fmu(file, eventful.SETTINGS, eventful.SETTINGS_XML, fmi=2)


@pytest.fixture(scope="module")
def sized(tmp_path_factory):
    """y = sum k u over n elements, n a structural parameter."""
    file = tmp_path_factory.mktemp("sized") / "sized.fmu"
    return eventful.make_fmu(file, eventful.SIZED, eventful.SIZED_XML, fmi=3)


def alone(fmu, name="part"):
    system = System("alone")
    system.add(fmu, name)
    return system


def output(system, path, members=1):
    simulation = Simulation(system, members=members)
    simulation.run_until("0.1")
    found = simulation.master.wiring.slots[path].data.copy()
    simulation.master.terminate()
    return found


def values_of(result):
    return {
        n: v.values.tobytes() for n, v in result.dataset().variables.items() if v.dtype.kind in "fi"
    }


# ------------------------------------------------------------------ dispersed


def dispersed_open_loop(orbit=None):
    """The open loop with position and velocity dispersed, flown with another orbit."""
    system = read_system(OPEN_LOOP)
    spread = [Dispersion("position", ("orbit.r0_i",), "[100, 200, 300] m")]
    spread += [Dispersion("velocity", ("orbit.v0_i",), "0.1 m/s", design="latin_hypercube")]
    for each in spread:
        system.disperse(each)
    if orbit is not None:
        system.replace("orbit", Fmu(file=orbit, rate=system.find("orbit").rate))
    return system


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_campaign_with_a_dispersed_parameter_of_an_fmu_is_the_native_one(exported, fmi):
    """To the bit; benchmarks/fmu_campaign.py has the same of 1,000 members."""
    options = {"runs": 24, "duration": "16.4", "workers": 1}
    native = run_campaign(dispersed_open_loop(), **options)
    flown = run_campaign(dispersed_open_loop(exported("orbit", fmi)), **options)
    assert values_of(flown) == values_of(native)
    assert native.parameters["orbit.r0_i"].tobytes() == flown.parameters["orbit.r0_i"].tobytes()
    assert len(np.unique(flown.parameters["orbit.r0_i"][:, 0])) == 24


def test_isolated_members_have_their_own_parameters(spring):
    system = alone(Fmu(file=spring(2), rate=Rate("0.01"), isolate=True))
    system.disperse(Dispersion("x0", ("part.x0",), ["1 m", "2 m", "3 m"], kind="list"))
    simulation = Simulation(system, members=3)
    simulation.initialize()
    assert simulation.master.wiring.slots["part.x"].data[:, 0].tolist() == [1.0, 2.0, 3.0]
    simulation.master.terminate()


# ------------------------------------------------------------------ declared and set


def test_a_parameter_is_declared_with_unit_bounds_and_meaning(settings):
    fmu = alone(Fmu(file=settings, rate=Rate("0.1"))).nodes["part"]
    body = fmu.settings()["body_k"]
    assert (body.kind(), body.doc, float(body.default)) == ("number [kg]", "mass of the body", 2.0)
    assert fmu.settings()["mode"].kind() == '"off" | "slow" | "fast"'
    assert fmu.is_default("body_k")
    assert float(fmu.setting("body_k")) == 2.0
    for value, message in (
        ("0.5 kg", r"'part.body_k' is 0.5 kg; it must be at least 1 kg, says its FMU"),
        ("25000 g", r"is 25 kg; it must be at most 20 kg"),
        ("2 m", "is given in m"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            fmu.set_parameter("body_k", value)
    for name, value, message in (
        ("tolerance_", 2.7, "is 2.7; it must be a whole number"),
        ("tolerance_", 3e9, "must be at most 2147483647, says its FMU"),
        ("mode", "quick", '"off" or "slow" or "fast"'),
        ("on", "maybe", "it takes true or false"),
        ("bodyk", 3, "did you mean 'body_k'?"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            fmu.set_parameter(name, value)


def test_every_type_reaches_the_fmu(settings, tmp_path):
    """In a file before or after `file`, with --set, in Python and in start; written and read back."""
    text = (
        'schema = "terrafix-system/1"\nname = "s"\n[component.a]\ntype = "fmu"\nrate = "10 Hz"\n'
        'body_k = "3000 g"\nfile = "{}"\nmode = "fast"\ntolerance_ = 5\n'
    )
    (tmp_path / "s.toml").write_text(text.format(settings))
    given = [("a.on", "true"), ("a.word", "hello"), ("a.mode", "off")]
    system = read_system(tmp_path / "s.toml", given)
    expected = [[3.0, 5.0, 3.0, 1.0, ord("h")]]
    assert output(system, "a.y").tolist() == expected
    write_system(system, tmp_path / "again.toml")
    assert output(read_system(tmp_path / "again.toml"), "a.y").tolist() == expected
    options = {"file": settings, "rate": Rate("0.1")}
    made = Fmu(body_k="3 kg", tolerance_=5, mode="off", on=True, word="hello", **options)
    assert output(alone(made), "part.y").tolist() == expected
    start = {"body.k": "3 kg", "tolerance": 5, "mode": 3, "on": True, "word": "hello"}
    assert output(alone(Fmu(start=start, **options)), "part.y").tolist() == expected
    assert output(alone(Fmu(**options)), "part.y").tolist() == [[2.0, 3.0, 7.0, 0.0, ord("s")]]


def test_whole_numbers_are_dispersed_by_a_list(settings):
    system = alone(Fmu(file=settings, rate=Rate("0.1")))
    system.disperse(Dispersion("n", ("part.tolerance_",), [4, 8], kind="list"))
    assert output(system, "part.y", members=3)[:, 1].tolist() == [4.0, 8.0, 4.0]
    system = alone(Fmu(file=settings, rate=Rate("0.1")))
    system.disperse(Dispersion("n", ("part.tolerance_",), 1.0))
    with pytest.raises(ConfigurationError, match=r"after dispersion 'n' is .* a whole number"):
        Simulation(system, members=3)
    system = alone(Fmu(file=settings, rate=Rate("0.1")))
    system.disperse(Dispersion("mode", ("part.mode",), 1.0))
    with pytest.raises(SystemCheckError, match=r"'part.mode', which is no numeric parameter"):
        system.check()


def test_a_value_that_the_fmu_refuses_is_named(settings):
    system = alone(Fmu(file=settings, rate=Rate("0.1"), body_k="13 kg"))
    with pytest.raises(StepError, match="its 'body_k' was refused: fmi2SetReal returned Error"):
        simulate(system, duration="0.1")


def test_files_with_parameters_that_cannot_be_set(settings, tmp_path):
    text = (
        'schema = "terrafix-system/1"\nname = "s"\n[component.a]\ntype = "fmu"\nrate = "10 Hz"\n{}'
        '[record.r]\nports = ["a.y"]\n'
    )
    for lines, message in (
        ("body_kk = 3\nfile = 'settings.fmu'\n", "no parameter 'body_kk'\n  did you mean 'body_k'"),
        ("body_k = '3 kg'\nfile = 'none.fmu'\n", "cannot read '.*none.fmu'"),
        ("body_k = 3\nfile = 'settings.fmu'\n", "'a.body_k' has no unit"),
        (
            "body_k = '3 kg'\nfile = 'settings.fmu'\nstart = { 'body.k' = '4 kg' }\n",
            "'a.start.body.k' and 'a.body_k' give one parameter two values",
        ),
    ):
        (tmp_path / "settings.fmu").write_bytes(settings.read_bytes())
        (tmp_path / "s.toml").write_text(text.format(lines))
        with pytest.raises(SystemCheckError, match=message) as raised:
            read_system(tmp_path / "s.toml")
        assert len(raised.value.problems) == 1


def test_a_value_assigned_as_an_attribute_is_told(settings):
    system = alone(Fmu(file=settings, rate=Rate("0.1")))
    system.nodes["part"].body_k = 3.0
    with pytest.raises(SystemCheckError, match=r'write set_parameter\("body_k", ...\)'):
        system.check()


def test_another_file_without_a_parameter_that_was_set(settings, spring):
    fmu = Fmu(file=settings, rate=Rate("0.1"), body_k="3 kg")
    fmu.file = spring(2)
    with pytest.raises(
        ConfigurationError, match=r"'part.body_k' was set, but .* has no such parameter"
    ):
        alone(fmu)


# ------------------------------------------------------------------ structure


def test_structural_parameters_are_set_in_configuration_mode(sized, tmp_path):
    """y = sum of k u: 1 + 2 of two elements; 10 + 20 + 30 of three."""
    assert output(alone(Fmu(file=sized, rate=Rate("0.1"))), "part.y").tolist() == [[3.0]]
    fmu = Fmu(file=sized, rate=Rate("0.1"), k=[10, 20, 30], n=3, start={"u": [1, 1, 1]})
    system = alone(fmu)
    assert fmu.ports["u"].single.shape == (3,)
    assert output(system, "part.y").tolist() == [[60.0]]
    text = 'schema = "terrafix-system/1"\nname = "s"\n[component.a]\ntype = "fmu"\n'
    text += (
        f'rate = "10 Hz"\nk = [10, 20, 30]\nn = 3\nstart = {{ u = [1, 1, 1] }}\nfile = "{sized}"'
    )
    (tmp_path / "s.toml").write_text(text)
    assert output(read_system(tmp_path / "s.toml"), "a.y").tolist() == [[60.0]]
    start = {"u": [1, 1, 1], "k": [10, 20, 30], "n": 3}
    by_start = Fmu(file=sized, rate=Rate("0.1"), start=start)
    assert output(alone(by_start), "part.y").tolist() == [[60.0]]


def test_structural_parameters_that_do_not_fit(sized):
    with pytest.raises(ConfigurationError, match="it must be at least 1 and at most 9"):
        Fmu(file=sized, n=10)
    with pytest.raises(ConfigurationError, match=r"has shape \(2,\); it takes array \(3,\)"):
        Fmu(file=sized, n=3, k=[1, 2])
    fmu = Fmu(file=sized, k=[1, 2])
    with pytest.raises(ConfigurationError, match=r"has shape \(2,\); it takes array \(3,\)"):
        fmu.set_parameter("n", 3)


def test_a_parameter_without_a_value_is_not_dispersed(sized):
    system = alone(Fmu(file=sized, rate=Rate("0.1"), n=3))
    system.disperse(Dispersion("k", ("part.k",), [1.0, 1.0, 1.0]))
    with pytest.raises(SystemCheckError, match=r"'part.k', which has no value to begin with"):
        system.check()


def test_start_values_still_set_parameters(spring):
    by_start = Fmu(file=spring(3), rate=Rate("0.01"), start={"mass": "3000 g", "x0": "12 cm"})
    by_name = Fmu(file=spring(3), rate=Rate("0.01"), mass="3000 g", x0="12 cm")
    native = fmu_parts.Spring(mass=3.0, x0=0.12)
    found = [output(alone(made), "part.x").tobytes() for made in (by_start, by_name, native)]
    assert len(set(found)) == 1
    assert float(by_start.setting("mass")) == 3.0


def test_a_parameter_without_the_file_that_has_it():
    for kind, name in ((Fmu, "file"), (FmuLoop, "files")):
        with pytest.raises(ConfigurationError, match=f"has no parameter 'k'\n.*{name}"):
            kind(k=3)


# ------------------------------------------------------------------ of FMUs that loop


@pytest.fixture(scope="module")
def integrator(tmp_path_factory):
    """x' = u + drive, y = x + shift."""
    file = tmp_path_factory.mktemp("integrator") / "integrator.fmu"
    export_fmu(fmu_parts.EulerIntegrator(), file)
    return file


def test_a_loop_takes_the_parameters_of_its_fmus(integrator, tmp_path):
    """y = u by the implicit Euler method: (y + drive) grows by 1 / (1 - h) in each step."""
    text = (
        'schema = "terrafix-system/1"\nname = "s"\n[component.part]\ntype = "fmu_loop"\n'
        f'rate = "100 Hz"\na_drive = 2.0\nfiles = {{ a = "{integrator}" }}\n'
        'connect = "a.y -> a.u"\n'
    )
    (tmp_path / "s.toml").write_text(text)
    system = read_system(tmp_path / "s.toml", [("part.a_shift", "5")])
    expected = [(5 + 2) / 0.99**10 - 2]
    assert output(system, "part.a_y")[:, 0] == pytest.approx(expected, rel=1e-10)
    write_system(system, tmp_path / "again.toml")
    assert output(read_system(tmp_path / "again.toml"), "part.a_y")[:, 0] == pytest.approx(expected)
    system = read_system(tmp_path / "s.toml")
    system.disperse(Dispersion("shift", ("part.a_shift",), ["1", "2", "4"], kind="list"))
    found = output(system, "part.a_y", members=3)[:, 0]
    expected = (np.array([1, 2, 4]) + 2) / 0.99**10 - 2
    assert found == pytest.approx(expected, rel=1e-10)


STATE = """
F int fmi2GetFMUstate(void *c, void **s)
{ if (!*s) *s = malloc(sizeof(struct m)); memcpy(*s, c, sizeof(struct m)); return 0; }
F int fmi2SetFMUstate(void *c, void *s) { memcpy(c, s, sizeof(struct m)); return 0; }
F int fmi2FreeFMUstate(void *c, void **s) { free(*s); *s = 0; return 0; }
"""


def test_parameters_of_every_type_reach_the_fmus_of_a_loop(tmp_path):
    """With units and bounds, one for each FMU."""
    flag = 'modelIdentifier="m" canGetAndSetFMUstate="true"'
    xml = eventful.SETTINGS_XML.replace('modelIdentifier="m"', flag)
    file = eventful.make_fmu(tmp_path / "m.fmu", eventful.SETTINGS + STATE, xml, fmi=2)
    given = {"p_body_k": "3000 g", "p_mode": "fast", "p_tolerance_": 5, "p_on": True, "q_word": "x"}
    loop = FmuLoop(files={"p": file, "q": file}, connect="", rate=Rate("0.1"), **given)
    system = alone(loop)
    assert output(system, "part.p_y").tolist() == [[3.0, 5.0, 9.0, 1.0, ord("s")]]
    assert output(system, "part.q_y").tolist() == [[2.0, 3.0, 7.0, 0.0, ord("x")]]
    body = loop.settings()["q_body_k"]
    assert (body.kind(), body.doc, float(body.default)) == ("number [kg]", "mass of the body", 2.0)
    for name, value, message in (
        ("p_body_k", "0.5 kg", r"'part.p_body_k' is 0.5 kg; it must be at least 1 kg"),
        ("p_bodyk", 3, "has no parameter 'p_bodyk'\n  did you mean 'p_body_k'?"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            loop.set_parameter(name, value)
    loop.p_mode = "slow"
    with pytest.raises(SystemCheckError, match=r"'part.p_mode' was assigned as an attribute"):
        output(system, "part.p_y")
    files = {"p": file, "most": eventful_named(tmp_path, "iterations", xml)}
    with pytest.raises(ConfigurationError, match="'most' would be called 'most_iterations', as an"):
        alone(FmuLoop(files=files, connect="", rate=Rate("0.1")))


def eventful_named(tmp_path, name, xml):
    """The same with its text called something else."""
    changed = xml.replace('name="word"', f'name="{name}"')
    return eventful.make_fmu(tmp_path / "n.fmu", eventful.SETTINGS + STATE, changed, fmi=2)


def test_members_of_a_loop_have_their_own_noise(exported):
    """That of the same FMU as a component: its seed and member are those of the run."""
    file, rate = exported("imu", 3), Rate("0.01")
    alone_ = output(alone(Fmu(file=file, rate=rate), "part"), "part.delta_v_b", members=2)
    loop = FmuLoop(files={"i": file}, connect="", rate=rate)
    found = output(alone(loop), "part.i_delta_v_b", members=2)
    assert np.array_equal(found, alone_)
    assert (found[0] != found[1]).all()
