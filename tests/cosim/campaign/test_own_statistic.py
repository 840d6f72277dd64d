"""A statistic of one's own: a class and a line, and it is in summary, dataset and display."""

import io
import json

import numpy as np
import pytest
from campaign_parts import scalar_system
from rich.console import Console

from terrafix.cosim.basics.errors import CheckpointError, ConfigurationError
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.campaign.display import campaign_tables
from terrafix.cosim.campaign.statistics.ensemble import STATISTICS
from terrafix.cosim.campaign.statistics.hypotheses import Finding
from terrafix.cosim.campaign.statistics.statistic import Statistic
from terrafix.cosim.report.report import write_report


class Largest(Statistic):
    """The largest error of any member at each epoch."""

    merged = ("largest",)

    def sum(self, members):
        """Of one block."""
        return {"largest": np.nanmax(np.abs(members.error), axis=1)}

    def merge(self, sums, block):
        """The larger one."""
        np.fmax(sums["largest"], block["largest"], out=sums["largest"])

    def columns(self, layout, sums):
        """As it is."""
        return {"largest_error": (("time", "axis"), sums["largest"])}

    def summarize(self, layout, sums):
        """Of all epochs."""
        return {"largest_error": sums["largest"].max(axis=0).tolist()}

    def facts(self, summary):
        """One sentence."""
        for most in summary.get("largest_error", []):
            yield "largest", f"error of any member {most:.3f}"


class Limit(Largest):
    """The same, judged."""

    families = ("limit",)

    def judge(self, layout, sums, share):
        """No member may be a meter off."""
        off = sums["largest"].max() > 1
        return [Finding("out of bounds", "a member is off", 0.0)] * int(off), 1


class Twin(Statistic):
    """Takes a name that is taken."""

    def sum(self, members):
        """As moments do."""
        return {"n": members.valid.sum(axis=1)}


@pytest.fixture
def listed():
    """Put statistics in the list, for one test."""
    before = list(STATISTICS)
    yield STATISTICS.append
    STATISTICS[:] = before


def fly(runs=300, system=None, **options):
    return run_campaign(system or scalar_system(), runs=runs, batch=64, **options)


def shown(result):
    console = Console(record=True, width=120, file=io.StringIO())
    console.print(*campaign_tables(result, "system.toml"), sep="\n")
    return console.export_text()


def test_it_is_found_in_summary_dataset_display_and_page(listed, tmp_path):
    listed(Largest())
    result = fly(workers=2, out=tmp_path / "c")  # summed up by other processes
    dataset = result.dataset()
    largest = dataset["largest_error"]
    assert largest.dims == ("time", "axis")
    members = np.abs(dataset["error"].values)
    assert (largest.values >= members.max(axis=1)).all()
    assert fly(runs=128, workers=1).dataset()["largest_error"].values == pytest.approx(
        members.max(axis=1), abs=0
    )
    most = largest.values.max()
    assert json.loads(json.dumps(result.summary()))["evaluation"]["largest_error"] == [most]
    sentence = f"error of any member {most:.3f}"
    assert sentence in shown(result)
    assert sentence in repr(result)
    path, _ = write_report(tmp_path / "c")
    assert sentence in path.read_text()


def test_it_changes_nothing_else(listed):
    before = fly(workers=1)
    listed(Largest())
    after = fly(workers=1)
    assert after.verdicts == before.verdicts
    assert (
        after.dataset()
        .drop_vars("largest_error")
        .identical(before.dataset().assign_attrs(after.dataset().attrs))
    )


def test_it_speaks_in_the_verdict(listed):
    before = fly(workers=1).verdicts["judge"]
    listed(Limit())
    verdict = fly(workers=1).verdicts["judge"]
    assert (verdict.text, verdict.tests) == ("out of bounds", before.tests + 1)


def test_a_campaign_without_it_is_not_resumed_with_it(listed, tmp_path):
    fly(workers=1, out=tmp_path / "c")
    listed(Largest())
    with pytest.raises(CheckpointError, match=r"another statistics: None there, \['Largest'\]"):
        fly(workers=1, out=tmp_path / "c", resume=True)


def test_names_that_are_taken_are_refused(listed):
    listed(Twin())
    with pytest.raises(ConfigurationError, match="two statistics of a campaign both give 'n'"):
        fly(runs=2, workers=1)
