"""Seeded mistakes in the satellite's example: each has one message and exit status 2."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from terrafix.cli import main
from terrafix.models.motion.gravity_field import SHIPPED

EXAMPLE = Path(__file__).parents[2] / "examples" / "satellite.toml"
EPOCH = '"2022-09-18T07:49:21 UTC"'
DEGREE = "degree = 20"
MISTAKES = {
    "a state with no frame": (
        ('"start.frame" = "gcrf"\n', ""),
        [],
        "'start' has a state without a frame, in a system with the epoch '2022-09-18T07:49:21 UTC'",
        "say which: frame = gcrf, j2000",
    ),
    "no epoch": (
        (f"epoch = {EPOCH}", ""),
        [],
        "'start' has a state in the frame 'gcrf', which says nothing about the Earth without a",
        'epoch = "2022',
    ),
    "an epoch outside the tables": (
        (EPOCH, '"2050-01-01T00:00:00 UTC"'),
        [],
        "leap seconds are announced until 20",
        "pip install -U astropy-iers-data",
    ),
    "one that needs no leap seconds": (
        (EPOCH, '"2050-01-01T00:00:00 TAI"'),
        [],
        "the table of the IERS reaches from 1973-01-02 to the start of 20",
        "pip install -U astropy-iers-data",
    ),
    "a run beyond the tables": (
        ("", ""),
        ["--duration", "300000 h"],
        "the table of the IERS reaches from 1973-01-02 to",
        "pip install -U astropy-iers-data",
    ),
    "no such day": (
        (EPOCH, '"2022-02-30T00:00:00 UTC"'),
        [],
        "the epoch '2022-02-30T00:00:00 UTC': there is no 2022-02-30",
        "",
    ),
    "a date of TOML": ((EPOCH, "2022-09-18T07:49:21Z"), [], "it takes text with date", "epoch ="),
    "no such leap second": (
        (EPOCH, '"2022-09-18T23:59:60 UTC"'),
        [],
        "the epoch '2022-09-18T23:59:60 UTC' does not exist: there was no leap second",
        "the nearest one was 2016-12-31T23:59:60 UTC",
    ),
    "old elements": (
        ("", ""),
        ["--set", "from=elements", "--epoch", "2022-09-28T00:00:00 UTC"],
        "of 2022-09-18T07:12:00 UTC, at the epoch 9.7 days old; it takes them up to 3 days",
        'start.tle_age = "10 day"',
    ),
    "damaged elements": (
        ("14.60000000    05", "14.60000000    06"),
        ["--set", "from=elements"],
        "line 2 of the two-line elements is damaged: its checksum is 6, that of what it holds is 5",
        "",
    ),
    "a density without an index": (("ap = 12\n", ""), [], "'air' needs a value for 'ap'", ""),
    "a maneuver outside the run": (
        (DEGREE, 'maneuvers = { up = { start = "601 s", delta_v = "[0, 1, 0] m/s" } }'),
        [],
        "maneuver 'up' of 'satellite' ends at 601 s, outside the run of 600 s",
        "--duration",
    ),
    "coefficients said to be of another normalization": (
        (DEGREE, 'gravity_file = "said.gfc"'),
        [],
        "said.gfc: coefficients of another normalization: its norm is 'unnormalized'",
        "multiply them by",
    ),
    "coefficients of another normalization": (
        (DEGREE, 'gravity_file = "silent.gfc"'),
        [],
        "silent.gfc: coefficients of another normalization: C20 is -0.00108264, which is the Earth",
        "multiply them by",
    ),
    "surroundings of nothing": (
        ('    "environment.surroundings -> satellite.surroundings",\n', ""),
        [],
        "input 'satellite.surroundings' is not connected",
        "'environment.surroundings'",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_said_once(name, tmp_path):
    (old, new), words, said, then = MISTAKES[name]
    field = SHIPPED.read_text()
    (tmp_path / "said.gfc").write_text(field.replace("fully_normalized", "unnormalized"))
    changed = field.replace("-0.484165143790815e-03", "-0.108263617e-02")
    (tmp_path / "silent.gfc").write_text(changed)
    text = EXAMPLE.read_text()
    assert old in text
    (tmp_path / "s.toml").write_text(text.replace(old, new, 1) if old else text)
    done = CliRunner().invoke(main, ["run", str(tmp_path / "s.toml"), *words])
    assert done.exit_code == 2, done.output
    assert "has 1 problem\n" in done.output
    assert said in done.output
    assert then in done.output
    assert not re.search(r"Traceback|Error:.*Error:|datetime|None\b", done.output)


TRACKER = """
schema = "terrafix-system/1"
duration = "1 s"
[component.orbit]
type = "satellite"
start_from = "parameters"
r0_e = "[7070, 0, 0] km"
v0_e = "[0, 0, 7.5] km/s"
[component.attitude]
type = "lvlh_attitude"
[component.star]
type = "star_tracker"
[wiring]
connect = [
    "orbit.r_e -> attitude.r_e",
    "orbit.v_e -> attitude.v_e",
    "orbit.delta_v_e -> attitude.delta_v_e",
    "orbit.r_e -> star.r_e",
    "attitude.q_be -> star.q_be",
]
"""


def test_a_star_tracker_says_what_it_lacks(tmp_path):
    """First an environment, then an epoch."""
    path = tmp_path / "s.toml"
    path.write_text(TRACKER)
    bare = CliRunner().invoke(main, ["run", str(path)])
    path.write_text(
        TRACKER.replace("connect = [", 'connect = ["sky.surroundings -> star.surroundings",')
        + '[component.sky]\ntype = "environment"\n'
    )
    undated = CliRunner().invoke(main, ["run", str(path)])
    assert (bare.exit_code, undated.exit_code) == (2, 2)
    assert "input 'star.surroundings' is not connected" in bare.output
    assert "it takes inertial axes, Sun and Moon of an environment" in bare.output
    assert "'sky' needs to know what time it is, and the system has no epoch" in undated.output


ABSENT = (
    "import sys; sys.modules.update(dict.fromkeys({names})); from terrafix.cli import main; main()"
)


@pytest.mark.parametrize(
    ("names", "what"),
    [
        (["erfa", "astropy_iers_data", "pymsis", "sgp4"], "an epoch needs the package 'astropy"),
        (["pymsis"], "'air': a density by MSIS needs the package 'pymsis'"),
    ],
)
def test_without_the_extra_it_says_what_to_install(names, what):
    done = subprocess.run(
        [sys.executable, "-c", ABSENT.format(names=names), "run", str(EXAMPLE)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "has 1 problem\n" in done.stderr
    assert what in done.stderr
    assert "pip install 'terrafix[truth]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_the_extra_what_needs_none_flies():
    """The orbit of no date, and the satellite with its field and pole."""
    code = ABSENT.format(names=["erfa", "astropy_iers_data", "pymsis", "sgp4"])
    orbit = [str(EXAMPLE.with_name("orbit.toml")), "--duration", "10 s"]
    done = subprocess.run(
        [sys.executable, "-c", code, "run", *orbit], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
