"""What a campaign says in the terminal."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from terrafix.cosim.campaign.outcome import Outcome, command
from terrafix.cosim.campaign.statistics.ensemble import facts_of
from terrafix.cosim.campaign.statistics.moments import EndRow, end_rows
from terrafix.cosim.campaign.verdict import Verdict
from terrafix.cosim.show.numbers import number, shown_unit

_STYLES = {"consistent": "bold green", "undecided": "bold yellow"}
NAMED = 5
WIDTH, ROWS, EVALUATIONS = 100, 15, 3
"""Of what is shown at a prompt: characters, rows of tables, evaluation components."""


def campaign_tables(
    result: Outcome, system: str, settings: Sequence[tuple[str, str]] = ()
) -> list[Any]:
    """What a person wants to know of a campaign, as rich renderables in the order of reading.

    `system` and `settings` are the file and what was set, to be repeated.
    """
    shown = overview(result)
    repeat = command(system, settings, runs=result.runs, seed=result.seed, duration=result.duration)
    text = f"repeat any run alone: {repeat} --member K --out member.nc"
    shown.append(Text(text, style="dim", no_wrap=True))
    if result.out is not None:
        shown.append(Text(f"wrote {result.out}; terrafix report {result.out}", style="dim"))
    return shown


def overview(result: Outcome, *, brief: bool = False) -> list[Any]:
    """The same without what to do next; on one screen, if `brief`."""
    header = Text(f"{result.system}: {result.runs} runs", style="bold")
    facts = [
        f"{result.wall_s:.2f} s (set up in {result.setup_s:.2f} s)",
        result.workers,
        f"kernel {result.kernel}",
        f"seed {result.seed}",
    ]
    header.append(f", {', '.join(facts)}", style="not bold")
    shown: list[Any] = [header]
    several = len(result.statistics)
    n_shown = min(several, EVALUATIONS) if brief else several
    for path, statistics in list(result.statistics.items())[:n_shown]:
        if several > 1:
            shown.append(Text(f"\n{path}", style="bold"))
        summary = statistics.summary()
        shown.append(_table(list(end_rows(summary)), ROWS // n_shown if brief else None))
        shown += [Text(line) for line in _aligned(facts_of(summary, statistics.present))]
        if path in result.verdicts:
            shown.append(_verdict(result.verdicts[path]))
    rest = [f"{path} ({verdict.text})" for path, verdict in result.verdicts.items()][n_shown:]
    if rest:
        shown.append(Text(f"\nand {', '.join(rest)}"))
    return shown + [Text(line) for line in _failures(result, NAMED if brief else None)]


def as_text(result: Outcome) -> str:
    """A screen of plain text."""
    return _console(result).export_text().rstrip()


def as_html(result: Outcome) -> str:
    """The same for a notebook."""
    frame = '<pre style="line-height: 1.3">{code}</pre>'
    return _console(result).export_html(inline_styles=True, code_format=frame)


def _console(result: Outcome) -> Console:
    console = Console(
        file=io.StringIO(), record=True, width=WIDTH, force_jupyter=False, legacy_windows=False
    )
    console.print(*overview(result, brief=True), sep="\n")
    return console


def _table(found: list[EndRow], rows: int | None) -> Padding:
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
    for row in found[:rows]:
        unit, factor = shown_unit(row.unit)
        values = (row.mean_error, row.standard_error, row.sigma_sample, row.sigma_predicted)
        table.add_row(
            row.quantity if row.first else "",
            row.axis,
            unit if row.first else "",
            *(number(None if v is None else v * factor) for v in values),
            number(row.ratio, 3),
            "-" if row.interval is None else "{:.2f}-{:.2f}".format(*row.interval),
        )
    if len(found[:rows]) < len(found):
        table.add_row(f"and {len(found) - len(found[:rows])} more")
    return Padding(table, (1, 0))


def _aligned(facts: Iterable[tuple[str, str]]) -> list[str]:
    pairs = list(facts)
    width = max((len(term) for term, _ in pairs), default=0)
    return [f"{term:{width}}  {text}" for term, text in pairs]


def _verdict(verdict: Verdict) -> Text:
    text = Text("verdict: ")
    text.append(verdict.text, style=_STYLES.get(verdict.words[0], "bold red"))
    if not verdict.findings:
        return text.append(f" ({verdict.reasons[0]})")
    return text.append("".join(f"\n  {reason}" for reason in verdict.reasons))


def _failures(result: Outcome, most: int | None) -> Iterator[str]:
    if not result.n_excluded:
        return
    yield f"{result.n_excluded} of {result.runs} members failed and are left out from then on:"
    for reason, count in list(result.reasons.items())[:most]:
        members = [str(e["member"]) for e in result.excluded if e["reason"] == reason]
        more = ", ..." if len(members) > NAMED else ""
        yield f"  {count}: {reason} (members {', '.join(members[:NAMED])}{more})"
    if most is not None and len(result.reasons) > most:
        yield f"  and {len(result.reasons) - most} other reasons"
