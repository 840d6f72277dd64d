"""Units of foreign FMUs and packages: what UnitDefinitions say; a name is a label."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, WiringError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.ssp.reading import read_ssp
from terrafix.cosim.system.system import System

SSP = "http://ssp-standard.org/SSP1/SystemStructure"
KMPH = '<Unit name="kmph"><BaseUnit m="1" s="-1" factor="0.27778"/></Unit>'
G = '<Unit name="g"><BaseUnit m="1" s="-2" factor="9.80665"/></Unit>'


class Reader(Component):
    """Shows what comes in, in m/s."""

    default_rate = Rate("0.1")
    u = Input((), unit="m/s", doc="speed")
    y = Output((), unit="m/s", doc="the same")

    def _initialize_impl(self):
        self.port_views["y"][...] = self.port_views["u"]

    def _step_impl(self, t, dt):
        self._initialize_impl()


def unit_of(file, name="y"):
    fmu = Fmu(file=file)
    fmu.prepare()
    return fmu.ports[name].single.unit


def final(system, path):
    simulation = Simulation(system)
    simulation.run_until("0.2")
    found = simulation.master.wiring.slots[path].data.copy()
    simulation.master.terminate()
    return float(found.ravel()[0])


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_definition_converts_and_not_the_name(tmp_path, fmi):
    """100 kmph of factor 0.27778 are 27.778 m/s; Pint's kilo-mile per hour would be 44,704."""
    file = small_fmu(
        tmp_path / "v.fmu", fmi, [Variable("y", start="100.0", unit="kmph")], units=KMPH
    )
    with System("s") as system:
        system.add(Fmu(file=file, rate=Rate("0.1")), "v")
        system.add(Reader(), "reader")
        system.connect("v.y", "reader.u")
    assert final(system, "reader.y") == pytest.approx(27.778, rel=1e-15)


@pytest.mark.parametrize(
    ("name", "base", "unit"),
    [
        ("g", 'm="1" s="-2" factor="9.80665"', "g = 9.80665 m/s^2"),
        ("g", 'kg="1" factor="0.001"', "g"),
        ("m/s2", 'm="1" s="-2"', "m/s^2"),
        ("rad/s2", 'rad="1" s="-2"', "rad/s^2"),
        ("rad/s", 's="-1"', "rad/s"),  # the radian may be left out
        ("kg.m2", 'kg="1" m="2"', "kg m^2"),
        ("W/(m2.K)", 'kg="1" s="-3" K="-1"', "W/(m^2 K)"),
        ("s-1", 's="-1"', "s^-1"),
        ("rev/min", 'rad="1" s="-1" factor="0.10471975511965977"', "revolution/min"),
        ("rev/min", 's="-1" factor="0.5"', "rev/min = 0.5 1/s"),
        ("Ohm", 'kg="1" m="2" s="-3" A="-2"', "ohm"),
        ("degC", 'K="1" offset="273.15"', "degC"),
        ("degC", 'K="1"', "degC = 1.0 K"),
        ("deg", 'rad="1" factor="0.0174533"', "deg = 0.0174533 rad"),
        ("%", 'factor="0.01"', "%"),
    ],
)
def test_labels_and_their_definitions(tmp_path, name, base, unit):
    definition = f'<Unit name="{name}"><BaseUnit {base}/></Unit>'
    file = small_fmu(tmp_path / "v.fmu", 2, [Variable("y", unit=name)], units=definition)
    assert unit_of(file) == unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *(("m/s2", "m/s^2"), ("rad/s2", "rad/s^2"), ("kg.m2", "kg m^2"), ("Ohm", "ohm")),
        *(("W/(m2.K)", "W/(m^2 K)"), ("s-1", "s^-1"), ("rev/min", "revolution/min")),
        *(("kmph", "kmph = ?"), ("Nm", "Nm = ?"), ("9^9^9^9", "9^9^9^9 = ?")),
    ],
)
def test_names_without_a_definition_are_si_or_fit_themselves_alone(tmp_path, name, unit):
    file = small_fmu(tmp_path / "v.fmu", 2, [Variable("y", unit=name)])
    assert unit_of(file) == unit


def test_a_unit_that_nobody_defines_is_refused_and_can_be_said(tmp_path):
    file = small_fmu(tmp_path / "v.fmu", 2, [Variable("y", start="10.0", unit="kmph")])
    with System("s") as system:
        system.add(Fmu(file=file, rate=Rate("0.1")), "v")
        system.add(Fmu(file=file, rate=Rate("0.1"), units={"y": "km/h"}), "said")
        system.add(Reader(), "reader")
    with pytest.raises(WiringError, match=r"kmph = \? is not m/s\n  nobody defines kmph"):
        system.connect("v.y", "reader.u")
    system.connect("said.y", "reader.u")
    assert final(system, "reader.y") == pytest.approx(10 / 3.6, rel=1e-15)


def test_gravity_does_not_feed_grams(tmp_path):
    accel = small_fmu(tmp_path / "a.fmu", 2, [Variable("y", unit="g")], units=G)
    grams = small_fmu(
        tmp_path / "m.fmu",
        2,
        [Variable("u", causality="input", start="0.0", unit="g")],
        units='<Unit name="g"><BaseUnit kg="1" factor="0.001"/></Unit>',
    )
    with System("s") as system:
        system.add(Fmu(file=accel, rate=Rate("0.1")), "a")
        system.add(Fmu(file=grams, rate=Rate("0.1")), "m")
    with pytest.raises(WiringError, match=r"the units differ: g = 9.80665 m/s\^2 is not g"):
        system.connect("a.y", "m.u")


def test_parameters_take_the_label_of_the_fmu_and_convert_others(tmp_path):
    speed = Variable("k", causality="parameter", start="1.0", unit="kmph")
    file = small_fmu(
        tmp_path / "v.fmu", 2, [Variable("y"), speed], units=KMPH, step="m->r[0] = m->r[1];"
    )
    for given, expected in (("50 kmph", 50.0), ("13.889 m/s", 50.0), (50.0, 50.0)):
        with System("s") as system:
            system.add(Fmu(file=file, rate=Rate("0.1"), start={"k": given}), "v")
        assert final(system, "v.y") == pytest.approx(expected, rel=1e-15)
    with pytest.raises(ConfigurationError, match=r"is given in kg; it takes number \[kmph = 0.27"):
        System("s").add(Fmu(file=file, start={"k": "1 kg"}), "v")


# ------------------------------------------------------------------ packages


def package(target, file, units="", parameters="", connection=""):
    """Two of one FMU, a feeding b, with units of the package's own."""
    component = (
        '<Component name="{}" source="resources/v.fmu"><Connectors>'
        '<Connector name="y" kind="output"/><Connector name="u" kind="input"/>'
        "</Connectors>{}</Component>"
    )
    bound = (
        '<ParameterBindings><ParameterBinding><ParameterValues><p:ParameterSet version="1.0" '
        f'name="p">{parameters}</p:ParameterSet></ParameterValues></ParameterBinding>'
        "</ParameterBindings>"
    )
    text = (
        f'<SystemStructureDescription xmlns="{SSP}Description" xmlns:c="{SSP}Common" '
        f'xmlns:p="{SSP}ParameterValues" name="two" version="1.0"><System name="s"><Elements>'
        f"{component.format('a', bound)}{component.format('b', '')}</Elements><Connections>"
        '<Connection startElement="a" startConnector="y" endElement="b" endConnector="u"'
        f"{connection}</Connections></System>{units}</SystemStructureDescription>"
    )
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("SystemStructure.ssd", text)
        archive.write(file, "resources/v.fmu")
    return target


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """y [kmph] is the parameter k [kmph]; z is u as it was set, in m/s."""
    variables = [
        Variable("y", unit="kmph"),
        Variable("k", causality="parameter", start="1.0", unit="kmph"),
        Variable("u", causality="input", start="0.0", unit="m/s"),
        Variable("z", unit="m/s"),
    ]
    step = "m->r[0] = m->r[1]; m->r[3] = m->r[2];"
    return small_fmu(
        tmp_path_factory.mktemp("parts") / "v.fmu",
        2,
        variables,
        step=step,
        units=KMPH,
        experiment='stepSize="0.1"',
    )


UNITS = '<{0}Units><c:Unit name="kmph"><c:BaseUnit m="1" s="-1" factor="{1}"/></c:Unit></{0}Units>'
IN_KMPH = '<p:Parameters><p:Parameter name="k"><p:Real value="36" unit="kmph"/></p:Parameter>' \
          "</p:Parameters>"  # fmt: skip
LINEAR = '><LinearTransformation factor="2" offset="1"/></Connection>'


@pytest.mark.parametrize(
    ("units", "parameters", "connection", "y", "z"),
    [
        ("", IN_KMPH, "/>", 36.0, 10.00008),
        # the package's kmph is another: 36 of them are 72 m/s, 259.19...; its own set goes first
        (UNITS.format("", 2), IN_KMPH, "/>", 72 / 0.27778, 72.0),
        (UNITS.format("", 5), IN_KMPH + UNITS.format("p:", 2), "/>", 72 / 0.27778, 72.0),
        ("", IN_KMPH, ' suppressUnitConversion="true"/>', 36.0, 36.0),
        # in addition to the conversion, or instead of it
        ("", IN_KMPH, LINEAR, 36.0, 2 * 10.00008 + 1),
        ("", IN_KMPH, ' suppressUnitConversion="true"' + LINEAR, 36.0, 73.0),
    ],
)
def test_units_of_packages(tmp_path, parts, units, parameters, connection, y, z):
    system = read_ssp(package(tmp_path / "two.ssp", parts, units, parameters, connection))
    simulation = Simulation(system)
    simulation.run_until("0.5")
    slots = simulation.master.wiring.slots
    found = [float(np.ravel(slots[p].data)[0]) for p in ("a.y", "b.z")]
    simulation.master.terminate()
    assert found == pytest.approx([y, z], rel=1e-14)
