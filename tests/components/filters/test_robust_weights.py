"""Robust weights of a filter of one's own: its settings, its kernels, its errors under outliers."""

import casadi as ca
import numpy as np
import pytest

import terrafix as tf
from terrafix.components.filters.family import FilterCorrect
from terrafix.models.filters.consistency import gate_thresholds
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.robust import WEIGHTS
from terrafix.testing import drive

STATE = ErrorState(vector("r", 1, unit="m"))
BOTH = Observation(lambda x, _: ca.vertcat(x["r"], x["r"]), {"a": "m", "b": "m"})


class Correct(FilterCorrect):
    """Corrects it by two measurements of it."""

    default_rate = tf.Rate("1", offset="1")
    error_state, observation = STATE, BOTH


def test_settings_of_weights_that_were_not_chosen_are_idle():
    takes = {
        w: {n for n in ("huber_threshold", "nis_threshold") if c.takes(n)}
        for w, c in ((w, Correct(weights=w)) for w in ("none", "huber", "nis"))
    }
    assert takes == {"none": set(), "huber": {"huber_threshold"}, "nis": {"nis_threshold"}}
    with tf.System("idle", duration="2") as system:
        correct = system.add(Correct(huber_threshold=2.0), "correct")
    said = correct.idle("huber_threshold")
    assert "'correct' does not take 'huber_threshold' with" in said
    assert "weights = 'none': it would change nothing" in said


def test_the_nis_that_is_taken_as_it_is_is_that_of_99_of_100_sound_fixes():
    """Chi-square quantiles of 0.99 with 1 and 2 degrees of freedom, from any table."""
    assert Correct().setting("nis_threshold") == pytest.approx([6.6349, 9.2103], abs=5e-5)
    assert Correct().setting("huber_threshold") == 1.345
    assert Correct().setting("weights") == "none"


def test_weights_and_thresholds_are_read_as_any_setting():
    with pytest.raises(tf.ConfigurationError, match='it takes "none" or "huber" or "nis"'):
        Correct(weights="tukey")
    with pytest.raises(tf.ConfigurationError, match="must be positive"):
        Correct(huber_threshold=0.0)


@pytest.mark.parametrize("weights", WEIGHTS)
def test_a_fix_far_off_moves_the_estimate_by_what_the_definition_says(weights):
    """Prior of 0 +- 1 m, two elements of 1 m noise, both off by 30 m: S = [[2, 1], [1, 2]].

    Huber: R' = R z / k on both, z = 30 / sqrt(2); NIS = 600 = 900 * 2 / (1 + 2): scale from
    900 * 2 / (scale + 2) = 9.21. Then r = 60 / (R' + 2).
    """
    ones = {"y": [30.0, 30.0], "R": np.eye(2), "present": [1.0, 1.0]}
    prior = {"r": [0.0], "P": np.eye(1)}
    out = drive(Correct(weights=weights), {"fix": {1: ones}, "prior": prior})
    R = {
        "none": 1.0,
        "huber": 30 / np.sqrt(2) / 1.345,
        "nis": 1800 / gate_thresholds(0.99, 2)[1] - 2,
    }[weights]
    assert out["estimate"]["r"][-1].item() == pytest.approx(60 / (R + 2), rel=1e-12)
    assert out["estimate"]["P"][-1].item() == pytest.approx(R / (R + 2), rel=1e-12)
    assert out["innovation"]["nis"][-1].item() == pytest.approx(600.0, rel=1e-12)
    assert out["innovation"]["sigma"][-1].ravel() == pytest.approx(np.sqrt(2), rel=1e-12)


@pytest.mark.parametrize("weights", WEIGHTS[1:])
def test_a_threshold_of_infinity_is_off_in_kernels_too(weights):
    off = {"y": [30.0, -3.0], "R": np.eye(2), "present": [1.0, 1.0]}
    given = {"fix": {1: off}, "prior": {"r": [0.0], "P": np.eye(1)}}
    plain = drive(Correct(), given)
    robust = drive(Correct(weights=weights, huber_threshold=np.inf, nis_threshold=np.inf), given)
    assert not robust.failed
    for name in ("r", "P"):
        expected = plain["estimate"][name][-1].item()
        assert robust["estimate"][name][-1].item() == pytest.approx(expected, rel=1e-12)
