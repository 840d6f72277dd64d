"""The command line: ``terrafix run | check | graph | components | export-fmu | check-fmu | ssp``.

Exit status: 0 fine, 1 a run failed, 2 bad input. With ``--json`` standard output is exactly one
JSON object; everything else goes to standard error. Nothing heavy is imported before a command
needs it, so that ``terrafix --help`` is immediate.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from terrafix.cosim.basics.errors import (
    ConfigurationError,
    StepError,
    SystemCheckError,
    TerrafixError,
)

if TYPE_CHECKING:
    from terrafix.cosim.engine.result import Result
    from terrafix.cosim.system.system import System

FAILED, REFUSED = 1, 2
MOST_SHOWN = 6  # findings of one check
FIGURES = (".png", ".svg", ".pdf")
DIAGRAMS = (".svg", ".png", ".mmd")
Command = TypeVar("Command", bound=Callable[..., Any])
Settings = tuple[tuple[str, str], ...]


class Cli(click.Group):
    """A command group that reports errors and sets the exit status by the rules above."""

    def main(  # type: ignore[override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **options: Any
    ) -> None:
        """Run the command line and leave with an exit status."""
        words = list(sys.argv[1:] if args is None else args)
        options["standalone_mode"] = False
        try:
            status = super().main(words, prog_name or "terrafix", **options) or 0
        except Exception as error:
            status = _report(error, as_json="--json" in words)
        sys.exit(status)


def _report(error: Exception, *, as_json: bool) -> int:
    """Explain an error on standard error (and as JSON), and return the exit status."""
    status, problems = REFUSED, [error]
    if isinstance(error, SystemCheckError):
        problems = list(error.problems)
        text = str(error)
    elif isinstance(error, TerrafixError):
        status = FAILED if isinstance(error, StepError) else REFUSED
        text = f"{type(error).__name__}: {error}"
    elif isinstance(error, click.Abort):
        status, text = FAILED, "interrupted"
    elif isinstance(error, click.ClickException):
        text = ""
        error.show()
    else:
        status = FAILED
        text = (
            f"{type(error).__name__}: {' '.join(str(error).split())}: this is a bug in terrafix; "
            "TERRAFIX_TRACEBACK=1 shows where"
        )
        if os.environ.get("TERRAFIX_TRACEBACK"):
            import traceback

            traceback.print_exception(error)
    if text:
        print(text, file=sys.stderr)
    if as_json:
        described = [{"type": type(p).__name__, "message": _message(p)} for p in problems]
        refused: dict[str, Any] = {"error": {"status": status, "problems": described}}
        if isinstance(error, SystemCheckError):
            refused |= {"system": error.system, "ok": False, "problems": described}
        _print_json(refused)
    return status


def _message(error: Exception) -> str:
    if isinstance(error, click.Abort):
        return "interrupted"
    return error.format_message() if isinstance(error, click.ClickException) else str(error)


def _print_json(content: dict[str, Any]) -> None:
    import json

    print(json.dumps(plain(content), allow_nan=False))


def plain(value: Any) -> Any:
    """Turn a value into what JSON can hold; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):  # NumPy arrays and numbers
        return plain(value.tolist())
    if isinstance(value, float):
        return value if value - value == 0.0 else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


# ------------------------------------------------------------------------- shared by commands


def _pairs(
    context: click.Context,  # noqa: ARG001 - click's signature
    parameter: click.Parameter,  # noqa: ARG001
    values: tuple[str, ...],
) -> Settings:
    pairs = []
    for text in values:
        path, equals, value = text.partition("=")
        if not equals or not path.strip():
            raise ConfigurationError(
                f"--set '{text}' sets nothing\n  write --set PATH=VALUE, as in --set duration=10"
            )
        pairs.append((path.strip(), value.strip()))
    return tuple(pairs)


_system = click.argument("system", metavar="SYSTEM.toml")
_set = click.option(
    "--set",
    "settings",
    metavar="PATH=VALUE",
    multiple=True,
    callback=_pairs,
    help="Set a parameter, a choice or a key of the system; may be given again.",
)
_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def _target(option: str, text: str | None, suffixes: tuple[str, ...]) -> Path | None:
    """The file an option names, refused now if it could not be written later."""
    if text is None:
        return None
    if not text.strip():
        raise ConfigurationError(f"{option} names no file\n  name one, or leave {option} out")
    path = Path(text)
    if path.suffix.lower() not in suffixes:
        raise ConfigurationError(
            f"{option} '{text}' is no {' or '.join(suffixes)} file\n"
            f"  its ending says what is written: name it '{path.with_suffix(suffixes[0]).name}'"
        )
    probe = path.with_name(f".{path.name}.{os.getpid()}.probe")
    try:
        if path.is_dir():
            raise ConfigurationError(f"{option} '{text}' is a folder; name a file in it")
        if not path.parent.is_dir():
            raise ConfigurationError(
                f"cannot write {option} '{text}': there is no folder '{path.parent}'"
            )
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigurationError(f"cannot write {option} '{text}': {error.strerror}") from error
    return path


def _read(path: str, settings: Settings, *, outside: bool = False) -> System:
    if Path(path).suffix.lower() == ".ssp":
        from terrafix.cosim.exchange.ssp.reading import read_ssp

        if settings:
            raise ConfigurationError(
                f"--set does not reach into '{path}'\n"
                "  terrafix ssp import writes it as a system file, where everything can be set"
            )
        return read_ssp(path)
    from terrafix.cosim.files.reading import read_system

    return read_system(path, settings, outside=outside)


def _show(*renderables: Any) -> None:
    """Print for a person; wide enough for tables where nobody's terminal says otherwise."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = 100
    console.print(*renderables, sep="\n")


# ------------------------------------------------------------------------- commands


@click.group(cls=Cli, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="terrafix", prog_name="terrafix")
def main() -> None:
    """Fly, check, draw and list systems of terrain-relative navigation.

    Exit status: 0 fine, 1 a run failed, 2 bad input.
    """


@main.command()
@_system
@click.option("--members", type=click.IntRange(min=1), metavar="N", help="Size of the ensemble.")
@_set
@click.option("--seed", type=click.IntRange(min=0), metavar="N", help="Root seed.")
@click.option("--duration", metavar="S", help='Simulated time, exact: "590.4" or "10 min".')
@click.option("--out", metavar="FILE.nc", help="Write records to a NetCDF file.")
@click.option("--plot", metavar="FILE.png", help="Draw the result (.png, .svg or .pdf).")
@click.option("--checkpoint-every", metavar="S", help="Simulated seconds between checkpoints.")
@click.option("--resume", metavar="FILE", help="Continue from a checkpoint.")
@_json
@click.option("--quiet", is_flag=True, help="Nothing but errors on standard error.")
def run(
    system: str,
    members: int | None,
    settings: Settings,
    seed: int | None,
    duration: str | None,
    out: str | None,
    plot: str | None,
    checkpoint_every: str | None,
    resume: str | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Run a system, once or as an ensemble."""
    from terrafix.cli.progress import ProgressBar, stderr_is_terminal

    target, figure = _target("--out", out, (".nc",)), _target("--plot", plot, FIGURES)

    def say_kernel() -> None:
        from terrafix.cosim.kernels.toolchain import describe

        if not quiet and any(c.capabilities.symbolic for c in loaded.flatten().components.values()):
            print(describe(), file=sys.stderr)

    shown = not quiet and stderr_is_terminal()
    failure: StepError | None = None
    with ProgressBar(shown=shown, first="preparing", on_running=say_kernel) as progress:
        from terrafix.cosim.engine.run import RunError, simulate

        loaded = _read(system, settings)
        if figure is not None:
            _drawable(loaded)
        try:
            result = simulate(
                loaded,
                members=members,
                seed=seed,
                duration=duration,
                out=target,
                checkpoint_every=checkpoint_every,
                resume=resume,
                progress=progress,
            )
        except RunError as error:
            failure, result = error, error.result
        except TerrafixError as error:
            if progress.running:  # it was no bad input: a disk that is full, say
                raise StepError(str(error)) from error
            raise
        drawn = figure is not None and _draw(result, figure, failed=failure is not None)
    if as_json:
        files = {"out": result.out, "plot": figure if drawn else None}
        _print_json(result.summary() | files)
    else:
        from terrafix.cosim.engine.display import result_tables

        _show(*result_tables(result))
    if not quiet:
        for note in result.notes:
            print(f"note: {note}", file=sys.stderr)
        written = [result.out] if result.out else []
        for path in [*written, figure] if drawn else written:
            print(f"wrote {path}", file=sys.stderr)
    if failure is not None:
        stopped = isinstance(failure.__cause__, KeyboardInterrupt)
        print(failure if stopped else f"StepError: {failure}", file=sys.stderr)
    return 0 if failure is None else FAILED


def _drawable(system: System) -> None:
    """Refuse to draw a system that records nothing, before it runs."""
    from terrafix.cosim.declare.evaluation import Evaluation

    flat = system.flatten()
    if not flat.records and not any(isinstance(c, Evaluation) for c in flat.components.values()):
        raise ConfigurationError(
            f"--plot: system '{system.name}' records nothing that could be drawn\n"
            "  add a [record.NAME] with ports, or an evaluation component"
        )


def _draw(result: Result, figure: Path, *, failed: bool) -> bool:
    from terrafix.cosim.show.plots import plot_result

    try:
        plot_result(result.dataset, figure)
    except ConfigurationError as error:
        if not failed:
            raise StepError(f"the run is complete, but {error}") from error
        return False  # a run that failed at its start has nothing to show
    return True


@main.command()
@_system
@click.option("--runs", type=click.IntRange(min=1), metavar="N", help="Members of the campaign.")
@_set
@click.option("--seed", type=click.IntRange(min=0), metavar="N", help="Root seed.")
@click.option("--duration", metavar="S", help='Simulated time, exact: "590.4" or "10 min".')
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Processes to fly it.")
@click.option("--dask", metavar="ADDRESS|local:N", help="Fly it on a Dask cluster.")
@click.option("--out", metavar="DIR", help="Folder to keep the campaign in.")
@click.option("--resume", is_flag=True, help="Complete what is in --out.")
@click.option("--histories", is_flag=True, help="Keep full records of all members, in --out.")
@click.option("--member", type=click.IntRange(min=0), metavar="K", help="Repeat one member alone.")
@_json
@click.option("--quiet", is_flag=True, help="Nothing but errors on standard error.")
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
    if member is not None:
        return _one_member(
            system, settings, member, runs, seed=seed, duration=duration, out=out, as_json=as_json
        )
    with ProgressBar(shown=not quiet and stderr_is_terminal(), first="preparing") as progress:
        from terrafix.cosim.campaign.batch import FileSource
        from terrafix.cosim.campaign.campaign import run_campaign

        ssp = Path(system).suffix.lower() == ".ssp"
        source = _read(system, settings) if ssp else FileSource(str(system), tuple(settings))
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
        _print_json(result.summary())
    else:
        from terrafix.cosim.campaign.display import campaign_tables

        _show(*campaign_tables(result, system))
    return 0


@main.command()
@_system
@_set
@click.option("--duration", metavar="S", help='Simulated time, exact: "590.4" or "10 min".')
@_json
def lincov(system: str, settings: Settings, duration: str | None, as_json: bool) -> int:
    """Predict a campaign by linear covariance analysis: sigma, error budget, observability."""
    from terrafix.cosim.lincov.deviations import linear_covariance
    from terrafix.cosim.lincov.display import prediction_tables, summary

    loaded = _read(system, settings)
    found = linear_covariance(loaded, duration=duration)
    if as_json:
        _print_json(summary(found))
    else:
        _show(*prediction_tables(loaded.name, found))
    return 0


@main.command()
@click.argument("result", metavar="RESULT")
@click.option("-o", "--out", metavar="FILE.html", help="The page; RESULT/report.html if absent.")
@click.option("--figures", metavar="DIR", help="Write each figure to a file in this folder too.")
@click.option(
    "--format", "form", type=click.Choice(["png", "svg", "pdf"]), default="png", help="Of figures."
)
@click.option("--no-lincov", is_flag=True, help="Leave out the linear covariance analysis.")
@_json
def report(
    result: str, out: str | None, figures: str | None, form: str, no_lincov: bool, as_json: bool
) -> int:
    """Write the page of a campaign: statistics, figures, error budget, how to repeat it."""
    from terrafix.cosim.report.figures import save_figures
    from terrafix.cosim.report.report import write_report

    target = _target("-o", out, (".html", ".htm"))
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
        _print_json({"written": [str(p) for p in written], "notes": campaign_read.notes})
    else:
        for each in written:
            print(f"wrote {each}")
        for note in campaign_read.notes:
            print(f"note: {note}", file=sys.stderr)
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
    target = _target("--out", out, (".nc",))
    result = simulate(
        _read(system, settings),
        members=[member],
        runs=runs,
        seed=seed,
        duration=duration,
        out=target,
    )
    if as_json:
        _print_json(result.summary())
    else:
        _show(*result_tables(result))
    return 0


@main.command()
@_system
@_set
@_json
def check(system: str, settings: Settings, as_json: bool) -> None:
    """Find every mistake in a system, and say what it consists of."""
    plan = _read(system, settings).check()
    if as_json:
        _print_json(plan.content())
    else:
        _show(plan)


@main.command()
@_system
@_set
@click.option("-o", "out", metavar="FILE", help="Write .svg, .png or .mmd (Mermaid) there.")
def graph(system: str, settings: Settings, out: str | None) -> None:
    """Draw a system; without -o, print it as Mermaid text."""
    target = _target("-o", out, DIAGRAMS)
    diagram = _read(system, settings).graph()
    if target is None:
        print(diagram)
    else:
        diagram.save(target)


@main.command()
@click.argument("kind", metavar="[TYPE]", required=False)
@_json
def components(kind: str | None, as_json: bool) -> None:
    """List component types, or the parameters and ports of one type."""
    from terrafix.cosim.declare import listing

    content = listing.types_content() if kind is None else listing.type_content(kind)
    if as_json:
        _print_json(content)
    elif kind is None:
        _show(*listing.types_tables(content))
    else:
        _show(*listing.type_tables(content))


# ------------------------------------------------------------------------- exchange


@main.command("export-fmu")
@click.argument("what", metavar="SYSTEM.toml[:COMPONENT]")
@click.option("-o", "out", metavar="FILE.fmu", required=True, help="The file to write.")
@click.option("--fmi", type=click.Choice(["2", "3"]), default="3", help="Version of the standard.")
@click.option(
    "--platforms",
    metavar="host|all|LIST",
    default="host",
    help="Whose binaries it carries; all but the host's own need zig.",
)
@_set
@_json
def export_fmu_command(
    what: str, out: str, fmi: str, platforms: str, settings: Settings, as_json: bool
) -> None:
    """Export a component, or a whole symbolic system, as an FMU."""
    from terrafix.cosim.exchange.fmi.write.export import checked_target, export_fmu

    checked_target(out)
    path, component = _named(what)
    loaded = _read(path, settings, outside=True)
    made = export_fmu(loaded, out, component=component, fmi=int(fmi), platforms=platforms)
    if as_json:
        _print_json(made.summary())
        return
    _show(
        f"{made.model}: FMI {made.fmi}, {' and '.join(made.kinds)}; {made.inputs} inputs, "
        f"{made.outputs} outputs, {made.parameters} parameters; steps are multiples of "
        f"{made.step_s} s; binaries for {', '.join(made.platforms)}"
    )
    print(f"wrote {made.path}", file=sys.stderr)


def _named(what: str) -> tuple[str, str | None]:
    """Split ``SYSTEM.toml:COMPONENT``; a drive letter is no system."""
    head, colon, tail = what.rpartition(":")
    if colon and len(head) > 1 and "/" not in tail and "\\" not in tail:
        return head, tail
    return what, None


@main.command("check-fmu")
@click.argument("file", metavar="FILE.fmu")
@_json
def check_fmu_command(file: str, as_json: bool) -> int:
    """Check anybody's FMU: its description, its binaries, and what they do."""
    from terrafix.cli.progress import ProgressBar, stderr_is_terminal
    from terrafix.cosim.exchange.fmi.check.check import check_fmu

    with ProgressBar(shown=stderr_is_terminal(), first="checking") as progress:
        report = check_fmu(file, progress=progress)
    if as_json:
        _print_json(report.summary())
    else:
        kinds = " and ".join(report.kinds)
        _show(f"{report.model}: FMI {report.fmi}, {kinds}; checked: {', '.join(report.checks)}")
        shown: dict[str, int] = {}
        for found in [*report.findings, *report.notes]:
            shown[found.check] = shown.get(found.check, 0) + 1
            if shown[found.check] == MOST_SHOWN + 1:
                print(f"  more of '{found.check}': --json lists all")
            if shown[found.check] > MOST_SHOWN:
                continue
            print(f"{found.severity}: {found.check}: {found.where}: {found.what}")
            if found.why:
                print(f"  {found.why}")
        count = len(report.findings)
        print("no findings" if not count else f"{count} finding{'s' if count > 1 else ''}")
    return 0 if report.ok else FAILED


@main.group()
def ssp() -> None:
    """Write systems as SSP packages, and read them."""


@ssp.command("export")
@_system
@click.option("-o", "out", metavar="FILE.ssp", required=True, help="The file to write.")
@click.option("--platforms", metavar="host|all|LIST", default="host", help="As in export-fmu.")
@click.option(
    "--leave-out",
    metavar="COMPONENT",
    multiple=True,
    help="Do not package a component that only observes; may be given again.",
)
@_set
@_json
def ssp_export(
    system: str,
    out: str,
    platforms: str,
    leave_out: tuple[str, ...],
    settings: Settings,
    as_json: bool,
) -> None:
    """Write a system as a package of FMUs (FMI 2)."""
    from terrafix.cosim.exchange.fmi.write.export import checked_target
    from terrafix.cosim.exchange.ssp.export import export_ssp

    checked_target(out, ".ssp")
    made = export_ssp(
        _read(system, settings, outside=True), out, platforms=platforms, leave_out=leave_out
    )
    if as_json:
        _print_json(made.summary())
        return
    _show(f"{len(made.components)} components, {made.connections} scalar connections")
    if made.delayed:
        print(
            f"note: masters that exchange values after each step delay {len(made.delayed)} "
            "connections by one step that are read at its end here:",
            file=sys.stderr,
        )
        for connection in made.delayed:
            print(f"  {connection}", file=sys.stderr)
    print(f"wrote {made.path}", file=sys.stderr)


@ssp.command("import")
@click.argument("file", metavar="FILE.ssp")
@click.option("-o", "out", metavar="SYSTEM.toml", required=True, help="The file to write.")
def ssp_import(file: str, out: str) -> None:
    """Write a package as a system file, its FMUs beside it."""
    from terrafix.cosim.exchange.fmi.write.export import checked_target
    from terrafix.cosim.exchange.ssp.reading import import_ssp

    target = checked_target(out, ".toml")
    folder = import_ssp(file, target)
    print(f"wrote {target} and {folder}", file=sys.stderr)
