"""Longer ensembles, by `make campaigns`: bounds that 100 members are too few for."""

from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system

SYSTEM = Path(__file__).parents[2] / "examples" / "spacecraft_sar_open_loop.toml"


@pytest.mark.campaign
@pytest.mark.parametrize("seed", [1, 2])
def test_tc2_with_matched_truth_over_300_members(seed: int):
    """Sample sigma has an error of 4.1 % at 300; the mean of NEES one of 0.24."""
    system = read_system(SYSTEM, [("case", "TC-2"), ("config", "B")])
    result = simulate(system, members=300, seed=seed)
    for quantity in ("position", "velocity"):
        figures = result.evaluation[quantity]
        ratio = np.divide(figures["sigma_sample"], figures["sigma_predicted"])
        assert np.all(np.abs(ratio - 1) < 4 * 0.041), (quantity, ratio)
    # NEES is correlated from epoch to epoch: its time mean has the bounds of a single epoch
    low, high = chi_square_interval(9, 300, probability=0.999)
    assert low < result.evaluation["nees"]["mean"] < high
    # white innovations: 300 x 72 values, three standard errors of their mean
    assert result.evaluation["nis"]["mean"] == pytest.approx(4.0, abs=3 * np.sqrt(8 / (300 * 72)))
