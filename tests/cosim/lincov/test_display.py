"""What a person sees of a prediction, at any width."""

import re

import numpy as np
import pytest
from rich.console import Console

from terrafix.cosim.lincov.display import prediction_tables
from terrafix.cosim.lincov.prediction import MOST_AXES, LinearCovariance


def prediction(n_quantities=3, n_sources=4):
    labels = [f"{q} {a}" for q in ("position", "velocity", "misalignment") for a in "xyz"]
    labels += [f"more{i} x" for i in range(100)]
    labels = labels[: 3 * n_quantities]
    n = len(labels)
    sources = {
        f"antenna.misalignment_noise_{i} at the start": np.array([np.eye(n) / (i + 1)])
        for i in range(n_sources)
    }
    units = (["m"] * 3 + ["m/s"] * 3 + ["rad"] * n)[:n]
    return LinearCovariance(
        "evaluation", labels, units, np.array([9.0]), np.array([np.eye(n)]), sources
    )


def shown(found, width):
    console = Console(width=width, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(*prediction_tables("system", found), sep="\n")
    return capture.get()


@pytest.mark.parametrize("width", [40, 80, 100, 160])
def test_names_are_whole_at_any_width(width):
    """A source's name stands in a line of its own; a name longer than the line is folded."""
    found = prediction()
    text = shown(found, width)
    assert "…" not in text
    whole = re.sub(r"\s", "", text)
    for name in found.sources:
        assert name in text if width >= 80 else name.replace(" ", "") in whole
    for quantity in ("position", "velocity", "misalignment"):
        assert quantity in text
    assert max(map(len, text.splitlines())) <= width


def test_shares_are_under_their_axes_when_stacked():
    found = prediction(n_sources=2)
    found.sources["antenna.misalignment_noise_0 at the start"][0, 1, 1] = 0.0
    lines = shown(found, 60).splitlines()
    heads = next(line for line in lines if re.fullmatch(r"position +x +y +z *", line))
    at = lines.index("antenna.misalignment_noise_1 at the start".ljust(60))
    row = next(line for line in lines[at:] if line.startswith("position"))
    end = heads.index("y") + 1
    assert row[:end].endswith("100.0 %")
    assert row[: heads.index("x") + 1].endswith("33.3 %")


def test_small_sources_are_counted():
    found = prediction(n_sources=1)
    found.sources["speck"] = found.filter * 1e-6
    assert "speck" not in shown(found, 80)
    assert "and 1 smaller source\n" in re.sub(" +\n", "\n", shown(found, 80))


def test_a_prompt_gets_a_screen_at_most():
    found = prediction(n_quantities=10, n_sources=30)
    lines = repr(found).splitlines()
    assert len(lines) <= 24
    assert lines[0] == "linear covariance of 'evaluation' at t = 9 s"
    assert f"and {30 - MOST_AXES} more" in repr(found)
    assert re.search(r"position x +m +1\.443 +1\.000$", repr(prediction()), re.MULTILINE)
    assert re.search(
        r"antenna.misalignment_noise_0 at the start +48.0 % of position x", repr(prediction())
    )


def test_a_notebook_gets_tables_with_escaped_names():
    found = prediction()
    found.sources["a<b"] = found.filter
    assert found._repr_html_().count("<table>") == 2
    assert "a&lt;b" in found._repr_html_()


def test_without_errors_there_are_no_shares():
    """A filter that predicts nothing and an error of nothing: dashes, no warnings."""
    found = prediction(n_sources=1)
    for name in found.sources:
        found.sources[name] = 0.0 * found.filter
    found.filter[:] = 0.0
    assert "nan" not in shown(found, 80) + repr(found)
