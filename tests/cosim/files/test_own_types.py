"""Component types of one's own, by module and class, without a package."""

import subprocess
import sys
import textwrap

import pytest

import terrafix as tf

MODULE = """
import terrafix as tf


class Walk(tf.Component):
    '''Walks at random.'''

    default_rate = tf.Rate("1")
    sigma = tf.Parameter(1.0, unit="m")
    x = tf.Output(unit="m")

    def _initialize_impl(self):
        self.x = 0.0

    def _step_impl(self, t, dt):
        self.x = self.x + self.sigma * self.normals("step", 1)[:, 0]


helper = 3
"""

SYSTEM = """
schema = "terrafix-system/1"
name = "walk"
duration = "5 s"
[component.walk]
type = "{kind}"
sigma = "2 m"
[record.x]
ports = ["walk.x"]
period = "1 s"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "own_walk.py").write_text(MODULE)
    yield tmp_path
    for name in ("own_walk", "own_broken"):
        sys.modules.pop(name, None)


def written(folder, kind="own_walk:Walk"):
    path = folder / "walk.toml"
    path.write_text(SYSTEM.format(kind=kind))
    return path


def test_a_module_beside_the_file_is_enough(folder):
    result = tf.simulate(tf.read_system(written(folder)), members=3)
    assert result.dataset["walk.x"].values[1:].std() > 0.5
    told = result.dataset.attrs["configuration"]
    assert "own_walk" in told


def test_it_is_written_as_it_was_read(folder):
    system = tf.read_system(written(folder))
    again = folder / "again.toml"
    tf.write_system(system, again)
    assert 'type = "own_walk:Walk"' in again.read_text()
    one, two = (tf.simulate(s, members=2) for s in (system, tf.read_system(again)))
    assert (one.dataset["walk.x"].values == two.dataset["walk.x"].values).all()


def test_the_command_line_takes_it_from_any_folder_and_in_several_processes(
    folder, tmp_path_factory
):
    judged = textwrap.dedent('''
        class Judge(tf.Evaluation):
            """Of nothing but a walk that should stay near zero."""

            default_rate = tf.Rate("1")
            quantities = (tf.Quantity("x", "m", ("x",)),)
            x = tf.Input(unit="m")
            x_error = tf.Output((1,), unit="m")
            x_sigma = tf.Output((1,), unit="m")

            def _step_impl(self, t, dt):
                self.x_error, self.x_sigma = self.x[:, None], 2.0 * t**0.5

            def _initialize_impl(self):
                self.x_error, self.x_sigma = 0.0, 1e-9
    ''')
    (folder / "own_walk.py").write_text(MODULE + judged)
    path = written(folder)
    text = path.read_text() + '[component.judge]\ntype = "own_walk:Judge"\n'
    path.write_text(text + '[wiring]\nconnect = ["walk.x -> judge.x"]\n')
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    for words in (["check", str(path)], ["campaign", str(path), "--runs", "130", "--workers", "2"]):
        ran = subprocess.run(
            [sys.executable, "-m", "terrafix", *words],
            cwd=elsewhere,
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr
    assert "130 runs" in ran.stdout


def test_the_listing_shows_it(folder):
    ran = subprocess.run(
        [sys.executable, "-m", "terrafix", "components", "own_walk:Walk"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "Walks at random." in ran.stdout
    assert "sigma" in ran.stdout


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("own_walk:Wlak", "'Wlak' is not there\n  did you mean 'Walk'?"),
        ("own_walk:helper", "'helper' is not a terrafix Component"),
        (
            "nowhere_at_all:Walk",
            "there is no module 'nowhere_at_all' beside the system's file, in '",
        ),
        ("own_broken:Walk", "SyntaxError"),
        ("own_walk.py:Walk", "write the module without .py"),
        ("own walk:Walk", "is neither a registered name nor MODULE:CLASS"),
        ("own_walk:", "is neither a registered name nor MODULE:CLASS"),
    ],
)
def test_what_cannot_be_had_is_said(folder, kind, said):
    (folder / "own_broken.py").write_text("class Walk(:\n")
    with pytest.raises(tf.SystemCheckError) as told:
        tf.read_system(written(folder, kind))
    assert said in str(told.value)


def test_another_module_of_that_name_is_not_taken_for_it(folder):
    """A file beside the system called as a module that is in use already."""
    (folder / "textwrap.py").write_text(MODULE)
    with pytest.raises(tf.SystemCheckError, match=r"module 'textwrap' was imported from .* before"):
        tf.read_system(written(folder, "textwrap:Walk"))
