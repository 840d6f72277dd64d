"""What a campaign says in the terminal."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rich import box
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from terrafix.cosim.campaign.verdict import Verdict
from terrafix.cosim.show.numbers import number, shown_unit

if TYPE_CHECKING:
    from terrafix.cosim.campaign.results import CampaignResult

_STYLES = {"consistent": "bold green", "undecided": "bold yellow"}
NAMED = 5


def campaign_tables(result: CampaignResult, system: str) -> list[Any]:
    """What a person wants to know of a campaign, as rich renderables in the order of reading."""
    header = Text(f"{result.system}: {result.runs} runs", style="bold")
    facts = [
        f"{result.wall_s:.2f} s (set up in {result.setup_s:.2f} s)",
        result.workers,
        f"kernel {result.kernel}",
        f"seed {result.seed}",
    ]
    header.append(f", {', '.join(facts)}", style="not bold")
    shown: list[Any] = [header]
    summary = result.summary()["evaluation"]
    each = summary if len(result.statistics) > 1 else dict.fromkeys(result.statistics, summary)
    for path, evaluation in each.items():
        if len(result.statistics) > 1:
            shown.append(Text(f"\n{path}", style="bold"))
        shown.append(_table(evaluation))
        shown += [Text(line) for line in _lines(evaluation)]
        shown.append(_verdict(result.verdicts[path]))
    shown += [Text(line) for line in _failures(result)]
    repeat = f"terrafix campaign {shlex.quote(system)} --runs {result.runs} --seed {result.seed}"
    shown.append(Text(f"repeat any run alone: {repeat} --member K --out member.nc", style="dim"))
    if result.out is not None:
        shown.append(Text(f"wrote {result.out}; terrafix report {result.out}", style="dim"))
    return shown


def _table(evaluation: Mapping[str, Any]) -> Padding:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in ("at the end", "axis", "unit"):
        table.add_column(column)
    for column in (
        "mean error",
        "std. error",
        "sample sigma",
        "predicted",
        "ratio",
        "in (95 %)",
    ):
        table.add_column(column, justify="right")
    for name, q in evaluation.items():
        if not isinstance(q, Mapping) or "sigma_sample" not in q:
            continue
        unit, factor = shown_unit(q["unit"])
        for i, axis in enumerate(q["axes"]):
            low, high = q["ratio_interval_95"][i]
            values = [
                q[k][i] for k in ("mean_error", "standard_error", "sigma_sample", "sigma_predicted")
            ]
            table.add_row(
                name if i == 0 else "",
                axis,
                unit if i == 0 else "",
                *(number(None if v is None else v * factor) for v in values),
                number(q["ratio"][i], 3),
                f"{low:.2f}-{high:.2f}" if low is not None else "-",
            )
    return Padding(table, (1, 0))


def _lines(evaluation: Mapping[str, Any]) -> Iterator[str]:
    for name in ("nees", "nis"):
        c = evaluation.get(name)
        if c and c["mean"] is not None:
            low, high = c["interval_95"]
            yield (
                f"{name.upper():5} {number(c['mean'])} on average, expected {number(c['dof'])}, "
                f"95 % interval {number(low)} to {number(high)}; "
                f"{c['fraction_inside']:.0%} of the epochs inside theirs"
            )
    white = evaluation.get("whiteness")
    if white:
        values = ", ".join(number(v, 2) for v in white["correlation"])
        yield f"correlation of successive innovations {values}"


def _verdict(verdict: Verdict) -> Text:
    style = _STYLES.get(verdict.words[0], "bold red")
    text = Text("verdict: ")
    text.append(verdict.text, style=style)
    if not verdict.findings:
        text.append(f" ({verdict.tests} tests at a level of 1 % in all)")
    for finding in verdict.findings:
        text.append(f"\n  {finding.word}: {finding.text}")
    return text


def _failures(result: CampaignResult) -> Iterator[str]:
    if not result.n_excluded:
        return
    yield f"{result.n_excluded} of {result.runs} members failed and are left out from then on:"
    for reason, count in result.reasons.items():
        members = [str(e["member"]) for e in result.excluded if e["reason"] == reason]
        more = ", ..." if len(members) > NAMED else ""
        yield f"  {count}: {reason} (members {', '.join(members[:NAMED])}{more})"
