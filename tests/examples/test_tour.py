"""The notebook runs from its first cell to its last, and its pictures are there."""

import base64
import sys
from pathlib import Path

import nbformat
import pytest
from ipykernel.kernelspec import write_kernel_spec
from nbclient import NotebookClient

TOUR = Path(__file__).parents[2] / "examples" / "tour.ipynb"
KERNEL = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """What the notebook shows, by the last line of each cell; its kernel is this very Python."""
    folder = tmp_path_factory.mktemp("jupyter")
    write_kernel_spec(folder / "kernels" / "python3", overrides={"argv": KERNEL})
    with pytest.MonkeyPatch.context() as patch:
        for name in ("JUPYTER_PATH", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
            patch.setenv(name, str(folder))
        notebook = nbformat.read(TOUR, as_version=4)
        about = {"metadata": {"path": str(TOUR.parent)}}
        NotebookClient(notebook, timeout=300, kernel_name="python3", resources=about).execute()
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    return {cell.source.splitlines()[-1]: cell.outputs[-1] for cell in code}


@pytest.mark.parametrize("line", ["result.plot()", "tf.simulate(own).plot()"])
def test_results_are_pictures(shown, line):
    picture = base64.b64decode(shown[line].data["image/png"])
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 10_000


def test_the_graph_is_a_picture(shown):
    found = shown["system.graph()"].data
    assert "<svg" in found["image/svg+xml"]
    assert found["text/plain"].startswith("flowchart LR")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("result", "20 members"),
        ("system", "10 components, 24 connections"),
        ("own", "missing: a connection to 'altimeter.r_e'"),
        ("system.check()", "10 components in stepping order"),
        ('system["imu"]', "velocity_random_walk"),
        ('Altimeter(sigma="25 m")', "25 m"),
    ],
)
def test_tables_are_shown(shown, line, words):
    assert "<table" in shown[line].data["text/html"]
    assert words in shown[line].data["text/plain"]


def test_help_lists_parameters_and_ports(shown):
    text = shown["help(tf.components.lvlh_attitude)"].text
    assert "Parameters" in text
    assert "q_be : array (4,), frame b" in text


@pytest.mark.parametrize("line", ["campaign", 'tf.linear_covariance(system, duration="30 s")'])
def test_campaigns_and_predictions_are_shown(shown, line):
    assert shown[line].data["text/plain"]


def test_the_notebook_is_kept_without_what_it_shows():
    """Pictures are made anew: none that is out of date, no machine's times."""
    code = [c for c in nbformat.read(TOUR, as_version=4).cells if c.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
