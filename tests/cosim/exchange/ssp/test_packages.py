"""Where packages lie: archives, folders, descriptions chosen by name, packages in packages."""

from __future__ import annotations

import zipfile

import pytest
from ssp_parts import bindings, bound, link, packaged, part, system, values

from terrafix.cli import main
from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.exchange.fmi.run import archive
from terrafix.cosim.exchange.ssp.reading import import_ssp, read_ssp
from terrafix.cosim.files.readers import read_system

SET = bindings('<ssd:ParameterBinding source="v.ssv"/>')


def variant(k):
    return system(part("a", inside=bindings(bound(k=k))))


def text_of(tmp_path, top):
    """A description alone."""
    with zipfile.ZipFile(packaged(tmp_path / "text.ssp", {}, top)) as archive:
        return archive.read("SystemStructure.ssd")


@pytest.fixture
def variants(tmp_path, fmus):
    """k = 2, and in B.ssd 5."""
    other = text_of(tmp_path, variant("5"))
    with zipfile.ZipFile(packaged(tmp_path / "x.ssp", fmus, variant("2")), "a") as archive:
        archive.writestr("B.ssd", other)
    return tmp_path / "x.ssp"


@pytest.fixture
def unpacked(tmp_path, variants):
    with zipfile.ZipFile(variants) as archive:
        archive.extractall(tmp_path / "folder")
    return tmp_path / "folder"


def test_a_description_by_its_name(variants):
    assert values(variants, "a.y") == [2.0]
    assert values(f"{variants}#B.ssd", "a.y") == [5.0]
    with pytest.raises(ConfigurationError) as raised:
        read_ssp(f"{variants}#C.ssd")
    assert str(raised.value) == (
        f"'{variants}' has no description 'C.ssd'\n  it has B.ssd, SystemStructure.ssd"
    )


def test_a_folder_is_a_package(unpacked, tmp_path):
    before = sorted(unpacked.rglob("*"))
    for name, k in (("", 2.0), ("#B.ssd", 5.0), ("/B.ssd", 5.0), ("/SystemStructure.ssd", 2.0)):
        assert values(f"{unpacked}{name}", "a.y") == [k]
        assert list(read_system(f"{unpacked}{name}").nodes) == ["a"]
    with pytest.raises(ConfigurationError, match=r"has no description 'C.ssd'\n  it has B.ssd, S"):
        read_ssp(f"{unpacked}#C.ssd")
    assert sorted(unpacked.rglob("*")) == before
    (unpacked / "SystemStructure.ssd").unlink()
    with pytest.raises(ConfigurationError, match=r"name one, as in '.*folder#B.ssd'"):
        read_ssp(unpacked)


def test_sources_beside_a_folder_but_not_beside_an_archive(tmp_path, fmus):
    """A folder is somebody's own; an archive may name nothing outside itself."""
    (tmp_path / "fmus").mkdir()
    (tmp_path / "fmus" / "k.fmu").write_bytes(fmus["k"])
    (tmp_path / "d").mkdir()
    top = system(part("a", "../fmus/k", bindings(bound(k="3"))))
    (tmp_path / "d" / "SystemStructure.ssd").write_bytes(text_of(tmp_path, top))
    assert values(tmp_path / "d", "a.y") == [3.0]
    with pytest.raises(ConfigurationError, match=r"names '../fmus/k.fmu', which is not in it"):
        read_ssp(packaged(tmp_path / "x.ssp", {}, top))
    import_ssp(tmp_path / "d", tmp_path / "x.toml")
    assert (tmp_path / "x_package" / "k.fmu").is_file()
    assert "../" not in (tmp_path / "x.toml").read_text()
    assert list(read_system(tmp_path / "x.toml").nodes) == ["a"]


def test_a_proxy_here_is_a_process_of_its_own_and_one_elsewhere_is_named(tmp_path, fmus):
    """As packages of the Open Simulation Platform have it."""

    def at(host):
        given = bindings(bound(k="4"))
        source = f"proxyfmu://{host}?file=k.fmu"
        top = system(f'<ssd:Component name="a" source="{source}">{given}</ssd:Component>')
        return packaged(tmp_path / "x.ssp", fmus, top)

    assert read_ssp(at("localhost")).nodes["a"].given_parameters["isolate"]
    assert values(at("localhost:9090"), "a.y") == [4.0]
    with pytest.raises(
        ConfigurationError, match=r"names 'proxyfmu://far\?.*', which lies elsewhere"
    ):
        read_ssp(at("far"))


def held(source, kind="package", inside=""):
    return f'<ssd:Component name="B" type="application/x-ssp-{kind}" source="{source}">{inside}</ssd:Component>'


def test_a_description_of_a_package_within(tmp_path, fmus, variants):
    inner = variants.read_bytes()
    top = packaged(tmp_path / "y.ssp", fmus, system(held("in.ssp#B.ssd")), **{"in.ssp": inner})
    assert values(top, "B_a.y") == [5.0]
    top = packaged(tmp_path / "y.ssp", fmus, system(held("in.ssp#C.ssd")), **{"in.ssp": inner})
    with pytest.raises(
        ConfigurationError,
        match=r"y.ssp': 'B': 'in.ssp' has no description 'C.ssd'\n  it has B.ssd, System",
    ):
        read_ssp(top)


def test_a_description_elsewhere_means_what_lies_beside_it(tmp_path, fmus):
    inner = text_of(tmp_path, variant("8"))
    files = {"sub/C.ssd": inner, "sub/k.fmu": fmus["k"]}
    top = system(held("sub/C.ssd", "definition"))
    assert values(packaged(tmp_path / "y.ssp", {}, top, **files), "B_a.y") == [8.0]


def test_a_system_of_the_same_document_by_its_id(tmp_path, fmus):
    """Twice the system "gain": k is 2 in it, 9 where the component says so."""
    gain = variant("2").replace('name="top"', 'name="G" id="gain"')
    again = held("#gain", "definition", bindings(bound(a__k="9")))
    assert values(packaged(tmp_path / "x.ssp", fmus, system(gain + again)), "G_a.y", "B_a.y") == [
        2.0,
        9.0,
    ]
    wrong = packaged(tmp_path / "x.ssp", fmus, system(gain + held("#gian", "definition")))
    with pytest.raises(ConfigurationError, match=r"id 'gian'\n  .*gain"):
        read_ssp(wrong)
    itself = system(held("#me", "definition")).replace('name="top"', 'name="top" id="me"')
    with pytest.raises(ConfigurationError, match="more than 10 packages lie within each other"):
        read_ssp(packaged(tmp_path / "x.ssp", fmus, itself))


def test_a_package_in_a_system_file(tmp_path, variants):
    file = tmp_path / "s.toml"
    file.write_text(
        'schema = "terrafix-system/1"\nname = "s"\nduration = "1 s"\n\n'
        f'[component.inner]\ntype = "system"\nfile = "{variants.name}#B.ssd"\n'
    )
    assert values(variants, "a.y") == [2.0]
    made = read_system(file)
    assert made.nodes["inner"].nodes["a"].given_parameters["k"] == 5.0
    file.write_text(file.read_text().replace("B.ssd", "C.ssd"))
    with pytest.raises(TerrafixError, match=r"'inner': .*has no description 'C.ssd'"):
        read_system(file)


def test_the_command_line_takes_all_of_them(tmp_path, unpacked, variants, capsys):
    for name in (variants, f"{variants}#B.ssd", unpacked, unpacked / "B.ssd"):
        with pytest.raises(SystemExit) as done:
            main(["run", str(name), "--duration", "0.2", "--quiet"])
        assert done.value.code == 0
    with pytest.raises(SystemExit) as done:
        main(["run", f"{variants}#C.ssd"])
    assert done.value.code == 2
    assert "it has B.ssd, SystemStructure.ssd" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("elements", "files", "message"),
    [
        (
            '<ssd:Component name="a"/>',
            {},
            "component 'a' has no source: it is a design that nobody",
        ),
        (part("a", "none"), {}, "names 'none.fmu', which is not in it"),
        (part("a", inside=SET), {}, "names 'v.ssv', which is not in it"),
        (part("a", inside=SET), {"v.ssv": "<a"}, "v.ssv is damaged: unclosed token"),
        (part("a", inside=SET), {"v.ssv": "<a/>"}, "'v.ssv' is no ParameterSet of SSP"),
        (part("a", inside=SET), {"v.ssv": "<!DOCTYPE a><a/>"}, "v.ssv has a document type"),
        (part("a"), {"../x": ""}, "it would write outside its folder, to '../x'"),
        (part("a"), {"x": b"\0" * (5 << 20)}, "it unpacks to more than 0 GiB|unpacks to 0.0 GiB"),
    ],
)
def test_bad_packages(tmp_path, fmus, elements, files, message, monkeypatch):
    """One message each, that names the file; the last one unpacks to more than is allowed."""
    monkeypatch.setattr(archive, "MOST_BYTES", 4 << 20)
    file = packaged(tmp_path / "x.ssp", fmus, system(elements), **files)
    with pytest.raises(ConfigurationError, match=message) as raised:
        read_ssp(file)
    assert str(file) in str(raised.value)
    assert "terrafix-" not in str(raised.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('factor="3"', 'factor="1e400"', "factor of its LinearTransformation is '1e400', which is"),
        ('m="1"', 'm="x"', "BaseUnit of 'm': m is 'x', which is no number"),
        ('m="1"', 'm="1.5"', "BaseUnit of 'm': m is '1.5', which is no whole number"),
        ('factor="1"', 'factor="inf"', "BaseUnit of 'm': factor is 'inf', which is no number"),
    ],
)
def test_numbers_that_are_none(tmp_path, fmus, old, new, message):
    units = '<ssd:Units><ssc:Unit name="m"><ssc:BaseUnit m="1" factor="1"/></ssc:Unit></ssd:Units>'
    unit = '<ssd:Connector name="y" kind="output"><ssc:Real unit="m"/></ssd:Connector>'
    step = '<ssc:LinearTransformation factor="3"/>'
    shown = f"<ssd:Connectors>{unit}</ssd:Connectors>"
    top = system(part("a", inside=shown) + part("b"), link("a.y", "b.u", step)) + units
    file = packaged(tmp_path / "x.ssp", fmus, top.replace(old, new))
    with pytest.raises(ConfigurationError, match=message):
        read_ssp(file)
