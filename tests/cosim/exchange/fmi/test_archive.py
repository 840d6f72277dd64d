"""Archives that are no FMU, damaged, or dangerous."""

from __future__ import annotations

import stat
import warnings
import zipfile

import pytest

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.run import archive
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.reading import read_interface

XML = '<?xml version="1.0"?>\n<fmiModelDescription fmiVersion="{}" modelName="m" guid="g"/>'


def zipped(path, **files):
    with zipfile.ZipFile(path, "w") as out:
        for name, text in files.items():
            out.writestr(name.replace("__", "/").replace("_xml", ".xml"), text)
    return path


def test_absent(tmp_path):
    with pytest.raises(ConfigurationError, match=r"cannot read '.*none.fmu': No such file"):
        open_archive(tmp_path / "none.fmu")


def test_a_folder(tmp_path):
    with pytest.raises(ConfigurationError, match=r"is a folder; name an .fmu file"):
        open_archive(tmp_path)


def test_no_zip(tmp_path):
    (tmp_path / "x.fmu").write_text("hello")
    with pytest.raises(ConfigurationError, match=r"is no FMU: file is not a zip file"):
        open_archive(tmp_path / "x.fmu")


def test_cut_short(spring, tmp_path):
    data = spring(3).read_bytes()
    (tmp_path / "x.fmu").write_bytes(data[: len(data) // 2])
    with pytest.raises(ConfigurationError, match=r"may have been cut short"):
        open_archive(tmp_path / "x.fmu")


def test_a_flipped_byte(spring, tmp_path):
    data = bytearray(spring(3).read_bytes())
    data[300] ^= 0xFF
    (tmp_path / "x.fmu").write_bytes(bytes(data))
    with pytest.raises(ConfigurationError):
        open_archive(tmp_path / "x.fmu")


def test_without_a_description(tmp_path):
    with pytest.raises(ConfigurationError, match=r"no modelDescription.xml at its top\n  zip the"):
        open_archive(zipped(tmp_path / "x.fmu", inner__modelDescription_xml="<a/>"))


@pytest.mark.parametrize(
    ("version", "said"),
    [
        ("1.1", "of FMI 1.1; terrafix reads 1.0, 2.0 and 3.0"),
        ("3.0-beta.3", "of FMI 3.0-beta.3, a draft of the standard; terrafix reads"),
        ("", "without a version"),
    ],
)
def test_other_versions(tmp_path, version, said):
    with pytest.raises(ConfigurationError, match=said):
        open_archive(zipped(tmp_path / "x.fmu", modelDescription_xml=XML.format(version)))


def test_damaged_xml(tmp_path):
    with pytest.raises(ConfigurationError, match=r"modelDescription.xml is damaged: .* line 1"):
        open_archive(zipped(tmp_path / "x.fmu", modelDescription_xml="<fmiModelDescription"))


def test_xml_that_is_no_description(tmp_path):
    with pytest.raises(ConfigurationError, match=r"understood: it lacks what FMI 2\.0 asks for"):
        open_archive(zipped(tmp_path / "x.fmu", modelDescription_xml=XML.format("2.0")))


def test_entities_are_not_read(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("do not tell")
    text = f'<!DOCTYPE a [<!ENTITY b SYSTEM "file://{secret}">]><a fmiVersion="2.0">&b;</a>'
    with pytest.raises(ConfigurationError, match=r"has a document type") as raised:
        open_archive(zipped(tmp_path / "x.fmu", modelDescription_xml=text))
    assert "do not tell" not in str(raised.value)


@pytest.mark.parametrize("name", ["../evil", "/tmp/evil", "a/../../evil", "..\\evil", "C:\\evil"])
def test_nothing_is_written_outside(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "x.fmu", "w") as out:
        out.writestr(zipfile.ZipInfo(name), "boo")
    with pytest.raises(ConfigurationError, match=r"would write outside its folder"):
        open_archive(tmp_path / "x.fmu")


def test_links_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.fmu", "w") as out:
        info = zipfile.ZipInfo("link")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        out.writestr(info, "/etc")
    with pytest.raises(ConfigurationError, match=r"'link' is a link"):
        open_archive(tmp_path / "x.fmu")


def test_size_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "MOST_BYTES", 1000)
    with pytest.raises(ConfigurationError, match=r"is not unpacked: it unpacks to"):
        open_archive(zipped(tmp_path / "x.fmu", modelDescription_xml="a" * 2000))


def test_many_files_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "MOST_FILES", 3)
    with pytest.raises(ConfigurationError, match=r"it holds 4 files"):
        open_archive(zipped(tmp_path / "x.fmu", a="", b="", c="", d=""))


# ------------------------------------------------------------------ by people who mean no good


def test_a_file_that_is_there_twice(tmp_path):
    """Of two descriptions, one reader shows the first and another runs the second."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, second, same in (("x", "1.0", False), ("y", "2.0", True)):
            with zipfile.ZipFile(tmp_path / name, "w") as out:
                out.writestr("modelDescription.xml", XML.format("2.0"))
                out.writestr("./modelDescription.xml", XML.format(second))
            said = "it lacks what FMI" if same else "holds 'modelDescription.xml' twice"
            with pytest.raises(ConfigurationError, match=said):
                open_archive(tmp_path / name)


def test_backslashes_of_windows_are_folders(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.fmu", "w") as out:
        for name in ("resources\\", "resources\\a.txt"):
            info = zipfile.ZipInfo("x")
            info.filename = name
            out.writestr(info, "a" if name.endswith("txt") else "")
    archive.unpack(tmp_path / "x.fmu", tmp_path / "here")
    assert (tmp_path / "here" / "resources" / "a.txt").read_text() == "a"


def test_more_than_the_archive_says_is_not_unpacked(tmp_path, monkeypatch):
    """Its directory says 10 bytes where 50,000 are."""
    file = zipped(tmp_path / "x.fmu", big="\0" * 50_000)
    data = file.read_bytes().replace((50_000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    file.write_bytes(data)
    with pytest.raises(ConfigurationError, match="bad CRC-32"):
        archive.unpack(file, tmp_path / "here")
    assert (tmp_path / "here" / "big").stat().st_size <= 10


@pytest.mark.parametrize(
    ("name", "said"),
    [("a\0b", "no modelDescription.xml at its top"), ("a" * 300, "File name too long")],
)
def test_names_that_no_file_has(tmp_path, name, said):
    with zipfile.ZipFile(tmp_path / "x.fmu", "w") as out:
        info = zipfile.ZipInfo("x")
        info.filename = name
        out.writestr(info, "a")
    with pytest.raises(ConfigurationError, match=said):
        open_archive(tmp_path / "x.fmu")


def described(path, fmi, variables):
    identity = 'guid="g"' if fmi == 2 else 'instantiationToken="g"'
    text = (
        f'<?xml version="1.0"?><fmiModelDescription fmiVersion="{fmi}.0" modelName="m" {identity}>'
        f'<CoSimulation modelIdentifier="m"/><ModelVariables>{variables}</ModelVariables>'
        "<ModelStructure/></fmiModelDescription>"
    )
    return zipped(path, modelDescription_xml=text)


@pytest.mark.parametrize(
    ("fmi", "variables", "said"),
    [
        (2, '<ScalarVariable name="y" valueReference="4294967297" causality="output"><Real/>'
            "</ScalarVariable>", "the valueReference of 'y' is 4294967297; FMI demands 0 to"),
        (2, '<ScalarVariable name="u" valueReference="1" causality="input"><Real start="abc"/>'
            "</ScalarVariable>", r"the FMU says that 'u' \(Real\) starts at 'abc'"),
        (2, "<a>" * 3000 + "</a>" * 3000, "cannot be understood: Excessive depth"),
        (3, '<Float64 name="y" valueReference="1" causality="output">'
            '<Dimension start="1000000000000"/></Float64>', "'y' is an array of 1000000000000;"),
        (3, '<Float64 name="y" valueReference="1" causality="output">'
            '<Dimension start="-5"/></Float64>', "'y' is an array of -5;"),
    ],
    ids=["reference", "start", "depth", "size", "negative"],
)  # fmt: skip
def test_descriptions_that_no_tool_writes(tmp_path, fmi, variables, said):
    """A reference of 33 bits would be read as another variable's."""
    with pytest.raises(ConfigurationError, match=said):
        read_interface(open_archive(described(tmp_path / "x.fmu", fmi, variables)))


def test_an_element_far_away_makes_no_array(tmp_path):
    both = "".join(
        f'<ScalarVariable name="y[{k}]" valueReference="{k}" causality="output"><Real/>'
        "</ScalarVariable>"
        for k in (1, 4_000_000_000)
    )
    found = read_interface(open_archive(described(tmp_path / "x.fmu", 2, both)))
    assert [p.name for p in found.ports] == ["y_1", "y_4000000000"]
