"""``terrafix campaign | lincov | report``: many members, what is foretold of them, the page."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from terrafix.cli.options import (
    Settings,
    duration_option,
    epoch_option,
    json_option,
    quiet_option,
    read,
    seed_option,
    set_option,
    system_argument,
    target_of,
)
from terrafix.cli.output import print_json, show
from terrafix.cli.watch import watch_foreign_code
from terrafix.cosim.basics.errors import ConfigurationError


@click.command()
@system_argument
@click.option("--runs", type=click.IntRange(min=1), metavar="N", help="Members of the campaign.")
@set_option
@seed_option
@duration_option
@epoch_option
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Processes to fly it.")
@click.option("--dask", metavar="ADDRESS|local:N", help="Fly it on a Dask cluster.")
@click.option("--out", metavar="DIR", help="Folder to keep the campaign in.")
@click.option("--resume", is_flag=True, help="Complete what is in --out.")
@click.option("--histories", is_flag=True, help="Keep full records of all members, in --out.")
@click.option("--member", type=click.IntRange(min=0), metavar="K", help="Repeat one member alone.")
@json_option
@quiet_option
def campaign(
    system: str,
    runs: int | None,
    settings: Settings,
    seed: int | None,
    duration: str | None,
    workers: int | None,
    dask: str | None,
    out: str | None,
    resume: bool,
    histories: bool,
    member: int | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Fly many members of a system, and judge its filter.

    With --member K, fly that member alone, with full records: to --out FILE.nc.
    """
    from terrafix.cli.progress import ProgressBar, stderr_is_terminal

    if dask is not None and workers is not None:
        raise ConfigurationError(
            "--dask and --workers both say who flies the campaign\n  give one of them"
        )
    runs = _runs(runs, out, resume=resume)
    if dask is None:
        kept = "is not kept: give --out DIR" if out is None else f"is kept in {out}: give --resume"
        watch_foreign_code(
            read(system, settings),
            "with isolate = true it has one of its own, and costs no more than the members that it "
            f"fails\n  what was done until then {kept}",
        )
    if member is not None:
        return _one_member(
            system, settings, member, runs, seed=seed, duration=duration, out=out, as_json=as_json
        )
    with ProgressBar(shown=not quiet and stderr_is_terminal(), first="preparing") as progress:
        from terrafix.cosim.campaign.batch import FileSource
        from terrafix.cosim.campaign.campaign import run_campaign
        from terrafix.cosim.exchange.ssp.packages import is_package

        packed = is_package(Path(system))
        source = read(system, settings) if packed else FileSource(str(system), tuple(settings))
        result = run_campaign(
            source,
            runs=runs,
            seed=seed,
            duration=duration,
            workers=workers,
            dask=dask,
            out=out,
            resume=resume,
            histories=histories,
            progress=progress,
        )
    if as_json:
        print_json(result.summary())
    else:
        from terrafix.cosim.campaign.display import campaign_tables

        show(*campaign_tables(result, system, settings))
    return 0


def _runs(runs: int | None, out: str | None, *, resume: bool) -> int:
    """How many members: as said, or as the folder says that is resumed."""
    if runs is not None:
        return runs
    if resume and out is not None:
        from terrafix.cosim.campaign.store import read_manifest

        return int(read_manifest(Path(out))["runs"])
    raise ConfigurationError("a campaign needs a number of members\n  give --runs 100")


def _one_member(
    system: str,
    settings: Settings,
    member: int,
    runs: int,
    *,
    seed: int | None,
    duration: str | None,
    out: str | None,
    as_json: bool,
) -> int:
    from terrafix.cosim.engine.display import result_tables
    from terrafix.cosim.engine.run import simulate

    if member >= runs:
        raise ConfigurationError(
            f"there is no member {member} among {runs} runs\n  members are numbered from 0"
        )
    target = target_of("--out", out, (".nc",))
    result = simulate(
        read(system, settings),
        members=[member],
        runs=runs,
        seed=seed,
        duration=duration,
        out=target,
    )
    if as_json:
        print_json(result.summary())
    else:
        show(*result_tables(result))
    return 0


@click.command()
@system_argument
@set_option
@duration_option
@epoch_option
@json_option
def lincov(system: str, settings: Settings, duration: str | None, as_json: bool) -> int:
    """Predict a campaign by linear covariance analysis: sigma, error budget, observability."""
    from terrafix.cosim.lincov.deviations import linear_covariance
    from terrafix.cosim.lincov.display import prediction_tables, summary

    loaded = read(system, settings)
    found = linear_covariance(loaded, duration=duration)
    if as_json:
        print_json(summary(found))
    else:
        show(*prediction_tables(loaded.name, found))
    return 0


@click.command()
@click.argument("result", metavar="RESULT")
@click.option("-o", "--out", metavar="FILE.html", help="The page; RESULT/report.html if absent.")
@click.option("--figures", metavar="DIR", help="Write each figure to a file in this folder too.")
@click.option(
    "--format", "form", type=click.Choice(["png", "svg", "pdf"]), default="png", help="Of figures."
)
@click.option("--no-lincov", is_flag=True, help="Leave out the linear covariance analysis.")
@json_option
def report(
    result: str, out: str | None, figures: str | None, form: str, no_lincov: bool, as_json: bool
) -> int:
    """Write the page of a campaign: statistics, figures, error budget, how to repeat it."""
    from terrafix.cosim.report.figures import save_figures
    from terrafix.cosim.report.report import write_report

    target = target_of("-o", out, (".html", ".htm"))
    path, campaign_read = write_report(result, target, analyze=not no_lincov)
    written = [path]
    if figures is not None:
        several = len(campaign_read.paths) > 1
        for name in campaign_read.paths:
            folder = Path(figures, name) if several else Path(figures)
            prediction = campaign_read.prediction
            mine = prediction if prediction is not None and prediction.path == name else None
            part = campaign_read.part(name)
            written += save_figures(part, folder, form=form, prediction=mine)
    if as_json:
        print_json({"written": [str(p) for p in written], "notes": campaign_read.notes})
    else:
        for each in written:
            print(f"wrote {each}")
        for note in campaign_read.notes:
            print(f"note: {note}", file=sys.stderr)
    return 0
