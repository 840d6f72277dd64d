"""Linear covariance against the Kalman filter in closed form, and against sampled campaigns."""

from pathlib import Path

import numpy as np
import pytest
from campaign_parts import scalar_system

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.lincov.deviations import LinearCovariance, linear_covariance
from terrafix.cosim.system.dispersion import Dispersion

OPEN_LOOP = Path(__file__).parents[3] / "examples" / "spacecraft_sar_open_loop.toml"


def kalman(n, walk=0.5, noise=1.0, sigma0=2.0, tuning=1.0):
    """Variance of the error, by source, of a filter whose measurement variance may be wrong."""
    P = sigma0**2
    true = {"start": sigma0**2, "walk": 0.0, "noise": 0.0}
    for _ in range(n):
        prior = P + walk**2
        K = prior / (prior + tuning * noise**2)
        P = (1 - K) * prior
        true["walk"] += walk**2
        true = {k: (1 - K) ** 2 * v for k, v in true.items()}
        true["noise"] += K**2 * noise**2
    return P, true


@pytest.mark.parametrize("tuning", [1.0, 0.25, 4.0])
def test_a_scalar_filter_is_predicted_exactly(tuning):
    """Also where the filter's model is not the truth's."""
    found = linear_covariance(scalar_system(tuning=tuning))
    P, true = kalman(20, tuning=tuning)
    assert found.filter[-1, 0, 0] == pytest.approx(P, rel=1e-12)
    assert found.total[-1, 0, 0] == pytest.approx(sum(true.values()), rel=1e-12)
    budget = found.budget()
    assert budget["filter.w at the start"][0] ** 2 == pytest.approx(true["start"], rel=1e-9)
    assert budget["filter.w"][0] ** 2 == pytest.approx(true["walk"], rel=1e-12)
    assert budget["filter.v"][0] ** 2 == pytest.approx(true["noise"], rel=1e-12)


def test_dispersions_are_sources():
    """An unknown bias of sigma 0.3 m in every measurement."""
    system = scalar_system()
    system.disperse(Dispersion("bias", ("filter.bias",), 0.3))
    found = linear_covariance(system)
    sampled = run_campaign(system, runs=4000, workers=1).statistics["judge"]
    assert found.sigma[-1, 0] == pytest.approx(
        np.sqrt(sampled.covariance_sample[-1, 0, 0]), rel=4 / np.sqrt(8000)
    )
    assert found.budget()["dispersion bias"][0] == pytest.approx(0.3, rel=1e-3)


def test_a_prediction_survives_being_stored():
    found = linear_covariance(scalar_system())
    again = LinearCovariance.of_dataset(found.dataset())
    assert again.total.tobytes() == found.total.tobytes()
    assert again.labels == found.labels
    assert list(again.sources) == list(found.sources)


def test_what_cannot_be_linearized_is_named():
    with pytest.raises(ConfigurationError, match=r"'wire' \(Tripwire\) has no symbolic Jacobian"):
        linear_covariance(scalar_system(tripwire=1))


@pytest.fixture(scope="module")
def open_loop():
    return linear_covariance(read_system(OPEN_LOOP, [("case", "TC-2")]), duration="123")


def test_the_open_loop_is_predicted(open_loop):
    """A matched filter: what it predicts is what its errors are, but for eight ticks' turn."""
    np.testing.assert_allclose(open_loop.sigma, open_loop.sigma_filter, rtol=2e-3)


def test_the_misalignment_about_the_boresight_is_not_observed(open_loop):
    first = open_loop.unobserved()[0]
    assert open_loop.labels[int(np.abs(first.components).argmax())] == "misalignment z"
    assert abs(first.components).max() > 0.999
    assert first.remaining == pytest.approx(1.0, abs=1e-6)


def test_the_open_loop_as_sampled(open_loop):
    """256 members: a sigma's standard error is 4.4 %; four of them for 9 axes at one epoch."""
    from terrafix.cosim.campaign.batch import FileSource

    source = FileSource(str(OPEN_LOOP), (("case", "TC-2"),))
    s = run_campaign(source, runs=256, duration="123", workers=1).statistics["evaluation"]
    sample = np.sqrt(np.diagonal(s.covariance_sample[-1]))
    predicted = np.sqrt(np.diagonal(s.covariance_predicted[-1]))
    np.testing.assert_allclose(sample, open_loop.sigma[-1], rtol=4 / np.sqrt(512))
    np.testing.assert_allclose(predicted, open_loop.sigma_filter[-1], rtol=5e-3)
