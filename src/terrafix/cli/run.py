"""``terrafix run``: a system flown once, or as an ensemble."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

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
from terrafix.cli.output import FAILED, print_json, show
from terrafix.cli.watch import watch_foreign_code
from terrafix.cosim.basics.errors import ConfigurationError, StepError, TerrafixError

if TYPE_CHECKING:
    from terrafix.cosim.engine.result import Result
    from terrafix.cosim.system.system import System

FIGURES = (".png", ".svg", ".pdf")


@click.command()
@system_argument
@click.option("--members", type=click.IntRange(min=1), metavar="N", help="Size of the ensemble.")
@set_option
@seed_option
@duration_option
@epoch_option
@click.option("--out", metavar="FILE.nc", help="Write records to a NetCDF file.")
@click.option("--plot", metavar="FILE.png", help="Draw the result (.png, .svg or .pdf).")
@click.option("--checkpoint-every", metavar="S", help="Simulated seconds between checkpoints.")
@click.option("--resume", metavar="FILE", help="Continue from a checkpoint.")
@json_option
@quiet_option
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

    target, figure = target_of("--out", out, (".nc",)), target_of("--plot", plot, FIGURES)

    def say_kernel() -> None:
        from terrafix.cosim.kernels.toolchain import describe

        if not quiet and any(c.capabilities.symbolic for c in loaded.flatten().components.values()):
            print(describe(), file=sys.stderr)

    shown = not quiet and stderr_is_terminal()
    failure: StepError | None = None
    with ProgressBar(shown=shown, first="preparing"):
        loaded = read(system, settings)
        if figure is not None:
            _drawable(loaded)
    watch_foreign_code(loaded)
    with ProgressBar(shown=shown, first="preparing", on_running=say_kernel) as progress:
        from terrafix.cosim.engine.run import RunError, simulate

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
        print_json(result.summary() | files)
    else:
        from terrafix.cosim.engine.display import result_tables

        show(*result_tables(result))
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
