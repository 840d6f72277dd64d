"""The public face: what stays stable, quick to import, and complete for editors."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import terrafix as tf
from terrafix.cosim.declare.registry import component_entries

FACE = [
    *("BundleInput", "BundleOutput", "CampaignError", "CampaignResult", "Capabilities"),
    *("CheckpointError", "Choice", "Component", "ConfigurationError", "Count", "Dispersion"),
    *("EpochError", "Evaluation", "Field", "FilePath", "FileTable", "Flag", "Input"),
    *("LinearCovariance",),
    *("MessageInput", "MessageOutput", "Model", "OptionalFilePath", "Output", "Parameter"),
    *("Quantity", "Rate", "RateError", "Result", "RunError", "STATISTICS", "SharedInput"),
    *(
        "SharedOutput",
        "Simulation",
        "SmoothedRun",
        "State",
        "Statistic",
        "StepError",
        "SymbolicComponent",
        "System",
        "SystemCheckError",
    ),
    *("Table", "TerrafixError", "Text", "WindowInput", "WiringError", "__version__"),
    *("check_fmu", "components", "export_fmu", "filters", "linear_covariance", "read_result"),
    *("read_system", "run_campaign", "simulate", "smooth_run", "testing", "write_system"),
]


def test_the_face_is_what_it_was():
    """A name that goes, or comes, is a decision: users build on these."""
    assert tf.__all__ == FACE
    assert dir(tf) == FACE


FILTERS = [
    *("ALARMS", "Block", "Carried", "EnsembleCorrect", "EnsembleObservation", "ErrorState"),
    *("FilterAcquisition", "FilterCorrect", "FilterEvaluation", "FilterMonitor", "FilterPredict"),
    *("FilterSensor", "FilterTruth", "Observation", "Process", "clone", "considered"),
    *("ensemble_observation", "rotation", "vector"),
]


def test_what_filters_are_made_of_is_what_it_was():
    assert tf.filters.__all__ == FILTERS
    assert all(getattr(tf.filters, name).__doc__ for name in FILTERS)


@pytest.mark.parametrize("name", FACE)
def test_every_name_is_there(name):
    found = getattr(tf, name)
    assert getattr(found, "__doc__", None)


def test_editors_see_the_same_names():
    """The imports for type checkers and the table of the running program agree."""
    tree = ast.parse(Path(tf.__file__).read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {a.asname for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names}
    assert sorted({*seen, "__version__"}) == FACE


def test_a_wrong_name_is_answered():
    with pytest.raises(AttributeError, match="terrafix has no 'Sytem'\n  did you mean 'System'"):
        tf.Sytem  # noqa: B018
    with pytest.raises(AttributeError, match="has no 'orbti'\n  did you mean 'orbit'"):
        tf.components.orbti  # noqa: B018


def test_components_go_by_the_names_of_system_files():
    assert dir(tf.components) == sorted(component_entries())
    for name in component_entries():
        assert issubclass(getattr(tf.components, name), tf.Component)
    assert tf.components.orbit.__name__ == "OrbitTruth"


def test_importing_the_face_brings_nothing_at_all():
    """It costs milliseconds: no package of anybody's is loaded before a name is used."""
    code = "import sys; a = set(sys.modules); import terrafix; print(*(set(sys.modules) - a))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(
        m.split(".")[0] in (*sys.stdlib_module_names, "terrafix") for m in done.stdout.split()
    )
