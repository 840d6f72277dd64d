"""Streamed statistics against NumPy on everything at once; verdicts against what was done."""

import numpy as np
import pytest
from campaign_parts import scalar_system
from scipy.stats import chi2

from terrafix.cosim.campaign.batch import Task, fly_batch
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.campaign.statistics.ensemble import Statistics, block_of
from terrafix.cosim.campaign.statistics.moments import ratio_interval
from terrafix.cosim.campaign.statistics.statistic import BLOCK, Layout
from terrafix.cosim.campaign.verdict import judge


def layout(n_axes=3, n_epochs=5):
    axes = tuple("abc"[:n_axes])
    return Layout("e", (("q", "m", axes),), np.arange(float(n_epochs)), True, True, len(axes))


def random_history(rng, n_members, n_axes=3, n_epochs=5):
    L = rng.normal(size=(n_axes, n_axes))
    P = L @ L.T + n_axes * np.eye(n_axes)
    error = rng.normal(size=(n_epochs, n_members, n_axes)) @ np.linalg.cholesky(P).T
    error[2:, 1] = np.nan  # a member that fails
    sigma = np.broadcast_to(np.sqrt(np.diag(P)), error.shape).copy()
    z = rng.normal(size=(n_epochs, n_members, 2))
    z[0] = np.nan
    return {
        "q_error": error,
        "q_sigma": sigma,
        "covariance": np.broadcast_to(P, (n_epochs, n_members, n_axes, n_axes)),
        "nees": np.einsum("emi,ij,emj->em", error, np.linalg.inv(P), error),
        "nis": np.where(np.isnan(z).any(axis=2), np.nan, (z**2).sum(axis=2)),
        "nis_dof": np.full((n_epochs, n_members), 2.0),
        "normalized_innovation": z,
    }


def streamed(history, n_members):
    statistics = Statistics(layout())
    for start in range(0, n_members, BLOCK):
        part = {k: v[:, start : start + BLOCK] for k, v in history.items()}
        statistics.add(block_of(layout(), part, first=start))
    return statistics


@pytest.mark.parametrize("n_members", [2, 64, 65, 300])
def test_blocks_add_up_to_the_whole(n_members):
    history = random_history(np.random.default_rng(n_members), n_members)
    statistics = streamed(history, n_members)
    error = history["q_error"]
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(statistics["mean_error"], np.nanmean(error, axis=1), atol=1e-13)
    for epoch in range(5):
        valid = error[epoch][np.isfinite(error[epoch]).all(axis=1)]
        assert statistics.n[epoch] == len(valid)
        if len(valid) > 1:
            np.testing.assert_allclose(
                statistics["covariance_sample"][epoch], np.cov(valid.T), rtol=1e-12
            )
    np.testing.assert_allclose(
        statistics["covariance_predicted"][0], history["covariance"][0, 0], rtol=1e-12
    )
    np.testing.assert_allclose(statistics["nees"], np.nanmean(history["nees"], axis=1))
    assert np.isnan(statistics["nis"][0])
    np.testing.assert_allclose(statistics["nis"][1:], np.nanmean(history["nis"][1:], axis=1))


def test_quantiles_are_within_a_bin():
    history = random_history(np.random.default_rng(1), 2000)
    quantiles = streamed(history, 2000)["normalized_error_quantiles"]
    z = (history["q_error"] / history["q_sigma"])[0]
    np.testing.assert_allclose(
        quantiles[:, 0], np.quantile(z, [0.025, 0.16, 0.5, 0.84, 0.975], axis=0), atol=0.06
    )


def test_successive_innovations_are_correlated_where_they_are():
    rng = np.random.default_rng(2)
    history = random_history(rng, 200)
    statistics = streamed(history, 200)
    white, pairs = statistics["innovation_correlation"], statistics["innovation_pairs"]
    assert (np.abs(white) < 4 / np.sqrt(pairs)).all()
    z = history["normalized_innovation"]
    z[2:] = 0.6 * z[1:-1] + 0.8 * z[2:]
    assert (streamed(history, 200)["innovation_correlation"] > 0.3).all()


def test_intervals_of_sigma_ratios_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(3)
    n, trials = 40, 4000
    ratio = rng.normal(size=(trials, n)).std(axis=1, ddof=1)
    low, high = ratio_interval(n)
    inside = np.mean((low * ratio <= 1) & (high * ratio >= 1))
    assert abs(inside - 0.95) < 4 * np.sqrt(0.95 * 0.05 / trials)
    assert high == pytest.approx(np.sqrt((n - 1) / chi2.ppf(0.025, n - 1)))


VERDICTS = [
    ("consistent", {}),
    ("conservative", {"tuning": 4.0}),
    ("overconfident", {"tuning": 0.25}),
    ("biased", {"bias": 1.0}),
]


@pytest.mark.parametrize(("word", "settings"), VERDICTS)
def test_filters_are_called_by_their_names(word, settings):
    found = [
        run_campaign(scalar_system(**settings), runs=100, seed=seed, workers=1).verdicts["judge"]
        for seed in range(8)
    ]
    named = [word in verdict.words for verdict in found]
    assert all(named), [v.text for v in found]
    assert word == "consistent" or all(v.findings for v in found)


def test_few_members_are_not_judged():
    result = run_campaign(scalar_system(), runs=2, workers=1)
    assert result.verdicts["judge"].words == ("undecided",)
    assert "fly 3 or more" in result.verdicts["judge"].findings[0].text


def test_sums_do_not_depend_on_how_members_were_grouped():
    from fractions import Fraction

    task = Task(scalar_system(wall=4.0), 200, 5, Fraction(20))
    whole = fly_batch(task, 0, 200)
    parts = [b for first in (0, 64, 128, 192) for b in fly_batch(task, first, min(first + 64, 200))]
    assert [b.number for b in whole] == [b.number for b in parts] == [0, 1, 2, 3]
    for ours, theirs in zip(whole, parts, strict=True):
        assert ours.excluded == theirs.excluded
        for name, values in ours.sums["judge"].items():
            assert values.tobytes() == theirs.sums["judge"][name].tobytes(), name
    assert sum(len(b.excluded) for b in whole) > 5


def test_judging_takes_any_statistics():
    verdict = judge(streamed(random_history(np.random.default_rng(9), 128), 128))
    assert verdict.words == ("consistent",)
    assert verdict.summary()["tests"] == verdict.tests > 10
