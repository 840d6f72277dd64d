"""Members whose shared values are their own: each is flown alone, and is as it is anywhere."""

import numpy as np
import pytest
import xarray as xr
from campaign_parts import Lonely, scalar_system

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.campaign import campaign as module
from terrafix.cosim.campaign.campaign import CampaignError, run_campaign
from terrafix.cosim.engine.run import simulate

RUNS = 3


def lonely():
    """The scalar filter, and a component that shares the truth of one member."""
    system = scalar_system()
    system.add(Lonely(), "lonely")
    system.connect("filter.truth", "lonely.truth")
    return system


def fly(**options):
    return run_campaign(lonely(), runs=RUNS, **{"workers": 1, **options})


@pytest.fixture(scope="module")
def flown():
    return fly().dataset()


def test_members_are_those_that_fly_together(flown):
    """Without what is shared there is no reason to fly alone; sums round in another order."""
    together = run_campaign(scalar_system(), runs=RUNS, workers=1).dataset()
    assert flown.sizes["member"] == RUNS
    np.testing.assert_array_equal(flown["error"], together["error"])
    for name in ("mean_error", "covariance_sample", "covariance_predicted"):
        np.testing.assert_allclose(flown[name], together[name], rtol=1e-12, atol=1e-14)


def test_a_member_is_the_one_of_a_run_by_its_number(flown):
    alone = simulate(lonely(), members=[2], runs=RUNS).dataset
    np.testing.assert_array_equal(alone["judge.x_error"][:, 0], flown["error"][:, 2])


def test_processes_share_the_members(flown, tmp_path):
    """A member a batch; full records are a file for each."""
    result = fly(workers=2, out=tmp_path / "c", histories=True)
    assert result.workers == "2 processes"
    np.testing.assert_array_equal(result.dataset()["mean_error"], flown["mean_error"])
    files = sorted((tmp_path / "c" / "histories").iterdir())
    assert [int(xr.load_dataset(f)["member"].item()) for f in files] == list(range(RUNS))


def test_an_interrupted_campaign_keeps_its_members(flown, tmp_path, monkeypatch):
    real = module.pools.in_this_process

    def interrupted(task, batches, *, threads):
        for number, blocks in enumerate(real(task, batches, threads=threads)):
            if number == 2:
                raise KeyboardInterrupt
            yield blocks

    with monkeypatch.context() as patch:
        patch.setattr(module.pools, "in_this_process", interrupted)
        with pytest.raises(CampaignError, match=r"2 of 3 members are done, and kept in"):
            fly(out=tmp_path / "c")
    result = fly(out=tmp_path / "c", resume=True)
    np.testing.assert_array_equal(result.dataset()["mean_error"], flown["mean_error"])


def test_several_together_are_refused_before_anything_is_flown():
    said = r"what 'lonely' shares is of one member, as it is set, and 2 are to be flown together"
    with pytest.raises(ConfigurationError, match=said) as caught:
        simulate(lonely(), members=2)
    assert "terrafix campaign --runs N" in str(caught.value)
    with pytest.raises(ConfigurationError, match="batch does nothing: 'lonely' shares"):
        fly(batch=64)
