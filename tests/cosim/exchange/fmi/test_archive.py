"""Archives that are no FMU, damaged, or dangerous."""

from __future__ import annotations

import stat
import zipfile

import pytest

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.run import archive
from terrafix.cosim.exchange.fmi.run.archive import open_archive

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
