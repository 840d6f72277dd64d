"""A file is read as its suffix says; a package adds a format as ours do."""

import sys
import textwrap
from pathlib import Path

import pytest

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.files.writing import system_text

TOML = (Path(__file__).parents[3] / "examples" / "orbit.toml").read_text()


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a package of one module that registers readers, as pip would."""
    monkeypatch.syspath_prepend(tmp_path)

    def add(package, entries, code=""):
        (tmp_path / f"{package}.py").write_text(textwrap.dedent(code))
        about = tmp_path / f"{package}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = "".join(f"{suffix} = {value}\n" for suffix, value in entries.items())
        (about / "entry_points.txt").write_text(f"[terrafix.readers]\n{lines}")

    return add


def refusal(path, *arguments):
    with pytest.raises(ConfigurationError) as caught:
        read_system(path, *arguments)
    return str(caught.value)


@pytest.mark.parametrize("name", ["coast.toml", "coast.TOML"])
def test_the_suffix_chooses_the_reader(tmp_path, name):
    (tmp_path / name).write_text(TOML)
    assert read_system(str(tmp_path / name), [("duration", "5")]).duration == 5


def test_a_package_adds_a_format(tmp_path, install):
    install(
        "plain_reader",
        {"plain": "plain_reader:read"},
        """
        from terrafix.cosim.system.system import System

        def read(path, settings, *, outside):
            system = System(path.read_text().strip(), duration="1")
            system.doc = f"{settings} {outside}"
            return system
        """,
    )
    (tmp_path / "coast.plain").write_text("coast\n")
    system = read_system(tmp_path / "coast.plain", [("a", "b")], outside=True)
    assert (system.name, system.doc) == ("coast", "[('a', 'b')] True")
    assert ".plain, .ssd, .ssp, .toml" in refusal(tmp_path / "coast.xyz")


def test_an_unknown_suffix_lists_those_that_are_read(tmp_path):
    assert refusal(tmp_path / "coast.yaml") == (
        f"cannot tell how to read system file '{tmp_path}/coast.yaml': no reader takes .yaml files"
        "\n  suffixes of system files: .ssd, .ssp, .toml"
    )
    (tmp_path / "coast.toml").write_text(TOML)
    assert refusal(tmp_path / "coast.tml").endswith(".ssd, .ssp, .toml; did you mean 'coast.toml'?")


def test_an_fmu_is_no_system_and_what_to_do_with_it_is_said(tmp_path):
    assert refusal(tmp_path / "orbit.fmu") == (
        f"'{tmp_path}/orbit.fmu' is an FMU, which runs as a component of a system\n"
        '  [component.NAME] with type = "fmu" and file = "orbit.fmu" in a .toml file; '
        f"terrafix check-fmu {tmp_path}/orbit.fmu checks it alone"
    )


def test_a_name_without_suffix_is_refused_and_the_file_that_was_meant_named(tmp_path):
    said = (
        f"cannot tell how to read system file '{tmp_path}/coast': its name has no suffix\n"
        "  suffixes of system files: .ssd, .ssp, .toml"
    )
    assert refusal(tmp_path / "coast") == said
    (tmp_path / "coast.toml").write_text(TOML)
    assert refusal(tmp_path / "coast") == f"{said}; did you mean 'coast.toml'?"


def test_a_suffix_of_two_packages_is_refused_with_both_names(tmp_path, install):
    install("one", {"xy": "one:read"})
    install("two", {"XY": "two:read"})
    assert refusal(tmp_path / "coast.xy") == (
        f"cannot tell how to read '{tmp_path}/coast.xy': several packages read .xy files\n"
        "  one (one:read), two (two:read): uninstall all but one"
    )


def test_nobody_takes_our_suffixes_over_in_silence(tmp_path, install):
    (tmp_path / "coast.toml").write_text(TOML)
    install("other", {"toml": "other:read"})
    assert "other (other:read), terrafix (terrafix.cosim.files" in refusal(tmp_path / "coast.toml")


@pytest.mark.parametrize(
    ("value", "code", "message"),
    [
        ("gone:read", "", "(gone:read) cannot be imported\n  ModuleNotFoundError: No module named"),
        ("bad:read", "1 / 0", "(bad:read) cannot be imported\n  ZeroDivisionError: division"),
        ("bad:read", "", "(bad:read) cannot be imported\n  AttributeError: module 'bad' has no"),
        ("bad:read", "read = 3", "(bad:read) is int, not a function"),
        ("bad:read", "def read(*_, **__): ...", "(bad:read) returned NoneType for '"),
    ],
)
def test_a_reader_that_does_not_serve_is_named(
    tmp_path, install, monkeypatch, value, code, message
):
    monkeypatch.delitem(sys.modules, "bad", raising=False)
    install("bad", {"xy": value}, code)
    assert f"the reader of .xy files {message}" in refusal(tmp_path / "coast.xy")


def test_settings_do_not_reach_into_a_package(tmp_path):
    assert refusal(tmp_path / "coast.ssp", [("duration", "5")]) == (
        f"--set duration does not reach into '{tmp_path}/coast.ssp', of which step sizes alone can "
        "be set\n"
        "  terrafix ssp import writes it as a system file, where everything can be set"
    )
    assert refusal(tmp_path / "coast.ssp") == f"there is no SSP package '{tmp_path}/coast.ssp'"


@pytest.mark.parametrize(
    ("mark", "end"), [(b"\xef\xbb\xbf", b"\r\n"), (b"", b"\r\n"), (b"", b"\n")]
)
def test_a_file_of_an_editor_of_windows_is_read(tmp_path, mark, end):
    file, plain = tmp_path / "orbit.toml", tmp_path / "plain.toml"
    file.write_bytes(mark + TOML.encode().replace(b"\n", end))
    plain.write_text(TOML)
    assert system_text(read_system(file)) == system_text(read_system(plain))
