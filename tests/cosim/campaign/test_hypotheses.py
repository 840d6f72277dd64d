"""Tests of hypotheses: at the edge of what is still right, a p-value is uniformly distributed.

That is what a p-value is; whatever is wrong with a factor or a number of degrees of freedom shows
with few members.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, f, kstest, norm, sem

from terrafix.cosim.campaign.statistics.consistency import Nis
from terrafix.cosim.campaign.statistics.ensemble import Statistics, block_of
from terrafix.cosim.campaign.statistics.moments import Moments
from terrafix.cosim.campaign.statistics.statistic import Layout
from terrafix.cosim.campaign.statistics.whiteness import Whiteness
from terrafix.cosim.campaign.verdict import judge

EDGE = 1.05
BIAS = np.sqrt(EDGE**2 - 1)  # root mean square five percent above sigma
ALL = np.inf  # a share of the level at which everything is found


def layout(n_axes=1, n_epochs=1, *, covariance=True):
    axes = tuple("xyz"[:n_axes])
    return Layout("e", (("q", "m", axes),), np.arange(float(n_epochs)), covariance, True, len(axes))


def history(error, P, z=None):
    """What an evaluation publishes, of errors (n_epochs, n_members, n_axes)."""
    n_epochs, n_members, _ = error.shape
    z = np.full((n_epochs, n_members, 1), np.nan) if z is None else z
    return {
        "q_error": error,
        "q_sigma": np.broadcast_to(np.sqrt(np.diag(P)), error.shape).copy(),
        "covariance": np.broadcast_to(P, (*error.shape[:2], *P.shape)).copy(),
        "nees": np.einsum("emi,ij,emj->em", error, np.linalg.inv(P), error),
        "nis": np.where(np.isnan(z).any(axis=2), np.nan, (z**2).sum(axis=2)),
        "nis_dof": np.where(np.isnan(z).any(axis=2), np.nan, float(z.shape[2])),
        "normalized_innovation": z,
    }


def found(kind, drawn, **options):
    """Findings of one statistic, by their words."""
    where = layout(drawn["q_error"].shape[2], len(drawn["q_error"]), **options)
    sums = block_of(where, drawn, first=0, kinds=(kind,))
    findings, _ = kind.judge(where, sums, ALL)
    return {finding.word + finding.text.split(" ")[0]: finding.p for finding in findings}


def uniform(p):
    """Whether p-values are spread evenly over 0 to 1: by Kolmogorov and Smirnov."""
    return kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(("d", "n"), [(1, 3), (3, 6)])
def test_a_bias_at_the_edge(d, n):
    """Of the edge's size in any direction, in predicted sigmas; S is not known but estimated."""
    rng = np.random.default_rng(d)
    L = np.linalg.cholesky(np.eye(d) + 0.5)
    P, direction = L @ L.T, L @ np.eye(d)[0]
    errors = rng.normal(size=(800, 1, n, d)) @ L.T + BIAS * direction
    assert uniform([found(Moments(), history(e, P))["biasedmean"] for e in errors])


def test_no_bias_is_hotellings_test(monkeypatch):
    """Without tolerance: T^2 (n - d) / (d (n - 1)) is F of d and n - d degrees of freedom."""
    module = "terrafix.cosim.campaign.statistics.moments.BIAS_TOLERANCE"
    monkeypatch.setattr(module, 1e-9)
    e = np.random.default_rng(4).normal(size=(1, 7, 3)) + 0.7
    mean, S = e[0].mean(axis=0), np.cov(e[0].T)
    T2 = 7 * mean @ np.linalg.inv(S) @ mean
    right = f.sf(T2 * (7 - 3) / (3 * (7 - 1)), 3, 7 - 3)
    assert found(Moments(), history(e, np.eye(3)))["biasedmean"] == pytest.approx(right, rel=1e-6)


@pytest.mark.parametrize(("word", "edge"), [("overconfident", EDGE), ("conservative", 0.95)])
@pytest.mark.parametrize(("d", "n"), [(1, 4), (3, 6)])
def test_a_spread_at_the_edge(word, edge, d, n):
    """Each of two sides is tested: p is twice that of one, and of each axis 2 d times."""
    rng = np.random.default_rng(10 * d)
    L = np.linalg.cholesky(np.eye(d) + 0.5)
    errors = edge * rng.normal(size=(800, 1, n, d)) @ L.T
    p = [found(Moments(), history(e, L @ L.T)) for e in errors]
    assert uniform([each[word + "spread"] / 2 for each in p])
    assert d > 1 or uniform([each[word + "sigma"] / 2 for each in p])


def test_nis_at_the_edge():
    rng = np.random.default_rng(5)
    z = EDGE * rng.normal(size=(800, 3, 5, 2))
    still = np.zeros((3, 5, 1))
    p = [found(Nis(), history(still, np.eye(1), each))["overconfidentNIS"] / 2 for each in z]
    assert uniform(p)


def test_a_correlation_at_the_edge():
    """Half of the time it is beyond the edge, and p then uniform: the test has two sides."""
    rng = np.random.default_rng(6)
    n, rho = 400, 0.05
    p = []
    for _ in range(1000):
        w = rng.normal(size=n + 1)
        z = np.empty(n + 1)
        z[0] = w[0]
        for k in range(n):
            z[k + 1] = rho * z[k] + np.sqrt(1 - rho**2) * w[k + 1]
        drawn = history(np.zeros((n + 1, 1, 1)), np.eye(1), z[:, None, None])
        p.append(found(Whiteness(), drawn)["correlated innovationselement"])
    p = np.array(p)
    assert abs((p < 1).mean() - 0.5) < 0.06
    assert uniform(p[p < 1])


def test_epochs_and_axes_share_the_level():
    """A finding among k equal ones is k times as likely by chance: Bonferroni."""
    e = np.random.default_rng(7).normal(size=(1, 9, 1)) + 1.0
    one, four = (found(Moments(), history(np.repeat(e, k, axis=0), np.eye(1))) for k in (1, 4))
    for word, p in one.items():
        assert four[word] == pytest.approx(4 * p)
    z = np.random.default_rng(8).normal(size=(50, 1, 1))
    one, three = (
        found(Whiteness(), history(np.zeros((50, 1, 1)), np.eye(1), np.repeat(z, k, axis=2)))
        for k in (1, 3)
    )
    assert [*three.values()] == [pytest.approx(3 * p) for p in one.values()]


def test_families_share_the_level_of_one_percent():
    """Five families: bias, spread, spread of an axis, NIS, whiteness."""
    n = 40
    unit = norm.ppf((np.arange(n) + 0.5) / n)[None, :, None]
    unit *= 1 / unit.std(ddof=1)

    def words(p, **level):
        """Verdict on errors whose spread of an axis has this p, times two sides."""
        ratio = chi2.isf(p / 2, n - 1) / (n - 1) * EDGE**2
        statistics = Statistics(layout())
        statistics.add(block_of(layout(), history(np.sqrt(ratio) * unit, np.eye(1)), first=0))
        return judge(statistics, **level).words

    assert words(0.0019) == ("overconfident",)
    assert words(0.0021) == ("consistent",)
    assert words(0.0021, level=0.02) == ("overconfident",)


def test_what_a_summary_says_of_an_axis():
    """Against SciPy's standard error and chi-square, with a member that has failed."""
    e = np.random.default_rng(11).normal(size=(1, 12, 1)) * 3 + 1
    e[0, 4] = np.nan
    statistics = Statistics(layout())
    statistics.add(block_of(layout(), history(e, 4 * np.eye(1)), first=0))
    q = statistics.summary()["q"]
    left = e[0, np.isfinite(e[0, :, 0]), 0]
    assert q["standard_error"] == [pytest.approx(sem(left))]
    assert statistics["standard_error"][0] == pytest.approx(sem(left))
    ratio = left.std(ddof=1) / 2
    assert q["ratio"] == [pytest.approx(ratio)]
    bounds = np.sqrt(10 / chi2.ppf([0.975, 0.025], 10)) * ratio
    assert q["ratio_interval_95"] == [pytest.approx(bounds.tolist())]


def test_two_members_more_than_axes_are_judged():
    for n, word in ((4, "undecided"), (5, "consistent")):
        e = np.random.default_rng(3).normal(size=(1, n, 3))
        statistics = Statistics(layout(3))
        statistics.add(block_of(layout(3), history(e, np.eye(3)), first=0))
        assert judge(statistics).words == (word,)


def test_epochs_with_too_few_members_are_not_tested():
    """Of 6, 5 and 4 members left, three axes need 5: bias, both sides of spread, of each axis."""
    e = np.random.default_rng(3).normal(size=(3, 6, 3))
    e[1, 5:], e[2, 4:] = np.nan, np.nan
    statistics = Statistics(layout(3, 3))
    statistics.add(block_of(layout(3, 3), history(e, np.eye(3)), first=0))
    assert judge(statistics).tests == 2 * (1 + 2 + 2 * 3)


def test_means_over_epochs_count_every_value_and_intervals_what_is_independent():
    """NEES of 2 and 8 members, of which the first epoch has no fix; NIS of both fixes of 8."""
    z = np.random.default_rng(12).normal(size=(3, 8, 2))
    e = np.random.default_rng(13).normal(size=(3, 8, 1))
    z[0], e[2, 2:], z[2, 2:] = np.nan, np.nan, np.nan
    drawn = history(e, np.eye(1), z)
    statistics = Statistics(layout(n_epochs=3))
    statistics.add(block_of(layout(n_epochs=3), drawn, first=0))
    summary = statistics.summary()
    nees = np.concatenate([drawn["nees"][1], drawn["nees"][2, :2]])
    assert summary["nees"]["mean"] == pytest.approx(nees.mean())
    bounds = chi2.ppf([0.025, 0.975], 8) / 8  # of one epoch: it is correlated with the others
    assert summary["nees"]["interval_95"] == pytest.approx(bounds.tolist())
    nis = drawn["nis"][np.isfinite(drawn["nis"])]
    assert summary["nis"]["mean"] == pytest.approx(nis.mean())
    bounds = chi2.ppf([0.025, 0.975], 2 * 10) / 10
    assert summary["nis"]["interval_95"] == pytest.approx(bounds.tolist())


def test_pairs_of_innovations_are_of_elements_measured_twice():
    """The second of two elements is missing every other time: it has no pair."""
    z = np.ones((6, 1, 2))
    z[1::2, :, 1] = np.nan
    statistics = Statistics(layout(n_epochs=6))
    statistics.add(
        block_of(layout(n_epochs=6), history(np.zeros((6, 1, 1)), np.eye(1), z), first=0)
    )
    assert statistics["innovation_pairs"].tolist() == [5, 0]
    assert statistics["innovation_correlation"][0] == 1.0


def test_a_bias_speaks_for_nis_too():
    """Innovations that are too large because of a mean error say nothing of the sigmas."""
    rng = np.random.default_rng(14)
    e = rng.normal(size=(1, 50, 1)) + 2.0
    z = rng.normal(size=(1, 50, 1)) * 3.0
    statistics = Statistics(layout())
    statistics.add(block_of(layout(), history(e, np.eye(1), z), first=0))
    assert judge(statistics).words == ("biased",)
    unbiased = Statistics(layout())
    unbiased.add(block_of(layout(), history(e - 2.0, np.eye(1), z), first=0))
    assert judge(unbiased).words == ("overconfident",)


def test_nis_of_innovations_that_are_alike_counts_as_that_of_one_time():
    """1.3 in place of 1, of 100 members at 50 times: of 5,000 degrees plain, of 100 by chance.

    chi2.sf(130 / 1.05^2, 100) = 0.11; of 5,000 below 1e-14.
    """
    from scipy.stats import chi2

    sums = {
        "nis_sum": np.full(50, 130.0),
        "nis_n": np.full(50, 100),
        "dof": np.full(50, 100.0),
        "nis_of_sum": np.array([6500.0]),
        "nis_of_n": np.array([5000]),
        "nis_of_dof": np.array([5000.0]),
    }
    white, alike = layout(n_epochs=50), replace(layout(n_epochs=50), white=False)
    found, _ = Nis().judge(white, sums, 0.01)
    assert [f.word for f in found] == ["overconfident"]
    assert found[0].p < 1e-14
    assert Nis().judge(alike, sums, 0.01)[0] == []
    found, tests = Nis().judge(alike, sums, ALL)
    p = next(f.p for f in found if f.word == "overconfident")
    assert p / tests == pytest.approx(chi2.sf(130 / 1.05**2, 100), rel=1e-9)
    interval = {
        k: Nis().summarize(lay, sums)["nis"]["interval_95"]
        for k, lay in (("white", white), ("alike", alike))
    }
    np.testing.assert_allclose(interval["white"], chi2.ppf([0.025, 0.975], 5000) / 5000, rtol=1e-9)
    np.testing.assert_allclose(interval["alike"], chi2.ppf([0.025, 0.975], 100) / 100, rtol=1e-9)
