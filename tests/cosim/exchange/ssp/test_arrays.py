"""Types and arrays of SSP 2.0, on FMUs of FMI 3: y = 2 u (our own), and y = k . u with n elements."""

from __future__ import annotations

import eventful
import fmu_parts
import pytest
from ssp_parts import bindings, link, packaged, part, system, values

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.exchange.ssp.reading import import_ssp, read_ssp
from terrafix.cosim.files.readers import read_system


@pytest.fixture(scope="module")
def arrays(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arrays")
    export_fmu(fmu_parts.Doubling(), folder / "d.fmu", fmi=3)
    eventful.make_fmu(folder / "s.fmu", eventful.SIZED, eventful.SIZED_XML, fmi=3)
    return {n: (folder / f"{n}.fmu").read_bytes() for n in "ds"}


def values_2(**given):
    """A parameter set of SSP 2.0: a type, and as many dimensions as a list has."""
    written = ""
    for name, (kind, value) in given.items():
        size = len(value.split())
        shape = f'<ssv:Dimension size="{size}"/>' if size > 1 else ""
        written += (
            f'<ssv:Parameter name="{name}"><ssv:{kind} value="{value}"/>{shape}</ssv:Parameter>'
        )
    return bindings(
        '<ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="2.0" name="v">'
        f"<ssv:Parameters>{written}</ssv:Parameters></ssv:ParameterSet></ssd:ParameterValues>"
        "</ssd:ParameterBinding>"
    )


def array(name, kind, inside='<ssd:Dimension size="3"/>'):
    made = f'<ssd:Connector name="{name}" kind="{kind}"><ssc:Float64/>{inside}</ssd:Connector>'
    return f"<ssd:Connectors>{made}</ssd:Connectors>"


def doubled(name="a"):
    return part(name, "d", array("y", "output") + values_2(u=("Float64", "1 2 3")))


def summed(n="3", k="1 2 3"):
    given = values_2(n=("UInt64", n), k=("Float64", k), u=("Float64", "1"))
    return part("b", "s", array("u", "input", '<ssd:Dimension sizeConnector="n"/>') + given)


def test_a_whole_array_goes_to_another(tmp_path, arrays):
    """b has three elements, as its structural parameter says: 1 * 2 + 2 * 4 + 3 * 6."""
    top = system(doubled() + summed(), link("a.y", "b.u"))
    file = packaged(tmp_path / "x.ssp", arrays, top, version="2.0")
    assert [str(c) for c in read_ssp(file).connections] == ["a.y -> b.u"]
    assert values(file, "b.y", t="0.1") == [28.0]


def test_arrays_of_other_sizes_are_named(tmp_path, arrays):
    top = system(doubled() + summed("2", "1 2"), link("a.y", "b.u"))
    file = packaged(tmp_path / "x.ssp", arrays, top, version="2.0")
    with pytest.raises(
        ConfigurationError,
        match=r"connects 'a.y' to 'b.u', but one has 3 elements and the other 2",
    ):
        read_ssp(file)
    file = packaged(tmp_path / "x.ssp", arrays, system(summed("3", "1 2")), version="2.0")
    with pytest.raises(ConfigurationError, match=r"'b': 'k' has 3 elements, and its parameter set"):
        read_ssp(file)


def test_elements_go_to_elements(tmp_path, arrays):
    """Indices count from one, as in A(1,1); b.u = [a.y[3], start, c.y[1]] = [6, 1, 2]: 6 + 2 + 6."""
    top = system(
        doubled("a") + doubled("c") + summed(),
        link("a.y", "b.u").replace(">", ' startIndices="3" endIndices="1">', 1),
        link("c.y", "b.u").replace(">", ' startIndices="1" endIndices="3">', 1),
    )
    file = packaged(tmp_path / "x.ssp", arrays, top, version="2.0")
    assert values(file, "b.y", t="0.1") == [1 * 6 + 2 * 1 + 3 * 2]
    import_ssp(file, tmp_path / "x.toml")
    assert read_system(tmp_path / "x.toml").nodes["elements_of_b_u"].take == "1:2,-,2:0"
    wrong = top.replace('endIndices="3"', 'endIndices="4"')
    file = packaged(tmp_path / "x.ssp", arrays, wrong, version="2.0")
    with pytest.raises(ConfigurationError, match=r"connects 'b.u\[4\]', but the FMU has no such"):
        read_ssp(file)
