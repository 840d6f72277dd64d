"""Contours of whole pixels, which a filter of moments does not survive: a negative control."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import terrafix as tf

FILE = Path(__file__).parents[2] / "benchmarks" / "integer_contours.py"


@pytest.fixture(scope="module")
def integer():
    spec = importlib.util.spec_from_file_location("integer_contours", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def final(result):
    nees = result.dataset["evaluation.nees"].values[-1].mean()
    error = np.linalg.norm(result.dataset["evaluation.position_error"].values[-1], axis=1)
    return np.median(error), nees


def test_whole_pixels_in_what_is_measured_make_the_filter_overconfident(integer, outline):
    """The noise that it is told is that of rounding, but every member and frame rounds alike."""
    system = integer.whole_pixels(
        "leo_lake.toml", "T2", both=False, settings=[("lakes.file", str(outline))]
    )
    error, nees = final(tf.simulate(system, members=8))
    assert nees > 6.0  # of three; by 0.001 chance of 8 members below 6
    assert error > 150.0


@pytest.mark.campaign
def test_whole_pixels_on_both_sides_lose_the_satellite(integer, outline):
    """A step of 0.1 km is a third of a pixel: differences see whole pixels or none. Kilometers."""
    system = integer.whole_pixels(
        "leo_lake.toml", "T1", both=True, settings=[("lakes.file", str(outline))]
    )
    error, nees = final(tf.simulate(system, members=6, duration="3"))
    assert error > 3e3
    assert nees > 1e3
